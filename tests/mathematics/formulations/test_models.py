"""Formulations as models of whole problems: the identities with the mixed one, and what each says of itself."""

from dataclasses import replace

import numpy as np
import pytest
from numerics import Varying
from other_problems import Torsion
from transformed import Transformed

import vibench
from vibench import Enrichment, Formulation, Kind, Offline, PrimalStrategy, Reduction, Snapshots, Stop, UnsupportedError
from vibench.offline.models import Model
from vibench.offline.reduction import high_fidelity_sweep
from vibench.stages import formulation as _  # noqa: F401  lists the classes that formulations may store
from vibench.stages.artefacts import dumps, loads
from vibench_problems.obstacle import Obstacle
from vibench_strategies.cpg import CPG
from vibench_strategies.dictionary import Dictionary
from vibench_strategies.formulations.hyper_reduced import HyperReduced
from vibench_strategies.formulations.local import Local
from vibench_strategies.formulations.penalty import Penalty
from vibench_strategies.formulations.proximal import Proximal
from vibench_strategies.formulations.regression import Regression
from vibench_strategies.formulations.sparse_dictionary import SparseDictionary
from vibench_strategies.online_supremizers import OnlineSupremizers

MU = np.array([0.43])

STRING = Reduction(Varying(count=15), CPG(), OnlineSupremizers(), Stop(1e-6), Stop(1e-3), accuracy=1e-11)


class Supplied(PrimalStrategy):
    """Supremizers as a strategy makes them that computes its vectors itself."""

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        assert offline.span.size
        assert tolerance is None
        return Enrichment(Kind.PER_PARAMETER, supply=lambda V, vi, span: V.solve(np.asarray(vi.B.T @ span)))


@pytest.fixture(scope="module")
def processes() -> Model:
    pytest.importorskip("sklearn")
    return STRING.with_formulation(Regression()).model


@pytest.fixture(scope="module")
def membrane() -> Reduction:
    problem = Obstacle(resolution=150)
    mus = problem.training_set()[::4]
    found = Reduction(problem, CPG(), None, Stop(tolerance=1e-3), Stop(tolerance=1e-2), accuracy=1e-10)
    return found.given(snapshots=high_fidelity_sweep(problem, mus))


@pytest.mark.parametrize("formulation", [Penalty(1e-11), Proximal(), SparseDictionary()])
def test_other_ways_to_solve_the_reduced_program_give_the_mixed_answer(formulation: Formulation) -> None:
    mixed, other = STRING.model.solve(MU), STRING.with_formulation(formulation).model.solve(MU)
    assert other.status == "ok"
    assert np.allclose(other.u, mixed.u, atol=1e-8 * np.abs(mixed.u).max())
    assert np.allclose(other.lam, mixed.lam, atol=1e-6 * mixed.lam.max())
    assert 0 < other.iterations < 100


def test_all_entries_of_a_sparse_dictionary_are_the_cone_dictionary() -> None:
    whole = replace(STRING, dual=Dictionary())
    mixed, sparse = whole.model.solve(MU), whole.with_formulation(SparseDictionary()).model.solve(MU)
    assert np.allclose(sparse.u, mixed.u, atol=1e-7 * np.abs(mixed.u).max())
    vi = STRING.problem.assemble(MU)
    assert np.allclose(vi.B.T @ sparse.lam, vi.B.T @ mixed.lam, atol=1e-6 * np.abs(vi.f).max())
    few = whole.with_formulation(SparseDictionary(entries=1)).model.solve(MU)
    assert few.status == "inaccurate"
    assert "1 entries leave the violation" in few.reason
    assert np.count_nonzero(few.alpha) == 1
    rough = whole.with_formulation(SparseDictionary(tolerance=0.5)).model.solve(MU)
    assert rough.status == "ok"


