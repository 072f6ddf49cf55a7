"""Export a cell, and compare answers and seconds of vibench, the exported script and its C source.

Usage: python tests/benchmarks/exported.py RUN CELL [TOLERANCE]
"""

import ctypes
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import vibench
from vibench import Array
from vibench.library.reduced_model import Model
from vibench.offline.models import Model as LibraryModel
from vibench.offline.polynomials import TOLERANCE
from vibench.qp.exact import exact_solution
from vibench.timing import timed

Call = Callable[[Array], Any]
"""A query at a parameter mu (d,)."""

QUERIES = 1000
SCRIPT, LIBRARY, HIGH_FIDELITY = "script", "model.solve", "high-fidelity solution"


def in_turns(calls: Mapping[str, Call], mus: Array) -> dict[str, float]:
    """Median CPU seconds of calls by name at parameters (P×d), at each one after the other, once more at the first."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for mu in (mus[0], *mus):
        for name, call in calls.items():
            seconds[name].append(timed(partial(call, mu))[1].cpu)
    return {name: float(np.median(found[1:])) for name, found in seconds.items()}


def queries(model: LibraryModel, file: Path) -> dict[str, Call]:
    """The script of an exported file and its model, which give u, λ and the outputs.

    A certified model also answers with bounds, and with corrected solutions.
    """
    plain = replace(model, certificate=None)
    found: dict[str, Call] = {SCRIPT: Model(file).solve, LIBRARY: partial(_whole, plain, False)}
    if model.certificate is not None:
        found |= {f"{LIBRARY}, with bounds": partial(_whole, model, False)}
        found |= {f"{LIBRARY}, corrected": partial(_whole, model, True)}
    return found


def _whole(model: LibraryModel, corrected: bool, mu: Array) -> None:
    solution = model.solve(mu, corrected=corrected)
    if solution.x is not None and solution.alpha is not None:
        _ = solution.answer, solution.outputs, solution.output_bounds


def main(run: str, cell: str, tolerance: float) -> None:
    """Print largest relative errors of u and λ, and median CPU seconds of queries, taken in turns."""
    model = vibench.open_run(run).model(cell)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.npz"
        arrays = vibench.export_model(model, file, tolerance, c=True).arrays
        exported, compiled = Model(file), in_c(file, arrays)
        mus, errors = model.parameters.sample(QUERIES, seed=0), dict[str, list[tuple[float, float]]]()
        V, W, chi = model.problem.V, model.problem.W, model.reduced.generators
        for mu in mus[: QUERIES // 10]:
            reduced = model.reduced.assemble(mu)
            exact = exact_solution(reduced.program)
            if exact is None:
                continue
            u, lam = reduced.reconstruct(exact.x[:, None])[:, 0], chi @ exact.alpha
            solution, answer = model.solve(mu, corrected=False), exported.solve(mu)
            both = {LIBRARY: (solution.x, solution.alpha), SCRIPT: (answer.x, answer.alpha), "C": compiled["C"](mu)}
            for name, (coordinates, forces) in both.items():
                found = reduced.reconstruct(coordinates[:, None])[:, 0]
                of_lam = exact.unique * W.norm(chi @ forces - lam) / (W.norm(lam) or 1.0)
                errors.setdefault(name, []).append((V.norm(found - u) / (V.norm(u) or 1.0), of_lam))
        print(f"{QUERIES // 10} queries: largest distance from the reduced program solved to round-off")
        for name, distances in errors.items():
            of_u, of_lam = np.max(distances, axis=0)
            print(f"    {name:26} u {of_u:.1e}  λ {of_lam:.1e}")
        print(f"{QUERIES} queries: median CPU time, taken in turns")
        for name, seconds in in_turns(queries(model, file) | compiled, mus).items():
            print(f"    {name:26} {1e6 * seconds:6.0f} µs")
        seconds = in_turns({HIGH_FIDELITY: model.high_fidelity}, mus[:9])[HIGH_FIDELITY]
        print(f"    {HIGH_FIDELITY:26} {1e6 * seconds:6.0f} µs")


def in_c(file: Path, exported: Mapping[str, np.ndarray]) -> dict[str, Call]:
    """The functions of the C source beside an exported file, with the arrays that it is made of."""
    library, data = file.with_suffix(".so"), np.load(file)
    compiler = ["cc", "-std=c99", "-O3", "-shared", "-fPIC", "-o", str(library), str(file.with_suffix(".c")), "-lm"]
    subprocess.run(compiler, check=True)
    found = ctypes.CDLL(str(library))
    sizes = data["f_terms"].shape[1], data["g_terms"].shape[1], 3
    if "certificate_rows" in exported:
        sizes += (len(exported["generators"]), len(exported["certificate_rows"]), 3)
    arrays = [np.zeros(size) for size in sizes]
    x, alpha, residuals, *others = [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]

    def solve(mu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found.model_solve(mu.ctypes.data_as(ctypes.c_void_p), x, alpha, residuals)
        return arrays[0].copy(), arrays[1].copy()

    def certify(corrected: int, mu: np.ndarray) -> None:
        solve(mu)
        found.model_certify(mu.ctypes.data_as(ctypes.c_void_p), x, alpha, corrected, *others)

    bounded = {"C, with bounds": partial(certify, 0), "C, corrected": partial(certify, 1)} if others else {}
    return {"C": solve} | bounded


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]) if len(sys.argv) > 3 else TOLERANCE)
