"""Seconds of our transcription of the published algorithms (`published.py`) and of vibench's own, in one process.

    python tests/benchmarks/as_published.py obstacle|hertz [--repeats K] [--resolution paper] [--out FOLDER]

Both sides do the same stages one after the other, K times in turn, each with the results of its own earlier stages, on
one BLAS thread; CPU seconds, medians. Greedy enrichment (PGA) of the transcription is done in both ways that the paper
can be read: as printed every step projects every S_R(mu) again, or residuals are kept between the steps. A query is all
from mu to the coefficients x and α, without reconstruction; cvxopt solves it to several accuracies. Exit code 1 unless
both come to the same models: sizes, σ, snapshots and errors.
"""

import argparse
import os
import statistics
import sys
from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

if __name__ == "__main__":  # before NumPy is imported
    for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR"):
        os.environ[f"{library}_NUM_THREADS"] = "1"

import numpy as np
import pandas as pd
import published
from sides import CASES, Ours, Published, Side

from vibench import Array, provenance
from vibench.qp import verification
from vibench.timing import median_seconds, timed

SEED = 2022
STAGES = ("snapshots", "POD", "CPG", "mCPG", "PGA", "PGA, residuals kept", "reduction")
TOTALS = {
    f"offline, PGA {way}": ("snapshots", "POD", "mCPG", pga)
    for way, pga in {"with residuals kept": "PGA, residuals kept", "as printed": "PGA"}.items()
}
ACCURACIES = (1e-6, 1e-8, 1e-10)
QUERIES = tuple(f"query {way}, {accuracy:.0e}" for way in ("online", "offline") for accuracy in ACCURACIES)
COMPILED = "query offline, compiled"


class Pair(NamedTuple):
    published: Any
    ours: Any


Seconds = dict[str, Pair]
"""CPU seconds of every repeat, by stage: two lists."""


def measure_stages(sides: Pair, repeats: int) -> Seconds:
    seconds: Seconds = defaultdict(lambda: Pair([], []))
    for name in STAGES:
        for _ in range(repeats):
            for side, spent in zip(sides, seconds[name], strict=True):
                spent.append(timed(partial(side.do, name))[1].cpu)
        _tell(name, seconds[name])
    for total, stages in TOTALS.items():
        for side in range(2):
            seconds[total][side].extend(np.sum([seconds[name][side] for name in stages], axis=0).tolist())
    return seconds


Figures = dict[str, Pair]


def measure_queries(sides: Pair, mus: Array) -> tuple[Seconds, Figures]:
    """Queries at every mu (P×d) on both sides in turn: seconds; means of the errors, and the worst residuals.

    Ours are reduced, by DAQP, and once more by PIQP: their seconds stand beside the same ones of the transcription.
    """
    seconds: Seconds = defaultdict(lambda: Pair([], []))
    found: Figures = {}
    problem = sides.published.problem
    V, W, (u, lam) = problem.V, problem.W, published.snapshots(problem, mus)
    for side in sides:
        side.prepare()
    for name in QUERIES:
        way, accuracy = name.removeprefix("query ").split(", ")
        error_u, error_lam, residual = Pair([], []), Pair([], []), Pair([], [])
        for k, mu in enumerate(mus):
            for i, side in enumerate(sides):
                (program, x, alpha, Z), spent = median_seconds(
                    partial(side.query, way, mu, float(accuracy)), enough=0.02
                )
                seconds[name][i].append(spent.cpu)
                error_u[i].append(float(V.norm(u[:, k] - Z() @ x) / V.norm(u[:, k])))
                error_lam[i].append(float(W.norm(lam[:, k] - side.chi @ alpha) / W.norm(lam[:, k])))
                residual[i].append(verification.kkt_residuals(program, x, alpha).worst)
            slower = partial(sides.ours.query, way, mu, float(accuracy), "piqp")
            seconds[f"{name}, piqp"].ours.append(median_seconds(slower, enough=0.02)[1].cpu)
        seconds[f"{name}, piqp"].published.extend(seconds[name].published)
        found[f"error of u, {name}"] = Pair(*map(statistics.mean, error_u))
        found[f"error of λ, {name}"] = Pair(*map(statistics.mean, error_lam))
        found[f"largest residual, {name}"] = Pair(*map(max, residual))
        _tell(name, seconds[name])
    if not sides.ours.not_compiled:
        worst = max(map(sides.ours.compiled_residual, mus))
        found[f"largest residual, {COMPILED}"] = Pair(worst, worst)
        seconds[COMPILED] = Pair(
            seconds[QUERIES[-1]].published, [median_seconds(partial(sides.ours.compiled, mu))[1].cpu for mu in mus]
        )
        _tell(COMPILED, seconds[COMPILED])
    return seconds, found


def _tell(name: str, seconds: Pair) -> None:
    medians = ", ".join(f"{statistics.median(spent):.3g} s" for spent in seconds)
    print(f"{name}: {medians}", file=sys.stderr, flush=True)


