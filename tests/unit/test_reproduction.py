"""The page that compares the paper claim by claim: its predicates, and that it lists every row and every figure."""

import html
import importlib
import math
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

from vibench_problems.paper import claims
from vibench_problems.paper import tables as paper_tables
from vibench_problems.paper.claims import Agreement
from vibench_problems.paper.published import HERTZ, OBSTACLE

ROOT = Path(__file__).parents[2]

TABLES = {"Table 1": ("(19, 50)", "(51, 70)", "(89, 50)"), "Table 2": ("(3, 12)", "(46, 70)", "(46, 12)")}
TIMES = ("offline time, on [s]", "offline time, off [s]", "offline time, off / on")
LINES = ("N", "R", *TIMES, "online time, on [s]", "online time, off [s]", "online time, on / off", "benefit threshold")


@pytest.fixture(scope="module")
def reproduction() -> Iterator[ModuleType]:
    scripts = str(ROOT / "results" / "scripts")
    sys.path.insert(0, scripts)
    yield importlib.import_module("reproduction")
    sys.path.remove(scripts)


def test_numbers_agree_within_a_relative_difference_or_an_order() -> None:
    for paper, ours, within, expected in (
        (50, 43, 0.15, True), (19, 14, 0.15, False), ((3, 46), (3, 44), 0.15, True), ((3, 46), (3, 10), 0.15, False),
        (0.09, 0.09 * (1.0 + 1e-14), 0.0, True), (1, 2, 0.0, False), ((1, 2), (1,), 1.0, False),
        (-1.25, -1.25, 0.0, True), (1.0, math.nan, 1.0, False),
    ):  # fmt: skip
        assert claims.close(paper, ours, within) is expected
    assert claims.same_order(8.0, [9.1, 12.6])
    assert not claims.same_order(8.0, [9.1, 26.0])
    assert not claims.same_order(1e-7, [2e-14])
    smaller = {0: 1.0, 1: 0.5, 2: 0.4, 3: 0.3, 5: 9.0}
    larger = {0: 1.0, 1: 0.5 * (1.0 - 1e-12), 2: 0.3, 3: 0.2, 4: 0.1}
    assert claims.exceptions(smaller, larger) == [2, 3]
    assert claims.ranges([9, 10, 11, 19, 22, 27, 28]) == "9–11, 19, 22, 27–28"


def test_break_evens_agree_in_their_intervals_and_are_written_with_them(reproduction: ModuleType) -> None:
    for meaning, low, high, expected in (
        ("from", 90.0, 110.0, "agrees"), ("from", 40.0, 110.0, "agrees"), ("from", 30.0, 110.0, "cannot be compared"),
        ("from", 20.0, 90.0, "differs"), ("from", 103.0, 110.0, "differs"), ("from", 90.0, 101.0, "differs"),
        ("from", math.nan, math.nan, "differs"), ("never", None, None, "differs"), ("until", 90.0, 110.0, "differs"),
        ("at once", None, None, "differs"), ("undecided", 90.0, None, "cannot be compared"),
    ):  # fmt: skip
        assert claims.break_even_verdict(102.0, meaning, low, high).value == expected
    for meanings, expected in (
        (["from", "from", "from"], "agrees"), (["from", "undecided", "from"], "cannot be compared"),
        (["undecided", "never"], "differs"), (["until"], "differs"),
    ):  # fmt: skip
        assert claims.cheaper_from(meanings).value == expected
    assert claims.break_even_text(28.3, "from", 18.8, 63.1) == "from 28 (19–63)"
    assert claims.break_even_text(math.nan, "never", math.nan, math.nan) == "never"
    assert claims.break_even_text(None, "undecided", 179.3, None) == "undecided (≥ 179)"
    table = reproduction.markdown(("claim",), [["n* of a|b\nis -1e-06, 2e+07 in 1e-7, 3–4"]])
    assert table.splitlines()[-1] == r"| n\* of a\|b is −1e-6, 2e7 in 1e-7, 3–4 |"


def test_causes_are_given_where_numbers_disagree_and_inputs_are_no_outcome() -> None:
    """Inputs, prescribed sizes and arithmetic on printed numbers do not count as agreement, but still may differ."""
    agreed = claims.number("Table 1", "N", 50, 47, within=0.15, why="Counted.", cause="Another mesh.")
    differing = claims.number("Table 1", "N", 50, 30, within=0.15, why="Counted.", cause="Another mesh.")
    missing = claims.number("Table 1", "ratio", 2.0, math.nan, within=0.15)
    assert (agreed.verdict.value, agreed.why) == ("agrees", "Counted.")
    assert (differing.verdict.value, differing.why) == ("differs", "Counted. Another mesh.")
    assert missing.verdict.value == "cannot be compared"
    copied, other = (claims.number("§5.1", "load", -1, ours, given=True) for ours in (-1, -2))
    assert (copied.verdict.value, other.verdict.value) == ("by construction", "differs")
    assert claims.holds("§5.2", "d ≥ γ₀ / 2", "0.09", True, why="Inputs.", given=True).why == "Inputs."
    assert claims.judged(None, given=True) is Agreement.OPEN


