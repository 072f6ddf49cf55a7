from collections.abc import Callable

import pytest
from running import Changed

from vibench.report.findings import findings

Said = Callable[..., list[str]]


@pytest.fixture
def said(changed: Changed) -> Said:
    """Function that gives the findings of a changed copy of a real run."""
    return lambda *statements: findings(changed(*statements))


def only(texts: list[str], *words: str) -> str:
    (text,) = (text for text in texts if all(word in text for word in words))
    return text


def test_a_whole_run_is_called_whole_and_what_fell_short_is_counted(said: Said) -> None:
    whole = said()
    assert whole[0].startswith("36 cells, 36 with every query ok; 288 of 288 queries")
    assert "hold in all 288 queries" in whole[1]
    assert whole[2].startswith("Solvers that were ok on the same reduced problem agree")
    ruined = said("UPDATE cells SET status = 'inaccurate', queries_ok = 3 WHERE solver = 'osqp'")
    assert ruined[0].startswith("36 cells, 24 with every query ok; 228 of 288 queries")
    assert only(ruined, "12 cells have fewer than half of the queries ok")
    for source, cause in (("solver", "the QP solver makes"), ("assembly", "reduced assembly makes")):
        loose = said(f"UPDATE cells SET {source}_share_mean = 0.2 WHERE solver = 'osqp'")
        assert only(loose, "12 cells are not compared with others", cause)
    many = said("UPDATE cells SET R = 50, dim_W = 12 WHERE dual = 'cpg'")
    assert only(many, "cpg has 50 generators for 12 multipliers")


def test_what_is_alarming_comes_first_and_of_one_solver_no_agreement_is_told(said: Said) -> None:
    broken = "UPDATE queries SET beta_span = 9 WHERE query = 3 AND problem = 'hertz' AND solver = 'piqp'"
    violated, disagree, *_ = said(broken, "UPDATE disagreements SET flagged = 1")
    assert "of the inf-sup constants" in violated
    assert "violated" in violated
    assert disagree.startswith("Solvers disagree by more than the accuracy allows")
    one = [f"DELETE FROM {table} WHERE solver != 'piqp'" for table in ("queries", "cells")]
    whole = said(*one, "DELETE FROM disagreements")
    assert whole[0].startswith("12 cells, 12 with every query ok")
    assert not [text for text in whole if "olvers" in text]
    assert only(said("DELETE FROM disagreements"), "No two solvers were ok on the same reduced problem.")


def test_zero_solutions_declarations_and_disturbed_cells_are_counted(said: Said) -> None:
    mine = "problem = 'hertz' AND query IN (2, 5)"
    texts = said(
        f"UPDATE queries SET zero_lambda = 1, error_lambda = NULL, error_lambda_scaled = 1e-11 WHERE {mine}",
        f"UPDATE queries SET error_lambda_scaled = 0.25 WHERE {mine} AND query = 5 AND solver = 'piqp'",
    )
    assert "at most 0.25 of the largest" in only(texts, "λ of hertz is zero at 2 validation parameters")
    texts = said("UPDATE queries SET zero_lambda = 1, error_lambda = NULL", "UPDATE cells SET error_lambda_mean = NULL")
    assert not [text for text in texts if "nan" in text]
    # With 8 random parameters a share of 0.31 of the box would be met at 95 %; 3/8 is above that.
    text = only(said("UPDATE cells SET certificate = 'certified' WHERE problem = 'hertz'"), "Declarations")
    assert text.startswith("Declarations of hertz agree with the assembly at all 8 validation parameters")
    assert text.endswith("one is false in at most 0.38 of the box, at 95 %.")
    assert not [text for text in said() if "Declarations" in text]
    calm = "UPDATE cells SET disturbed = 0"
    assert not [text for text in said(calm) if "disturbed" in text]
    texts = said(calm, "UPDATE cells SET disturbed = 1 WHERE rowid = 1")
    assert only(texts, "1 of 36 timed cells was timed while other processes slowed the machine down")
