import numpy as np
import pandas as pd

from vibench.results.consistency import added_up, violations
from vibench.results.schema import STORED

CONSTANTS = [name for name in STORED["queries"] if name.startswith("beta_") and "energy" not in name]
GOOD: dict[str, float | str] = dict.fromkeys(CONSTANTS, 0.1) | dict.fromkeys(
    [name for name in STORED["queries"] if name.startswith("effectivity_")], 1.0
)
GOOD |= {f"beta_full_{what}": 0.2 for what in ("span", "cone_lower", "cone_upper")}
GOOD |= {"beta_bounds": "L0/U0"}
KINDS = pd.Series({"a": "fixed", "b": "per-parameter"})


def rows(**changed: float | str | None) -> pd.DataFrame:
    online = GOOD | {f"beta_{what}": 0.2 for what in ("span", "cone_lower", "cone_upper")}
    return pd.DataFrame([{"cell": "a", **GOOD, **changed}, {"cell": "b", **online}])


def test_constants_in_order_are_fine_and_so_is_round_off() -> None:
    assert violations(rows(), KINDS) == []
    assert violations(rows(beta_plain_span=0.1 * (1.0 + 5e-9)), KINDS) == []
    assert violations(rows(effectivity_u=np.nan, effectivity_lambda=40.0), KINDS) == []
    assert violations(rows(effectivity_lambda_natural=1.0 - 1e-11), KINDS) == []
    assert violations(rows(beta_span=np.inf, beta_full_span=np.inf, beta_cone_upper=np.inf), KINDS) == []


def test_every_violation_is_found_and_named() -> None:
    for changed, names in (
        ({"beta_span": 0.05, "beta_plain_span": 0.06}, "beta_span ≥ beta_plain_span"),
        ({"beta_hf_span": 0.21, "beta_hf_cone_upper": 0.3}, "beta_full_span ≥ beta_hf_span"),
        ({"beta_plain_cone_upper": 0.09}, "beta_plain_cone_upper ≥ beta_plain_span"),
        ({"beta_cone_lower": 0.11}, "beta_cone_upper ≥ beta_cone_lower"),
        ({"beta_span": np.nan}, "beta_span ≥ beta_plain_span"),
        ({"effectivity_u": 0.999}, "effectivity_u ≥ 1"),
        ({"effectivity_lambda_natural": 1.0 - 1e-9}, "effectivity_lambda_natural ≥ 1"),
        ({"effectivity_lambda": 0.5}, "effectivity_lambda ≥ 1"),
    ):
        found = violations(rows(**changed), KINDS)
        assert names in [violation.invariant for violation in found]
        assert all(violation.rows == 1 for violation in found)


def test_a_formulation_without_constants_is_judged_by_its_bounds_alone() -> None:
    without = dict.fromkeys(name for name in CONSTANTS if "hf" not in name)
    assert violations(rows(**without, bounds=None), KINDS) == []
    found = violations(rows(**without, bounds=None, effectivity_u=0.999), KINDS)
    assert [violation.invariant for violation in found] == ["effectivity_u ≥ 1"]


def test_per_parameter_enrichments_must_reach_the_whole_space() -> None:
    frame = rows()
    frame.loc[1, "beta_span"] = 0.19
    found = violations(frame, KINDS)
    assert [str(v) for v in found] == ["beta_span ≥ beta_full_span is violated in 1 rows, by up to 1.0e-02"]


def test_a_cone_with_free_generators_is_compared_with_the_high_fidelity_pair_over_the_span_alone() -> None:
    above = {"beta_hf_cone_lower": 0.3, "beta_hf_cone_upper": 0.3}
    assert [v.invariant for v in violations(rows(**above), KINDS)] == ["beta_full_cone_upper ≥ beta_hf_cone_lower"]
    assert violations(rows(**above, beta_bounds="span/span"), KINDS) == []
    found = violations(rows(**above, beta_bounds="span/U1", beta_hf_span=0.25), KINDS)
    assert [v.invariant for v in found] == ["beta_full_span ≥ beta_hf_span"]


def test_violations_of_parts_are_those_of_the_whole() -> None:
    parts = [rows(beta_cone_lower=0.11), rows(), rows(beta_cone_lower=0.13, effectivity_u=0.5), rows(beta_span=np.nan)]
    whole = {str(one) for one in violations(pd.concat(parts, ignore_index=True), KINDS)}
    assert {str(one) for one in added_up(one for part in parts for one in violations(part, KINDS))} == whole
