"""What an exported model needs to bound its errors: arrays of a certificate, and θ of the members at a parameter."""

from __future__ import annotations

from collections.abc import Mapping, Set

import numpy as np

from vibench.arrays import Array, Indices
from vibench.interfaces.problem import MEMBERS
from vibench.model.certificates.base import Guarantee
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.model.chebyshev import AffinePolynomial

EXACT = 1e-14
"""A polynomial whose measured error is smaller is the function that it replaces, up to round-off."""


def reason_for_none(certificate: OnlineCertificate | None) -> str:
    """Why an exported model cannot bound its errors; "" if it can."""
    if certificate is None:
        return 'its cell has no bounds, they need assembly = "certified"'
    if certificate.prepared is None or certificate.base.bound_terms is None:
        return (
            "they need B(mu) and g(mu) on all contact unknowns, which the code of the problem evaluates unless B is "
            "declared to be one matrix times a function of mu and g an affine sum"
        )
    return ""


def thetas(certificate: OnlineCertificate, samples: Mapping[str, Array]) -> dict[str, Array]:
    """θ (Q,) of A, f, B and g in the terms of the certificate, from what a query evaluates."""
    found = certificate.base.coefficients(samples) | {"g": samples.get("g", np.ones(1))}
    return {f"theta_{name}": value for name, value in found.items()}


def rotated(certificate: OnlineCertificate) -> dict[str, Array]:
    """What takes the θ of A as a query evaluates them to those of the certificate; none of a constant A."""
    rotation = certificate.base.rotation
    return {} if rotation is None else {"theta_A": rotation}


def arrays(
    certificate: OnlineCertificate, polynomials: Mapping[str, AffinePolynomial], unknowns: Indices | None
) -> dict[str, Array]:
    """The arrays of a certificate for which there is no `reason_for_none`.

    With the positions of the contact `unknowns`, those that take ν to a corrected u at mesh size are among them.
    Bounds grow by what the measured errors of the polynomials, of A and of all θ, may add, doubled.
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
    error = {name: _error(polynomial) for name, polynomial in polynomials.items()}
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
    return 0.0 if polynomial.error <= EXACT else 2.0 * polynomial.error * polynomial.scale


def guarantee(certificate: OnlineCertificate, constant: Set[str]) -> Guarantee:
    """What the bounds are worth: verified at most where a polynomial takes the place of a function of the parameter.

    How far it is from the function was measured at some parameters, which proves nothing about others, however small
    it is there. The polynomials of members that the problem declares constant are numbers.
    """
    return certificate.base.guarantee if constant >= set(MEMBERS) else Guarantee.VERIFIED
