"""Linear quantities of interest of an exported model: N' + R numbers each, and what bounds their errors."""

from __future__ import annotations

import numpy as np

from vibench.arrays import Array, Indices
from vibench.interfaces.outputs import Output
from vibench.interfaces.problem import Problem
from vibench.linalg.inner_product import InnerProduct
from vibench.model.certificates.base import contact_unknowns, output_coefficients
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.offline.models import Model


def linear(problem: Problem) -> list[Output]:
    """The outputs that are exported."""
    return [output for output in problem.outputs if output.linear]


def descriptions(problem: Problem) -> dict[str, list[dict[str, str]] | list[str]]:
    """Names and units of the exported outputs, and names of those that code computes, which the file cannot hold."""
    found = [{"name": output.name, "unit": output.unit} for output in linear(problem)]
    return {"linear": found, "left_out": [output.name for output in problem.outputs if not output.linear]}


def arrays(model: Model, basis: Array, generators: Array, certificate: OnlineCertificate | None) -> dict[str, Array]:
    """Coefficients of x (O×N') and α (O×R), none without linear outputs.

    With a certificate also of λ on all rows (O×m), of a in u = u_N − lift · a (O×j), and the `output_weights` (O×2).
    """
    problem, outputs = model.problem, linear(model.problem)
    if not outputs:
        return {}
    of_u, of_lam = (
        np.array(rows) for rows in zip(*(output_coefficients(problem, output) for output in outputs), strict=True)
    )
    found = {"outputs_x": of_u @ basis, "outputs_alpha": of_lam @ generators}
    if certificate is not None and certificate.prepared is not None:
        B, X = certificate.base.constraint[certificate.prepared.rows], certificate.base.X
        found |= {
            "certificate_outputs_lam": of_lam,
            "certificate_outputs_shift": _at_contact(X, of_u, contact_unknowns(problem)) @ B.T,
            "certificate_outputs_weights": np.array([model.output_weights[output.name] for output in outputs]),
        }
    return found


def _at_contact(X: InnerProduct, of_u: Array, unknowns: Indices) -> Array:
    """Rows X⁻¹l at the contact unknowns (O×k)."""
    return np.array([X.riesz(row)[unknowns] for row in of_u])
