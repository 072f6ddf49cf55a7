"""The process that reads a mesh of others: `python mesh_process.py FORMAT FILE BYTES SECONDS`, arrays on its output.

It imports meshio and NumPy alone. BYTES are those of memory beyond what these take, SECONDS those of the processor.
"""

from __future__ import annotations

import contextlib
import os
import resource
import sys
from pathlib import Path
from typing import BinaryIO
from xml.etree import ElementTree  # noqa: F401  imported before the limit of memory, like the rest

import meshio
import numpy as np

TOO_LARGE = 3
"""Exit code of a process whose memory did not suffice."""


def triangles_of(form: str, path: str) -> dict[str, np.ndarray]:
    """The points (p×2) and triangles (t×3) in a file of one of meshio's formats; it raises anything, and exits."""
    mesh = meshio.read(path, form)
    corners = np.asarray(mesh.get_cells_type("triangle")).reshape(-1, 3)
    return {"points": np.asarray(mesh.points, float)[:, :2], "triangles": corners}


def main(out: BinaryIO, form: str, path: str, size: str, seconds: str) -> None:
    """Read a mesh under limits and write its arrays."""
    statm = Path("/proc/self/statm")
    taken = int(statm.read_text().split()[0]) * resource.getpagesize() if statm.is_file() else 2**30
    for limit, most in ((resource.RLIMIT_AS, taken + int(size)), (resource.RLIMIT_CPU, int(seconds))):
        hard = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    try:
        np.savez(out, allow_pickle=False, **triangles_of(form, path))
    except MemoryError:
        sys.exit(TOO_LARGE)
    except SystemExit:
        sys.exit(f"it is damaged, or no file of the format '{form}'")
    except Exception as error:  # noqa: BLE001  meshio raises anything for damaged files
        sys.exit(f"{type(error).__name__}: {error}".replace("\n", " "))


if __name__ == "__main__":
    with os.fdopen(os.dup(1), "wb") as answer, contextlib.redirect_stdout(None):  # meshio prints
        main(answer, *sys.argv[1:])
