"""A model pack as a problem: matrices that another code has written into a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vibench import (
    Array,
    BlockKind,
    Contact,
    Indices,
    Output,
    Picture,
    Problem,
    RequestError,
    Sampler,
    VariationalInequality,
)
from vibench.packs import pack_digest, read_model_pack


class Pack(Problem):
    """A problem that is a folder; its format and its sign conventions are documented in `docs/model-packs.md`.

    Parameters
    ----------
    path
        The folder; in a study file relative to that.
    """

    blocks = (BlockKind.INTERVAL,)

    def __init__(self, path: Path) -> None:
        self._pack = pack = read_model_pack(path)
        if pack.V is None:
            raise RequestError(
                f"pack '{path}' has multipliers and X_W alone, which are not a problem: `vibench pack FOLDER --cones`"
            )
        self.parameters, self.V, self.W = pack.box, pack.V, pack.W
        # Declared by classes of other problems; here by what the folder holds.
        self.constant, self.entrywise = pack.constant, pack.entrywise  # type: ignore[misc]
        self.affine, self.K = pack.affine, pack.K
        self.licence = pack.manifest.license or "unknown"

    @classmethod
    def data_digest(cls, **options: Any) -> str:
        """Digest of the manifest and of the arrays."""
        return pack_digest(options["path"])

    def training_set(self) -> Array:
        """The training set of the pack."""
        return self._pack.training

    def validation_set(self, count: int, seed: int) -> Array:
        """The first of the listed validation parameters, or random ones in the box if none are listed."""
        return self._pack.validation_set(count, seed)

    def assemble(self, mu: Array) -> VariationalInequality:
        """The matrices at mu (d,)."""
        return self._pack.at(mu)

    @property
    def contact_dofs(self) -> Indices:
        """The unknowns that B touches at some parameter."""
        return self._pack.contact

    def contact(self, mu: Array) -> Contact:
        """B on the contact unknowns, and g."""
        members = self._pack.contact_members
        return Contact(members["B"].at(mu), members["g"].at(mu))

    def sampler(self, wanted: Mapping[str, tuple[Indices, Indices]]) -> Sampler:
        """Entries of the terms of affine members, and of the arrays of members by parameter."""
        evaluate = {name: self._pack.members[name].entries(*places) for name, places in wanted.items()}
        return lambda mu: {name: entries(mu) for name, entries in evaluate.items()}

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The quantities of interest of the pack."""
        return self._pack.outputs

    def multiplier_integrals(self) -> Array:
        """The integrals of the multiplier functions as the pack has them, or X_W applied to ones."""
        return super().multiplier_integrals() if self._pack.integrals is None else self._pack.integrals

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture | None:  # noqa: ARG002
        """The unknowns at their points of the mesh, zero at the others; `None` without a mesh."""
        mesh = self._pack.mesh
        if mesh is None:
            return None
        values = np.zeros(mesh.points.shape[1])
        values[mesh.drawn] = u[mesh.unknowns]
        return Picture(mesh.points, mesh.triangles, values, mesh.value, mesh.positions, lam, mesh.multiplier)
