"""Families of multiplier snapshots, degenerate ones included, for tests of dual strategies."""

import numpy as np
import scipy.sparse as sp
from hypothesis import strategies as st

from vibench import Array, InnerProduct

M = 12


def line_mass(m: int, scale: float) -> InnerProduct:
    """The consistent mass matrix of a line: whitening destroys signs, as on the meshes."""
    return InnerProduct(sp.diags_array([4.0 * np.ones(m), np.ones(m - 1), np.ones(m - 1)], offsets=[0, 1, -1]) / scale)


W = line_mass(M, M)


def bumps(count: int = 12, m: int = 40) -> tuple[Array, InnerProduct]:
    """Shifted and scaled bumps with exact zeros, and the mass matrix of their mesh."""
    x = np.linspace(0.0, 1.0, m)
    centres, widths = np.linspace(0.35, 0.65, count), 0.15 + 0.1 * np.sin(np.arange(count))
    return np.maximum(0.0, 1.0 - ((x[:, None] - centres) / widths) ** 2), line_mass(m, 6.0 * m)


@st.composite
def families(draw: st.DrawFn) -> Array:
    """Nonnegative snapshots (12×Q) with exact zeros, some of them zero, copies, multiples or nearly parallel."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    columns: list[Array] = []
    kinds = st.sampled_from(["new", "bump", "zero", "copy", "multiple", "nearly"])
    for kind in draw(st.lists(kinds, min_size=1, max_size=8)):
        source = columns[rng.integers(len(columns))] if columns else rng.random(M)
        columns.append({
            "new": rng.random(M) * (rng.random(M) < 0.6), "zero": np.zeros(M), "copy": source.copy(),
            "bump": np.maximum(0.0, 1.0 - ((np.arange(M) - 11.0 * rng.random()) / 4.0) ** 2),
            "multiple": 10.0 ** rng.integers(-6, 3) * source, "nearly": source * (1.0 + 1e-9 * rng.random(M)),
        }[kind])  # fmt: skip
    return np.column_stack(columns)
