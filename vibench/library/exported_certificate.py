"""Arrays by which an exported C program bounds its errors, and its linear quantities of interest."""

from __future__ import annotations

from collections.abc import Mapping, Set

import numpy as np

from vibench.arrays import Array, Indices
from vibench.interfaces.outputs import Output
from vibench.interfaces.problem import MEMBERS, Problem
from vibench.model.certificates.base import Guarantee, contact_unknowns, output_coefficients
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.chebyshev import AffinePolynomial
from vibench.offline.c_source import ExactMember
from vibench.offline.models import Model


def reason_for_none(certificate: OnlineCertificate | None) -> str:
    """Reason why an exported model cannot bound its errors; "" if it can."""
    if certificate is None:
        return "its cell has no bounds: they need bounds = true"
    if certificate.prepared is None or certificate.base.bound_terms is None:
        return (
            "they need B(mu) and g(mu) on all contact unknowns, which the code of the problem evaluates unless B is "
            "declared to be one matrix times a function of mu and g an affine sum"
        )
    return ""


def thetas(certificate: OnlineCertificate, samples: Mapping[str, Array]) -> dict[str, Array]:
    """Coefficients θ (Q,) of A, f, B and g in the terms of the certificate, from those that a query evaluates."""
    found = certificate.base.coefficients(samples) | {"g": samples.get("g", np.ones(1))}
    return {f"theta_{name}": value for name, value in found.items()}


def rotated(certificate: OnlineCertificate) -> dict[str, Array]:
    """The matrix from the θ of A as a query evaluates them to those of the certificate; none of a constant A."""
    rotation = certificate.base.rotation
    return {} if rotation is None else {"theta_A": rotation}


def exact_thetas(certificate: OnlineCertificate, exact: Mapping[str, ExactMember]) -> dict[str, ExactMember]:
    """`thetas` of members that are exact."""
    rotation = certificate.base.rotation
    terms = {name: np.eye(len(member.thetas)) for name, member in exact.items()}
    if rotation is not None and "A" in terms:
        terms["A"] = rotation.T
    return {f"theta_{name}": ExactMember(exact[name].thetas, matrix) for name, matrix in terms.items()}


def arrays(
    certificate: OnlineCertificate,
    polynomials: Mapping[str, AffinePolynomial],
    exact: Mapping[str, ExactMember],
    unknowns: Indices | None,
) -> dict[str, Array]:
    """The arrays of a certificate for which there is no `reason_for_none`.

    With the positions of the contact `unknowns`, those that take ν to a corrected u at mesh size are among them.
    Bounds grow by what the measured errors of the polynomials, of A and of all θ, may add.
    """
    base, residual, corrections, terms = (
        certificate.base, certificate.residual, certificate.prepared, certificate.base.bound_terms
    )  # fmt: skip
    assert corrections is not None  # there is no reason for none
    assert terms is not None
    responses = np.zeros((len(corrections.basis), len(corrections.rows)))
    responses[corrections.moved] = corrections.responses
    found = {
        "generators": certificate.generators, "bounds": terms, "rows": corrections.rows, "inverse": corrections.inverse,
        "diagonal": corrections.compliance.diagonal(), "reach": corrections.reach, "basis": corrections.basis,
        "responses": responses, "sizes": corrections.sizes, "directions": corrections.directions,
        "terms": np.array(corrections.terms), "kept": residual.kept, "factor": residual.factor,
        "inverse_scale": residual.inverse_scale, "remainder": np.array(residual.remainder), "norms": residual.norms,
    }  # fmt: skip
    if unknowns is not None:
        loads = np.zeros((base.X.dim, len(corrections.rows)))
        loads[unknowns] = base.constraint[corrections.rows].toarray().T
        found["lift"] = base.X.riesz(loads)
    error = {name: 0.0 if name in exact else _error(polynomial) for name, polynomial in polynomials.items()}
    sizes = residual.norms.copy()  # of all terms of residuals
    sizes[residual.kept] = np.hypot(
        np.linalg.norm(residual.factor, axis=0), residual.remainder * residual.inverse_scale
    )
    of_f, of_lam = sizes[: polynomials["theta_f"].terms.shape[1]], sizes[-certificate.generators.shape[1] :]
    stiffness = 0.0
    if base.spectral is not None:  # terms whose norms are not needed otherwise are taken to have the largest one
        norms = base.spectral.norms
        stiffness = error["theta_A"] * float(np.linalg.norm(np.where(norms > 0.0, norms, norms.max())))
    found |= {
        "load_error": np.array(base.load_error + error["theta_f"] * np.linalg.norm(of_f)),
        "stiffness_error": np.array(base.stiffness_error + stiffness),
        "energy_error": np.array(np.sqrt(2.0) * error["A"]),  # off the diagonal every entry counts twice
        "constraint_error": np.array(error["theta_B"]), "multiplier_norms": of_lam,
        "bound_errors": error["theta_g"] * np.linalg.norm(terms, axis=1),
    }  # fmt: skip
    if (spectral := base.spectral) is not None:
        found |= {
            "anchors": np.column_stack([spectral.alpha, spectral.gamma, spectral.theta.T]),
            "lower": spectral.lower, "upper": spectral.upper, "count": np.array(spectral.count),
            "term_norms": spectral.norms, "spectral_error": np.array(spectral.error + stiffness),
        }  # fmt: skip
    return {f"certificate_{name}": array for name, array in found.items()}


