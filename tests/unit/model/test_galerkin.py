from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import Varying
from other_problems import Torsion

from vibench import MEMBERS, HighFidelitySolution, Problem, RequestError, checked_assembly, solve_qp, supremizers
from vibench.highfidelity import active_set
from vibench.interfaces.strategies import Enrichment, Kind
from vibench.model import galerkin
from vibench.model.galerkin import ReducedModel, project, projected_members
from vibench.stability import cone_basis
from vibench_problems.hertz import Hertz
from vibench_problems.obstacle import Obstacle

ONLINE = Enrichment(Kind.PER_PARAMETER, supply=lambda V, vi, span: supremizers(V, vi.B, span))


def model(problem: Problem, solutions: list[HighFidelitySolution], enrichment: Enrichment = ONLINE) -> ReducedModel:
    chi = np.column_stack([s.lam for s in solutions if s.lam.any()])
    cone = cone_basis(chi / problem.W.norm(chi), problem.W)
    basis = problem.V.orthonormalise(np.column_stack([s.u for s in solutions]))
    return ReducedModel(problem, basis, enrichment, cone.chi, cone.span)


def test_projection_is_galerkin() -> None:
    vi, rng = Varying().assemble(np.array([0.4])), np.random.default_rng(0)
    Z, chi = rng.standard_normal((30, 3)), rng.random((8, 2))
    found = project(vi, Z, chi)
    x, alpha = rng.standard_normal(3), rng.random(2)
    assert np.isclose(x @ found.A @ x, (Z @ x) @ (vi.A @ (Z @ x)))
    assert np.isclose(found.f @ x, vi.f @ (Z @ x))
    assert np.isclose(alpha @ found.B @ x, (chi @ alpha) @ (vi.B @ (Z @ x)))
    assert np.isclose(found.g @ alpha, vi.g @ (chi @ alpha))
    assert np.array_equal(found.A, found.A.T)


@pytest.mark.parametrize(
    ("make", "left_out"),
    [(Varying, "Af"), (Torsion, ""), (partial(Obstacle, 150), "Af"), (partial(Hertz, 300), "g")],
    ids=["members", "sums", "contact", "lines"],
)
def test_projected_members_are_those_of_the_assembled_problem(make: Callable[[], Problem], left_out: str) -> None:
    # sums, members on the contact unknowns, and constraints that are assembled
    problem, rng = make(), np.random.default_rng(1)
    Z, chi = rng.standard_normal((problem.V.dim, 3)), rng.random((problem.W.dim, 2))
    made = projected_members(problem, Z, chi, {*left_out})
    for mu in problem.parameters.sample(2, seed=3):
        expected, found = project(checked_assembly(problem, mu), Z, chi), made(mu)
        assert found.keys() == set(MEMBERS) - {*left_out}
        for name, value in found.items():
            known = getattr(expected, name)
            assert np.allclose(value, known, rtol=0.0, atol=1e-10 * np.abs(known).max()), name


KINDS = {
    Kind.NONE: Enrichment(Kind.NONE), Kind.FIXED: Enrichment(Kind.FIXED, vectors=np.zeros((30, 0))),
    Kind.PER_PARAMETER: ONLINE,
}  # fmt: skip


@given(st.sampled_from(sorted(KINDS)), st.integers(14, 40), st.integers(3, 8), st.integers(1, 6), st.integers(0, 5))
@settings(max_examples=20)
def test_training_snapshots_in_the_spaces_are_reproduced(kind: Kind, n: int, m: int, count: int, which: int) -> None:
    """With supremizers the pair is stable, so u ∈ V_N' and λ in the cone make both the solution of the reduced QP."""
    problem = Varying(30 if kind is Kind.FIXED else n, m, count)
    mus = problem.training_set()
    solutions = [active_set.solve_high_fidelity(problem.assemble(mu)) for mu in mus]
    exact, contact = solutions[which % count], [s for s in solutions if s.lam.any()]
    if not contact:
        return
    reduced = model(problem, solutions, KINDS[kind])
    query, fixed = reduced.assemble(mus[which % count]), reduced.fixed_basis
    assert np.allclose(problem.V.gram(query.basis, query.basis), np.eye(query.basis.shape[1]), atol=1e-11)
    assert np.allclose(query.basis[:, : fixed.shape[1]], fixed, rtol=0.0, atol=1e-14)
    answer = solve_qp(query.program, "piqp", 1e-12)
    u, lam = query.basis @ answer.x, reduced.generators @ answer.alpha
    assert problem.V.norm(u - exact.u) <= 1e-6 * problem.V.norm(exact.u)
    if kind is Kind.PER_PARAMETER:  # only a stable pair makes the multiplier unique
        assert problem.W.norm(lam - exact.lam) <= 1e-4 * max(problem.W.norm(s.lam) for s in contact)


