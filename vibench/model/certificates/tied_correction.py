"""Corrections of constraints among which there are equalities, by their values on the contact unknowns.

No margin covers an equality, and the rows of a row and its opposite are dependent. The program of
`vibench.model.certificates.contact_correction` is then solved as a least distance problem in y, w_E = L y, with
C = L Lᵀ and ‖w‖ = |y|. The w' that holds the equalities is within η of w (`vibench.model.equalities`).
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.interfaces.problem import Contact
from vibench.model.equalities import Equalities
from vibench.model.error_bounds import ATTEMPTS, MARGIN, NO_ROOM
from vibench.qp.exact import least_distance
from vibench.qp.rows import rows_that_matter
from vibench.qp.scaling import row_norms

UNIT = 1.01 * float(np.finfo(float).eps)


def tied_correction(
    C: Array, contact: Contact, excess: Array, round_off: Array, size: Array, lam: Array, gamma: float
) -> tuple[Array, float, float, Array, float, float] | None:
    """C (k,), ‖w'‖, λᵀ(B w' − s), ν (m,), νᵀ(B w' − s) and η; `None` without equalities, or if no w was found.

    Parameters
    ----------
    C, contact
        C (k×k), and B (m×k) and g (m,).
    excess, round_off, size
        s (m,), a bound of its round-off, and of its terms.
    lam, gamma
        λ ≥ 0 (m,) and γ.
    """
    B = sp.csr_array(contact.B)
    rows = rows_that_matter(B, contact.g, NO_ROOM * size, lam)
    if not rows.equal.any():
        return None
    L, kept, lengths = np.linalg.cholesky(C), rows.kept, row_norms(B)[rows.kept]
    whitened = np.asarray((B @ L).T)
    equalities = Equalities.of(whitened[:, rows.equalities], lambda y: np.asarray(L @ y), B)
    K, load = -whitened[:, kept] / lengths / np.sqrt(gamma), -(whitened @ lam) / np.sqrt(gamma)
    margin = np.where(rows.equal, 0.0, MARGIN * round_off[kept])
    for _ in range(ATTEMPTS):
        forces = least_distance(K, load, -(excess[kept] + margin) / lengths, rows.equal)
        if forces is None:
            return None
        w = L @ (load - K @ forces) / np.sqrt(gamma)
        missed = (B @ w - excess)[rows.equalities]
        w = w - equalities.step(missed)
        slack = B @ w - excess
        rounded = round_off + UNIT * (np.diff(B.indptr) + 4.0) * (abs(B) @ np.abs(w))
        eta = equalities.distance((np.abs(slack) + rounded)[rows.equalities])
        eta += equalities.distance(np.abs(missed))  # ν belongs to the w before the step
        reach = equalities.reach * eta
        lacking = np.where(rows.implied, 0.0, rounded + reach - slack)
        if np.all(lacking <= 0.0):  # NaN is not
            y = scipy.linalg.solve_triangular(L, w, lower=True)
            nu = rows.multipliers(np.where(rows.equal, forces, np.maximum(forces, 0.0)) / lengths, len(lam))
            products = [max(0.0, float(of @ np.where(of > 0.0, slack, 0.0))) + float(of @ reach) for of in (lam, nu)]
            c = scipy.linalg.solve_triangular(L, y, lower=True, trans="T")
            return c, float(np.linalg.norm(y)) + eta, products[0], nu, products[1], eta
        margin = 10.0 * np.maximum(margin, np.where(rows.equal, 0.0, np.nan_to_num(lacking[kept], posinf=0.0)))
    return None