def test_a_ratio_that_the_paper_leaves_open_is_not_confirmed() -> None:
    found = (25.1, 19.5, "agrees"), (152.0, 25.8, "cannot be compared"), (200.0, 100.0, "differs")
    for anew, kept, expected in found:
        seconds = {"snapshots": 20.0, "POD": 0.1, "mCPG": 10.0, "PGA": anew, "PGA, residuals kept": kept}
        pair = HERTZ.pairs[2] if expected != "agrees" else OBSTACLE.pairs[0]  # 1.68 and 2.06
        claim = paper_tables.transcribed(seconds, pair, "Table")
        assert claim.verdict.value == expected
        assert all(claims.text(1.0 + value / 30.1) in claim.ours for value in (anew, kept))


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    return pd.read_csv(ROOT / "docs" / "reproduction.csv", dtype=str, keep_default_na=False)


def test_the_page_has_every_row_figure_count_and_reason(rows: pd.DataFrame, reproduction: ModuleType) -> None:
    page, named = (ROOT / "docs" / "reproduction.md").read_text(encoding="utf-8"), list(rows["claim"])
    cells = [f"{table}, {column}: {line}" for table, columns in TABLES.items() for column in columns for line in LINES]
    assert [cell for cell in cells if named.count(cell) != 1] == []
    assert {int(number) for number in re.findall(r"Fig\. (\d+)", "\n".join(named))} == set(range(1, 16))
    counts = [int((rows["verdict"] == verdict.value).sum()) for verdict in Agreement]
    assert f"| all | {' | '.join(map(str, counts))} |" in page
    assert sum(counts) == len(rows) > 150
    assert (rows.loc[rows["verdict"].isin(["differs", "cannot be compared"]), "why"] != "").all()
    prescribed = [f"Table 2, {pair.name}: {size}" for pair in HERTZ.pairs for size in "NR"]
    copied = ["Hertz, §5.2: E [Pa], ν", "Obstacle, §5.1: load [1/m]", "Obstacle, §5.1: nodes"]
    printed = [f"Table {number}: benefit thresholds from the printed seconds" for number in (1, 2)]
    verdicts = rows.set_index("claim")["verdict"]
    assert {verdicts[claim] for claim in (*prescribed, *copied, *printed)} == {Agreement.GIVEN.value}
    fit = reproduction.variants()
    assert reproduction.FIT.format(**fit) in page
    assert (fit["count"], fit["low"], fit["high"]) == (9, 10, 72)


TWINS = ROOT / "results" / "paper-figures" / "paper-figures.md"
SECTION = re.compile(
    r"^## Figure (?P<number>\d+)(?P<direct> hertz direct)?\n.*?^\*\*Here\.\*\* (?P<said>.+?)$", re.M | re.S
)
DRAWN = re.compile(r"Fig\. ([3-8]|1\d)\b")
GROUPS = "|".join(verdict.capitalize() for verdict in Agreement)


def unescaped(markdown: str) -> str:
    return html.unescape(re.sub(r"\\([\\`*_\[\]|#])", r"\1", markdown))


def judged_under_figures() -> list[tuple[str, str, str]]:
    """Statement, our value and verdict of everything that is said below the figures drawn again."""
    result = []
    for section in SECTION.finditer(TWINS.read_text(encoding="utf-8")):
        suffix = ", direct projection" if section["direct"] else ""
        groups = re.split(rf"(?:^|(?<=\.) )({GROUPS}): ", unescaped(section["said"]))[1:]
        for verdict, said in zip(groups[::2], groups[1::2], strict=True):
            for words in said.removesuffix(".").split("; "):
                statement, _, ours = words.partition(": ")
                result.append((statement + suffix, ours, verdict.lower()))
    return result


def test_both_pages_of_the_paper_have_the_same_claims_on_figures(rows: pd.DataFrame) -> None:
    """The other way round: of a figure that is drawn again, the claims of the page stand below it."""
    under_figures = judged_under_figures()
    assert len(under_figures) > 100
    short = rows["claim"].str.partition(": ")[2]
    known = set(zip(short, rows["vibench"], rows["verdict"], strict=True))
    assert [claim for claim in under_figures if claim not in known] == []
    statements = {statement for statement, _, _ in judged_under_figures()}
    of_figures = [claim for claim in rows["claim"] if DRAWN.search(claim)]
    missing = {claim for claim in of_figures if claim.partition(": ")[2] not in statements}
    assert {claim for claim in missing if not claim.endswith(", without symmetry")} == set()
