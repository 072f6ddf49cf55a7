"""Meshes in files of others, read by meshio in a process that has limits of memory and time.

The process runs this module with the arguments FORMAT FILE BYTES SECONDS; arrays are on its output.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError, message_of
from vibench.guardian import guarded, new_environment
from vibench.text import one_line


def format_of(path: Path) -> str:
    """The name that meshio has for the format of a file; a `RequestError` if that is not read."""
    # Formats that name other files (XDMF, Abaqus, TetGen, DOLFIN) or are HDF5, which may link to others, are missing.
    formats = {
        ".msh": "gmsh", ".vtu": "vtu", ".vtk": "vtk", ".mesh": "medit", ".ply": "ply", ".stl": "stl", ".off": "off",
        ".obj": "obj",
    }  # fmt: skip
    if (form := formats.get(path.suffix.lower())) is None:
        expected = f"expected one whose mesh is in one file: {', '.join(formats)}"
        raise RequestError(f"'{path.name}' has a format that is not read; {expected}")
    return form


def read_mesh(path: Path, limit: int, seconds: int) -> tuple[Array, Array]:
    """The points (p×2) and triangles (t×3) of a mesh, read within bytes of memory and seconds of the processor."""
    # The numbers of the triangles are of any type and any value. A `RequestError` says why a mesh cannot be read.
    form = format_of(path)
    if importlib.util.find_spec("meshio") is None:
        raise RequestError("it needs meshio: pip install 'vibench[mesh]'")
    process = guarded(__name__, form, str(path.absolute()), str(limit), str(seconds), environment=new_environment())
    try:
        # A busy machine takes longer than the seconds of the processor; a process that sleeps ends, too.
        done = subprocess.run(**process, capture_output=True, check=False, timeout=600)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RequestError(f"'{path.name}' cannot be read: {message_of(error)}") from None
    if done.returncode == 0:
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
            return arrays["points"], arrays["triangles"]
    said = done.stderr.decode(errors="replace").strip().splitlines() or ["it is damaged"]
    why = {
        3: f"it takes more than the {limit / 2**30:.3g} GiB of memory that are allowed",
        -signal.SIGXCPU: f"it takes more than {seconds} s",
    }
    raise RequestError(f"'{path.name}' cannot be read: {why.get(done.returncode, one_line(said[-1]))}")


def triangles_of(form: str, path: str) -> dict[str, np.ndarray]:
    """The points (p×2) and triangles (t×3) in a file of one of meshio's formats; meshio raises anything, and exits."""
    import meshio  # noqa: PLC0415  optional

    mesh = meshio.read(path, form)
    corners = np.asarray(mesh.get_cells_type("triangle")).reshape(-1, 3)
    return {"points": np.asarray(mesh.points, float)[:, :2], "triangles": corners}


def main(out: BinaryIO, form: str, path: str, size: str, seconds: str) -> None:
    """Read a mesh and write its arrays, within bytes of memory beyond those taken and seconds of the processor."""
    # Imported before the limit of memory, which is for the mesh.
    import xml.etree.ElementTree  # noqa: F401, PLC0415

    import meshio  # noqa: F401, PLC0415

    statm = Path("/proc/self/statm")
    taken = int(statm.read_text().split()[0]) * resource.getpagesize() if statm.is_file() else 2**30
    for limit, most in ((resource.RLIMIT_AS, taken + int(size)), (resource.RLIMIT_CPU, int(seconds))):
        hard = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    try:
        np.savez(out, allow_pickle=False, **triangles_of(form, path))
    except MemoryError:
        # The exit code that `read_mesh` explains.
        sys.exit(3)
    except SystemExit:
        sys.exit(f"it is damaged, or no file of the format '{form}'")
    except Exception as error:  # noqa: BLE001  meshio raises anything for damaged files
        sys.exit(f"{type(error).__name__}: {error}".replace("\n", " "))


if __name__ == "__main__":
    # Standard output is for the arrays alone, and meshio prints.
    with os.fdopen(os.dup(1), "wb") as answer, contextlib.redirect_stdout(None):
        main(answer, *sys.argv[1:])
