from typing import Any

import pandas as pd
from samples import cell_row

from vibench import Kind
from vibench.results import formats
from vibench.results.verdict import Verdict, verdicts

PLAIN: dict[str, Any] = {
    "problem": "box", "status": "ok", "formulation": "mixed", "dual": "mcpg", "primal": "decorrelated", "N": 8, "R": 5,
    "solver": "piqp", "hf_s": 0.1, "online_s": 2e-3, "error_u_mean": 1e-3, "error_lambda_mean": 0.08,
    "enrichment_kind": Kind.NONE, "certificate": "none", "solver_share_mean": 0.0, "assembly_share_mean": 0.0,
}  # fmt: skip
ENRICHED = PLAIN | {"primal": "pga", "N": 13, "online_s": 4e-3, "error_lambda_mean": 0.004}
ENRICHED |= {"enrichment_kind": Kind.FIXED}


def judged(*cells: dict[str, Any], meaning: str = "from") -> list[Verdict]:
    """Verdicts of these cells, each of which pays against the full model after 25 queries."""
    named = [cell_row(**cell | {"cell": f"c{k}"}) for k, cell in enumerate(cells)]
    pays = {"cell_a": None, "benefit_threshold": 25.0, "threshold_low": 23.0, "threshold_high": 28.0}
    thresholds = [pays | {"cell_b": one["cell"], "meaning": meaning} for one in named]
    return list(verdicts(pd.DataFrame(named), pd.DataFrame(thresholds)))


def test_the_fastest_query_within_the_error_is_the_best_and_says_when_it_pays() -> None:
    slower, other = ENRICHED | {"online_s": 0.01}, PLAIN | {"problem": "rope", "error_lambda_mean": 0.003}
    box, rope = judged(PLAIN, slower, ENRICHED, other | {"certificate": "certified"})
    assert str(box) == (
        "box: a full solution takes 100 ms, a query of the best model within 1 % takes 4 ms: pga on the cone of mcpg, "
        "13 modes, 5 generators, piqp, without error bounds. It pays from 25 queries on (95 % interval: 23 to 28); "
        "enriching V divides the error of λ by 20 here."
    )
    assert "with proved error bounds. It pays from 25 queries on (95 % interval: 23 to 28)." in str(rope)
    assert (formats.break_even("from", 203.4), formats.interval(202.9, 204.6)) == ("from 203", "203–205")
    # Seconds of the second cell come from a machine that was half as fast.
    (best,) = judged(ENRICHED, ENRICHED | {"online_s": 5e-3, "hf_s": 0.2})
    assert best.best["cell"] == "c1"
    for meaning, words in (
        ("until", "cheaper up to 25 queries (95 %"), ("at once", "from the first query on"), ("never", "never pays"),
        ("as fast", "does not pay"), ("undecided", "is undecided"),
    ):  # fmt: skip
        (verdict,) = judged(ENRICHED, meaning=meaning)
        assert words in str(verdict)


def test_what_is_missing_is_said_and_enrichment_is_judged_at_the_best_tolerances() -> None:
    (far,), (wild,) = judged(PLAIN, PLAIN | {"error_lambda_mean": 0.05}), judged(PLAIN | {"error_lambda_mean": 0.5})
    assert "No model is within 1 % for both u and λ; the closest is decorrelated on" in str(far)
    assert "0.1 % for u and 5 % for λ. It pays from 25 queries on" in str(far)
    assert str(wild) == str(far).replace("and 5 %", "and 50 %")
    (nobody,) = judged(ENRICHED | {"status": "inaccurate"}, ENRICHED | {"solver_share_mean": 0.2})
    assert "No model of this run takes part in a comparison" in str(nobody)
    assert judged(ENRICHED | {"hf_s": None}) == []
    (formulation,) = judged(ENRICHED | {"formulation": "regression", "primal": "–", "dual": "–", "solver": "–"})
    assert ": regression, 13 modes, 5 generators, without" in str(formulation)
    (useless,) = judged(PLAIN | {"error_lambda_mean": 0.005}, ENRICHED)
    assert "enriching V does not help here" in str(useless)
    (unknown,) = judged(PLAIN | {"dual": "cpg"}, ENRICHED)
    assert unknown.enriching is None
