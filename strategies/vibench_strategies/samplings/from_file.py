"""Parameters in a file."""

from __future__ import annotations

import hashlib
from pathlib import Path
from stat import S_ISDIR, S_ISREG
from typing import Any
from unicodedata import normalize

import numpy as np

from vibench import Array, ParameterBox, RequestError, Sampling


class File(Sampling):
    """The rows of a file: an array of NumPy (.npy, P×d), or text with commas (.csv) under the parameters' names.

    Parameters
    ----------
    path
        The file, relative to the folder of the study file. The columns of a .csv may have any order.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def data_digest(cls, **options: Any) -> str:
        """Digest of the file."""
        return hashlib.sha256(_read(Path(options["path"]))).hexdigest()[:16]

    def parameters(self, box: ParameterBox) -> Array:
        """The rows in their order."""
        _read(self.path)
        try:
            if self.path.suffix == ".npy":
                with np.errstate(over="raise"):  # of the size that a header declares; it is that of the file at most
                    points: Array = np.array(np.lib.format.open_memmap(self.path, mode="r"))
                if points.dtype.kind not in "fiu":
                    raise RequestError(f"'{self.path}' holds values of the type {points.dtype}; expected real numbers")
                return points[:, None] if points.ndim == 1 and box.dim == 1 else points
            if self.path.suffix != ".csv":
                raise RequestError(f"'{self.path}' is neither a .csv nor a .npy file")
            head, *lines = self.path.read_text(encoding="utf-8-sig").strip().splitlines() or [""]
            names, known = ([normalize("NFKC", name.strip()) for name in row] for row in (head.split(","), box.names))
            if sorted(names) != sorted(known):
                raise RequestError(f"'{self.path}' has the columns {', '.join(names)}; expected {', '.join(box.names)}")
            rows = [[float(value) for value in line.split(",")] for line in lines]
            if any(len(row) != box.dim for row in rows):
                raise RequestError(f"'{self.path}' has a row without {box.dim} values")
            return np.array(rows).reshape(-1, box.dim)[:, [names.index(name) for name in known]]
        except (OSError, ValueError, ArithmeticError, MemoryError) as error:
            raise RequestError(f"'{self.path}' cannot be read: {error}") from None


def _read(path: Path) -> bytes:
    try:
        mode = path.stat().st_mode
        if not (S_ISREG(mode) or S_ISDIR(mode)):  # of a pipe or a device there is no end
            raise RequestError(f"'{path}' cannot be read: it is no regular file")
        return path.read_bytes()
    except OSError as error:
        raise RequestError(f"'{path}' cannot be read: {error.strerror}") from None
