"""Runs that are compared, and the differences of a cell between two of them: numbers, seconds, break-even."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from vibench.qp.status import Status
from vibench.results.break_even import TAIL, BreakEven, Meaning
from vibench.results.paired_timing import DRAWS
from vibench.results.read import in_order, read_table
from vibench.results.schema import STORED
from vibench.results.sqlite import FILE, read_meta, study_of
from vibench.results.verdict import Verdict, verdicts
from vibench.stability.infsup import VANISHES
from vibench.timing import FEWEST_ROUNDS

# Columns that identify cells in a comparison; "asked" has all tolerances, or sizes.
AXES = ("problem", "formulation", "dual", "primal", "asked", "solver", "accuracy", "assembly", "bounds", "correction")


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """A run by its results file and the name under which it is compared."""

    path: Path
    name: str

    @cached_property
    def cells(self) -> dict[str, dict[str, Any]]:
        """Rows of the table of cells in the order of the axes, by key."""
        rows = in_order(read_table(self.path, "cells")).to_dict("records")
        return {str(row["cell"]): {str(name): value for name, value in row.items()} for row in rows}

    @cached_property
    def identity(self) -> dict[str, Any]:
        """Name and seed of the study, and its validation parameters: their number, or their sampling as JSON."""
        study = study_of(self.path, read_meta(self.path))
        validation = study.get("validation")
        shown = validation if isinstance(validation, int) else json.dumps(validation, sort_keys=True)
        return {"study": study.get("name"), "seed": study.get("seed"), "validation": shown}

    @cached_property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Whether reduction pays, problem by problem."""
        return tuple(verdicts(in_order(read_table(self.path, "cells")), self.thresholds))

    @property
    def ok(self) -> int:
        return sum(row["status"] == Status.OK for row in self.cells.values())

    @property
    def machines(self) -> list[str]:
        return sorted({str(row["machine"]) for row in self.cells.values() if row["machine"]})

    @cached_property
    def versions(self) -> dict[str, str]:
        """Versions of Python, libraries and solvers; several, where its cells were run with several."""
        by_name: dict[str, set[str]] = {}
        for text in {row["versions"] for row in self.cells.values() if isinstance(row["versions"], str)}:
            for name, version in json.loads(text).items():
                by_name.setdefault(name, set()).add(str(version))
        return {name: ", ".join(sorted(several)) for name, several in sorted(by_name.items())}

    @property
    def facts(self) -> Iterator[tuple[str, str]]:
        """Origin of the numbers, in lines of a name and a text."""
        rows = self.cells.values()
        yield "study", "{study}, seed {seed}, validation parameters: {validation}".format(**self.identity)
        for axis in AXES:
            if axis != "asked":
                yield axis, ", ".join(dict.fromkeys(str(row[axis]) for row in rows))
        counts = Counter(row["status"] for row in rows).most_common()
        yield "cells", f"{len(rows)}: " + ", ".join(f"{count} {status}" for status, count in counts)
        yield "machine", "; ".join(self.machines)
        disturbed, timed = (sum(row["disturbed"] in values for row in rows) for values in ((1,), (0, 1)))
        seconds = "CPU seconds on one thread; the offline time of a cell includes every stage it depends on"
        yield "seconds", f"{seconds}; {disturbed} of {timed} timed cells were timed on a disturbed machine"
        yield "versions", ", ".join(f"{name} {text}" for name, text in self.versions.items() if text)
        yield "code", self.code
        yield "study file", ", ".join(sorted({str(row["study_hash"]) for row in rows if row["study_hash"]}))

    @property
    def code(self) -> str:
        return ", ".join(sorted({str(row["code"]) for row in self.cells.values() if row["code"]}))

    @cached_property
    def ok_queries(self) -> pd.DataFrame:
        """Rows of the ok queries, by cell and number."""
        queries = read_table(self.path, "queries")
        return queries[queries["status"] == Status.OK].set_index(["cell", "query"])

    @cached_property
    def rounds(self) -> Mapping[str, list[float]]:
        """Seconds of a query in every round of timing, by cell."""
        timings = read_table(self.path, "timings").sort_values(["cell", "round"])
        return {str(cell): list(rows["total_s"]) for cell, rows in timings.groupby("cell")}

    @cached_property
    def thresholds(self) -> pd.DataFrame:
        return read_table(self.path, "thresholds")

    def thresholds_of(self, cells: Collection[str]) -> pd.DataFrame:
        """Rows of the break-evens in which no other cells take part."""
        thresholds, keys = self.thresholds, set(cells)
        of_a, of_b = (thresholds[end].isin(keys) for end in ("cell_a", "cell_b"))
        return thresholds[(of_a | thresholds["cell_a"].isna()) & of_b]

    def measured_beside(self, other: ComparedRun, unless: Sequence[ComparedRun]) -> list[str]:
        """Cells whose seconds compare with those of the other run, and with those of none of the runs `unless`."""
        own = {key: self.measured_by(key) for key in self.cells}
        mine = [key for key, one in own.items() if other.measured_by(key) == one]
        return [key for key in mine if own[key] not in [run.measured_by(key) for run in unless]]

    def measured_by(self, cell: str) -> tuple[str, str] | None:
        """Machine and version of the benchmark protocol that measured a cell; `None` without it."""
        if (row := self.cells.get(cell)) is None:
            return None
        versions = json.loads(row["versions"]) if isinstance(row["versions"], str) else {}
        return str(row["machine"]), str(versions.get("protocol", ""))