def _error(polynomial: AffinePolynomial) -> float:
    """Absolute error to expect of a polynomial; none where it is the function that it replaces."""
    # below 1e-14 it is the function up to round-off; other parameters may have twice the measured error
    return 0.0 if polynomial.error <= 1e-14 else 2.0 * polynomial.error * polynomial.scale


def guarantee(certificate: OnlineCertificate, exact: Set[str]) -> Guarantee:
    """Worth of the bounds: that of the certificate if all members are exact, constant or declared by expressions.

    Where a polynomial takes the place of a function they are verified at most: its error was measured at some
    parameters, which proves nothing about others, however small it is there.
    """
    return certificate.base.guarantee if exact >= set(MEMBERS) else Guarantee.VERIFIED


def _linear(problem: Problem) -> list[Output]:
    return [output for output in problem.outputs if output.linear]


def output_descriptions(problem: Problem) -> dict[str, list[dict[str, str]] | list[str]]:
    """Names and units of the exported outputs, and names of those that code computes, which the file cannot hold."""
    found = [{"name": output.name, "unit": output.unit} for output in _linear(problem)]
    return {"linear": found, "left_out": [output.name for output in problem.outputs if not output.linear]}


def output_arrays(
    model: Model, basis: Array, generators: Array, certificate: OnlineCertificate | None
) -> dict[str, Array]:
    """Coefficients of x (O×N') and α (O×R), none without linear outputs.

    With a certificate also of λ on all rows (O×m), of a in u = u_N − lift · a (O×j), and the `output_weights` (O×2).
    """
    problem, outputs = model.problem, _linear(model.problem)
    if not outputs:
        return {}
    of_u, of_lam = (
        np.array(rows) for rows in zip(*(output_coefficients(problem, output) for output in outputs), strict=True)
    )
    found = {"outputs_x": of_u @ basis, "outputs_alpha": of_lam @ generators}
    if certificate is not None and certificate.prepared is not None:
        B, X = certificate.base.constraint[certificate.prepared.rows], certificate.base.X
        lifted = np.array([X.riesz(row)[contact_unknowns(problem)] for row in of_u])
        found |= {
            "certificate_outputs_lam": of_lam,
            "certificate_outputs_shift": lifted @ B.T,
            "certificate_outputs_weights": np.array([model.output_weights[output.name] for output in outputs]),
        }
    return found
