"""Preparation of what bounds the errors of one reduced model at online cost, from arrays of mesh size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask
from vibench.errors import UnsupportedError
from vibench.highfidelity.active_set import FALLBACK_SOLVER
from vibench.interfaces.problem import Problem
from vibench.linalg.factorisations import implementation
from vibench.model.affine import AffineMember
from vibench.model.certificates.base import CertificateBase, contact_at, contact_unknowns, is_exact
from vibench.model.certificates.bounds import OnlineCertificate, residual_coefficients
from vibench.model.certificates.contact_correction import ContactCompliance, find_contact_correction, held_rows
from vibench.model.certificates.prepared_correction import prepare_corrections
from vibench.model.certificates.residual import Known, Terms, residual_basis
from vibench.model.hyperreduced import HyperReducedModel
from vibench.qp.solve import solve_qp

SAMPLES = 200
"""Training parameters at most whose reduced solutions tell what terms of the residual contribute."""

RINGS = 1
"""Rings of rows around the support of the generators whose contact unknowns corrections usually involve."""

SAMPLE_ACCURACY = 1e-8


def prepare(
    model: HyperReducedModel, members: Mapping[str, AffineMember], base: CertificateBase, training: Array
) -> OnlineCertificate:
    """Prepare what bounds the errors of a reduced model, from the members it was made of and `certificate_base`.

    Sharpness alone depends on `training` (P×d), parameters that show which terms of residuals contribute.
    """
    problem, Phi, chi, B = model.problem, model.basis, model.generators, members["B"]
    X, dofs, scaled = base.X.matrix, contact_unknowns(problem), base.bound_terms is not None
    factor = implementation(base.X.factorisation).eliminate_with_factor(X, dofs, "A")
    forces = None if is_exact(problem, "B", B) else np.asarray(base.constraint.T @ chi)

    def known(functionals: Array) -> Known:
        return Known(factor.solve_factor_transposed(np.asarray(functionals)))

    blocks: list[Terms] = [known(np.column_stack(members["f"].terms))]
    if base.spectral is None:
        blocks.append(Known(factor.apply_factor(Phi)))  # A is X
    else:
        blocks += [known(term @ Phi) for term in base.terms]
    on_contact = ContactFunctionals(factor.trailing_factor, len(X.indptr) - 1)
    if forces is None:
        blocks += [known(B_q.T @ chi) for B_q in B.terms]
    else:
        blocks += [on_contact, Known(on_contact.combined(forces))]
    compliance = ContactCompliance(base.compliance, _near(problem, chi, training))
    contact_basis = np.ascontiguousarray(Phi[dofs])
    z, typical, held = _sampled(model, base, compliance, contact_basis, forces, training)
    residual, U = residual_basis(blocks, z, typical, len(dofs))
    directions = scipy.linalg.solve_triangular(factor.trailing_factor, U)
    corrections = prepare_corrections(base.constraint, scaled, base.compliance, held, contact_basis, directions)
    return OnlineCertificate(base, residual, directions, compliance, contact_basis, chi, forces, corrections)


@dataclass(frozen=True)
class ContactFunctionals:
    """The functionals that act on one contact unknown each, in coordinates that have these unknowns at the end.

    There X = FᵀF with F upper triangular, and `trailing` is its last block (k×k); n is the dimension of the space.
    """

    trailing: Array
    dim: int

    @cached_property
    def norms(self) -> Array:
        """Their norms (k,)."""
        inverse = scipy.linalg.solve_triangular(self.trailing, np.eye(len(self.trailing)), check_finite=False)
        return np.asarray(np.linalg.norm(inverse, axis=1))

    def columns(self, chosen: Indices) -> Array:
        """The chosen ones (n×c)."""
        return self.combined(np.eye(len(self.trailing))[:, chosen])

    def combined(self, samples: Array) -> Array:
        """Their sums (n×S) with coefficients (k×S)."""
        result = np.zeros((self.dim, samples.shape[1]))
        if samples.size:
            last = scipy.linalg.solve_triangular(self.trailing, samples, trans="T", check_finite=False)
            result[self.dim - len(self.trailing) :] = last
        return result


def _near(problem: Problem, chi: Array, training: Array) -> Indices:
    """Contact unknowns that rows in the support of a generator, or next to it, touch at some training parameter."""
    near = np.zeros(len(contact_unknowns(problem)), bool)
    for mu in training:
        contact = contact_at(problem, mu)
        touches, rows = abs(sp.csr_array(contact.B)) > 0.0, np.any(chi > 0.0, axis=1)
        for _ in range(RINGS):
            rows = touches @ (touches.T @ rows)
        near |= touches.T @ rows
    return np.flatnonzero(near)


def _sampled(
    model: HyperReducedModel,
    base: CertificateBase,
    compliance: ContactCompliance,
    rows: Array,
    forces: Array | None,
    training: Array,
) -> tuple[Array, float, Mask]:
    """What reduced solutions at training parameters have.

    Coefficients (Z×S) of their residuals, the median norm of corrections, and the rows (m,) that some of these hold.
    `rows` are those of Φ (k×d) at the contact unknowns, `forces` those of `residual_coefficients`.
    """
    problem, residuals, norms = model.problem, [], [0.0]
    held = np.zeros(len(model.generators), bool)
    for number, mu in enumerate(training[:: -(-len(training) // SAMPLES)]):
        reduced = model.assemble(mu)
        answer = solve_qp(reduced.program, FALLBACK_SOLVER, SAMPLE_ACCURACY, factor=reduced.factor)
        if answer.x is None or answer.alpha is None or not np.all(np.isfinite(answer.x)):
            continue
        evaluated, alpha = reduced.evaluated, np.maximum(answer.alpha, 0.0)
        lam, y = model.generators @ alpha, evaluated.in_space(answer.x)
        contact, theta = evaluated.contact or contact_at(problem, mu), base.coefficients(evaluated.samples)
        residuals.append(residual_coefficients(theta, y, forces, contact, alpha, lam))
        held |= held_rows(compliance, contact, rows @ y, lam)
        if number % 8 == 0:
            correction = find_contact_correction(compliance, contact, rows @ y, np.zeros(len(rows)), lam, 1.0)
            norms += [] if correction is None else [correction.norm]
    if not residuals:
        raise UnsupportedError("no reduced program at a training parameter has a solution")
    return np.column_stack(residuals), float(np.median(norms)), held