def compared_runs(paths: Sequence[Path]) -> list[ComparedRun]:
    """The runs of some results files, each under a name of its own: its folder or file, where needed with folders."""
    parts = [(path.resolve().parent if path.name == FILE else path.resolve().with_suffix("")).parts for path in paths]
    deepest = max(map(len, parts))
    for depth in range(1, deepest + 1):
        names = ["/".join(some[-depth:]) for some in parts]
        if len(set(names)) == len(set(parts)):
            break
    # One run may be named twice.
    return list(map(ComparedRun, paths, numbered(names, "{} ({})")))


def numbered(names: Iterable[str], form: str) -> list[str]:
    """Names of which those that differ in case alone, or not at all, have numbers from 2 on in a given form."""
    taken: dict[str, str] = {}
    for name in names:
        choices = chain([name], (form.format(name, k) for k in count(2)))
        chosen = next(one for one in choices if one.lower() not in taken)
        taken[chosen.lower()] = chosen
    return list(taken.values())


# Columns of a cell that are means or maxima over its ok queries: the column of a query, and which of the two.
ERRORS = {
    **{f"error_{name}_{how}": (f"error_{name}", how) for name in ("u", "lambda") for how in ("mean", "max")},
    "violation_max": ("violation", "max"),
}
Interval = tuple[float, float]


class ChangeKind(StrEnum):
    """Verdict on a difference between two numbers, the changes that matter most last."""

    EQUAL = "equal"
    WITHIN_ACCURACY = "within accuracy"
    WITHIN_LIMIT = "within limit"
    UNDECIDED = "undecided"
    CHANGED = "changed"
    BETTER = "better"
    WORSE = "worse"


class Difference(NamedTuple):
    """A column of a cell in two runs: the values, the verdict, and the 95 % interval of the ratio of seconds."""

    cell: Mapping[str, Any]
    what: str
    before: Any
    after: Any
    verdict: ChangeKind
    interval: Interval | None = None

    @property
    def ratio(self) -> float:
        """After over before; NaN where either is no number or the denominator is zero."""
        numbers = isinstance(self.before, float | int) and isinstance(self.after, float | int)
        return float(self.after) / float(self.before) if numbers and self.before else float("nan")


