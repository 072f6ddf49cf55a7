from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from functools import lru_cache
from types import MappingProxyType, SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numerics import exact, space, spd

from vibench import RAYS, AffineProblem, AffineSum, InnerProduct, ParameterBox, UnsupportedError, create
from vibench.interfaces.problem import Contact, Problem, Sampler, VariationalInequality
from vibench.interfaces.strategies import Enrichment, Kind
from vibench.linalg.factorisations import Implementation
from vibench.model.affine import affine_decomposition
from vibench.model.bound_terms import BoundNote, CorrectionMode
from vibench.model.certificates import contact_correction
from vibench.model.certificates.base import Guarantee, certificate_base, unsupported
from vibench.model.certificates.bounds import OnlineBound, OnlineCertificate, prepare
from vibench.model.certificates.prepared_correction import prepare_corrections
from vibench.model.certificates.residual import ColumnBlock, residual_basis
from vibench.model.galerkin import ReducedModel
from vibench.model.hyperreduced import HyperReducedModel, hyper_reduce
from vibench.offline.reduction import high_fidelity_sweep
from vibench.qp.exact import exact_solution

N, M = 14, 5
EVERY = CorrectionMode.FEASIBLE
CONTACT = np.arange(3, 11)
BOX = ParameterBox(("a", "b"), np.array([0.5, -1.0]), np.array([2.0, 1.0]), ("1", "1"))


def theta(mu: np.ndarray) -> np.ndarray:
    return np.array([1.0, mu[0] ** 2, np.exp(mu[1])])


def scale(mu: np.ndarray) -> np.ndarray:
    return np.array([-0.5 - mu[0]])


def bound_theta(mu: np.ndarray) -> np.ndarray:
    return np.array([1.0, mu[1]])


BODY = 9
"""The first unknowns of a problem of two bodies are those of the first one, six of which are in contact."""


