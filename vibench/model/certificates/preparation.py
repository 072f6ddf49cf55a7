"""Preparation of what bounds the errors of one reduced model at online cost, from arrays of mesh size."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices
from vibench.errors import UnsupportedError
from vibench.highfidelity.active_set import FALLBACK_SOLVER
from vibench.interfaces.problem import Problem
from vibench.model.affine import AffineMember
from vibench.model.certificates.base import CertificateBase, contact_at, contact_unknowns, injected, is_exact
from vibench.model.certificates.bounds import OnlineCertificate, coordinates_of, evaluated_by, residual_coefficients
from vibench.model.certificates.lifting import ContactCompliance, lift
from vibench.model.certificates.prepared_lifting import PreparedLiftings, carriers, prepare_liftings
from vibench.model.certificates.residual import residual_basis
from vibench.model.hyperreduced import HyperReducedModel
from vibench.qp.solve import solve_qp

SAMPLES = 200
"""Training parameters at most whose reduced solutions tell what terms of the residual contribute."""

RINGS = 1
"""Rings of rows around the support of the generators whose contact unknowns liftings usually involve."""

SAMPLE_ACCURACY = 1e-8


def prepare(
    model: HyperReducedModel, members: Mapping[str, AffineMember], base: CertificateBase, training: Array
) -> OnlineCertificate:
    """Prepare what bounds the errors of a reduced model, from the members it was made of and `certificate_base`.

    Sharpness alone depends on `training` (P×d), parameters that show which terms of residuals contribute.
    """
    problem, Phi, chi, B = model.problem, model.basis, model.generators, members["B"]
    functionals, on_contact = injected(problem), not is_exact(problem, "B", B)
    blocks = [np.column_stack(members["f"].terms), *(np.asarray(term @ Phi) for term in base.terms)]
    blocks += [functionals] if on_contact else [np.asarray(term.T @ chi) for term in B.terms]
    compliance = ContactCompliance(base.compliance, _near(problem, chi, training))
    residual, U = residual_basis(base.X, blocks, *_sampled(model, base, compliance, on_contact, training))
    directions = base.X.whiten_functional(functionals).T @ U
    contact_basis = np.ascontiguousarray(Phi[contact_unknowns(problem)])
    liftings = _prepared_liftings(problem, members, base, training, chi, contact_basis, directions)
    return OnlineCertificate(base, residual, directions, compliance, contact_basis, chi, on_contact, *liftings)


def _prepared_liftings(
    problem: Problem,
    members: Mapping[str, AffineMember],
    base: CertificateBase,
    training: Array,
    chi: Array,
    contact_basis: Array,
    directions: Array,
) -> tuple[PreparedLiftings | None, Array | None]:
    """Liftings of constraints that are one matrix times a factor, on some bodies at least, and the terms of g."""
    rows, B, g = np.any(chi > 0.0, axis=1), members["B"], members["g"]
    common = base.compliance, rows, contact_basis, directions
    if len(B.terms) == 1 and is_exact(problem, "B", B) and is_exact(problem, "g", g):
        term = sp.csr_array(B.terms[0])[:, contact_unknowns(problem)]
        return prepare_liftings(term, True, *common), np.column_stack(g.terms)
    constraints = [contact_at(problem, mu).B for mu in training]
    kept = carriers(base.compliance, constraints)
    return prepare_liftings(sp.csr_array(constraints[0]) @ sp.diags_array(kept.astype(float)), False, *common), None


def _near(problem: Problem, chi: Array, training: Array) -> Indices:
    """Contact unknowns that rows in the support of a generator, or next to it, touch at some training parameter."""
    found = np.zeros(len(contact_unknowns(problem)), bool)
    for mu in training:
        contact = contact_at(problem, mu)
        touches, rows = abs(sp.csr_array(contact.B)) > 0.0, np.any(chi > 0.0, axis=1)
        for _ in range(RINGS):
            rows = touches @ (touches.T @ rows)
        found |= touches.T @ rows
    return np.flatnonzero(found)


def _sampled(
    model: HyperReducedModel, base: CertificateBase, compliance: ContactCompliance, on_contact: bool, training: Array
) -> tuple[Array, float]:
    """Coefficients of residuals (Z×S) of reduced solutions at training parameters, and the median norm of liftings."""
    problem, found, norms = model.problem, [], [0.0]
    rows = model.basis[contact_unknowns(problem)]
    for number, mu in enumerate(training[:: -(-len(training) // SAMPLES)]):
        reduced = model.assemble(mu)
        answer = solve_qp(reduced.program, FALLBACK_SOLVER, SAMPLE_ACCURACY, factor=reduced.factor)
        if answer.x is None or answer.alpha is None or not np.all(np.isfinite(answer.x)):
            continue
        evaluated, lam = evaluated_by(reduced), model.generators @ np.maximum(answer.alpha, 0.0)
        contact, y = evaluated.contact or contact_at(problem, mu), coordinates_of(answer.x, evaluated)
        theta = base.coefficients(evaluated.samples)
        of_lam = contact.B.T @ lam if on_contact else np.outer(theta["B"], answer.alpha).ravel()
        found.append(residual_coefficients(theta, y, of_lam))
        if number % 8 == 0:
            lifting = lift(compliance, contact, rows @ y, np.zeros(len(rows)), lam, 1.0)
            norms += [] if lifting is None else [lifting.norm]
    if not found:
        raise UnsupportedError("no reduced program at a training parameter has a solution")
    return np.column_stack(found), float(np.median(norms))
