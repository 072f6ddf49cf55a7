"""Meshes in files of others, read by meshio in a process that has limits of memory and time."""

from __future__ import annotations

import importlib.util
import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError, message_of
from vibench.text import one_line
from vibench.timing import ONE_THREAD

FORMATS = {
    ".msh": "gmsh", ".vtu": "vtu", ".vtk": "vtk", ".mesh": "medit", ".ply": "ply", ".stl": "stl", ".off": "off",
    ".obj": "obj",
}  # fmt: skip
"""meshio's names of the formats that are read, by the end of a file's name: those whose mesh is in one file.

Those that name other files (XDMF, Abaqus, TetGen, DOLFIN) or are HDF5, which may link to others, are not among them.
"""

SECONDS = 60
"""Seconds of the processor that reading a mesh may take."""

TOO_LARGE = 3
"""Exit code of the process where its memory did not suffice."""

WALL_SECONDS = 600
"""The same in wall seconds, of a busy machine."""


def format_of(path: Path) -> str:
    """The name that meshio has for the format of a file.

    Raises
    ------
    RequestError
        If it is not one of `FORMATS`.
    """
    if (form := FORMATS.get(path.suffix.lower())) is None:
        raise RequestError(
            f"'{path.name}' has a format that is not read; expected one whose mesh is in one file: {', '.join(FORMATS)}"
        )
    return form


def read_mesh(path: Path, limit: int) -> tuple[Array, Array]:
    """The points (p×2) and triangles (t×3) of a mesh; `limit` are the bytes of memory that reading it may take.

    The numbers of the triangles are of any type and any value.

    Raises
    ------
    RequestError
        If the format is not one of `FORMATS`, meshio is not installed, the file is damaged, or a limit is exceeded.
    """
    form = format_of(path)
    if importlib.util.find_spec("meshio") is None:
        raise RequestError("it needs meshio: pip install 'vibench[mesh]'")
    process = str(Path(__file__).with_name("mesh_process.py"))
    command = [sys.executable, "-P", process, form, str(path.absolute()), str(limit), str(SECONDS)]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=WALL_SECONDS,
            env={**os.environ, **ONE_THREAD},
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        raise RequestError(f"'{path.name}' cannot be read: {message_of(error)}") from None
    if done.returncode == 0:
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
            return arrays["points"], arrays["triangles"]
    said = done.stderr.decode(errors="replace").strip().splitlines() or ["it is damaged"]
    why = {
        TOO_LARGE: f"it takes more than the {limit / 2**30:.3g} GiB of memory that are allowed",
        -signal.SIGXCPU: f"it takes more than {SECONDS} s",
    }
    raise RequestError(f"'{path.name}' cannot be read: {why.get(done.returncode, one_line(said[-1]))}")
