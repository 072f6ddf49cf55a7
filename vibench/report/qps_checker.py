"""Recompute the residuals of every solution of this test set; needs only NumPy, not the program that exported it.

Programs are min ½ xᵀPx + qᵀx subject to Gx ≤ h, in programs/NAME.npz; solutions x and multipliers z ≥ 0 of
Px + q + Gᵀz = 0 are x_CELL and z_CELL in solutions/NAME.npz, a cell being a solver at an accuracy; rows.csv names the
cells and holds the claimed status and residuals. With r = Px + q + Gᵀz, s = Gx − h, norms ‖·‖ in P⁻¹ and
S² = xᵀPx + ‖Gᵀz‖², the residuals, which depend on no units and on no scaling of rows, are

    primal  max (s_i)₊ / ‖G_i‖ / S, over the rows whose s_i is not round-off
    dual    ‖r‖ / S
    gap     |zᵀs| / S²

Usage: python check.py [FOLDER]. Exit code 1 if a row claims "ok" and is not, or a claimed residual is not reproduced.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np


def residuals(P: np.ndarray, q: np.ndarray, G: np.ndarray, h: np.ndarray, x: np.ndarray, z: np.ndarray) -> list[float]:
    """Primal and dual residual and gap, as defined above."""
    P, q, G, h, x, z = (array.astype(np.longdouble) for array in (P, q, G, h, x, z))
    r, s, force = P @ x + q + G.T @ z, G @ x - h, G.T @ z
    terms = np.count_nonzero(G, axis=1) + 2.0
    violated = s > 1.01 * float(np.finfo(float).eps) * terms * (abs(G) @ abs(x) + abs(h))
    columns = np.column_stack([r, force, G[violated].T]).astype(float)
    norms = np.linalg.norm(np.linalg.solve(np.linalg.cholesky(P.astype(float)), columns), axis=0)
    S = float(np.hypot(np.sqrt(max(float(x @ P @ x), 0.0)), norms[1]))
    primal, gap = float(np.max(s[violated] / norms[2:], initial=0.0)), abs(float(z[z > 0.0] @ s[z > 0.0]))
    sizes = (primal, S), (float(norms[0]), S), (gap, S**2)
    return [0.0 if size == 0.0 else size / scale if scale else float("inf") for size, scale in sizes]


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
            recomputed = residuals(program["P"], program["q"], program["G"], program["h"], x, z)
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
