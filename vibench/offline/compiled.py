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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.errors import NumericalError, RequestError, UnsupportedError, foreign
from vibench.files import scratch
from vibench.interfaces.contact_source import ContactSource
from vibench.interfaces.problem import MEMBERS, Contact, VariationalInequality
from vibench.interfaces.validation import training_parameters
from vibench.model.chebyshev import AffinePolynomial
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel
from vibench.offline import c_source
from vibench.offline.c_source import ContactCode, contact_text
from vibench.offline.polynomials import EVALUATIONS, TOLERANCE, declared_model, member_polynomials
from vibench.qp.exact import exact_solution
from vibench.qp.verification import QPSolution
from vibench.text import one_line


@dataclass(frozen=True)
class CompiledModel:
    """Data of the C source of a model: polynomials of A, f, B and g, and the accuracy that it verifies.

    B and g have none where the problem has C code for them, which is that of a reduced model in the same process.
    """

    members: Mapping[str, AffinePolynomial]
    # The box, `lower` and `upper` (d,), and those of `first_sets`.
    arrays: Mapping[str, Array]
    accuracy: float

    @classmethod
    def of(cls, reduced: AnyReducedModel, accuracy: float) -> CompiledModel:
        """Interpolate the members of a reduced model.

        Raises an `UnsupportedError` if the basis depends on the parameter, or polynomials are inaccurate or too large.
        """
        try:
            queried = declared_model(reduced)
            if isinstance(queried, HyperReducedModel) and queried.space is not None:
                raise RequestError("the enrichment changes the basis at every parameter")
            coded = "" if ContactCode.of(queried) is None else "Bg"
            members = member_polynomials(queried, TOLERANCE, EVALUATIONS, check=_refuse_large, left_out=coded)
        except RequestError as error:
            raise UnsupportedError(f"the model cannot be exported to C: {error}") from None
        box = reduced.problem.parameters
        # Store polynomials and not the source: who loads an artefact runs nothing that is in it.
        arrays = {"lower": box.lower, "upper": box.upper, **first_sets(reduced, members)}
        return cls(members, arrays, accuracy)

    def source(self, reduced: AnyReducedModel | None = None) -> str:
        """The C source; its function is called `model_solve`."""
        code = None if reduced is None else ContactCode.of(reduced)
        return c_source.source(self.members, self.arrays, about_model(self.accuracy), "model", code=code)[0]

    def program(self, reduced: AnyReducedModel | None = None) -> CompiledProgram:
        """Compile and load the program; raises an `UnsupportedError` if there is no C compiler, or it fails."""
        f, g = (self.members[name].terms.shape[1] if name in self.members else 0 for name in "fg")
        return CompiledProgram(self.source(reduced), f, g if reduced is None else reduced.generators.shape[1])


def about_model(accuracy: float, outputs: Sequence[Mapping[str, str]] = ()) -> dict[str, Any]:
    """The texts of a source that stays in this process."""
    return {
        "parameters": {"names": (), "units": ()}, "exported_by": "vibench", "outputs": {"linear": list(outputs)},
        "cell": dict.fromkeys(("problem", "dual", "primal", "cell"), "of this run"), "accuracy": accuracy,
        "source": dict.fromkeys(("distribution", "licence"), "as the problem"),
    }  # fmt: skip


