"""Polynomials on the parameter box in place of A, f, B and g of a reduced model, which need no code of its problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, RequestError, in_a_line
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.interfaces.validation import training_parameters
from vibench.model.affine import affine_decomposition, check_affine
from vibench.model.chebyshev import AffinePolynomial, compressed, interpolate_on_box
from vibench.model.galerkin import projections
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel, hyper_reduce

# Defaults of the largest relative error of a polynomial, with which solutions agree to 1e-9 and better, and of the
# largest number of points of the interpolation grid.
TOLERANCE, EVALUATIONS = 1e-11, 4096

# From the θ of the members at a parameter to further arrays that are interpolated.
Beside = Callable[[Mapping[str, Array]], Mapping[str, Array]]


class InaccurateError(RequestError):
    """Polynomials do not reach the tolerance; their relative `error`."""

    def __init__(self, message: str, error: float) -> None:
        super().__init__(message)
        self.error = error


def member_polynomials(
    queried: AnyReducedModel, tolerance: float, evaluations: int, *, beside: Beside | None = None,
    rotated: Mapping[str, Array] = {}, check: Callable[[VariationalInequality], None] | None = None,
    left_out: Sequence[str] = (),
) -> dict[str, AffinePolynomial]:  # fmt: skip
    """Polynomials of the members of a `declared_model`."""
    # A is a packed upper triangle (row by row). The arrays of `beside` have polynomials, too. Those in `rotated` are
    # the θ of A times a matrix, by name: one polynomial serves them and A. `check` may refuse a model by its program at
    # one parameter, before it is interpolated. Members that are `left_out` have no polynomials.
    box = queried.problem.parameters
    try:
        first = members_of(queried, box.lower, coefficients_of(queried, box.lower))
        if not len(first.f) or not len(first.g):
            raise RequestError("the model has no unknowns or no constraints")
        # Before the interpolation, which is the expensive part.
        if check is not None:
            check(first)
        terms = declared_terms(queried)
        shared = rotated and "A" not in terms
        if rotated:
            terms |= {"A": _stiffness_terms(queried, box.lower)} | {name: of.T for name, of in rotated.items()}
        theta_of = {name: "A" if name in rotated else name for name in terms}
        # Of a constant member nothing is sampled: thousands of copies of A take gigabytes.
        packed = _packed(first, len(first.f), box.lower)
        constant = {name: packed[name][None, :] for name in queried.problem.constant if name not in terms}
        terms |= constant
        chosen = [name for name in MEMBERS if name not in left_out]

        def evaluate(mu: Array) -> dict[str, Array]:
            theta = coefficients_of(queried, mu)
            found = {} if beside is None else dict(beside(theta))
            # Members whose terms are known are not evaluated.
            if any(name not in terms for name in chosen):
                packed = _packed(members_of(queried, mu, theta), len(first.f), mu)
                found |= {name: packed[name] for name in chosen}
            # In place of a sum of known terms its θ.
            found |= {name: theta[member] for name, member in theta_of.items()}
            return found | {name: np.ones(1) for name in constant}

        # Coefficients cost little beside a member.
        budget = evaluations if any(name not in terms for name in chosen) else 4 * evaluations
        grid, alike = (box.lower, box.upper, tolerance, budget), ["A", *rotated] if rotated else []
        polynomials = interpolate_on_box(evaluate, *grid, terms=terms, alike=alike)
    except NumericalError as error:
        raise RequestError(f"the model cannot be evaluated in the whole parameter box: {error}") from None
    except (ArithmeticError, ValueError, LookupError) as error:
        # The code of a problem may raise any of these at the corners of its box.
        raise RequestError(f"the model cannot be evaluated in the whole parameter box: {in_a_line(error)}") from None
    worst = max(polynomials, key=lambda name: polynomials[name].error)
    if (reached := polynomials[worst].error) > tolerance:
        degrees = ", ".join(map(str, polynomials[worst].degrees))
        why = "depends on mu through the code of the problem, which the file cannot hold"
        inaccurate = f"polynomials of degree ({degrees}) reach a relative error of {reached:.1e}, not {tolerance:.0e}"
        raise InaccurateError(f"{worst} {why}, and {inaccurate}", reached)
    if shared:
        # The terms of the certificate are not the best for A.
        polynomials["A"] = compressed(polynomials["A"], tolerance)
    return polynomials


def declared_model(queried: AnyReducedModel, *, coded: bool = False) -> AnyReducedModel:
    """The model without high-fidelity assembly where its problem declares all members constant or affine sums."""
    # Their terms are projected, whatever the assembly of the cell was; any other model is returned as it is. If `coded`
    # B and g may have C code instead. Raises a `RequestError` for declarations that are false.
    if isinstance(queried, HyperReducedModel):
        return queried
    problem = queried.problem
    training = training_parameters(problem)
    known = {*problem.constant, *problem.affine, *("Bg" if coded and problem.contact_source() is not None else "")}
    try:
        if queried.enrichment.supply is not None or not set(MEMBERS) <= known:
            check_affine(problem, training)
            return queried
        members = affine_decomposition(problem, training, tolerance=TOLERANCE)
        return HyperReducedModel(queried, hyper_reduce(queried, members))
    except NumericalError as error:
        raise RequestError(f"the model cannot be evaluated in the whole parameter box: {error}") from None


def declared_terms(queried: AnyReducedModel) -> dict[str, Array]:
    """Flat terms (Q×size) of the members declared affine, of A packed upper triangles, on a fixed space."""
    if isinstance(queried, HyperReducedModel):
        return queried.declared_terms()
    problem, of = queried.problem, projections(queried.fixed_basis, queried.generators)
    upper = np.triu_indices(queried.fixed_basis.shape[1])
    declared = {name: sums.mapped(of[name]) for name, sums in problem.affine.items() if name not in problem.constant}
    return {n: np.stack([t[upper] if n == "A" else np.ravel(t) for t in sums.terms]) for n, sums in declared.items()}


def _stiffness_terms(queried: AnyReducedModel, mu: Array) -> Array:
    """Flat terms (Q×size) of A, packed upper triangles, of a model that evaluates their coefficients."""
    theta = coefficients_of(queried, mu)
    terms = (members_of(queried, mu, {**theta, "A": one}).A for one in np.eye(len(theta["A"])))
    return np.stack([np.asarray(term)[np.triu_indices(len(term))] for term in terms])


def coefficients_of(queried: AnyReducedModel, mu: Array) -> Mapping[str, Array]:
    """θ (Q,) at a parameter of the members that are sums of terms, as far as the model evaluates them."""
    if isinstance(queried, HyperReducedModel):
        return queried.coefficients(mu)
    problem = queried.problem
    return {name: sums.coefficients(mu) for name, sums in problem.affine.items() if name not in problem.constant}


def members_of(queried: AnyReducedModel, mu: Array, theta: Mapping[str, Array]) -> VariationalInequality:
    """A, f, B, g at a parameter with these coefficients, on a space that does not depend on it."""
    if isinstance(queried, HyperReducedModel):
        return queried.members(mu, theta)
    if queried.kind is Kind.PER_PARAMETER:
        changes = "the enrichment changes the basis at every parameter, the cell assembles in full"
        why = f"{changes}, and its problem does not declare all members constant or affine"
        raise RequestError(f'{why}; export the same cell with assembly = "reduced"')
    return queried.assemble(mu).program


def _packed(found: VariationalInequality, size: int, mu: Array) -> dict[str, Array]:
    """Members at mu (d,) as flat arrays; of A the upper triangle."""
    if len(found.f) != size:
        raise RequestError(f"the reduced program has {len(found.f)} unknowns at mu = {mu.tolist()}, {size} elsewhere")
    arrays = {name: np.asarray(getattr(found, name)) for name in MEMBERS}
    arrays["A"] = 0.5 * (arrays["A"] + arrays["A"].T)[np.triu_indices(size)]
    if not all(np.all(np.isfinite(array)) for array in arrays.values()):
        raise NumericalError(f"it has entries that are not finite at mu = {mu.tolist()}")
    return {name: array.ravel() for name, array in arrays.items()}