@pytest.mark.parametrize("by", ["parameters", "contact"])
def test_one_cluster_is_the_mixed_model_and_several_have_smaller_spaces(by: str) -> None:
    mixed = STRING.model.solve(MU)
    one = STRING.with_formulation(Local(clusters=1, by=by)).model.solve(MU)
    assert np.allclose(one.u, mixed.u, atol=1e-9)
    assert np.allclose(one.lam, mixed.lam, atol=1e-6 * mixed.lam.max())
    several = STRING.with_formulation(Local(clusters=3, by=by)).model
    assert several.online.dimension < STRING.pod.basis.shape[1] + STRING.cone.size
    owners, steps = several.built["owners"], several.built["steps"]
    assert set(owners) == set(range(len(steps)))
    assert 1 < len(steps) <= 3
    for number, of_cluster in enumerate(steps):
        members = np.flatnonzero(owners == number)
        # the query chooses what the training chose, and each space keeps the tolerance for its own snapshots
        assert all(several.online.phase(STRING.snapshots.mu[k]) == number for k in members)
        u, V = STRING.snapshots.u[:, members], STRING.problem.V
        basis = of_cluster["pod"].basis
        rest = V.norm(u - basis @ V.gram(basis, u))
        assert np.linalg.norm(rest) <= 1e-6 * np.linalg.norm(V.norm(u)) + 1e-12
    assert several.solve(MU).status == "ok"
    stored = Local(by=by).model(STRING, loads(dumps(several.built)))
    assert np.array_equal(stored.solve(MU, several.settings()[0]).x, several.solve(MU).x)


def test_clusters_of_parameters_are_chosen_by_the_nearest_centroid() -> None:
    model = STRING.with_formulation(Local(clusters=3)).model.online
    owners = np.array([model.phase(mu) for mu in STRING.snapshots.mu])
    places = STRING.problem.parameters.to_unit(STRING.snapshots.mu)
    # k-means has ended: each centroid is the mean of those that it is nearest to
    centroids = np.array([places[owners == number].mean(axis=0) for number in range(owners.max() + 1)])
    for mu in STRING.problem.validation_set(20, 1):
        distances = np.linalg.norm(centroids - STRING.problem.parameters.to_unit(mu), axis=1)
        assert distances[model.phase(mu)] <= distances.min() + 1e-12


def test_clusters_name_their_fallbacks_and_take_no_vectors_that_are_supplied() -> None:
    offline = STRING.given(cone=replace(STRING.cone, fallbacks=("a step",)))
    model = Local(clusters=1).model(offline, {
        "weights": np.zeros((3, 1)), "owners": np.zeros(len(offline.snapshots.mu)),
        "steps": [{name: getattr(offline, name) for name in ("pod", "cone", "enrichment")}],
    })  # fmt: skip
    assert model.fallbacks == ("cluster 0: a step",)
    with pytest.raises(UnsupportedError, match="an enrichment that supplies its own vectors"):
        replace(STRING, primal=Supplied()).with_formulation(Local(clusters=1)).model  # noqa: B018


def test_processes_are_those_of_scikit_learn_and_multipliers_are_projected_on_the_cone_in_w(processes: Model) -> None:
    from sklearn.gaussian_process import GaussianProcessRegressor  # noqa: PLC0415
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern  # noqa: PLC0415

    problem, basis, W, fitted = STRING.problem, STRING.pod.basis, STRING.problem.W, processes
    of, places, variance = (fitted.built[name] for name in ("u", "places", "left_out"))
    found, place = fitted.solve(MU), problem.parameters.to_unit(MU)
    for k, values in enumerate(problem.V.gram(basis, STRING.snapshots.u)):
        kernel = ConstantKernel(of["variances"][k]) * Matern(of["lengths"][k], nu=2.5)
        process = GaussianProcessRegressor(kernel, alpha=1e-8, optimizer=None, normalize_y=True).fit(places, values)
        mean, deviation = process.predict(place[None], return_std=True)
        assert found.x[k] == pytest.approx(mean[0], rel=1e-6, abs=1e-9 * np.abs(values).max())
        variance += deviation[0] ** 2
    assert found.uncertainty == pytest.approx(np.sqrt(variance), rel=1e-3)
    # λ is the nearest of the cone in W to what the processes predict: the conditions of the projection
    span, chi, alpha = STRING.multipliers.span, STRING.cone.generators, found.alpha
    predicted = span @ fitted.online.functions.at(place)[1]
    slope = W.gram(chi, (found.lam - predicted)[:, None])[:, 0]
    assert slope.min() >= -1e-8 * W.norm(predicted)
    assert np.abs(slope[alpha > 0.0]).max() <= 1e-8 * W.norm(predicted)


