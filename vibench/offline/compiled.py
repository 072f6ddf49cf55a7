"""Reduced models as machine code: their exported C source, compiled and loaded into this process.

A query is one call, from the parameter to the verified solution. A crash of the program ends the calling process, so
that runs call it in their workers.
"""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError, UnsupportedError, foreign
from vibench.files import scratch
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.model.chebyshev import AffinePolynomial
from vibench.model.hyperreduced import AnyReducedModel
from vibench.offline import c_source
from vibench.offline.polynomials import EVALUATIONS, TOLERANCE, member_polynomials
from vibench.qp.verification import QPSolution
from vibench.text import one_line


@dataclass(frozen=True)
class CompiledModel:
    """Data of the C source of a model: polynomials of A, f, B and g, the box (d,), the accuracy that it verifies."""

    members: Mapping[str, AffinePolynomial]
    lower: Array
    upper: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    accuracy: float

    @classmethod
    def of(cls, reduced: AnyReducedModel, accuracy: float) -> CompiledModel:
        """Interpolate the members of a reduced model.

        Raises an `UnsupportedError` if the basis depends on the parameter, or polynomials are inaccurate or too large.
        """
        try:
            _, polynomials = member_polynomials(reduced, TOLERANCE, EVALUATIONS, fixed=True, check=_refuse_large)
        except RequestError as error:
            raise UnsupportedError(f"the model cannot be exported to C: {error}") from None
        box, members = reduced.problem.parameters, {name: polynomials[name] for name in MEMBERS}
        # Store polynomials and not the source: who loads an artefact runs nothing that is in it.
        return cls(members, box.lower, box.upper, box.names, box.units, accuracy)

    @property
    def source(self) -> str:
        """The C source; its function is called `model_solve`."""
        about: Mapping[str, Any] = {
            "parameters": {"names": self.names, "units": self.units}, "exported_by": "vibench",
            "cell": dict.fromkeys(("problem", "dual", "primal", "cell"), "of this run"), "accuracy": self.accuracy,
            "source": dict.fromkeys(("distribution", "licence"), "as the problem"),
        }  # fmt: skip
        return c_source.source(self.members, {"lower": self.lower, "upper": self.upper}, about, "model")[0]

    def program(self) -> CompiledProgram:
        """Compile and load the program; raises an `UnsupportedError` if there is no C compiler, or it fails."""
        return CompiledProgram(self.source, *(self.members[name].terms.shape[1] for name in "fg"))


def _refuse_large(program: VariationalInequality) -> None:
    """Raise an `UnsupportedError` if programs of this size have too many arrays on the stack."""
    N, R = len(program.f), len(program.g)
    # A packed and twice in full, J and U; B and the normals.
    size = 8 * (5 * N * N + 2 * N * R)
    # Stacks usually have eight mebibytes, beyond which the process is aborted.
    if size > 4 * 2**20:
        what = f"the program of {N} unknowns and {R} constraints has {size / 2**20:.1f} MiB of arrays on the stack"
        raise UnsupportedError(f"{what}, at most 4 MiB are safe")


class CompiledProgram:
    """A program of `unknowns` and `constraints`, compiled and loaded; an `UnsupportedError` if the compiler fails."""

    def __init__(self, source: str, unknowns: int, constraints: int) -> None:
        # A library that is loaded needs its file no longer.
        with foreign("the C compiler, or what it makes,"), scratch() as folder:
            self._solve = ctypes.CDLL(str(_compiled(source, folder))).model_solve
        self._sizes = unknowns, constraints
        self._solve.argtypes, self._solve.restype = [ctypes.c_void_p] * 4, ctypes.c_int

    def __call__(self, mu: Array) -> QPSolution:
        """The solution at mu (d,), verified by the program alone."""
        at = np.ascontiguousarray(mu, dtype=float)
        x, alpha, residuals = np.empty(self._sizes[0]), np.empty(self._sizes[1]), np.empty(3)
        code = self._solve(at.ctypes.data, x.ctypes.data, alpha.ctypes.data, residuals.ctypes.data)
        # The program adds 16 to its code at parameters outside the box.
        outcome = code % 16
        texts = ("solved", "inaccurate", "the constraints contradict each other", "not solved")
        text = texts[outcome] if outcome < len(texts) else f"code {code}"
        return QPSolution(x, alpha, text) if outcome in {0, 1} else QPSolution(None, None, text)


def compiler() -> list[str]:
    """The command of the C compiler: that of the environment variable CC, or the first of cc, gcc and clang."""
    named, usual = shlex.split(os.environ.get("CC", "")), ("cc", "gcc", "clang")
    for command in [named] if named else [[name] for name in usual]:
        if shutil.which(command[0]):
            return command
    if named:
        raise UnsupportedError(f"the environment variable CC names the C compiler '{named[0]}', which is not found")
    advice = "install one, or name it in the environment variable CC"
    raise UnsupportedError(f"there is no C compiler: none of {', '.join(usual)} is on the PATH; {advice}")


def _compiled(source: str, folder: Path) -> Path:
    command, library = compiler(), folder / "model.so"
    (folder / "model.c").write_text(source, encoding="utf-8")
    # For this processor, which changes no result: no option reorders or contracts sums. Some compilers do not know it.
    for native in (["-march=native"], []):
        options = ["-std=c99", "-O3", *native, "-ffp-contract=off", "-shared", "-fPIC"]
        ended = subprocess.run(
            [*command, *options, "model.c", "-o", library.name, "-lm"],
            cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", check=False,
        )  # fmt: skip
        if not ended.returncode:
            break
    if ended.returncode or not library.is_file():
        said = next((line for line in ended.stderr.splitlines() if "error" in line), ended.stderr) or "it says nothing"
        raise UnsupportedError(f"the C compiler '{' '.join(command)}' failed ({ended.returncode}): {one_line(said)}")
    return library
