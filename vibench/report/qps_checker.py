"""Recompute the residuals of every solution of this test set; needs only NumPy, not the program that exported it.

Programs are min ½ xᵀPx + qᵀx subject to Gx ≤ h, in programs/NAME.npz; solutions x and multipliers z ≥ 0 of
Px + q + Gᵀz = 0 are x_CELL and z_CELL in solutions/NAME.npz, a cell being a solver at an accuracy; rows.csv names the
cells and holds the claimed status and residuals. The relative residuals are, with the rows of G and h divided by the
norms of the rows of G in the primal one,

    primal  max(Gx − h)₊ / max(1, |h|∞)
    dual    |Px + q + Gᵀz|∞ / max(|Px|∞, |q|∞, |Gᵀz|∞)
    gap     |xᵀPx + qᵀx + hᵀz| / max(½|xᵀPx|, |qᵀx|, |hᵀz|, 1e-4 (qᵀq)² / 2qᵀPq)

The last term is a share of the energy that a step of steepest descent gains; it serves solutions that vanish up to
round-off. A program whose load vanishes, |q|∞ ≤ 1e-10 k max(−h)₊ with k the mean of the diagonal of P, has nothing but
the length L = |h|∞ that its constraints prescribe (1 if that is zero), and the force kL:

    primal  max(Gx − h)₊ / L
    dual    |Px + q + Gᵀz|∞ / max(|Px|∞, |q|∞, |Gᵀz|∞, 1e-4 kL)
    gap     |xᵀPx + qᵀx + hᵀz| / max(½|xᵀPx|, |qᵀx|, |hᵀz|, 1e-4 kL²)

Usage: python check.py [FOLDER]. Exit code 1 if a row claims "ok" and is not, or a claimed residual is not reproduced.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np

ROUND_OFF = 1e-13
"""Allowed difference between two computations of a residual."""


def residuals(P: np.ndarray, q: np.ndarray, G: np.ndarray, h: np.ndarray, x: np.ndarray, z: np.ndarray) -> list[float]:
    """Primal and dual residual and gap, as defined above."""
    norms = np.sqrt(np.sum(G**2, axis=1))
    norms[norms == 0.0] = 1.0
    bound = h / norms
    length, force, energy = smallest_scales(P, q, bound)
    primal = max(0.0, ((G @ x - h) / norms).max(initial=0.0)) / length
    parts = [P @ x, q, G.T @ z]
    largest = max(force, *(abs(part).max(initial=0.0) for part in parts))
    dual = abs(sum(parts)).max(initial=0.0) / (largest or 1.0)
    terms = [float(x @ P @ x), float(q @ x), float(h @ z)]
    size = max(0.5 * abs(terms[0]), abs(terms[1]), abs(terms[2]), energy)
    return [primal, dual, abs(sum(terms)) / (size or 1.0)]


def smallest_scales(P: np.ndarray, q: np.ndarray, bound: np.ndarray) -> tuple[float, float, float]:
    """The denominator of the primal residual, and what the two others never fall below."""
    longest, mean = float(abs(bound).max(initial=0.0)), float(P.trace()) / max(len(q), 1)
    stiffness = mean if mean > 0.0 else 1.0
    if abs(q).max(initial=0.0) > 1e-10 * stiffness * (-bound).max(initial=0.0):
        curvature = float(q @ P @ q)
        descent = float(q @ q) ** 2 / (2.0 * curvature) if curvature > 0.0 else 0.0
        return max(1.0, longest), 0.0, 1e-4 * descent
    length = longest or 1.0
    return length, 1e-4 * stiffness * length, 1e-4 * stiffness * length**2


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
            claimed = [float(row[name] or "nan") for name in ("primal_residual", "dual_residual", "gap")]
            honest = all(abs(a - b) <= ROUND_OFF + 1e-6 * abs(b) for a, b in zip(recomputed, claimed, strict=True))
            good = finite and z.min(initial=0.0) >= 0.0 and max(recomputed) <= float(row["accuracy"]) + ROUND_OFF
            fine += row["status"] == "ok"
            if not honest or (row["status"] == "ok" and not good):
                wrong += 1
                about = f"{row['program']} {row['solver']} at {row['accuracy']}: {row['status']}"
                print(f"{about!r}, claimed {claimed}, found {recomputed}")  # the rows may be those of others
    print(f"{count} solutions, {fine} claimed ok, {wrong} wrong")
    return wrong


if __name__ == "__main__":
    sys.exit(1 if main(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent)) else 0)