def first_sets(reduced: AnyReducedModel, members: Mapping[str, AffinePolynomial]) -> dict[str, Array]:
    """Training parameters (P×d), active sets (P×R) of their programs, and the factor of a constant A, packed."""
    box, training = reduced.problem.parameters, training_parameters(reduced.problem)
    # A query begins with the set of the nearest parameter, for which it looks at all of them.
    training = training[:: -(-len(training) // 512)]
    if set(MEMBERS) <= members.keys() and not (isinstance(reduced, HyperReducedModel) and reduced.space is not None):
        values = [members[name].evaluate((training - box.lower) / (box.upper - box.lower)) for name in MEMBERS]
        programs = (_unpacked(*each) for each in zip(*values, strict=True))
    else:
        programs = (reduced.assemble(mu).program for mu in training)
    sets = np.zeros((len(training), reduced.generators.shape[1]), bool)
    for k, program in enumerate(programs):
        if (solved := exact_solution(program)) is not None:
            sets[k] = solved.alpha > 0.0
    found = {"start_parameters": training, "start_sets": sets}
    if "A" in reduced.problem.constant and len(program.f) == members["f"].terms.shape[1]:
        found["start_factor"] = np.linalg.cholesky(program.A).T[np.triu_indices(len(program.f))]
    return found


def _unpacked(packed: Array, f: Array, B: Array, g: Array) -> VariationalInequality:
    A = np.zeros((len(f), len(f)))
    A[np.triu_indices(len(f))] = packed
    return VariationalInequality(A + np.triu(A, 1).T, f, B.reshape(-1, len(f)), g)


def _refuse_large(program: VariationalInequality) -> None:
    """Raise an `UnsupportedError` if programs of this size have too many arrays on the stack."""
    N, R = len(program.f), len(program.g)
    # A packed, in full and factorised, and B; then the dual method, or rows, products and factors of the quick one.
    known = min(R, 2 * N)
    size = 4 * (5 * N * N + 2 * N * R) + 8 * max(2 * N * N + N * R, known * (N + known // 2) + 2 * N * N)
    # Stacks usually have eight mebibytes, beyond which the process is aborted.
    if size > 4 * 2**20:
        what = f"the program of {N} unknowns and {R} constraints has {size / 2**20:.1f} MiB of arrays on the stack"
        raise UnsupportedError(f"{what}, at most 4 MiB are safe")


class CompiledProgram:
    """A program of `unknowns` and `constraints`, compiled and loaded; an `UnsupportedError` if the compiler fails."""

    def __init__(self, source: str, unknowns: int, constraints: int) -> None:
        self._solve = loaded(source, "model_solve_counting", 5)
        self._sizes = unknowns, constraints

    def __call__(self, mu: Array) -> QPSolution:
        """The solution at mu (d,), verified by the program alone."""
        at = np.ascontiguousarray(mu, dtype=float)
        x, alpha, residuals, steps = np.empty(self._sizes[0]), np.empty(self._sizes[1]), np.empty(3), ctypes.c_int()
        pointers = [array.ctypes.data for array in (at, x, alpha, residuals)]
        code = self._solve(*pointers, ctypes.addressof(steps))
        # The program adds 16 to its code at parameters outside the box.
        outcome = code % 16
        texts = ("solved", "inaccurate", "the constraints contradict each other", "not solved")
        text = texts[outcome] if outcome < len(texts) else f"code {code}"
        if outcome > 1:
            return QPSolution(None, None, text)
        return QPSolution(x, alpha, f"{text} by the dual method" if steps.value < 0 else text, max(steps.value, 0))


def compiled_contact(source: ContactSource, shape: tuple[int, int]) -> Callable[[Array], Contact | None]:
    """`Problem.contact` by its C source, with B of this shape; an `UnsupportedError` if the compiler fails."""
    wrapped = "int called(const double *mu, int *ends, int *columns, double *values, double *g)"
    text = f"#include <math.h>\n{contact_text(source)}{wrapped} {{ return contact(mu, ends, columns, values, g); }}"
    call = loaded(text, "called", 5)

    def contact(mu: Array) -> Contact | None:
        ends, columns = np.zeros(shape[0] + 1, np.intc), np.zeros(source.entries, np.intc)
        at, values, g = np.ascontiguousarray(mu, float), np.zeros(source.entries), np.zeros(shape[0])
        if not call(*(array.ctypes.data for array in (at, ends, columns, values, g))):
            return None
        if ends[-1] > source.entries:
            raise NumericalError(f"the C source of the constraint fills {ends[-1]} entries, it says {source.entries}")
        return Contact(sp.csr_array((values[: ends[-1]], columns[: ends[-1]], ends), shape), g)

    return contact


def loaded(source: str, name: str, pointers: int) -> Callable[..., int]:
    """A function of so many pointers, of a source that is compiled and loaded into this process."""
    # A library that is loaded needs its file no longer.
    with foreign("the C compiler, or what it makes, cannot be used"), scratch() as folder:
        found = ctypes.CDLL(str(compiled(source, folder)))[name]
    found.argtypes = [ctypes.c_void_p] * pointers
    return found


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


def compiled(source: str, folder: Path, native: bool = True) -> Path:
    """The shared library of a source, compiled in a folder; if `native`, for this processor."""
    command, library = compiler(), folder / "model.so"
    (folder / "model.c").write_text(source, encoding="utf-8")
    # The processor changes no result: no option reorders or contracts sums. Some compilers do not know this one.
    for processor in (["-march=native"], []) if native else ([],):
        options = ["-std=c99", "-O3", *processor, "-ffp-contract=off", "-shared", "-fPIC"]
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