def test_an_enrichment_is_what_its_kind_says() -> None:
    with pytest.raises(RequestError, match="fixed enrichment"):
        Enrichment(Kind.NONE, vectors=np.zeros((3, 1)))
    with pytest.raises(RequestError, match="per-parameter enrichment"):
        Enrichment(Kind.PER_PARAMETER)


@pytest.mark.parametrize("resolution", [150, 400])
def test_bases_at_many_parameters_are_those_of_each(resolution: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a bulge B is one matrix times a number, and all share one array; with one each has its own."""
    computed, added = list[Any](), ReducedModel._added

    def counted(*given: Any) -> Any:
        computed.append(given[2])
        return added(*given)

    for bulge in (False, True):
        problem = Obstacle(resolution=resolution, bulge=bulge)
        vis = [problem.assemble(mu).copy() for mu in problem.parameters.sample(9, 1)]
        rng, V, W = np.random.default_rng(0), problem.V, problem.W
        chi = rng.random((W.dim, 12))
        cone = cone_basis(chi / W.norm(chi), W)
        online = Enrichment(Kind.PER_PARAMETER, eta=cone.span)
        reduced = ReducedModel(problem, V.orthonormalise(rng.standard_normal((V.dim, 3))), online, cone.chi, cone.span)
        computed.clear()
        with monkeypatch.context() as patch:
            patch.setattr(ReducedModel, "_added", counted)
            found = list(reduced.primal_bases(iter(vis)))
            assert len(computed) == (len(vis) if bulge else 2)
            xs = list(rng.standard_normal((len(vis), found[0].shape[1])))
            together = reduced.reconstruct_all(vis, xs)
            assert len(computed) == 2 * (len(vis) if bulge else 2)
        for vi, Z, x, u in zip(vis, found, xs, together.T, strict=True):
            np.testing.assert_allclose(Z, reduced.primal_basis(vi), atol=1e-11 * np.abs(Z).max())
            np.testing.assert_allclose(u, Z @ x, atol=1e-11 * np.abs(u).max())
        assert len({id(Z) for Z in found}) == (len(vis) if bulge else 1)


def test_of_contact_nearly_everywhere_no_dense_factor_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Supremizers are orthonormalised as vectors then; in coordinates of contact they span the same space."""
    problem, cones = Torsion(8), []
    solutions = [active_set.solve_high_fidelity(problem.assemble(np.array([twist]))) for twist in (5.0, 7.0)]
    assert len(problem.contact_dofs) == problem.V.dim
    eta, vi = problem.W.orthonormalise(np.column_stack([s.lam for s in solutions])), problem.assemble(np.array([6.0]))
    found = model(problem, solutions, Enrichment(Kind.PER_PARAMETER, eta=eta))
    dense = galerkin.ContactCoordinates(problem.V, found.fixed_basis, problem.contact_dofs)
    monkeypatch.setattr(galerkin, "ContactCoordinates", lambda *_: cones.append(1))
    plain = found.primal_basis(vi)
    assert not cones
    monkeypatch.setattr(ReducedModel, "_contact", dense)
    cosines = np.linalg.svd(problem.V.gram(plain, found.primal_basis(vi)), compute_uv=False)
    assert cosines == pytest.approx(np.ones(4))