def number_differences(one: Mapping[str, Any], two: Mapping[str, Any], limit: float) -> Iterator[Difference]:
    """Differences of a cell that do not depend on the machine; none in columns that are empty in both runs."""
    severities = (Status(one["status"]).severity, Status(two["status"]).severity)
    verdicts: dict[str, ChangeKind | None] = {
        "queries_ok": _verdict(one["queries_ok"], two["queries_ok"], 1.0, more_is_better=True),
        "status": _verdict(*severities, 1.0),
    }
    for name in ("N", "R", "rank", "enrichment"):
        verdict = _verdict(one[name], two[name], limit)
        verdicts[name] = ChangeKind.CHANGED if verdict is ChangeKind.WITHIN_LIMIT else verdict
    for name in ("beta_span_min", "beta_cone_lower_min"):
        verdicts[name] = _verdict(one[name], two[name], limit, floor=VANISHES, more_is_better=True)
    for name in (*ERRORS, "error_u_zero_max", "error_lambda_zero_max"):
        allowed = _solvers_part(one, name) + _solvers_part(two, name)
        # Errors below 1e-10 are round-off, and their ratio is meaningless.
        verdicts[name] = _verdict(one[name], two[name], limit, floor=1e-10, allowed=allowed)
    for name, verdict in verdicts.items():
        if verdict is not None:
            yield Difference(one, name, one[name], two[name], verdict)


def _solvers_part(cell: Mapping[str, Any], error: str) -> float:
    """Largest contribution of the QP solver to an error; by the triangle inequality a mean moves by no more."""
    largest = cell.get(f"solver_{error.rpartition('_')[0]}_max")
    return 0.0 if largest is None or pd.isna(largest) else float(largest)


def _verdict(
    before: Any, after: Any, limit: float, *, floor: float | None = None, allowed: float | None = None,
    more_is_better: bool = False,
) -> ChangeKind | None:  # fmt: skip
    """Verdict on a number, `None` if neither run has it; `floor` replaces smaller ones, `allowed` is the accuracy."""
    if pd.isna(after):
        # A number that is gone is worse than any other.
        return None if pd.isna(before) else ChangeKind.WORSE
    if pd.isna(before):
        return ChangeKind.CHANGED
    if before == after:
        return ChangeKind.EQUAL
    if allowed is not None and abs(after - before) <= allowed:
        return ChangeKind.WITHIN_ACCURACY
    small, large = (before, after) if floor is None else (max(before, floor), max(after, floor))
    if more_is_better:
        small, large = large, small
    if large > limit * small:
        return ChangeKind.WORSE
    return ChangeKind.BETTER if small > limit * large else ChangeKind.WITHIN_LIMIT


def timing_differences(one: ComparedRun, two: ComparedRun, shared: Sequence[str], limit: float) -> Iterator[Difference]:
    """Differences in seconds and break-even of cells that one machine measured in both runs."""
    # Undecided: other work on the machine slowed down what a disturbed row measured.
    disturbed = {key for key in shared if one.cells[key]["disturbed"] == 1 or two.cells[key]["disturbed"] == 1}
    for key in shared:
        before, after = one.cells[key], two.cells[key]
        for name in ("offline_s", "online_s"):
            verdict = _verdict(before[name], after[name], limit)
            interval: Interval | None = None
            if verdict in (ChangeKind.WORSE, ChangeKind.BETTER) and pd.notna(after[name]):
                if name == "online_s":
                    interval = _online_interval(one.rounds.get(key, []), two.rounds.get(key, []))
                else:
                    # Offline seconds are measured once: the slowdowns of the two runs bound their ratio.
                    low, high = (float(after[f"offline_{end}_s"]) for end in ("low", "high"))
                    interval = low / float(before["offline_high_s"]), high / float(before["offline_low_s"])
                clear = interval is not None and (interval[0] > 1.0 or interval[1] < 1.0)
                decided = clear and key not in disturbed
                verdict = verdict if decided else ChangeKind.UNDECIDED
            if verdict is not None:
                yield Difference(before, name, before[name], after[name], verdict, interval)
    calm = [key for key in shared if key not in disturbed]
    yield from _break_evens(one.thresholds_of(calm), two.thresholds_of(calm), limit)


