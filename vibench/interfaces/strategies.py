"""The interfaces of strategy plugins.

Sampling strategies choose training or validation parameters, dual ones build a cone from multiplier snapshots, and
primal ones enrich V_N.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, ClassVar

import numpy as np

from vibench.arrays import Array, Mask, read_only, taken
from vibench.errors import NumericalError, RequestError, placed
from vibench.interfaces.dual_sets import BlockKind
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.linalg.inner_product import InnerProduct
from vibench.signatures import Count, NotNegative, bordered, bordered_constructor, bordered_overrides


@bordered_constructor
@dataclass(frozen=True)
class Stop:
    """Stopping criterion of a nested construction: a tolerance or a prescribed size, exactly one of the two.

    Attributes
    ----------
    tolerance
        Largest accepted relative error.
    size
        Number of vectors.
    """

    tolerance: NotNegative | None = None
    size: Count | None = None

    def __post_init__(self) -> None:
        if (self.tolerance is None) == (self.size is None):
            raise RequestError("a Stop has either a tolerance or a size")

    def reached(self, size: int, error: float) -> bool:
        """Whether a construction stops with `size` vectors and this relative error."""
        return error <= self.tolerance if self.tolerance is not None else size >= (self.size or 0)

    @bordered
    def first_reached(self, errors: Annotated[Array, "k"]) -> int | None:
        """Smallest k at which `errors[k]`, the error with k vectors, meets the criterion; `None` if there is none."""
        return next((k for k, error in enumerate(errors) if self.reached(k, float(error))), None)

    def __str__(self) -> str:
        return f"tolerance {self.tolerance:g}" if self.tolerance is not None else f"size {self.size}"


@bordered
@dataclass(frozen=True)
class ReducedSet:
    """A reduced set K_R of multipliers χ α: a cone, α ≥ 0 (paper, equation (12)), a hull, or the section of a span.

    Attributes
    ----------
    generators
        χ (m×R), coefficientwise nonnegative unless free, unit norm in W.
    errors
        Relative largest projection error e(r) of the cone of the first r generators, r = 0 … R (equations (13), (34)).
    free
        Which generators may be used with either sign (R,), none in an ordinary cone, all in a section.
    fallbacks
        One line for every step that deviates from the algorithm.
    gauges
        γ (R,) of a hull, whose coefficients have Σ γ_i α_i ≤ 1; `None` for a cone.
    """

    generators: Annotated[Array, "m", "R"]
    errors: Annotated[Array, "k"]
    free: Annotated[Mask, "R"]
    fallbacks: tuple[str, ...] = ()
    gauges: Annotated[Array, "R"] | None = None

    def __post_init__(self) -> None:
        for name in ("generators", "errors", "free"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def size(self) -> int:
        """Number R of generators."""
        return int(self.generators.shape[1])

    @property
    def kind(self) -> str:
        """Whether it is a "cone", a "hull" in K, or the "section" of a linear space with K."""
        return "hull" if self.gauges is not None else "section" if self.size and self.free.all() else "cone"

    @property
    def rays(self) -> Array:
        """Generators (m×(R+F)) of the same cone with nonnegative coefficients: free ones appear with both signs."""
        return rays(self.generators, self.free)


class Strategy:
    """Base of all strategies: arguments of the methods below are checked in every class that defines them."""

    requires: ClassVar[tuple[str, ...]] = ()
    """Optional distributions it cannot do without; where one is not installed its cells are unavailable."""

    def __init_subclass__(cls, **named: Any) -> None:
        super().__init_subclass__(**named)
        bordered_overrides(cls, __name__)


class DualStrategy(Strategy, ABC):
    """Builds a reduced cone from multiplier snapshots. Constructor arguments are the plugin's options."""

    blocks: ClassVar[tuple[BlockKind, ...]] = ()
    """Kinds of blocks besides rays that K may have."""
    is_default: ClassVar[bool] = False
    """Whether studies that name no dual strategy have this one, where no other default serves K with fewer `blocks`."""

    @abstractmethod
    def reduce(self, snapshots: Annotated[Array, "m", "P"], W: Annotated[InnerProduct, "m"], stop: Stop) -> ReducedSet:
        """Cone for snapshots λ(mu_p) ∈ K (m×P, rays ≥ 0); `stop` bounds its projection error or size."""


class Kind(StrEnum):
    """Dependence of an enrichment on the parameter; break-even pairs strategies by this, never by name."""

    NONE = "none"
    FIXED = "fixed"
    PER_PARAMETER = "per-parameter"