class Family(Problem):
    """Random matrices; A is constant, an affine sum, or interpolated, B and g vary on the contact unknowns.

    B is "moving"; or "scaled", one matrix times a function of mu; or "half" moving, on the second of two bodies; or
    "tied", where the last row is opposite to the one before.
    """

    parameters = BOX

    def __init__(self, stiffness: str, constraint: str = "moving", seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.V, self.W, self._stiffness = space(N, 1), InnerProduct(sp.eye_array(M, format="csc")), stiffness
        self._terms = tuple(sp.csr_array(0.3 * spd(N, rng, 30.0)) for _ in range(3))
        self._f, self._B, self._turn = rng.standard_normal(N), rng.standard_normal((M, 8)), rng.standard_normal((M, 8))
        self._g, self._constraint = rng.uniform(-0.3, 0.1, M), constraint
        if constraint == "half":
            apart = np.equal.outer(np.arange(N) < BODY, np.arange(N) < BODY)
            self._terms = tuple(sp.csr_array(term.toarray() * apart) for term in self._terms)
            self._turn[:, CONTACT < BODY] = 0.0
        self._dense = np.array([term.toarray() for term in self._terms])
        constant = {"constant": {"A", "f"}, "affine": {"f"}, "interpolated": {"f"}}[stiffness]
        self.constant = frozenset(constant)  # type: ignore[misc]
        self.entrywise = frozenset({"A"} if stiffness == "interpolated" else set())  # type: ignore[misc]
        sums = {"A": AffineSum(self._terms, theta)} if stiffness == "affine" else {}
        if constraint == "tied":
            for rows in (self._B, self._turn, self._g):
                rows[-1] = -2.0 * rows[-2]
        if constraint == "scaled":
            B = np.zeros((M, N))
            B[:, CONTACT] = self._B
            sums["B"] = AffineSum((sp.csr_array(B),), scale)
            sums["g"] = AffineSum((self._g, 0.2 * self._g), bound_theta)
        self.affine = MappingProxyType(sums)

    def training_set(self) -> np.ndarray:
        return self.parameters.grid(4, 4)

    def stiffness(self, mu: np.ndarray) -> sp.csr_array:
        if self._stiffness == "constant":
            return sum(self._terms)
        # Assembled some thousand times: sums of sparse matrices would take most of the seconds of these tests.
        A = np.tensordot(theta(mu), self._dense, 1)
        if self._stiffness == "interpolated":  # a little of what is no combination of few matrices
            A[np.diag_indices(N)] += 0.05 * np.cos(np.arange(N) * (mu[0] + mu[1]))
        return sp.csr_array(A)

    def assemble(self, mu: np.ndarray) -> VariationalInequality:
        B, g = self.constraint(mu)
        return VariationalInequality(self.stiffness(mu), self._f.copy(), B, g)

    @property
    def contact_dofs(self) -> np.ndarray:
        return CONTACT

    def contact(self, mu: np.ndarray) -> Contact:
        if self._constraint == "scaled":
            return Contact(sp.csr_array(scale(mu)[0] * self._B), self.affine["g"].at(mu))
        return Contact(sp.csr_array(self._B + np.sin(mu[0] + mu[1]) * self._turn), self._g * (1.0 + 0.2 * mu[1]))

    def sampler(self, wanted: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Sampler:
        return lambda mu: {"A": np.asarray(self.stiffness(mu).toarray()[wanted["A"]])}


Prepared = tuple[Any, HyperReducedModel, OnlineCertificate]


def certified(problem: Problem, basis: Any, chi: Any, tolerance: float = 1e-3, eta: Any = None) -> Prepared:
    training = problem.training_set()
    members = affine_decomposition(problem, training, tolerance)
    enrichment = Enrichment(Kind.NONE) if eta is None else Enrichment(Kind.PER_PARAMETER, eta=eta)
    model = ReducedModel(problem, problem.V.orthonormalise(basis), enrichment, chi, np.linalg.qr(chi)[0])
    reduced = HyperReducedModel(model, hyper_reduce(model, members))
    return problem, reduced, prepare(reduced, members, certificate_base(problem, members, training), training)


@lru_cache
def prepared(
    stiffness: str, per_parameter: bool = False, constraint: str = "moving", tolerance: float = 1e-3
) -> Prepared:
    rng = np.random.default_rng(5)
    basis, chi = rng.standard_normal((N, 4)), np.maximum(rng.standard_normal((M, 3)), 0.0) + 0.05
    return certified(Family(stiffness, constraint), basis, chi, tolerance, chi[:, :2] if per_parameter else None)


KINDS: list[tuple[str, bool, str]] = [
    ("constant", False, "moving"), ("constant", True, "moving"), ("affine", False, "moving"),
    ("affine", True, "moving"), ("interpolated", False, "moving"), ("constant", False, "scaled"),
    ("affine", False, "scaled"), ("affine", True, "scaled"), ("interpolated", False, "scaled"),
    ("constant", False, "half"), ("constant", True, "half"),
]  # fmt: skip
TIED = [("constant", False, "tied"), ("affine", True, "tied")]


def found(kind: Prepared, mu: np.ndarray, x: np.ndarray, alpha: np.ndarray) -> tuple[OnlineBound, float, float, float]:
    """The bound of some x and α, the errors, and the norm of u."""
    problem, model, certificate = kind
    reduced, vi = model.assemble(mu), problem.assemble(mu)
    u, lam = exact(VariationalInequality(vi.A.toarray(), vi.f, vi.B.toarray(), vi.g))
    bound = certificate.certify(problem, mu, reduced, x, alpha, EVERY)[0]
    e, force = u - reduced.reconstruct(x[:, None])[:, 0], vi.B.T @ (lam - model.generators @ alpha)
    A = vi.A.toarray()
    energies = (e @ A @ e, force @ np.linalg.solve(A, force), u @ A @ u)
    error, natural, size = (float(np.sqrt(value)) for value in energies)
    return bound, error, natural, size


def disturbed(program: VariationalInequality, size: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The solution x and α of a program, with normal errors of this size; α stays nonnegative."""
    x, alpha = exact(program)
    x = x + size * rng.standard_normal(len(x))
    return x, np.maximum(alpha + size * rng.standard_normal(len(alpha)), 0.0)


BETA = {"moving": BoundNote.NO_BODY, "scaled": BoundNote.SCALED, "half": BoundNote.ON_BODIES}


@pytest.mark.parametrize("kind", KINDS + TIED)
@given(st.integers(0, 10_000), st.sampled_from([0.0, 1e-3, 1.0, 20.0]), st.floats(0.5, 2.0), st.floats(-1.0, 1.0))
@settings(max_examples=6)
def test_no_error_is_above_its_bound(kind: tuple[str, bool, str], seed: int, size: float, a: float, b: float) -> None:
    """At any parameter of the box, for any x and any α ≥ 0, of both errors in all norms, and of the corrected pair.

    Nor is β_A below its lower bound, where there is one.
    """
    rng, mu = np.random.default_rng(seed), np.array([a, b])
    problem, model, certificate = given = prepared(*kind)
    reduced, vi = model.assemble(mu), problem.assemble(mu)
    x, alpha = disturbed(reduced.program, size, rng)
    bound, error, natural, norm = found(given, mu, x, alpha)
    scale = norm + np.linalg.norm(x) + np.linalg.norm(alpha)
    assert bound.note in {"", BoundNote.NOT_PREPARED}
    assert error <= bound.u_energy + 1e-7 * scale
    assert natural <= bound.lambda_natural + 1e-7 * scale
    assert error <= bound.relative * norm * (1.0 + 1e-9) + 1e-7 * scale
    A, B = vi.A.toarray(), vi.B.toarray()
    u, lam = exact(VariationalInequality(A, vi.f, B, vi.g))
    if kind[2] != "tied":
        beta = float(np.sqrt(np.linalg.eigvalsh(B @ np.linalg.solve(A, B.T))[0]))  # X_W is the identity
        assert bound.inf_sup_note == BETA[kind[2]]
        assert (bound.inf_sup > 0.0) == np.isfinite(bound.lam) == (kind[2] != "moving")
        assert bound.inf_sup <= beta
        assert np.linalg.norm(lam - model.generators @ alpha) <= bound.lam * (1.0 + 1e-9) + 1e-7 * (1.0 + size) / beta
        assert kind[::2] != ("constant", "scaled") or bound.inf_sup >= 0.998 * beta
    same, pair = certificate.certify(problem, mu, reduced, x, alpha, EVERY)
    assert same == bound
    corrected, nu, v = pair.bound, pair.nu, certificate.corrected(reduced.reconstruct(x), pair, CONTACT)
    assert np.min(nu) >= 0.0
    assert np.max(B @ v - vi.g) <= 1e-11 * scale
    e, force = u - v, B.T @ (lam - nu)
    assert np.sqrt(e @ A @ e) <= corrected.u_energy + 1e-7 * scale
    assert np.sqrt(force @ np.linalg.solve(A, force)) <= corrected.lambda_natural + 1e-7 * scale
    assert np.linalg.norm(lam - nu) <= corrected.lam + 1e-6 * scale
    assert np.sqrt(e @ A @ e) <= corrected.relative * norm + 1e-7 * scale
    assert corrected.rho >= bound.rho
    if kind[0] == "constant":  # nothing but the residual is left
        assert corrected.u_energy == pytest.approx(bound.rho, rel=1e-3, abs=1e-6 * scale)


@pytest.mark.parametrize("kind", TIED)
def test_what_equalities_miss_is_where_the_proof_says(
    kind: tuple[str, bool, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A larger η, with all else as it is, shows in the bound of λ_N and in those of the corrected pair."""
    mu, eta = np.array([1.2, 0.3]), 0.1
    problem, model, certificate = prepared(*kind)
    reduced = model.assemble(mu)
    x, alpha = disturbed(reduced.program, 1e-3, np.random.default_rng(4))
    monkeypatch.setattr(OnlineCertificate, "_defect_corrected", lambda *_: (np.inf, np.inf))  # of these two sorts
    before, pair = certificate.certify(problem, mu, reduced, x, alpha, EVERY)
    of_ties = contact_correction._Program.tied

    def missing_more(program: Any) -> Any:
        found = of_ties(program)
        assert found.eta < 1e-9
        return replace(found, eta=eta)

    monkeypatch.setattr(contact_correction._Program, "tied", missing_more)
    bound, other = certificate.certify(problem, mu, reduced, x, alpha, EVERY)
    spectral, at = certificate.base.spectral, certificate.base.coefficients(reduced.evaluated.samples)
    lower, upper = (1.0, 1.0) if spectral is None else spectral.evaluate(mu, at["A"])
    added = bound.lambda_natural**2 - before.lambda_natural**2
    assert bound.lambda_natural < bound.omega + bound.u_energy  # the other bound of the two
    assert added == pytest.approx(2.0 * before.rho * np.sqrt(lower) * eta, rel=1e-6)
    rho = pair.bound.rho + 0.5 * (lower + upper) * eta / np.sqrt(lower)
    assert other.bound.rho == pytest.approx(rho)
    assert other.bound.u_energy == pytest.approx(np.sqrt(rho**2 + 2.0 * pair.bound.kappa) + eta * np.sqrt(upper))


@pytest.mark.parametrize(("constraint", "size"), [("moving", 1.0), ("scaled", 1e-2)])
def test_margins_of_round_off_are_in_every_term(constraint: str, size: float) -> None:
    """m of ρ, of κ and, with ω, of rᵀw; μ of ω: larger ones show in these terms alone."""
    mu, more = np.array([1.2, 0.3]), 0.1
    problem, model, certificate = prepared("constant", constraint=constraint)
    reduced = model.assemble(mu)
    given = problem, mu, reduced, *disturbed(reduced.program, size, np.random.default_rng(4))
    before, name = certificate.certify(*given, EVERY)[0], "compliance" if certificate.prepared is None else "prepared"
    bound = replace(certificate, margin=certificate.margin + more).certify(*given, EVERY)[0]
    one, other = (np.array([each.rho, each.kappa, each.omega]) for each in (before, bound))
    assert before.kappa > 1e-2
    assert other / one == pytest.approx([1.0 + more, 1.0 + more, 1.0])
    added = bound.rho**2 - before.rho**2 + 2.0 * (bound.kappa - before.kappa) + 2.0 * more * bound.rho * bound.omega
    assert bound.lambda_natural**2 - before.lambda_natural**2 == pytest.approx(added)
    looser = replace(certificate, **{name: replace(getattr(certificate, name), error=0.21)}).certify(*given, EVERY)[0]
    assert [looser.rho, looser.kappa, looser.omega] == pytest.approx(one * [1.0, 1.0, 1.1])


def test_the_residual_of_a_corrected_pair_is_that_of_the_inner_product_in_place_of_the_stiffness() -> None:
    """u_N and λ_N satisfy the equation, and violate the constraints: what is left is (c X − A) w alone."""
    problem, reduced, certificate = certified(Family("affine", "scaled"), np.eye(N), np.eye(M))
    rng = np.random.default_rng(2)
    for mu in BOX.sample(10, 6):
        assembled, vi = reduced.assemble(mu), problem.assemble(mu)
        pressed = certificate.residual.norms[-M:] == 0.0  # where no sample does, forces are bounded alone
        A, lam = vi.A.toarray(), rng.uniform(0.0, 0.2, M) * pressed
        u_N = np.linalg.solve(A, vi.f - vi.B.T @ lam)
        x = np.linalg.lstsq(assembled.basis, u_N)[0]
        bound, found = certificate.certify(problem, mu, assembled, x, lam, EVERY)
        v = certificate.corrected(u_N, found, CONTACT)
        r = vi.f - A @ v - vi.B.T @ found.nu
        assert bound.rho < 1e-2 * found.bound.rho
        assert float(np.sqrt(r @ np.linalg.solve(A, r))) <= found.bound.rho


@pytest.mark.parametrize(("stiffness", "differs"), [("constant", False), ("affine", True), ("interpolated", True)])
def test_errors_differ_where_the_stiffness_varies(
    stiffness: str, differs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Elsewhere bounds are those of the sum of both, to the last bit."""
    mu = np.array([1.2, 0.3])
    problem, model, certificate = prepared(stiffness, True)
    reduced = model.assemble(mu)
    x, alpha = disturbed(reduced.program, 1e-3, np.random.default_rng(4))
    before = certificate.certify(problem, mu, reduced, x, alpha, EVERY)[0]
    monkeypatch.setattr(OnlineCertificate, "_defect_corrected", lambda *_: (0.0, 0.0))  # below all others
    assert (certificate.certify(problem, mu, reduced, x, alpha, EVERY)[0] != before) is differs


def test_where_a_constant_body_moves_at_a_parameter_there_is_no_inf_sup_constant() -> None:
    """What was the same at all training parameters may be another one elsewhere: this is looked at."""
    _, model, certificate = prepared("constant", constraint="half")
    mu = np.array([1.3, 0.2])
    reduced = model.assemble(mu)
    solution = exact(reduced.program)
    moved = Turned("constant", "half")
    reduced = replace(reduced, evaluated=replace(reduced.evaluated, contact=moved.contact(mu)))
    bound = certificate.certify(moved, mu, reduced, *solution, EVERY)[0]
    assert (bound.inf_sup, bound.inf_sup_note, bound.lam) == (0.0, BoundNote.NOT_CONSTANT, np.inf)
    assert np.isfinite(bound.lambda_natural)


class Turned(Family):
    """One entry of the constraint on the first body changes with the parameter."""

    def contact(self, mu: np.ndarray) -> Contact:
        contact = super().contact(mu)
        B = contact.B.toarray()
        B[0, 0] += 1e-9 * mu[0]
        return Contact(sp.csr_array(B), contact.g)


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_of_reduced_solutions_are_sharp(kind: tuple[str, bool, str]) -> None:
    given, effectivities = prepared(*kind), []
    assert (given[2].prepared is None) == (kind[2] == "moving")
    for mu in BOX.sample(12, 4):
        bound, error, natural, _ = found(given, mu, *exact(given[1].assemble(mu).program))
        both = float(np.hypot(error, natural))  # what the identity bounds; one of the two may be most of it
        effectivities.append((bound.u_energy / both, bound.lambda_natural / natural))
    assert np.all(np.median(effectivities, axis=0) <= (2.0, 4.0))


@pytest.mark.parametrize(("constraint", "loss"), [("scaled", 1.0), ("half", 1.5)])
def test_prepared_corrections_are_the_best_ones_or_close_to_them(constraint: str, loss: float) -> None:
    """With them the bounds are the same as with the best w, or those of a w that moves one of two bodies."""
    problem, model, certificate = prepared("constant", constraint=constraint)
    without = replace(certificate, prepared=None)
    for mu in BOX.sample(20, 6):
        reduced = model.assemble(mu)
        solution = exact(reduced.program)
        quick, best = (one.certify(problem, mu, reduced, *solution, EVERY)[0] for one in (certificate, without))
        assert quick.note == best.note == ""
        assert best.u_energy * (1.0 - 1e-6) <= quick.u_energy <= loss * best.u_energy * (1.0 + 1e-6)
        assert quick.lambda_natural <= loss * best.lambda_natural * (1.0 + 1e-6)


def test_where_no_prepared_correction_is_feasible_the_best_one_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Corrections of the first two rows alone leave the others violated."""
    monkeypatch.setattr(OnlineCertificate, "_defect_corrected", lambda *_: (np.inf, np.inf))  # if none are prepared
    problem, model, certificate = prepared("affine", constraint="scaled")
    term, rows = problem.affine["B"].terms[0][:, CONTACT], np.arange(M) < 2
    at_contact = certificate.contact_basis, certificate.contact_directions
    few = replace(certificate, prepared=prepare_corrections(term, True, certificate.compliance, rows, *at_contact))
    without = replace(certificate, prepared=None)
    for mu in BOX.sample(20, 6):
        reduced = model.assemble(mu)
        solution = exact(reduced.program)
        bound, error, natural, _ = found((problem, model, few), mu, *solution)
        assert bound == replace(without.certify(problem, mu, reduced, *solution, EVERY)[0], note=BoundNote.NOT_PREPARED)
        assert error <= bound.u_energy
        assert natural <= bound.lambda_natural


@pytest.mark.parametrize("constraint", ["scaled", "half"])
def test_small_residuals_keep_their_digits(constraint: str) -> None:
    """ρ of a solution that the space represents up to 1e-9 is that of the assembled residual."""
    problem, model, certificate = prepared("constant", constraint=constraint)
    mu = np.array([1.3, 0.2])
    reduced, vi = model.assemble(mu), problem.assemble(mu)
    A, rng = vi.A.toarray(), np.random.default_rng(2)
    x, alpha = rng.standard_normal(4), np.abs(rng.standard_normal(3))
    Z, force = reduced.basis, vi.B.T @ (model.generators @ alpha)
    away = rng.standard_normal(N)
    for size in (1e-6, 1e-9):
        load = A @ (Z @ x) + force + size * away  # f for which x and α have the residual size · away
        others = [np.asarray(term @ model.basis) for term in certificate.base.terms]
        blocks = [load[:, None], *others, np.eye(problem.V.dim)[:, problem.contact_dofs]]
        if certificate.forces is None:
            blocks[-1] = np.asarray(problem.affine["B"].terms[0].T @ model.generators)
        of_lam = scale(mu) * alpha
        if certificate.forces is not None:
            of_lam = force[CONTACT]
        z = np.concatenate([np.ones(1), -x, -of_lam])
        whiten = certificate.base.X.whiten_functional
        whitened = [ColumnBlock(whiten(block), np.zeros(block.shape[1]), N) for block in blocks]
        basis, _ = residual_basis(whitened, z[:, None], 0.0)
        exact_norm = size * float(np.sqrt(away @ np.linalg.solve(A, away)))
        coordinates, beside, _ = basis.parts(z)
        assert np.hypot(np.linalg.norm(coordinates), beside) == pytest.approx(exact_norm, rel=1e-5)


def test_a_multiplier_that_is_small_beside_the_error_of_u_is_bounded() -> None:
    """What is left of Δ² + 2 rᵀw may be round-off alone, and is then in the bound."""
    problem = Family("constant", "scaled")
    mu, rng = np.array([1.0, 0.0]), np.random.default_rng(3)
    (B, g), A = problem.constraint(mu), problem.stiffness(mu).toarray()
    u, lam = np.linalg.lstsq(B.toarray(), g)[0], 1e-9 * rng.uniform(0.5, 1.5, M)
    problem._f = A @ u + B.T @ lam
    given = certified(problem, np.eye(N), np.eye(M))
    for _ in range(10):
        u_N = u + np.linalg.solve(A, B.T @ rng.uniform(0.05, 0.15, M))
        x = np.linalg.lstsq(given[1].assemble(mu).basis, u_N)[0]
        bound, _, natural, _ = found(given, mu, x, np.zeros(M))
        assert natural <= bound.lambda_natural <= 1e-5 * bound.rho


class Loose(AffineProblem):
    """Two unknowns, one tied to the other, on springs so weak that round-off in the factor of A shows in the bound."""

    parameters = ParameterBox(("load",), np.array([1.0]), np.array([2.0]), ("1",))

    def __init__(self, springs: float) -> None:
        self.V, self.W = (InnerProduct(sp.eye_array(size, format="csc")) for size in (2, 1))
        A, B = (sp.csr_array(rows) for rows in ([[1.0 + springs, -1.0], [-1.0, 1.0 + springs]], [[-1.0, 0.0]]))
        self.declare(A=A, f=[("load", np.ones(2))], B=B, g=np.ones(1))

    def training_set(self) -> np.ndarray:
        return self.parameters.grid(2)


def test_round_off_of_the_factor_is_in_the_residual_and_in_the_compliance() -> None:
    """Without contact the bound of u_N = 0 is ‖u‖_A: the computed norm is 2e-8 of it too small."""
    problem: Any = Loose(3e-9)
    _, model, certificate = certified(problem, np.eye(2, 1), np.ones((1, 1)))
    stiffness = problem.assemble(np.ones(1)).A[0, 0] - 1.0  # of both unknowns together, without round-off
    missed = certificate.base.compliance[0, 0] * stiffness * (2.0 + stiffness) / (1.0 + stiffness) - 1.0
    assert 1e-9 <= abs(missed) <= certificate.base.compliance_error <= 1e-5
    for load in (1.0, 1.5, 2.0):
        mu = np.array([load])
        bound, _ = certificate.certify(problem, mu, model.assemble(mu), np.zeros(1), np.zeros(1), EVERY)
        assert bound.guarantee is Guarantee.CERTIFIED
        assert 0.0 <= bound.u_energy / (load * np.sqrt(2.0 / stiffness)) - 1.0 <= 1e-5


def test_relative_bounds_hold_whatever_rounding_leaves_of_energies() -> None:
    """The energy of u_N is what cancellation leaves of terms 1e9 times as large."""
    problem: Any = Loose(3e-9)
    mu, A = np.ones(1), [[Fraction(entry) for entry in row] for row in problem.assemble(np.ones(1)).A.toarray()]
    for size in 1.0 + 1e-5 * np.linspace(-1.0, 1.0, 5):
        _, model, certificate = certified(problem, np.array([[1.0], [size]]), np.ones((1, 1)))
        reduced = model.assemble(mu)
        x = 1.3 * reduced.program.f / reduced.program.A[0]
        u = [Fraction(entry) for entry in model.basis @ x]
        energy = float(sum(u[i] * A[i][j] * u[j] for i in range(2) for j in range(2)))
        bound, _ = certificate.certify(problem, mu, reduced, x, np.zeros(1), EVERY)
        assert 0.0 < bound.relative < 0.5
        assert bound.u_energy / bound.relative <= np.sqrt(energy) - bound.u_energy


@pytest.mark.parametrize("kind", KINDS[2::4])
def test_a_model_without_generators_is_certified(kind: tuple[str, bool, str]) -> None:
    """No training parameter had contact: λ_N is zero everywhere."""
    basis = np.random.default_rng(5).standard_normal((N, 4))
    given = certified(Family(kind[0], kind[2]), basis, np.zeros((M, 0)))
    for mu in BOX.sample(5, 3):
        program = given[1].assemble(mu).program
        bound, error, natural, _ = found(given, mu, np.linalg.solve(program.A, program.f), np.zeros(0))
        assert error <= bound.u_energy < np.inf
        assert natural <= bound.lambda_natural < np.inf


class Rough(Family):
    """A is interpolated with errors of its own size."""

    def stiffness(self, mu: np.ndarray) -> sp.csr_array:
        rough = 0.07 * np.cos(np.arange(N) * (mu[0] + mu[1]) ** 2)
        return sp.csr_array((1.0 + 0.1 * mu[0]) * self._terms[0] + sp.diags_array(rough))


def test_where_interpolation_errors_are_as_large_as_the_coercivity_there_is_no_bound() -> None:
    """‖u_N‖_X follows from α − η: no bound is said to be worth anything where that is not positive."""
    basis = np.random.default_rng(5).standard_normal((N, 4))
    chi = np.maximum(np.random.default_rng(6).standard_normal((M, 3)), 0.0) + 0.05
    given = certified(Rough("interpolated", "scaled"), basis, chi, 0.2)
    _, reduced, certificate = given
    refused = 0
    for mu in BOX.sample(25, 3):
        bound, error, *_ = found(given, mu, *exact(reduced.assemble(mu).program))
        refused += bound.guarantee is Guarantee.NONE
        assert (bound.note == BoundNote.NOT_COERCIVE) == (bound.guarantee is Guarantee.NONE) == np.isinf(bound.u_energy)
        assert error <= bound.u_energy
        assert bound.u_energy == np.inf or bound.coercivity > certificate.base.stiffness_error
    assert refused


def test_outside_the_box_only_exact_models_have_bounds() -> None:
    """Interpolation errors are measured inside it: bounds of interpolated models are verified there."""
    verified = prepared("interpolated")[2].base
    assert verified.guarantee is Guarantee.VERIFIED
    assert verified.stiffness_error > 0.0
    for iterative, worth in ((False, Guarantee.CERTIFIED), (True, Guarantee.VERIFIED)):  # iterations prove nothing
        with pytest.MonkeyPatch.context() as here:
            here.setattr(Implementation, "is_iterative", iterative)
            bases = [prepared(one, tolerance=1e-3 + iterative)[2].base for one in ("constant", "affine")]
        assert {base.guarantee for base in bases} == {worth}
        assert bases[0].spectral is None
    mu = np.array([2.3, 0.4])
    for stiffness, has_bound in (("affine", True), ("interpolated", False)):
        given = prepared(stiffness, constraint="scaled")
        bound, error, natural, _ = found(given, mu, *exact(given[1].assemble(mu).program))
        assert (bound.note == BoundNote.OUTSIDE) != has_bound
        assert (bound.guarantee is Guarantee.CERTIFIED) == has_bound == np.isfinite(bound.u_energy)
        assert error <= bound.u_energy
        assert natural <= bound.lambda_natural


class Bump(Family):
    """A and f are constant but for bumps between the parameters at which the problem is looked at."""

    where = np.array([1.07, 0.31])

    def __init__(self, member: str, declared: frozenset[str]) -> None:
        super().__init__("constant", "scaled")
        self.member, self.constant = member, declared

    def assemble(self, mu: np.ndarray) -> VariationalInequality:
        vi, height = super().assemble(mu), 0.5 * float(np.linalg.norm(mu - self.where) < 1e-3)
        return replace(vi, **{self.member: (1.0 + height) * getattr(vi, self.member)})


@pytest.mark.parametrize("member", ["A", "f"])
@pytest.mark.parametrize("declared", ["", "A", "f"])
def test_what_is_not_declared_is_not_certified_however_constant_it_was_found(member: str, declared: str) -> None:
    """The measured errors are zero to round-off; bounds are above errors but in the bump, which nothing measured."""
    given = certified(Bump(member, frozenset(declared)), np.eye(N), np.eye(M))
    reduced, base = given[1], given[2].base
    assert base.load_error == 0.0
    assert base.stiffness_error <= 1e-14  # the round-off of sums over entries
    assert base.guarantee is Guarantee.VERIFIED
    bound, error, *_ = found(given, Bump.where, *exact(reduced.assemble(Bump.where).program))
    if member in declared:
        return  # the problem says what is not so, which no measurement can be expected to find
    assert bound.guarantee is Guarantee.VERIFIED
    assert error > 10.0 * bound.u_energy
    mu = np.array([2.3, 0.4])
    outside, *_ = found(given, mu, *exact(reduced.assemble(mu).program))
    assert outside.note == BoundNote.OUTSIDE


def test_interpolation_errors_are_in_the_bound() -> None:
    """A coarse interpolation makes an error that the residual of the interpolated A does not see."""
    problem, model, certificate = prepared("interpolated", tolerance=0.02)
    size = certificate.base.stiffness_error
    blind = replace(certificate, base=replace(certificate.base, stiffness_error=0.0))
    assert size > 1e-6
    for mu in BOX.sample(20, 8):
        reduced = model.assemble(mu)
        x, alpha = exact(reduced.program)
        bound, error, natural, _ = found((problem, model, certificate), mu, x, alpha)
        assert error <= bound.u_energy
        assert natural <= bound.lambda_natural
        assert bound.coercivity > 2.0 * size
        plain, lower = blind.certify(problem, mu, reduced, x, alpha, EVERY)[0], bound.coercivity
        of_u = np.sqrt(x @ reduced.program.A @ x / (lower - size))
        assert bound.rho == pytest.approx(plain.rho + size * of_u / np.sqrt(lower), rel=1e-9)
        assert bound.rho > plain.rho * (1.0 + 1e-6)
    # nor have multipliers outside the cone a bound
    given = prepared("constant")
    mu, alpha = np.array([1.0, 0.0]), np.array([-10.0, 0.0, 0.0])
    bound = given[2].certify(given[0], mu, given[1].assemble(mu), np.zeros(4), alpha, EVERY)[0]
    assert (bound.guarantee, bound.note, bound.u_energy) == (Guarantee.NONE, BoundNote.NOT_IN_CONE, np.inf)


def test_problems_that_cannot_be_certified_say_why() -> None:
    """A domain obstacle of 30,000 unknowns needs a dense matrix of 7 GB."""
    problem = type("Without", (Family,), {"has_contact": False})("constant")
    members = affine_decomposition(problem, problem.training_set(), 1e-3)
    with pytest.raises(UnsupportedError, match="contact unknowns"):
        certificate_base(problem, members, problem.training_set())
    wide = cast(Any, SimpleNamespace(has_contact=True, contact_dofs=np.arange(30_000), K=RAYS))
    assert unsupported(wide, {}) == (
        "the constraint touches 30000 unknowns, and certificates need their compliance, a dense matrix of 7 GB; the "
        "limit is 4.3 GB, 23170 unknowns"
    )
    # Interpolation errors are measured at random parameters, where a problem of listed ones has no matrices.
    for stiffness, word in (("affine", ""), ("interpolated", "listed parameters only")):
        problem = Family(stiffness)
        training = problem.training_set()
        members = affine_decomposition(problem, training, 1e-3)
        problem.parameters = replace(BOX, listed=training)
        assert word in unsupported(problem, members)
        assert bool(unsupported(problem, members)) == bool(word)


def test_what_is_stored_is_of_contact_and_reduced_size() -> None:
    """Only the base has arrays of mesh size, which no evaluation reads."""
    problem, model, certificate = prepared("affine")
    without = replace(certificate.base, X=cast(Any, None), terms=())
    forgetful = replace(certificate, base=without)
    mu = np.array([1.2, 0.3])
    reduced = model.assemble(mu)
    solution = exact(reduced.program)
    one, other = (each.certify(problem, mu, reduced, *solution, EVERY)[0] for each in (forgetful, certificate))
    assert one == other


@pytest.mark.parametrize("name", ["hertz", "moving"])
def test_bounds_and_a_correction_evaluate_the_constraint_once(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The assembly of "moving" projects it, that of Hertz takes less, and certificate and correction share one."""
    if name == "moving":
        problem, model, certificate = prepared("interpolated")
    else:
        problem = create("problem", "hertz", {"resolution": 300})
        snapshots = high_fidelity_sweep(problem, problem.parameters.grid(*[2] * problem.parameters.dim))
        chi = snapshots.lam[:, :3] / problem.W.norm(snapshots.lam[:, :3])
        problem, model, certificate = certified(problem, snapshots.u, chi, 1e-6)
    mu, evaluated, contact = problem.parameters.sample(1, 3)[0], list[float](), problem.contact
    monkeypatch.setattr(problem, "contact", lambda at: evaluated.append(1.0) or contact(at))
    reduced = model.assemble(mu)
    assert len(evaluated) == (name == "moving")
    solution = exact_solution(reduced.program)
    bound, pair = certificate.certify(problem, mu, reduced, solution.x, solution.alpha, EVERY)
    assert bound.u_energy < np.inf
    assert pair is not None
    assert len(evaluated) == 1
