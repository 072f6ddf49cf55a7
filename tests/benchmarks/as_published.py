"""Seconds of our transcription of the published algorithms (`published.py`) and of vibench's own, in one process.

    python tests/benchmarks/as_published.py obstacle|hertz [--repeats K] [--resolution paper] [--out FOLDER]

Both sides do the same stages one after the other, K times in turn, each with the results of its own earlier stages, on
one BLAS thread; CPU seconds, medians. Exit code 1 unless both come to the same models: sizes, σ, snapshots and errors.
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
sys.path.append(str(Path(__file__).parents[2] / "results" / "scripts"))

import numpy as np
import pandas as pd
import published
from page import Page
from sides import CASES, TOTAL, TOTAL_NAME, Ours, Published, Side

from vibench import Array, provenance
from vibench.qp import verification
from vibench.timing import median_seconds, timed

ABOUT = (
    "The transcription is ours, too: the algorithms of Niakh, Drouet, Ehrlacher and Ern (2022) as printed, written "
    "around cvxopt (`tests/benchmarks/published.py`). The last column of the first table has the seconds of the paper "
    "itself, for its own reduced dimensions."
)

SEED = 2022
STAGES = ("snapshots", "POD", "CPG", "mCPG", "PGA", "PGA, residuals kept", "reduction")
QUERIES = ("query online", "query offline", "query online, reduced", "query offline, reduced")
BARE = "bare program of the reduced offline query"
BARE_ONLINE = "bare program of the reduced online query"
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
    for side in range(2):
        seconds[TOTAL_NAME][side].extend(np.sum([seconds[name][side] for name in TOTAL], axis=0).tolist())
    return seconds


Figures = dict[str, Pair]


def measure_queries(sides: Pair, mus: Array, repeats: int) -> tuple[Seconds, Figures]:
    """Queries at every mu (P×d) on both sides in turn: seconds; means of the errors, and the worst residuals."""
    seconds: Seconds = defaultdict(lambda: Pair([], []))
    found: Figures = {}
    problem = sides.published.problem
    V, W, (u, lam) = problem.V, problem.W, published.snapshots(problem, mus)
    for side in sides:
        side.prepare()
    for name in QUERIES:
        error_u, error_lam, residual = Pair([], []), Pair([], []), Pair([], [])
        for repeat in range(repeats):
            for k, mu in enumerate(mus):
                for i, side in enumerate(sides):
                    (program, x, alpha, Z), spent = median_seconds(partial(side.do, name, mu), enough=0.05)
                    seconds[name][i].append(spent.cpu)
                    if repeat:
                        continue
                    error_u[i].append(float(V.norm(u[:, k] - Z() @ x) / V.norm(u[:, k])))
                    error_lam[i].append(float(W.norm(lam[:, k] - side.chi @ alpha) / W.norm(lam[:, k])))
                    residual[i].append(verification.kkt_residuals(program, x, alpha).worst)
        found[f"error of u, {name}"] = Pair(*map(statistics.mean, error_u))
        found[f"error of λ, {name}"] = Pair(*map(statistics.mean, error_lam))
        found[f"largest residual, {name}"] = Pair(*map(max, residual))
        _tell(name, seconds[name])
    _measure_ours(sides.ours, mus, seconds, found)
    return seconds, found


def _measure_ours(ours: Ours, mus: Array, seconds: Seconds, found: Figures) -> None:
    """Add what our side alone has: bare programs, and the compiled query; it stands in both columns."""
    alone = {BARE: partial(ours.bare_program, query="offline"), BARE_ONLINE: partial(ours.bare_program, query="online")}
    if not ours.not_compiled:
        alone[COMPILED] = ours.compiled_query
        worst = max(map(ours.compiled_residual, mus))
        found[f"largest residual, {COMPILED}"] = Pair(worst, worst)
    for name, prepared in alone.items():
        for mu in mus:
            spent = median_seconds(prepared(mu))[1].cpu
            for of_side in seconds[name]:
                of_side.append(spent)
        _tell(name, seconds[name])


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
        for symbol, bound in (("u", 0.01), ("λ", 0.05)):
            name = f"error of {symbol}, {query}"
            result.append((f"relative difference of the {name}", _difference(found[name]), bound))
        for side, residual in found[f"largest residual, {query}"]._asdict().items():
            result.append((f"largest residual, {query}, {side}", residual, 10.0 * sides.ours.accuracy))
    if (compiled := f"largest residual, {COMPILED}") in found:
        result.append((compiled, found[compiled].ours, 10.0 * sides.ours.accuracy))
    return result


def _difference(pair: Pair) -> float:
    return abs(pair.ours - pair.published) / pair.published


def broken(of: list[Check]) -> list[Check]:
    return [check for check in of if not check[1] <= check[2]]


def time_table(seconds: Seconds, paper: Sequence[float]) -> pd.DataFrame:
    """Medians and their ratio, by stage, and the seconds that the paper gives."""
    rows = [(name, *(statistics.median(spent) for spent in pair), len(pair.ours)) for name, pair in seconds.items()]
    frame = pd.DataFrame(rows, columns=["stage", "transcription [s]", "ours [s]", "times measured"])
    frame.insert(3, "transcription / ours", frame["transcription [s]"] / frame["ours [s]"])
    frame["paper, on its machine [s]"] = frame["stage"].map(dict(zip((TOTAL_NAME, *QUERIES[:2]), paper, strict=True)))
    return frame


def ratio_table(seconds: Seconds) -> pd.DataFrame:
    published_, ours = ({name: statistics.median(pair[side]) for name, pair in seconds.items()} for side in range(2))
    reduced, with_reduction = ours["query offline, reduced"], ours[TOTAL_NAME] + ours["reduction"]
    rows = [
        ("offline, transcription over ours", published_[TOTAL_NAME] / ours[TOTAL_NAME]),
        ("offline with the reduction, transcription over ours", published_[TOTAL_NAME] / with_reduction),
        *((f"{name}, transcription over ours", published_[name] / ours[name]) for name in STAGES[2:6]),
        ("offline query, our full over our reduced assembly", ours["query offline"] / reduced),
        ("online query, our full over our reduced assembly", ours["query online"] / ours["query online, reduced"]),
        ("online query of the transcription over our reduced offline query", published_["query online"] / reduced),
        ("our reduced offline query over the bare program in it", reduced / ours[BARE]),
        ("our reduced online query over the bare program in it", ours["query online, reduced"] / ours[BARE_ONLINE]),
    ]
    if COMPILED in ours:
        rows.append(("our reduced offline query over the compiled one", reduced / ours[COMPILED]))
    return pd.DataFrame(rows, columns=["ratio of medians", "found"])


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("problem", choices=CASES)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--resolution", default="paper")
    parser.add_argument("--solver", default="piqp", help="of our queries")
    parser.add_argument("--accuracy", type=float, default=1e-10, help="of all queries")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args(arguments)
    case = CASES[asked.problem]
    resolution = int(asked.resolution) if asked.resolution.isdigit() else asked.resolution
    problem = case.problem(resolution=resolution)
    sides = Pair(*(side(problem, case, asked.solver, asked.accuracy) for side in (Published, Ours)))
    seconds = measure_stages(sides, asked.repeats)
    of_queries, found = measure_queries(sides, problem.validation_set(case.queries, SEED), asked.repeats)
    found = sizes(sides) | found
    verdicts = checks(sides, found)
    times = time_table(seconds | of_queries, case.paper)
    versions = provenance.versions(asked.solver) | provenance.versions("cvxopt")
    where = f"{provenance.machine()}; " + ", ".join(f"{name} {version}" for name, version in versions.items())
    figures = pd.DataFrame([(name, *pair) for name, pair in found.items()], columns=["figure", "transcription", "ours"])
    held = pd.DataFrame([(*v, "no" if v in broken(verdicts) else "yes") for v in verdicts])
    held.columns = pd.Index(["check", "found", "at most", "holds"])
    title = f"{asked.problem}, resolution {resolution}: the published algorithms and ours"
    command = f"python tests/benchmarks/as_published.py {asked.problem} --repeats {asked.repeats}"
    command += f" --out {asked.out}" if asked.out else ""
    about = ABOUT + (f" No compiled program: {sides.ours.not_compiled}." if sides.ours.not_compiled else "")
    file = f"as-published-{asked.problem}.md"
    page = Page(asked.out or Path(), title, command, about, machine=where, file=file)
    page.add(times, ratio_table(seconds | of_queries), figures, held)
    print(page.text)
    if asked.out:
        page.write()
        same = {"problem": asked.problem, "resolution": resolution, "solver": asked.solver, "machine": where}
        page.link(f"as-published-{asked.problem}", times.assign(**same))
    return int(bool(broken(verdicts)))


if __name__ == "__main__":
    sys.exit(main())