def sizes(sides: Pair) -> Figures:
    added = [side.space.shape[1] - side.basis.shape[1] for side in sides]
    return {
        "N": Pair(*(side.basis.shape[1] for side in sides)),
        "R of CPG": Pair(*(side.plain.shape[1] for side in sides)),
        "R of mCPG": Pair(*(side.chi.shape[1] for side in sides)),
        "vectors added by PGA": Pair(*added),
        "largest σ": Pair(*map(largest_sigma, sides)),
    }


def largest_sigma(side: Side) -> float:
    """Largest σ_S(mu) over the training set, equation (21)."""
    X, factor = side.problem.V.matrix, published.factorise(side.problem.V.matrix)
    largest = 0.0
    for mu in side.problem.training_set():
        Q = published.gram_schmidt(published.supremizers(factor, side.problem.assemble(mu).B, side.chi), X)
        (E,) = published.residuals(X, [Q], side.space)
        largest = max(largest, float(np.linalg.eigvalsh(E.T @ (X @ E))[-1]))
    return float(np.sqrt(largest))


Check = tuple[str, float, float]
"""What must not be larger than what: a name, the figure, the bound."""


def checks(sides: Pair, found: Figures) -> list[Check]:
    """Whether both sides came to the same: figures and their bounds."""
    case, problem = sides.published.case, sides.published.problem
    sized = [(name, found[name]) for name in ("N", "R of CPG", "R of mCPG")]
    result = [(f"difference of {name}", float(abs(pair.ours - pair.published)), 0.0) for name, pair in sized]
    result += [("relative difference of the vectors added", _difference(found["vectors added by PGA"]), case.ties)]
    result += [(f"σ, {side}", sigma, case.pga) for side, sigma in found["largest σ"]._asdict().items()]
    for name, space in (("u", problem.V), ("lam", problem.W)):
        one, other = (getattr(side, name) for side in sides)
        worst = float(np.max(space.norm(one - other) / space.norm(one)))
        result.append((f"relative difference of snapshots {'λ' if name == 'lam' else 'u'}", worst, 1e-7))
    for query in QUERIES:
        accuracy = float(query.split(", ")[1])
        # Answers that cvxopt finds to 1e-6 have larger errors than the models.
        for symbol, bound in (("u", 0.01), ("λ", 0.05)) if accuracy == min(ACCURACIES) else ():
            name = f"error of {symbol}, {query}"
            result.append((f"relative difference of the {name}", _difference(found[name]), bound))
        for side, residual in found[f"largest residual, {query}"]._asdict().items():
            result.append((f"largest residual, {query}, {side}", residual, 10.0 * accuracy))
    if (compiled := f"largest residual, {COMPILED}") in found:
        result.append((compiled, found[compiled].ours, 1e-9))
    return result


def _difference(pair: Pair) -> float:
    return abs(pair.ours - pair.published) / pair.published


def broken(of: list[Check]) -> list[Check]:
    return [check for check in of if not check[1] <= check[2]]


def time_table(seconds: Seconds) -> pd.DataFrame:
    """Medians of both sides and their ratio, by stage."""
    rows = [(name, *(statistics.median(spent) for spent in pair), len(pair.ours)) for name, pair in seconds.items()]
    frame = pd.DataFrame(rows, columns=["stage", "transcription [s]", "ours [s]", "times measured"])
    frame.insert(3, "transcription / ours", frame["transcription [s]"] / frame["ours [s]"])
    return frame


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("problem", choices=CASES)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--resolution", default="paper")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args(arguments)
    case = CASES[asked.problem]
    resolution = int(asked.resolution) if asked.resolution.isdigit() else asked.resolution
    problem = case.problem(resolution=resolution)
    sides = Pair(Published(problem, case), Ours(problem, case))
    seconds = measure_stages(sides, asked.repeats)
    of_queries, found = measure_queries(sides, problem.validation_set(case.queries, SEED))
    found = sizes(sides) | found
    verdicts = checks(sides, found)
    times = time_table(seconds | of_queries)
    figures = pd.DataFrame([(name, *pair) for name, pair in found.items()], columns=["figure", "transcription", "ours"])
    held = pd.DataFrame([(*v, "no" if v in broken(verdicts) else "yes") for v in verdicts])
    held.columns = pd.Index(["check", "found", "at most", "holds"])
    print(*(frame.to_string(index=False) for frame in (times, figures, held)), sides.ours.not_compiled, sep="\n\n")
    if asked.out:
        versions = provenance.versions("piqp") | provenance.versions("daqp") | provenance.versions("cvxopt")
        where = f"{provenance.machine()}; " + ", ".join(f"{name} {version}" for name, version in versions.items())
        same = {"problem": asked.problem, "resolution": resolution, "machine": where}
        asked.out.mkdir(parents=True, exist_ok=True)
        file = asked.out / f"as-published-{asked.problem}.csv"
        times.assign(**same).to_csv(file, index=False, float_format="%.6g")
    return int(bool(broken(verdicts)))


if __name__ == "__main__":
    sys.exit(main())