def _online_interval(before: Sequence[float], after: Sequence[float]) -> Interval | None:
    """Bootstrap interval of the ratio of medians over rounds, resampled in each of the runs; `None` for few rounds."""
    if min(len(before), len(after)) < FEWEST_ROUNDS:
        return None
    # A fixed seed: the same runs always get the same verdict.
    rng = np.random.default_rng(0)
    drawn = [np.array(some)[rng.integers(len(some), size=(DRAWS, len(some)))] for some in (before, after)]
    medians_before, medians_after = (np.median(rounds, axis=1) for rounds in drawn)
    low, high = np.quantile(medians_after / medians_before, (TAIL, 1.0 - TAIL))
    return float(low), float(high)


def _break_evens(one: pd.DataFrame, two: pd.DataFrame, limit: float) -> Iterator[Difference]:
    results = ("_s", "benefit_threshold", "threshold_low", "threshold_high", "meaning")
    keys = [name for name in STORED["thresholds"] if not name.endswith(results)]
    for row in one.merge(two, on=keys, suffixes=("_one", "_two")).to_dict("records"):
        before, after = (_break_even(row, k) for k in ("one", "two"))
        # Numbers of queries have wide intervals: those that overlap are no change.
        verdict: ChangeKind | None = ChangeKind.CHANGED
        if before == after:
            verdict = ChangeKind.EQUAL
        elif before.overlaps(after):
            verdict = ChangeKind.WITHIN_LIMIT
        elif before.meaning == after.meaning:
            verdict = _verdict(before.number, after.number, limit, more_is_better=before.meaning == Meaning.UNTIL)
        own = [_verdict(row[f"{phase}_b_s_one"], row[f"{phase}_b_s_two"], limit) for phase in ("offline", "online")]
        if ChangeKind.WORSE not in own and verdict is ChangeKind.WORSE:
            # The model that it is compared with became faster.
            verdict = ChangeKind.CHANGED
        elif ChangeKind.WORSE in own and verdict is ChangeKind.CHANGED and after.meaning == Meaning.NEVER:
            verdict = ChangeKind.WORSE
        # A break-even belongs to the cell of its model b.
        of_b = ("cell", "formulation", "primal", "assembly", "bounds", "primal_tol")
        cell = row | {name: row[f"{name}_b"] for name in of_b}
        other = row["primal_a"] if row["formulation_a"] == row["formulation_b"] else row["formulation_a"]
        if verdict is not None:
            yield Difference(cell, f"break-even against {other}", str(before), str(after), verdict)


class Agreement(NamedTuple):
    """Agreement of the break-evens that two runs have."""

    both: int  # numbers with an interval in both runs
    overlapping: int  # those whose intervals have a number in common
    opposite: int  # contradictions among the comparisons that both runs decide
    decided: int


def agreement(one: pd.DataFrame, two: pd.DataFrame) -> Agreement:
    """Agreement of the break-evens of two runs, rows of their thresholds, on any machines."""
    rows = one.merge(two, on=["cell_a", "cell_b"], suffixes=("_one", "_two")).to_dict("records")
    both = overlapping = opposite = decided = 0
    for row in rows:
        a, b = _break_even(row, "one"), _break_even(row, "two")
        if Meaning.UNDECIDED in (a.meaning, b.meaning):
            continue
        decided += 1
        if a.meaning == b.meaning:
            both += a.number is not None
            overlapping += a.number is not None and a.overlaps(b)
            continue
        # "As fast" and a small difference contradict each other only if the intervals of the gains are disjoint.
        apart = row["gain_high_one"] < row["gain_low_two"] or row["gain_high_two"] < row["gain_low_one"]
        opposite += apart or Meaning.AS_FAST not in (a.meaning, b.meaning)
    return Agreement(both, overlapping, opposite, decided)


def _break_even(row: Mapping[Any, Any], run: str) -> BreakEven:
    names = (f"{name}_{run}" for name in ("benefit_threshold", "threshold_low", "threshold_high"))
    number, low, high = (None if pd.isna(row[name]) else float(row[name]) for name in names)
    return BreakEven(number, Meaning(row[f"meaning_{run}"]), low, high)