def assert_interpolates(fitted: Model) -> None:
    V, W, known = STRING.problem.V, STRING.problem.W, STRING.snapshots
    for k in (0, 7):
        found = fitted.solve(known.mu[k])
        assert V.norm(found.u - known.u[:, k]) <= 1e-3 * V.norm(known.u[:, k])
        assert W.norm(found.lam - known.lam[:, k]) <= 1e-2 * W.norm(known.lam[:, k])
        assert found.lam.min() >= 0.0
        assert (found.uncertainty is None) == (fitted.formulation.kind == "radial")


def test_regression_interpolates_the_snapshots_and_its_uncertainty_has_the_size_of_the_error(processes: Model) -> None:
    problem, V, ratios = STRING.problem, STRING.problem.V, []
    assert_interpolates(processes)
    for mu in problem.validation_set(12, 0):
        found, exact = processes.solve(mu), vibench.solve_high_fidelity(problem.assemble(mu))
        ratios.append(V.norm(found.u - exact.u) / found.uncertainty)
        assert V.norm(found.u - exact.u) <= found.error_bounds.u  # the proved bound knows nothing of the regression
    assert 0.1 < np.median(ratios) < 10.0


def test_radial_basis_functions_interpolate_the_snapshots_and_reproduce_what_is_linear() -> None:
    pytest.importorskip("sklearn")  # which the formulation requires
    V, known = STRING.problem.V, STRING.snapshots
    assert_interpolates(STRING.with_formulation(Regression("radial")).model)
    # snapshots that are linear in the parameter, which few basis functions fit exactly
    first, slope = known.u[:, 0], known.u[:, -1] - known.u[:, 0]
    linear = Snapshots(known.mu, first[:, None] + slope[:, None] * known.mu.T, known.lam)
    between = STRING.given(snapshots=linear).with_formulation(Regression("radial")).model.solve(MU).u
    assert V.norm(between - first - slope * MU[0]) <= 1e-6 * V.norm(between)
    alone = STRING.given(snapshots=Snapshots(known.mu[:1], known.u[:, :1], known.lam[:, :1]))
    with pytest.raises(UnsupportedError, match="in a hyperplane, no linear function of 1 fits"):
        alone.with_formulation(Regression("radial")).model  # noqa: B018


@pytest.mark.parametrize("integrate", ["varying", "all"])
def test_the_whole_domain_is_the_mixed_formulation(membrane: Reduction, integrate: str) -> None:
    mu = np.array([0.93, 0.01, -0.02])
    whole = membrane.with_formulation(HyperReduced(tolerance=0.0, integrate=integrate)).model
    found, added = whole.solve(mu), whole.built["vectors"][:, membrane.pod.basis.shape[1] :]
    mixed = membrane.given(enrichment=Enrichment(Kind.FIXED, vectors=added)).model.solve(mu)
    assert added.size
    assert np.allclose(found.u, mixed.u, atol=1e-9)
    assert np.allclose(found.lam, mixed.lam, atol=1e-6 * mixed.lam.max())


def test_a_reduced_domain_has_the_multipliers_of_the_mixed_formulation(membrane: Reduction) -> None:
    # single rows in place of pressures on them are far off here: a membrane does not feel a point in the interior
    W, mixed = membrane.problem.W, membrane.with_formulation(HyperReduced(tolerance=0.0)).model
    reduced = membrane.with_formulation(HyperReduced(tolerance=1e-4, integrate="all")).model
    assert len(reduced.built["rows"][0]) < 0.5 * W.dim
    for mu in membrane.problem.validation_set(4, 0):
        expected, found = mixed.solve(mu).lam, reduced.solve(mu).lam
        assert W.norm(found - expected) <= 0.05 * W.norm(expected)


def test_pressures_do_the_same_work_on_few_rows(membrane: Reduction) -> None:
    chi, tolerance = membrane.cone.generators, 1e-2
    built = membrane.with_formulation(HyperReduced(tolerance)).model.built
    rows, shares = built["rows"]
    assert shares.min() > 0.0  # so that every admissible displacement satisfies the restricted constraints
    BV = membrane.problem.constraint(np.array([1.0, 0.0, 0.0]))[0] @ built["vectors"]
    whole, few = chi.T @ BV, chi[rows].T @ (shares[:, None] * BV[rows])
    lost = np.linalg.norm(whole - few, axis=1) / np.linalg.norm(whole, axis=1)
    assert np.sqrt(np.mean(lost**2)) <= 2.0 * tolerance


