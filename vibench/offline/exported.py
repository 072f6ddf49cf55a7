"""A reduced model as programs hold it that have no code of its problem: polynomials, outputs and bounds."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass
from functools import partial
from math import hypot, sqrt
from types import MappingProxyType
from typing import Any

import numpy as np

from vibench.arrays import Array, Indices
from vibench.errors import RequestError
from vibench.interfaces.outputs import Output
from vibench.interfaces.problem import MEMBERS, Problem
from vibench.model.certificates.base import Guarantee, contact_unknowns, output_coefficients
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.chebyshev import AffinePolynomial
from vibench.model.hyperreduced import HyperReducedModel
from vibench.offline import c_source
from vibench.offline.c_source import ContactCode, ExactMember
from vibench.offline.compiled import about_model, first_sets
from vibench.offline.models import Model
from vibench.offline.polynomials import (
    EVALUATIONS,
    TOLERANCE,
    InaccurateError,
    declared_model,
    declared_terms,
    member_polynomials,
)


@dataclass(frozen=True)
class ExportedModel:
    """A reduced model as an exported file holds it."""

    # A as packed upper triangle (row by row), f, B and g, as polynomials on the parameter box.
    members: Mapping[str, AffinePolynomial]
    # The other arrays of the file, and everything else in it.
    arrays: Mapping[str, Array]
    about: Mapping[str, Any]
    # Polynomials of the θ that the certificate evaluates at a parameter, if there is one.
    thetas: Mapping[str, AffinePolynomial]
    # Members and θ of a C source whose coefficients are declared as expressions.
    exact: Mapping[str, ExactMember]
    # In place of polynomials of B and g the C code of the problem, which a file for the script cannot hold.
    code: ContactCode | None = None

    def source(self, stem: str, sensors: Mapping[str, Any] = MappingProxyType({})) -> tuple[str, str]:
        """The C source and its header; with what `sensors` of a calibration need."""
        given = self.members, self.arrays, self.about, stem, self.thetas, self.exact, self.code
        return c_source.source(*given, sensors)

    @property
    def error(self) -> float:
        """Largest relative error of a member at random parameters."""
        return max(found.error for found in (*self.members.values(), *self.thetas.values()))


def exported(
    model: Model, tolerance: float = TOLERANCE, evaluations: int = EVALUATIONS, bases: bool = True, c: bool = False
) -> ExportedModel:
    """The model as `export_model` writes it."""
    box = model.parameters
    queried = declared_model(model.reduced, coded=c)
    code = ContactCode.of(queried) if c else None
    coded = "" if code is None else "Bg"
    why = _reason_for_none(model.certificate, code)
    if not why and not c:
        why = "only C programs have them; export to a name that ends in .c"
    certificate = None if why else model.certificate
    beside = None if certificate is None else partial(_certificate_thetas, certificate, coded)
    # The matrix from the θ of A as a query evaluates them to those of the certificate; none of a constant A.
    rotation = None if certificate is None else _stiffness_coefficients(certificate)
    rotated, limits = {} if rotation is None else {"theta_A": rotation}, (tolerance, evaluations)
    try:
        polynomials = member_polynomials(queried, *limits, beside=beside, rotated=rotated, left_out=coded)
    except InaccurateError as error:
        raise RequestError(
            f"{error}; `--tolerance {1.05 * error.error:.1e}` exports this approximation; more evaluations than "
            f"{evaluations}, an argument of `vibench.export_model`, may reach a better one"
        ) from None
    members = {name: polynomials.pop(name) for name in MEMBERS if name not in coded}
    outputs = [{"name": output.name, "unit": output.unit} for output in linear_outputs(model.problem)]
    about = about_model(model.accuracy, outputs) | {"certificate": Guarantee.NONE.value, "no_bounds": why}
    arrays = {"lower": box.lower, "upper": box.upper}
    if isinstance(queried, HyperReducedModel) and queried.space is not None:
        arrays["plain"] = queried.space.plain
    basis = queried.basis if isinstance(queried, HyperReducedModel) else queried.fixed_basis
    if bases:
        arrays |= {"basis": basis, "generators": queried.generators}
    arrays |= _output_arrays(model, basis, queried.generators, certificate)
    # The members that the model evaluates by declared sums whose coefficients are all expressions.
    declared = {name: queried.problem.affine[name] for name in declared_terms(queried)} if c else {}
    sums = {name: ExactMember.from_sum(declared[name], members[name].terms) for name in declared}
    exact = {name: member for name, member in sums.items() if member is not None}
    arrays |= first_sets(queried, members) if c else {}
    if certificate is not None:
        terms = {name: np.eye(len(member.thetas)) for name, member in exact.items()}
        if rotation is not None and "A" in terms:
            terms["A"] = rotation.T
        exact |= {f"theta_{name}": ExactMember(exact[name].thetas, matrix) for name, matrix in terms.items()}
        unknowns = contact_unknowns(model.problem) if bases else None
        arrays |= _certificate_arrays(certificate, polynomials | members, exact, unknowns)
        about["certificate"] = guarantee(certificate, {*model.problem.constant, *exact, *coded}).value
    return ExportedModel(members, arrays, about, polynomials, exact, code)


def _reason_for_none(certificate: OnlineCertificate | None, code: ContactCode | None) -> str:
    """Reason why an exported model cannot bound its errors; "" if it can."""
    if certificate is None:
        return "its cell has no bounds: they need bounds = true"
    if certificate.prepared is None or (certificate.base.bound_terms is None and code is None):
        return (
            "they need B(mu) and g(mu) on all contact unknowns: by `contact_source` of the problem, or B declared to "
            "be one matrix times a function of mu and g an affine sum"
        )
    return ""


def _certificate_thetas(
    certificate: OnlineCertificate, left_out: str, samples: Mapping[str, Array]
) -> dict[str, Array]:
    """Coefficients θ (Q,) of A, f, B and g in the terms of the certificate, from those that a query evaluates."""
    found = certificate.base.coefficients(samples) | {"g": samples.get("g", np.ones(1))}
    if (matrix := _stiffness_coefficients(certificate)) is not None:
        found["A"] = matrix @ samples["A"]
    return {f"theta_{name}": value for name, value in found.items() if name not in left_out}


def _stiffness_coefficients(certificate: OnlineCertificate) -> Array | None:
    """The matrix that makes θ of rotated terms of A from those of a query, if A varies, then the latter of a sum."""
    rotation = certificate.base.rotation
    if rotation is None or not certificate.base.term_errors.any():
        return rotation
    return np.vstack([rotation, np.eye(rotation.shape[1])])


def _certificate_arrays(
    certificate: OnlineCertificate,
    polynomials: Mapping[str, AffinePolynomial],
    exact: Mapping[str, ExactMember],
    unknowns: Indices | None,
) -> dict[str, Array]:
    """The arrays of a certificate for which there is no `reason_for_none`."""
    # With the positions of the contact `unknowns`, those that take ν to a corrected u at mesh size are among them.
    # Bounds grow by what the measured errors of the polynomials, of A and of all θ, may add.
    base, residual, corrections = certificate.base, certificate.residual, certificate.prepared
    assert corrections is not None  # there is no reason for none
    found = {
        "generators": certificate.generators, "rows": corrections.rows, "inverse": corrections.inverse,
        "compliance": corrections.compliance, "reach": corrections.reach, "basis": corrections.basis,
        "responses": corrections.responses, "moved": corrections.moved, "sizes": corrections.sizes,
        "directions": corrections.directions,
        "terms": np.array(corrections.terms), "kept": residual.kept, "factor": residual.factor,
        "inverse_scale": residual.inverse_scale, "remainder": np.array(residual.remainder), "norms": residual.norms,
        "round_off": np.array(residual.round_off), "margins": np.array([certificate.margin, corrections.error]),
    }  # fmt: skip
    if unknowns is not None:
        loads = np.zeros((base.X.dim, len(_shifts(certificate))))
        loads[unknowns] = _shifts(certificate).T
        found["lift"] = base.X.riesz(loads)
    of_A = "A" if _stiffness_coefficients(certificate) is None else "theta_A"
    error = {name: 0.0 if name in exact else _error(polynomial) for name, polynomial in polynomials.items()}
    size = residual.norms.copy()  # of all terms of residuals
    size[residual.kept] = np.hypot(np.linalg.norm(residual.factor, axis=0), residual.remainder * residual.inverse_scale)
    of_f, of_lam = size[: polynomials["theta_f"].terms.shape[1]], size[-certificate.generators.shape[1] :]
    stiffness = 0.0
    if base.spectral is not None:  # terms whose norms are not needed otherwise are taken to have the largest one
        norms, (leading, every) = base.spectral.norms, base.spectral.turn.shape
        stiffness = error["theta_A"] * hypot(float(np.linalg.norm(norms)), sqrt(every - leading) * float(norms.max()))
    found |= {
        "load_error": np.array(base.load_error + error["theta_f"] * np.linalg.norm(of_f)),
        "stiffness_error": np.array(base.stiffness_error + stiffness),
        # off the diagonal every entry counts twice; products of Chebyshev polynomials are at most 1
        "energy_error": np.array(
            np.sqrt(2.0) * error["A"]
            + np.abs(polynomials[of_A].coefficients).sum(axis=0) @ certificate.energy_round_off
        ),
    }  # fmt: skip
    if (terms := base.bound_terms) is not None:
        found |= {
            "bounds": terms, "bound_errors": error["theta_g"] * np.linalg.norm(terms, axis=1),
            "constraint_error": np.array(error["theta_B"]), "multiplier_norms": of_lam,
        }  # fmt: skip
    else:
        assert certificate.forces is not None
        bodies, (ends, columns, values) = base.inf_sup.entries
        found |= {"forces": certificate.forces, "bodies": bodies.astype(int)}
        found |= {"known_ends": ends, "known_columns": columns, "known_values": values}
        _, position, block = certificate.compliance.blocks[0]
        found |= {"near": position, "near_compliance": block.toarray()}
    if (spectral := base.spectral) is not None:
        grid = spectral.grid
        found |= {
            "anchors": np.column_stack([spectral.alpha, spectral.gamma, spectral.theta.T]),
            "axes": grid.axes, "lower": grid.lower, "upper": grid.upper, "counts": grid.counts, "places": grid.places,
            "turn": spectral.turn, "term_norms": spectral.norms, "spectral_error": np.array(spectral.error + stiffness),
        }  # fmt: skip
        if base.term_errors.any():
            found["term_errors"] = base.term_errors
        if (ranges := spectral.ranges) is not None:
            widest = np.maximum(-ranges.lower, ranges.upper) / np.abs(ranges.reference)
            found["ranges"] = np.column_stack([ranges.reference, ranges.lower, ranges.upper])
            found["range_errors"] = np.array([ranges.error, error["theta_A"] * np.linalg.norm(widest)])
    return {f"certificate_{name}": array for name, array in found.items()}


def _shifts(certificate: OnlineCertificate) -> Array:
    """Loads (j×k) on the contact unknowns whose multiples correct a solution."""
    if certificate.base.bound_terms is None:
        return np.eye(len(certificate.compliance.matrix))[certificate.compliance.near]
    assert certificate.prepared is not None  # there is no reason for none
    return np.asarray(certificate.base.constraint[certificate.prepared.rows].toarray())


def _error(polynomial: AffinePolynomial) -> float:
    """Absolute error to expect of a polynomial; none where it is the function that it replaces."""
    # below 1e-14 it is the function up to round-off; other parameters may have twice the measured error
    return 0.0 if polynomial.error <= 1e-14 else 2.0 * polynomial.error * polynomial.scale


def guarantee(certificate: OnlineCertificate, exact: Set[str]) -> Guarantee:
    """Worth of the bounds: that of the certificate if all members are exact, constant or declared by expressions."""
    # Where a polynomial takes the place of a function they are verified at most: its error was measured at some
    # parameters, which proves nothing about others, however small it is there.
    return certificate.base.guarantee if exact >= set(MEMBERS) else Guarantee.VERIFIED


def linear_outputs(problem: Problem) -> list[Output]:
    """Outputs that are linear, which files hold."""
    return [output for output in problem.outputs if output.linear]


def _output_arrays(model: Model, basis: Array, rays: Array, certificate: OnlineCertificate | None) -> dict[str, Array]:
    """Coefficients of x (O×N') and α (O×R), none without linear outputs."""
    # With a certificate also of λ on all rows (O×m), of a in u = u_N − lift · a (O×j), and the `output_weights` (O×2).
    problem, outputs = model.problem, linear_outputs(model.problem)
    if not outputs:
        return {}
    pairs = [output_coefficients(problem, output) for output in outputs]
    of_u, of_lam = (np.array(rows) for rows in zip(*pairs, strict=True))
    found = {"outputs_x": of_u @ basis, "outputs_alpha": of_lam @ rays}
    if certificate is not None and certificate.prepared is not None:
        X = certificate.base.X
        lifted = np.array([X.riesz(row)[contact_unknowns(problem)] for row in of_u])
        found |= {
            "certificate_outputs_lam": of_lam,
            "certificate_outputs_shift": lifted @ _shifts(certificate).T,
            "certificate_outputs_weights": np.array([model.output_weights[output.name] for output in outputs]),
        }
    return found