@bordered
@dataclass(frozen=True)
class Offline:
    """The offline data of a primal strategy.

    Attributes
    ----------
    problem
        The problem, for its spaces and its matrices at training parameters.
    basis
        V-orthonormal basis of V_N (n×N).
    cone
        The reduced cone.
    span
        W-orthonormal basis of span χ (m×rank), from a rank-revealing factorisation. Use T(mu)·span and not T(mu)χ as
        a basis of S_R(mu): where generators nearly coincide, T(mu)χ loses directions to round-off.
    training
        Training parameters (P×d).
    """

    problem: Problem
    basis: Annotated[Array, "n", "N"]
    cone: ReducedSet
    span: Annotated[Array, "m", "rank"]
    training: Annotated[Array, "P", "d"]

    def __post_init__(self) -> None:
        # Strategies share them.
        for name in ("basis", "span", "training"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


Supply = Callable[[InnerProduct, VariationalInequality, Array], Array]
"""Vectors (n×k) at one parameter, from V, the assembled forms and `Offline.span`; in the strategy's module."""


@bordered
@dataclass(frozen=True)
class Enrichment:
    """The vectors that a primal strategy adds to V_N.

    Attributes
    ----------
    kind
        None, fixed or per-parameter.
    vectors
        Fixed enrichment: vectors (n×S), V-orthonormal and orthogonal to V_N, nested.
    eta
        Per-parameter enrichment by supremizers: multipliers η (m×k); T(mu)η is added at every mu.
    supply
        Any other per-parameter enrichment: the function that computes its vectors.
    history
        Values over steps by quantity, for convergence figures.
    fallbacks
        One line for every step that deviates from the algorithm.
    """

    kind: Kind
    vectors: Annotated[Array, "n", "S"] | None = None
    eta: Annotated[Array, "m", "k"] | None = None
    supply: Supply | None = None
    history: Mapping[str, Annotated[Array, "k"]] = field(default_factory=dict)
    fallbacks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if (self.vectors is not None) != (self.kind is Kind.FIXED):
            raise RequestError("a fixed enrichment, and no other, has vectors")
        if (self.supply is not None) + (self.eta is not None) != (self.kind is Kind.PER_PARAMETER):
            raise RequestError("a per-parameter enrichment, and no other, has either eta or a supply")


class PrimalStrategy(Strategy, ABC):
    """Enriches the primal basis. Constructor arguments are the plugin's options."""

    takes_tolerance: ClassVar[bool] = False
    """Whether studies vary a tolerance of this strategy."""
    larger_is_tighter: bool = False
    """Whether the larger of two tolerances is the stricter one, as for a share of β to be reached."""

    @abstractmethod
    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        """Enrichment of `offline.basis`; `tolerance` is `None` exactly for strategies without one."""


def rays(generators: Array, free: Mask) -> Array:
    """Generators (m×R), followed by the negatives of the free ones (R,)."""
    return np.hstack([generators, -generators[:, free]])


def no_free(count: Count) -> Mask:
    """The `free` mask (count,) of an ordinary cone."""
    return np.zeros(count, dtype=bool)


class Sampling(Strategy, ABC):
    """Chooses parameters. Constructor arguments are the plugin's options; every random choice has a seed among them.

    Options annotated as `pathlib.Path` are relative to the folder of the study file.
    """

    ordered: ClassVar[bool] = False
    """Whether the points are a path: then QP solvers that can start from a solution start from the one before."""

    @classmethod
    def data_digest(cls, **options: Any) -> str:  # noqa: ARG003
        """Digest of the files that the options name, "" if they name none; it is part of the keys of all results."""
        return ""

    @abstractmethod
    def parameters(self, box: ParameterBox) -> Array:
        """Parameters (P×d) in the box, the same in every process.

        Raises a `RequestError` if the options do not fit the box, or a file cannot be read.
        """


class Trainer(ABC):
    """Reduced model of an adaptive sampling strategy, which grows with every high-fidelity solution."""

    @abstractmethod
    def solve(self, mu: Array, bound: float = float("nan")) -> None:
        """Solve at mu (d,) and add the solution to the training set; `bound`, the reason to do so, is recorded."""

    @abstractmethod
    def bound(self, mu: Array) -> float:
        """Bound of the relative error of the model of all solutions so far at mu (d,); infinite without bounds.

        An estimate of the error of λ in W is taken where it is larger than the bounds of u and λ.
        """

    def estimate(self, mu: Array) -> float | None:  # noqa: ARG002
        """Approximation of `bound` at a lower cost, to rank candidates; `None` where nothing is cheaper."""
        return None


class AdaptiveSampling(Sampling):
    """Chooses training parameters one after the other, by the model of all solutions so far, among `parameters`.

    It makes no validation set.
    """

    @abstractmethod
    def train(self, box: ParameterBox, trainer: Trainer) -> None:
        """Call `trainer.solve` at every training parameter, at one at least, in an order that is always the same."""


def check_sample(box: ParameterBox, returned: object) -> Array:
    """The parameters (P×d) that a sampling strategy returned, refused if they are none of the box.

    Raises a `RequestError` if they have the wrong shape, are not finite, lie outside the box, occur twice, or are not
    among the listed ones of a problem that has no other.
    """
    mus = np.asanyarray(returned)
    if mus.ndim != 2 or mus.shape[1] != box.dim or not len(mus):
        raise RequestError(f"parameters of shape {mus.shape}; expected (P, {box.dim}), a row for each, with P > 0")
    with placed("no parameters", NumericalError):
        mus = taken(mus, "the array", "P", box.dim, finite=False)
    # Of every kind of fault the first one is named.
    for k, i in np.argwhere(~np.isfinite(mus))[:1]:
        raise RequestError(f"parameter {k} has '{box.names[i]}' = {mus[k, i]}, which is not finite")
    for k, i in np.argwhere(box.outside(mus))[:1]:
        bounds = f"[{box.lower[i]:g}, {box.upper[i]:g}]"
        raise RequestError(f"parameter {k} has '{box.names[i]}' = {mus[k, i]:g}, outside the box {bounds}")
    if (listed := box.listed) is not None:
        # Round-off of decimals and of scaled parameters, relative to the widths of the box.
        away = np.abs(listed[:, None] - mus) / box.widths
        for k in np.flatnonzero(away.max(axis=2).min(axis=0, initial=np.inf) > 1e-9)[:1]:
            there = f"the problem has matrices only at its {len(listed)} listed parameters; choose among those"
            raise RequestError(f"parameter {k} = {mus[k].tolist()} is not available: {there}")
    # A parameter that occurs twice would count twice in means, and its snapshot in the POD.
    first = np.unique(mus, axis=0, return_index=True)[1]
    for k in sorted(set(range(len(mus))) - set(first.tolist()))[:1]:
        raise RequestError(f"parameter {k}, {mus[k].tolist()}, occurs twice")
    return mus
