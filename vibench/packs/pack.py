"""A model pack in memory: a variational inequality, its spaces, parameters, reference solutions and mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array, Indices
from vibench.errors import NumericalError, RequestError
from vibench.interfaces.affine import AffineSum, Expression, Thetas, entries_of
from vibench.interfaces.dual_sets import RAYS, DualSet, refuse_blocks
from vibench.interfaces.outputs import Output
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import MEMBERS, VariationalInequality
from vibench.interfaces.strategies import DualStrategy, ReducedSet, Stop
from vibench.interfaces.validation import check_cone
from vibench.linalg.inner_product import InnerProduct
from vibench.model.affine import decomposed, held_out_error
from vibench.packs.manifest import Manifest
from vibench.reduction.cones import hull_distances, project_on_cone


class Listing(NamedTuple):
    """The listed parameters (P×d) of a pack, and the widths (d,) of its box."""

    parameters: Array
    widths: Array

    def number(self, mu: Array) -> int:
        """Number of the listed parameter that equals mu (d,); raises a `NumericalError` if there is none."""
        away = np.abs((self.parameters - mu) / self.widths).max(axis=1)
        nearest = int(away.argmin())
        # Far above round-off, since assemblies are timed next to a parameter, far below distances of listed ones.
        if not away[nearest] <= 1e-8:  # not a number is not listed either
            raise NumericalError(f"the pack has arrays at its listed parameters only; mu = {mu.tolist()} is not listed")
        return nearest

    def repeated(self) -> tuple[int, int] | None:
        """Numbers of two listed parameters that count as the same, if there are any."""
        from scipy.spatial import KDTree  # noqa: PLC0415  slow to import

        first = np.unique(self.parameters, axis=0, return_index=True)[1]
        # A tree would find all pairs of equal points, which may be very many.
        if len(first) < len(self.parameters):
            again = int(np.setdiff1d(np.arange(len(self.parameters)), first)[0])
            return self.number(self.parameters[again]), again
        places = (self.parameters - self.parameters.min(axis=0)) / self.widths
        away, nearest = KDTree(places).query(places, k=2, p=np.inf)
        k = int(away[:, 1].argmin())
        return (k, int(nearest[k, 1])) if away[k, 1] <= 1e-8 else None  # as in `number`


@dataclass(frozen=True)
class TabulatedTheta:
    """A coefficient tabulated (P,) at the listed parameters."""

    listing: Listing
    values: Array

    @property
    def constant(self) -> float | None:
        """The value if it is one and the same at all listed parameters, else `None`."""
        return float(self.values[0]) if np.ptp(self.values) == 0.0 else None

    def __call__(self, mu: Array) -> float:
        """The value at mu (d,), one of the listed parameters."""
        return float(self.values[self.listing.number(mu)])


@dataclass(frozen=True)
class PackMember:
    """A matrix or vector: one array that is constant, the terms of an affine sum, or an array per listed parameter."""

    arrays: tuple[Any, ...]
    thetas: tuple[Expression | TabulatedTheta, ...] = ()  # coefficients of the terms of an affine sum
    listing: Listing | None = None  # the listed parameters of a member with an array for each of them

    @property
    def constant(self) -> bool:
        """Whether it does not depend on the parameter."""
        return not self.thetas and self.listing is None

    @property
    def everywhere(self) -> bool:
        """Whether it can be evaluated at every mu of the box, and not only at listed ones."""
        return self.listing is None and not any(isinstance(theta, TabulatedTheta) for theta in self.thetas)

    @cached_property
    def sum(self) -> AffineSum:
        """An affine sum as problems declare it; its matrices have the same sparsity pattern at every mu."""
        return AffineSum(self.arrays, Thetas(self.thetas))

    def at(self, mu: Array) -> Any:
        """The matrix or vector at mu (d,)."""
        return self.sum.at(mu) if self.thetas else self.arrays[0 if self.listing is None else self.listing.number(mu)]

    def entries(self, rows: Indices, columns: Indices) -> Callable[[Array], Array]:
        """Function that evaluates these entries (k,) at mu; `columns` is not used for vectors."""
        if self.thetas:
            return self.sum.entries(rows, columns)
        values, listing = [entries_of(array, rows, columns) for array in self.arrays], self.listing
        return lambda mu: values[0 if listing is None else listing.number(mu)]

    def mapped(self, change: Callable[[Any], Any]) -> PackMember:
        # Linear maps commute with the coefficients of a sum.
        return replace(self, arrays=tuple(map(change, self.arrays)))

    def __str__(self) -> str:
        if self.listing is not None:
            return f"one array for each of {len(self.arrays)} listed parameters"
        return f"affine, {len(self.arrays)} term{'s' * (len(self.arrays) > 1)}" if self.thetas else "constant"


class PackSolutions(NamedTuple):
    """Reference solutions: parameters (P×d), u (n×P) or `None`, λ (m×P), largest accepted relative KKT residual."""

    parameters: Array
    u: Array | None
    lam: Array
    tolerance: float


class PackMesh(NamedTuple):
    """Data of pictures: points (2×p) and triangles (3×t) of the mesh, points and unknowns (k,) drawn, positions."""

    points: Array
    triangles: Indices
    drawn: Indices
    unknowns: Indices
    positions: Array
    value: str
    multiplier: str


@dataclass(frozen=True)
class ModelPack:
    """A model pack, read into memory and checked.

    Attributes
    ----------
    manifest, box
        The manifest; parameters, bounds and units.
    training, validation
        Training parameters (P×d); validation parameters (Q×d), or `None` for random ones in the box.
    V, W
        Inner products X_V (n×n) and X_W (m×m); without operators V is `None`.
    members
        "A", "f", "B", "g"; none without operators.
    contact
        Unknowns (k,) that B touches at some parameter.
    integrals
        Integrals (m,) of the multiplier functions, `None` for X_W applied to ones.
    reference, residual
        Reference solutions, or `None`, and their largest KKT residual, `None` without, or without operators or u.
    mesh, outputs
        Data of pictures, or `None`; quantities of interest.
    K
        Set of the multipliers.
    """

    manifest: Manifest
    box: ParameterBox
    training: Array
    validation: Array | None
    V: InnerProduct | None
    W: InnerProduct
    members: Mapping[str, PackMember]
    contact: Indices
    integrals: Array | None
    reference: PackSolutions | None
    mesh: PackMesh | None
    outputs: tuple[Output, ...] = ()
    residual: float | None = None
    K: DualSet = RAYS

    @property
    def listed(self) -> Array:
        """The training parameters, then the validation parameters where these are listed."""
        return self.training if self.validation is None else np.vstack([self.training, self.validation])

    @property
    def constant(self) -> frozenset[str]:
        """Members that do not depend on the parameter."""
        return frozenset(name for name, member in self.members.items() if member.constant)

    @property
    def entrywise(self) -> frozenset[str]:
        """Members that reduced assembly interpolates."""
        given = self.manifest.operators and self.manifest.operators.entrywise
        return frozenset(self.members if given is None else map(str, given)) - self.constant

    @property
    def affine(self) -> Mapping[str, AffineSum]:
        """Affine members that reduced assembly may use."""
        members = {name: self.members[name] for name in MEMBERS if name in self.entrywise}
        return {name: member.sum for name, member in members.items() if member.thetas}

    def interpolation_errors(self, tolerance: float) -> dict[str, float]:
        """Relative errors at listed validation parameters of members that are interpolated to a tolerance."""
        errors, others = dict[str, float](), () if self.validation is None else self.validation
        for name in MEMBERS:
            if self.V is not None and name in self.entrywise and name not in self.affine:
                at = self.members[name].at
                member = decomposed(name, [at(mu) for mu in self.training], self.V, tolerance)
                errors[name] = held_out_error(name, member, [at(mu) for mu in others], self.V)
        return errors

    @property
    def everywhere(self) -> bool:
        """Whether the members can be evaluated at every parameter of the box."""
        return all(member.everywhere for member in self.members.values())

    @cached_property
    def contact_members(self) -> Mapping[str, PackMember]:
        """B on the columns `contact` and g."""
        return {"B": self.members["B"].mapped(lambda B: sp.csr_array(B)[:, self.contact]), "g": self.members["g"]}

    def at(self, mu: Array) -> VariationalInequality:
        """The variational inequality at mu (d,); a `NumericalError` if mu has to be listed, or θ(µ) is not finite."""
        return VariationalInequality(**{name: self.members[name].at(mu) for name in MEMBERS}, K=self.K)

    def validation_set(self, count: int, seed: int) -> Array:
        """Validation parameters, the first listed ones or random ones; a `NumericalError` if fewer are listed."""
        if self.validation is None:
            return self.box.sample(count, seed)
        if count > len(self.validation):
            most, asked = len(self.validation), f"the study asks for {count}"
            remedy = f"set validation = {most} in its file, or run it with --validation {most}"
            raise NumericalError(f"the pack lists {most} validation parameters, {asked}: {remedy}")
        return self.validation[:count]


def pack_multipliers(pack: ModelPack) -> tuple[Array, Array]:
    """The multipliers at training parameters (m×P), of which there has to be one, and the others (m×Q)."""
    if pack.reference is None:
        raise RequestError("the pack has no multipliers; [solutions] lam would give them")
    of_training = {tuple(mu) for mu in pack.training.tolist()}
    training = np.array([tuple(mu) in of_training for mu in pack.reference.parameters.tolist()])
    if not training.any():
        raise RequestError("none of the parameters of the solutions is a training parameter")
    # What is outside is round-off, as the checks of the pack have found.
    lam = np.column_stack([pack.K.project(column) for column in pack.reference.lam.T])
    return lam[:, training], lam[:, ~training]


def reduce_multipliers(pack: ModelPack, strategy: DualStrategy, tolerance: float) -> tuple[ReducedSet, float | None]:
    """A cone of the multipliers at training parameters, and its largest error at others by the largest norm."""
    training, others = pack_multipliers(pack)
    refuse_blocks(pack.K, strategy.blocks, f"the dual strategy {type(strategy).__name__}")
    cone = check_cone(strategy.reduce(training, pack.W, Stop(tolerance=tolerance)), pack.W, pack.K)
    if cone.gauges is None:
        distances = np.array([project_on_cone(cone.rays, column, pack.W).distance for column in others.T])
    else:
        distances = hull_distances(pack.W.whiten(cone.generators / cone.gauges), pack.W.whiten(others))
    return cone, float(distances.max() / pack.W.norm(training).max()) if len(distances) else None
