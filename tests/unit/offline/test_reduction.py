from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from samples import SMALL, pga_reduction, with_ways

import vibench
from vibench import UnsupportedError

PROBLEM = {"name": "radial-obstacle", "options": {"resolution": 200}}


@pytest.fixture(scope="module")
def reduce() -> partial[vibench.Reduction]:
    problem = vibench.create("problem", PROBLEM["name"], PROBLEM["options"])
    return partial(pga_reduction, problem, 1e-1, 1e-2)


@pytest.fixture(scope="module")
def snapshots(reduce: partial[vibench.Reduction]) -> vibench.Snapshots:
    return reduce().snapshots


@pytest.mark.parametrize("assembly", ["full", "certified"])
@pytest.mark.parametrize("primal", ["online-supremizers", "offline-pga"])
def test_a_reduction_answers_as_the_run_of_the_same_study(
    small_run: vibench.Run, reduce: partial[vibench.Reduction], snapshots: vibench.Snapshots, primal: str, assembly: str
) -> None:
    rows = with_ways(small_run.cells).set_index(["problem", "primal", "assembly"])
    row = rows.loc[(PROBLEM["name"], primal, assembly)]
    certified, theirs = assembly == "certified", small_run.model(row["cell"])
    reduction = reduce(
        primal=primal, tolerance=0.5 if primal == "offline-pga" else None,
        assembly="reduced" if certified else "full", bounds=certified,
        interpolation=SMALL.interpolation, accuracy=SMALL.accuracy[0], solver=theirs.solver,
    ).given(snapshots=snapshots)  # fmt: skip
    assert (reduction.pod.basis.shape[1], reduction.cone.size) == (row["N"], row["R"])
    assert reduction.enrichment.kind == row["enrichment_kind"]
    for mu in reduction.problem.validation_set(3, 1):
        one, other = reduction.model.solve(mu), theirs.solve(mu)
        assert one.status == other.status == "ok"
        assert np.allclose(one.u, other.u, rtol=0.0, atol=1e-8 * np.abs(other.u).max())
        assert (one.bound is None) == (other.bound is None) == (assembly == "full")
        if one.bound is not None and other.bound is not None:
            assert one.bound.guarantee == other.bound.guarantee
            # Snapshots of a run come from other starting points; small residuals agree in their first digits alone.
            assert one.bound.u_energy == pytest.approx(other.bound.u_energy, rel=5e-2)


def test_steps_are_made_once_and_follow_given_ones(
    reduce: partial[vibench.Reduction], snapshots: vibench.Snapshots
) -> None:
    calls: list[str] = []

    class Counting(vibench.DualStrategy):
        def reduce(self, snapshots: np.ndarray, W: vibench.InnerProduct, stop: vibench.Stop) -> vibench.ReducedSet:
            calls.append("cone")
            return vibench.greedy_cone(snapshots, W, stop)

    reduction = vibench.Reduction(reduce().problem, Counting(), None, *[vibench.Stop(size=2)] * 2, training=Few())
    assert reduction.pod.basis.shape[1] == 2
    assert not calls
    assert reduction.cone is reduction.cone
    assert reduction.model is reduction.model
    assert calls == ["cone"]
    assert reduction.enrichment.kind is vibench.Kind.NONE
    first = reduce().given(snapshots=snapshots)
    assert first.snapshots is snapshots
    whole = first.cone.size
    cone = vibench.greedy_cone(snapshots.lam, first.problem.W, vibench.Stop(size=1))
    second = first.given(cone=cone)
    assert second.snapshots is snapshots
    assert second.model.reduced.generators.shape[1] == 1
    assert first.model.reduced.generators.shape[1] == whole > 1


class Few(vibench.Sampling):
    """The corners of the box."""

    def parameters(self, box: vibench.ParameterBox) -> np.ndarray:
        return box.grid(*(2,) * box.dim)


class Centre(vibench.AdaptiveSampling):
    """The corners, one of them only because of its bound."""

    def parameters(self, box: vibench.ParameterBox) -> np.ndarray:
        return Few().parameters(box)

    def train(self, box: vibench.ParameterBox, trainer: vibench.Trainer) -> None:
        first, *others = self.parameters(box)
        trainer.solve(first)
        trainer.solve(max(others, key=trainer.bound))


def test_training_sets_of_sampling_strategies(reduce: partial[vibench.Reduction]) -> None:
    drawn = vibench.Reduction(reduce().problem, reduce().dual, None, *[vibench.Stop(size=2)] * 2, training=Few())
    assert np.array_equal(drawn.snapshots.mu, drawn.parameters)
    assert len(drawn.parameters) == 2**drawn.problem.parameters.dim
    adaptive = replace(drawn, training=Centre())
    assert len(adaptive.parameters) == 2
    assert adaptive.snapshots.u.shape == (adaptive.problem.V.dim, 2)
    assert len(adaptive.decomposed) == len(adaptive.problem.training_set())


def test_what_is_asked_for_wrongly_is_one_line(reduce: partial[vibench.Reduction]) -> None:
    right = reduce()
    for wrong, line in (
        ({"problem": type(right.problem)}, r"problem of Reduction is the class \w+, expected a Problem"),
        ({"modes": 1e-3}, r"modes of Reduction is 0\.001, expected a Stop"),
        ({"tolerance": None}, "OfflinePGA needs a tolerance"),
        ({"primal": None}, "without a primal strategy there is no tolerance"),
    ):
        with pytest.raises(vibench.RequestError, match=line):
            replace(right, **wrong)
    with pytest.raises(UnsupportedError, match="needs reduced assembly, and the model is assembled in full"):
        _ = replace(right, primal=None, tolerance=None, training=Few()).certificate


def test_certificates_hold_where_supremizers_use_few_of_the_coordinates_of_their_space() -> None:
    """Those of Hertz contact, whose loads reach some contact unknowns only."""
    problem = vibench.create("problem", "hertz", {"resolution": 300})
    given = {"primal": "online-supremizers", "tolerance": None, "assembly": "reduced", "bounds": True}
    model = pga_reduction(problem, 1e-2, 1e-2, **given).model
    for mu in problem.parameters.sample(2, 5):
        found, exact = model.solve(mu), model.high_fidelity(mu)
        e, A = exact.u - found.u, problem.assemble(mu).A
        error = float(np.sqrt(e @ (A @ e)))
        assert error <= found.bound.u_energy <= 10.0 * error