@pytest.mark.parametrize("integrate", ["varying", "all"])
def test_a_reduced_domain_converges_to_the_whole_one(membrane: Reduction, integrate: str) -> None:
    problem, mu = membrane.problem, np.array([0.93, 0.01, -0.02])
    exact = vibench.solve_high_fidelity(problem.assemble(mu))
    errors, elements = [], []
    for tolerance in (1e-1, 1e-3, 1e-5):
        reduced = membrane.with_formulation(HyperReduced(tolerance, integrate=integrate)).model
        found = reduced.solve(mu)
        assert found.status == "ok"
        assert reduced.built["elements"][1].min() > 0.0
        elements.append(len(reduced.built["elements"][0]))
        assert len(reduced.built["rows"][0]) < problem.W.dim
        errors.append(problem.V.norm(found.u - exact.u) / problem.V.norm(exact.u))
    assert elements == sorted(elements)
    assert elements[-1] < problem.mesh.nelements
    assert errors[2] < 0.3 * errors[0]
    assert errors[2] < 0.02


def test_the_enrichment_keeps_the_condition_of_the_contact_rigidity(membrane: Reduction) -> None:
    V, sizes = membrane.problem.V, []
    B = membrane.problem.constraint(np.array([1.0, 0.0, 0.0]))[0]
    rigidity = V.whiten_functional(np.asarray(B.T @ membrane.multipliers.span))
    for limit in (1.2, 100.0):
        vectors = membrane.with_formulation(HyperReduced(1e-1, condition=limit)).model.built["vectors"]
        sizes.append(vectors.shape[1])
        assert np.allclose(V.gram(vectors, vectors), np.eye(sizes[-1]), atol=1e-10)
        assert np.linalg.cond(rigidity.T @ V.whiten(vectors)) <= limit * np.linalg.cond(rigidity) * (1.0 + 1e-9)
    assert sizes[0] > sizes[1] >= membrane.multipliers.rank


def test_problems_without_elements_say_so_unless_nothing_has_to_be_integrated() -> None:
    with pytest.raises(UnsupportedError, match="integrates A and f by elements, the problem does not"):
        STRING.with_formulation(HyperReduced()).model  # noqa: B018
    bar = Reduction(Torsion(), CPG(), None, Stop(tolerance=1e-4), Stop(tolerance=1e-2), accuracy=1e-10)
    found = bar.with_formulation(HyperReduced(1e-4)).model.solve([6.3])
    exact = vibench.solve_high_fidelity(bar.problem.assemble(np.array([6.3])))
    assert bar.problem.V.norm(found.u - exact.u) <= 0.03 * bar.problem.V.norm(exact.u)


LENGTH = 1e4


@pytest.fixture(scope="module")
def discs() -> list[Reduction]:
    made = []
    for units in ({}, {"length": 4, "force": -3}):
        of = Transformed("hertz", {"resolution": 300}, **units)
        stops = Stop(tolerance=1e-4), Stop(tolerance=1e-1)
        made.append(Reduction(of, CPG(), OnlineSupremizers(), *stops, accuracy=1e-10))
    return made


@pytest.mark.parametrize(
    "formulation",
    [
        Penalty(),
        Proximal(),
        Local(2),
        HyperReduced(1e-2),
        *(
            pytest.param(one, marks=pytest.mark.long)
            for one in (SparseDictionary(), Regression(), Regression("radial"))
        ),
    ],
    ids=lambda formulation: " ".join([type(formulation).__name__, getattr(formulation, "kind", "")]).strip(),
)
def test_units_have_no_part_in_any_formulation(discs: list[Reduction], formulation: Formulation) -> None:
    first, second = (offline.with_formulation(formulation).model.solve([1.04]) for offline in discs)
    assert (first.status, second.status) == ("ok", "ok")
    assert np.allclose(first.u, second.u * LENGTH, rtol=1e-5, atol=1e-6 * np.abs(first.u).max())
    assert np.allclose(first.lam / first.lam.max(), second.lam / second.lam.max(), atol=1e-4)
