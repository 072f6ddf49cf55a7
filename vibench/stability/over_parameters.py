"""Inf-sup constants over many parameters, one computation per class of proportional constraint matrices."""

from __future__ import annotations

from collections.abc import Sequence

from vibench.arrays import Array
from vibench.linalg.inner_product import InnerProduct
from vibench.reduction.supremizers import ConstraintClasses, isometric_supremizers
from vibench.stability.infsup import InfSup, Multipliers, inf_sup, inf_sup_on


def constants_full(V: InnerProduct, classes: ConstraintClasses, cone: Multipliers) -> list[InfSup]:
    """Constants of the whole of V at every B(mu) (m×n)."""
    image = isometric_supremizers(V, classes.representatives, cone.rank + cone.chi.shape[1])
    found = [inf_sup(image(B, cone.span), image(B, cone.chi), cone) for B in classes.representatives]
    return everywhere(classes, found)


def constants_on(Z: Array, classes: ConstraintClasses, cone: Multipliers) -> list[InfSup]:
    """Constants of one primal space with V-orthonormal basis Z (n×N') at every B(mu)."""
    return everywhere(classes, [inf_sup_on(Z, B, cone) for B in classes.representatives])


def everywhere(classes: ConstraintClasses, found: Sequence[InfSup]) -> list[InfSup]:
    """Constants of all matrices from those of the representatives."""
    return [found[k].scaled(c) for k, c in zip(classes.members, classes.factors, strict=True)]
