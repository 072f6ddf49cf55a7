"""Export a cell, and compare answers and seconds of vibench, the exported script and its C source.

Usage: python tests/benchmarks/exported.py RUN CELL [TOLERANCE]
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import vibench
from vibench.library.export import TOLERANCE
from vibench.library.reduced_model import Model
from vibench.library.reduced_model_certificate import Model as WithBounds
from vibench.qp.exact import exact_solution

QUERIES = 1000


def main(run: str, cell: str, tolerance: float) -> None:
    """Print largest relative errors of u and λ, and median CPU seconds of a query."""
    model = vibench.open_run(run).model(cell)
    seconds: dict[str, list[float]] = {"vibench": [], "script": [], "C": []}
    errors: dict[str, list[tuple[float, float]]] = {"vibench": [], "script": [], "C": []}

    def timed(name: str, call: Callable[[], Any]) -> Any:
        start = time.process_time_ns()
        result = call()
        seconds[name].append(1e-9 * (time.process_time_ns() - start))
        return result

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.npz"
        vibench.export_model(model, file, tolerance, c=True)
        exported, library = Model(file), file.with_suffix(".so")
        compiler = ["cc", "-std=c99", "-O3", "-shared", "-fPIC", "-o", str(library), str(file.with_suffix(".c")), "-lm"]
        subprocess.run(compiler, check=True)
        function = ctypes.CDLL(str(library)).model_solve
        V, W, chi = model.problem.V, model.problem.W, model.reduced.generators
        for mu in model.parameters.sample(QUERIES, seed=0):
            solution, answer = timed("vibench", partial(model.solve, mu)), timed("script", partial(exported.solve, mu))
            x, alpha, residuals = np.zeros(len(answer.x)), np.zeros(len(answer.alpha)), np.zeros(3)
            pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (mu.copy(), x, alpha, residuals)]
            timed("C", partial(function, *pointers))
            reduced = model.reduced.assemble(mu)
            exact = exact_solution(reduced.program)
            if exact is None:
                continue
            u, lam = reduced.reconstruct(exact.x[:, None])[:, 0], chi @ exact.alpha
            both = {"vibench": (solution.x, solution.alpha), "script": (answer.x, answer.alpha), "C": (x, alpha)}
            for name, (coordinates, forces) in both.items():
                found = reduced.reconstruct(coordinates[:, None])[:, 0]
                of_lam = exact.unique * W.norm(chi @ forces - lam) / (W.norm(lam) or 1.0)
                errors[name].append((V.norm(found - u) / (V.norm(u) or 1.0), of_lam))
    print(f"{QUERIES} queries; distance from the reduced program solved to round-off, and median CPU time")
    for name, found in errors.items():
        of_u, of_lam = np.max(found, axis=0)
        print(f"{name:8} u {of_u:.1e}  λ {of_lam:.1e}  {1e6 * np.median(seconds[name]):6.0f} µs")
    if model.certificate is not None:
        bounds(model, tolerance)


def bounds(model: vibench.Model, tolerance: float) -> None:
    """Print how far the bounds of the script are from those of vibench, relative: median and largest."""
    certificate, differences = model.certificate, dict[str, list[float]]()
    assert certificate is not None
    with tempfile.TemporaryDirectory() as folder:
        vibench.export_model(model, Path(folder) / "model.npz", tolerance)
        exported = WithBounds(Path(folder) / "model.npz")
    for mu in model.parameters.sample(QUERIES // 10, seed=5):
        reduced, (solution, bound, _) = model.reduced.assemble(mu), exported.solve(mu)
        others = {"of the same solution": (solution.x, solution.alpha)}
        if (exact := exact_solution(reduced.program)) is not None:
            others["of the program solved to round-off"] = exact.x, exact.alpha
        if (own := model.solve(mu)).x is not None and own.alpha is not None:
            others[f"of `model.solve`, accuracy {model.accuracy:g}"] = own.x, own.alpha
        for name, (x, alpha) in others.items():
            of_vibench = certificate.evaluate(model.problem, mu, reduced, x, alpha)
            pairs = ((bound.u_energy, of_vibench.u_energy), (bound.lambda_natural, of_vibench.lambda_natural))
            differences.setdefault(name, []).append(max(abs(mine / theirs - 1.0) for mine, theirs in pairs))
    print(f"bounds of the script at {QUERIES // 10} parameters, relative to those of vibench:")
    for name, found in differences.items():
        print(f"    {name:45} median {np.median(found):.1e}  largest {np.max(found):.1e}")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]) if len(sys.argv) > 3 else TOLERANCE)
