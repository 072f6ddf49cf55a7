"""Preparation of what bounds the errors of one reduced model at online cost, from arrays of mesh size."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices, Mask
from vibench.errors import UnsupportedError
from vibench.highfidelity.active_set import FALLBACK_SOLVER
from vibench.interfaces.problem import Problem
from vibench.model.affine import AffineMember
from vibench.model.certificates.base import CertificateBase, contact_at, contact_unknowns, injected, is_exact
from vibench.model.certificates.bounds import OnlineCertificate, residual_coefficients
from vibench.model.certificates.contact_correction import ContactCompliance, find_contact_correction, held_rows
from vibench.model.certificates.prepared_correction import prepare_corrections
from vibench.model.certificates.residual import residual_basis
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
    whiten, scaled = base.X.whiten_functional, base.bound_terms is not None
    forces = None if is_exact(problem, "B", B) else np.asarray(base.constraint.T @ chi)
    blocks = [whiten(np.column_stack(members["f"].terms)), *(whiten(np.asarray(term @ Phi)) for term in base.terms)]
    functionals = whiten(injected(problem))
    if forces is None:
        blocks += [whiten(np.asarray(B_q.T @ chi)) for B_q in B.terms]
    else:
        blocks += [functionals, functionals @ forces]
    compliance = ContactCompliance(base.compliance, _near(problem, chi, training))
    z, typical, held = _sampled(model, base, compliance, forces, training)
    residual, U = residual_basis(blocks, z, typical)
    directions = functionals.T @ U
    contact_basis = np.ascontiguousarray(Phi[contact_unknowns(problem)])
    corrections = prepare_corrections(base.constraint, scaled, base.compliance, held, contact_basis, directions)
    return OnlineCertificate(base, residual, directions, compliance, contact_basis, chi, forces, corrections)


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
    forces: Array | None,
    training: Array,
) -> tuple[Array, float, Mask]:
    """What reduced solutions at training parameters have.

    Coefficients (Z×S) of their residuals, the median norm of corrections, and the rows (m,) that some of these hold.
    `forces` are those of `residual_coefficients`.
    """
    problem, residuals, norms = model.problem, [], [0.0]
    rows, held = model.basis[contact_unknowns(problem)], np.zeros(len(model.generators), bool)
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
