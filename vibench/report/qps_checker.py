"""Recompute the residuals of every solution of this test set; needs only NumPy, not the program that exported it.

Programs are min ½ xᵀPx + qᵀx subject to Gx ≤ h, in programs/NAME.npz; solutions x and multipliers z ≥ 0 of
Px + q + Gᵀz = 0 are x_CELL and z_CELL in solutions/NAME.npz, a cell being a solver at an accuracy; rows.csv names the
cells and holds the claimed status and residuals. With r = Px + q + Gᵀz, s = Gx − h, norms ‖·‖ in P⁻¹ and F = ‖Gᵀz‖,
the residuals, which depend on no units and on no scaling of rows, are

    primal  max (s_i)₊ / ‖G_i‖ / F, over the rows whose s_i is not round-off
    dual    ‖r‖ / F
    gap     |zᵀs| / F²

Where one is above the accuracy F is the larger of this and of max (s_i)₊ / ‖G_i‖ at x = −P⁻¹q; if that is zero, there
is no contact, and S takes its place, S² = xᵀPx + ‖Gᵀz‖².

Usage: python check.py [FOLDER]. Exit code 1 if a row claims "ok" and is not, or a claimed residual is not reproduced.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np


def residuals(
    P: np.ndarray, q: np.ndarray, G: np.ndarray, h: np.ndarray, x: np.ndarray, z: np.ndarray, accuracy: float
) -> list[float]:
    """Primal and dual residual and gap, as defined above."""
    L = np.linalg.cholesky(P)
    P, q, G, h, x, z = (array.astype(np.longdouble) for array in (P, q, G, h, x, z))
    r, force = P @ x + q + G.T @ z, G.T @ z
    free = -np.linalg.solve(L.T, np.linalg.solve(L, q.astype(float))).astype(np.longdouble)
    free -= np.linalg.solve(L.T, np.linalg.solve(L, (P @ free + q).astype(float)))

    def norms(functionals: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(np.linalg.solve(L, functionals.astype(float)), axis=0))

    def step(point: np.ndarray) -> float:
        s, terms = G @ point - h, np.count_nonzero(G, axis=1) + 2.0
        rows = s > 1.01 * float(np.finfo(float).eps) * terms * (abs(G) @ abs(point) + abs(h))
        return float(np.max(s[rows] / norms(G[rows].T), initial=0.0))

    rest, F = norms(np.column_stack([r, force])).tolist()
    s, least = G @ x - h, step(free)
    S = float(np.hypot(np.sqrt(max(float(x @ P @ x), 0.0)), F))
    found: list[float] = []
    for unit in (F, max(F, least) if least else S):
        sizes = (step(x), unit), (rest, unit), (abs(float(z[z > 0.0] @ s[z > 0.0])), unit**2)
        found = [0.0 if size == 0.0 else size / scale if scale else float("inf") for size, scale in sizes]
        if max(found) <= accuracy:
            break
    return found


def main(folder: Path) -> int:
    """Check all rows; returns the number of wrong ones."""
    wrong, count, fine = 0, 0, 0
    with (folder / "rows.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            count += 1
            program = np.load(folder / "programs" / f"{row['program']}.npz", allow_pickle=False)
            solution = np.load(folder / "solutions" / f"{row['program']}.npz", allow_pickle=False)
            x, z = solution[f"x_{row['cell']}"], solution[f"z_{row['cell']}"]
            finite = bool(np.all(np.isfinite(x)) and np.all(np.isfinite(z)))
            arrays = (program["P"], program["q"], program["G"], program["h"])
            recomputed = residuals(*arrays, x, z, float(row["accuracy"]))
            # Two computations of a residual may differ by round-off.
            margin = 1e-12
            claimed = [float(row[name] or "nan") for name in ("primal_residual", "dual_residual", "gap")]
            honest = all(abs(a - b) <= margin + 1e-6 * abs(b) for a, b in zip(recomputed, claimed, strict=True))
            good = finite and z.min(initial=0.0) >= 0.0 and max(recomputed) <= float(row["accuracy"]) + margin
            fine += row["status"] == "ok"
            if not honest or (row["status"] == "ok" and not good):
                wrong += 1
                about = f"{row['program']} {row['solver']} at {row['accuracy']}: {row['status']}"
                # `repr`, since the rows may be those of others.
                print(f"{about!r}, claimed {claimed}, found {recomputed}")
    print(f"{count} solutions, {fine} claimed ok, {wrong} wrong")
    return wrong


if __name__ == "__main__":
    sys.exit(1 if main(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent)) else 0)
