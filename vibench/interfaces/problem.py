"""The interface of problem plugins: a parametrised variational inequality on a high-fidelity pair of spaces."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, TypeAlias

import numpy as np
import scipy.sparse as sp
from scipy.spatial import KDTree

from vibench.arrays import Array, Indices, Mask, SparseMatrix, real_matrix, real_vector
from vibench.errors import at_parameter
from vibench.interfaces.absent_rows import settled_bounds, without_infinities
from vibench.interfaces.affine import AffineSum
from vibench.interfaces.contact_source import ContactSource
from vibench.interfaces.dual_sets import RAYS, BlockKind, DualSet, Rising
from vibench.interfaces.outputs import MeshFields, Output, Picture
from vibench.interfaces.parameters import ParameterBox
from vibench.linalg.factorisations import DEFAULT
from vibench.linalg.inner_product import InnerProduct
from vibench.signatures import Count, Rule, Seed, bordered, bordered_methods, bordered_overrides


@bordered_methods
@dataclass(frozen=True)
class VariationalInequality:
    """u = argmin ½ uᵀA u − fᵀu + σ_K(B u − g) at one parameter, B u ≤ g for rays (paper, equations (1), (2) and (7)).

    Attributes
    ----------
    A
        Stiffness, sparse SPD (n×n), on the free degrees of freedom.
    f
        Load (n,), including the contribution of the Dirichlet lift.
    B
        Constraint, sparse (m×n), sign such that A u + Bᵀλ = f with λ ∈ K.
    g
        Bound (m,), including the contribution of the Dirichlet lift; +inf, read as `ABSENT`, where a row constrains
        nothing, and its multiplier is zero. A zero row of B with g ≥ 0 constrains nothing, either.
    dirichlet_lift
        Lifting of inhomogeneous Dirichlet data, added to u in pictures only; `None` for homogeneous data.
    K
        Set of the multipliers: λ ≥ 0, or with intervals a bound of |λ_i| in some rows.
    """

    A: Annotated[SparseMatrix, "n", "n"]
    f: Annotated[Array, "n"]
    B: Annotated[SparseMatrix, "m", "n"]
    g: Annotated[Array, "m"]
    dirichlet_lift: Array | None = None
    K: DualSet = RAYS

    def __post_init__(self) -> None:
        object.__setattr__(self, "g", without_infinities(self.g))

    def copy(self) -> VariationalInequality:
        """A copy in arrays of its own: a problem may write its next assembly into those of this one."""
        lift = None if self.dirichlet_lift is None else self.dirichlet_lift.copy()
        return VariationalInequality(self.A.copy(), self.f.copy(), self.B.copy(), self.g.copy(), lift, self.K)

    def kept(self, rows: Annotated[Rising, "<m"]) -> VariationalInequality:
        """The same with some rows (k,) of the constraint alone, rising."""
        B = self.B[rows] if isinstance(self.B, np.ndarray) else sp.csr_array(self.B)[rows]
        return replace(self, B=B, g=self.g[rows], K=self.K.of(rows))


@dataclass(frozen=True)
class Contact:
    """The constraint B u ≤ g: B sparse (m×k), a column for each of the problem's `contact_dofs`, and g (m,)."""

    B: SparseMatrix
    g: Array

    def __post_init__(self) -> None:
        B = real_matrix(self.B, "B on the contact unknowns")
        object.__setattr__(self, "B", B)
        object.__setattr__(self, "g", settled_bounds(B, without_infinities(real_vector(self.g, "g"))))


@dataclass(frozen=True)
class ContactLoads:
    """B and g applied to k given multipliers η (m×k): the loads Bᵀη on the contact unknowns, and the bounds ηᵀg.

    Attributes
    ----------
    fixed
        The part of Bᵀη (|E|×k) that does not depend on mu.
    varying
        From mu (d,) to what is added to rows of it from `first` on (j×k), where j may depend on mu, and to ηᵀg (k,).
    first
        The first of these rows.
    reach
        The largest j; `None` for all rows from the first one on.
    from_contact
        From the constraint to what `varying` returns, where that evaluates it: queries evaluate it once then.
    """

    fixed: Array
    varying: Callable[[Array], tuple[Array, Array]]
    first: int
    reach: int | None = None
    from_contact: Callable[[Contact], tuple[Array, Array]] | None = None

    @property
    def reached(self) -> slice:
        """Rows that may vary."""
        return slice(self.first, len(self.fixed) if self.reach is None else self.first + self.reach)

    def at(self, mu: Array) -> tuple[Array, Array]:
        """Bᵀη on the contact unknowns (|E|×k) and ηᵀg (k,) at mu (d,)."""
        (varying, bounds), loads = self.varying(mu), self.fixed.copy()
        loads[self.first : self.first + len(varying)] += varying
        return loads, bounds

    def on(self, basis: Array) -> Callable[[Array], Array]:
        """ηᵀB Z (k×N') for rows of Z at the contact unknowns (|E|×N'), a function of what varies in Bᵀη (j×k)."""
        constant, reached = np.asarray(self.fixed.T @ basis), basis[self.reached]
        return lambda varying: np.asarray(constant + varying.T @ reached[: len(varying)])


MEMBERS = ("A", "f", "B", "g")
"""The members of a `VariationalInequality` that depend on the parameter."""

OfBox: TypeAlias = Annotated[Array, "d"]
OfV: TypeAlias = Annotated[Array, "n"]
OfW: TypeAlias = Annotated[Array, "m"]

Sampler = Callable[[Array], Mapping[str, Array]]
"""From a parameter mu (d,) to the values of chosen entries, by member."""


@bordered_methods
class Problem(ABC):
    """A parametrised variational inequality with its high-fidelity discretisation.

    Constructor arguments are the plugin's options; their annotations check what a study file gives. A problem is
    immutable once built, and `assemble` depends on nothing but the parameter.
    """

    parameters: Annotated[ParameterBox, "d"]
    """Names, bounds and units of the parameters."""
    V: Annotated[InnerProduct, "n"]
    """Inner product of the primal space, X_V (n×n), independent of the parameter."""
    W: Annotated[InnerProduct, "m"]
    """Inner product of the multiplier space, X_W (m×m), in a basis whose nonnegative coefficients are the cone W⁺."""
    K: DualSet = RAYS
    """The set of the multipliers, which every assembly has; it does not depend on mu."""
    blocks: ClassVar[tuple[BlockKind, ...]] = ()
    """Kinds of blocks besides rays that K may have: studies that name none take strategies that serve them."""
    constant: ClassVar[Set[str]] = frozenset()
    """Members of `VariationalInequality`, "A", "f", "B" or "g", that do not depend on mu."""
    affine: Mapping[str, AffineSum] = MappingProxyType({})
    """Members that are sums Σ_q θ_q(mu) · terms_q, by name; reduced assembly projects the terms and is exact.

    `affine["A"].terms` and `affine["A"].coefficients(mu)` are the terms and θ(mu), as for bounds of the coercivity.
    """
    entrywise: ClassVar[Set[str]] = frozenset()
    """Members that `sampler` evaluates entry by entry."""
    elementwise: ClassVar[Set[str]] = frozenset()
    """Members, "A" and "f" or one of them, that `element_sampler` integrates element by element."""
    licence: str = ""
    """Licence of the data that the problem is made of, "unknown" if it is; "" where that of its distribution holds."""
    factorisation: str = DEFAULT
    """Who factorises A and eliminates unknowns of X_V: the option that every problem has, set by `factorised_by`."""
    requires: ClassVar[tuple[str, ...]] = ()
    """Optional distributions it cannot do without; where one is not installed its cells are unavailable."""

    def __init_subclass__(cls, **named: Any) -> None:
        super().__init_subclass__(**named)
        bordered_overrides(cls, __name__)

    @classmethod
    def data_digest(cls, **options: Any) -> str:  # noqa: ARG003
        """Digest of the files that the options name, "" if they name none; it is part of the keys of all results.

        A problem with such files is also built once when a study is read, so that a `RequestError` of its constructor
        refuses the study before anything is written.
        """
        return ""

    def factorised_by(self, name: str) -> None:
        """Let an implementation of `vibench.linalg.factorisations` factorise A and eliminate unknowns of X_V."""
        self.factorisation = name
        self.V.factorised_by(name)

    @abstractmethod
    def training_set(self) -> Array:
        """Parameters (P×d) the reduced model is trained on."""

    def validation_set(self, count: Count, seed: Seed) -> Array:
        """Parameters (count×d) the reduced model is validated on; uniformly random in the box by default."""
        return self.parameters.sample(count, seed)

    @abstractmethod
    def assemble(self, mu: OfBox) -> VariationalInequality:
        """High-fidelity matrices and vectors at the parameter mu (d,)."""

    @property
    def contact_dofs(self) -> Indices | None:
        """Contact unknowns: all columns where B(mu) may be non-zero at some mu, rising; `None` if not declared."""
        return None

    def contact(self, mu: OfBox) -> Contact | None:  # noqa: ARG002
        """The constraint at mu (d,) on `contact_dofs`, assembled at that cost alone; `None` if not implemented."""
        return None

    def contact_source(self) -> ContactSource | None:
        """`contact` in C, for exported programs; `None` if not implemented."""
        return None

    @property
    def has_contact(self) -> bool:
        """Whether the problem defines `contact_dofs` and `contact`."""
        return self.contact_dofs is not None and type(self).contact is not Problem.contact

    def contact_loads(self, eta: Annotated[Array, "m", "k"]) -> ContactLoads:
        """Bᵀη on `contact_dofs` and ηᵀg for multipliers η (m×k), from `contact` where nothing cheaper is known.

        Queries of reduced models evaluate these at every parameter, for few multipliers: a problem that knows which
        rows depend on the parameter, or needs no sparse matrix for the product, answers them faster.
        """
        assert self.contact_dofs is not None  # implied by `has_contact`

        def from_contact(contact: Contact) -> tuple[Array, Array]:
            return np.asarray(contact.B.T @ eta), np.asarray(eta.T @ contact.g)

        def varying(mu: Array) -> tuple[Array, Array]:
            contact = self.contact(mu)
            assert contact is not None  # implied by `has_contact`
            return from_contact(contact)

        return ContactLoads(np.zeros((len(self.contact_dofs), eta.shape[1])), varying, 0, from_contact=from_contact)

    def sampler(self, wanted: Mapping[str, tuple[Indices, Indices]]) -> Sampler:
        """Function that evaluates chosen entries of the members in `entrywise`, at the cost of these entries alone.

        It maps mu (d,) to the values (k,) by member. `wanted` has their rows and columns (k,) by member; columns are
        zero for the vectors f and g.
        """
        raise NotImplementedError(f"{type(self).__name__} declares {sorted(self.entrywise)} and has no sampler")

    @property
    def element_dofs(self) -> Indices:
        """Unknowns of the elements (k×e), -1 where a value is prescribed; of problems with members in `elementwise`."""
        raise NotImplementedError(f"{type(self).__name__} declares {sorted(self.elementwise)} and has no element_dofs")

    def element_sampler(self, elements: Indices) -> Sampler:
        """Function that integrates the members in `elementwise` over chosen elements (j,), at the cost of these alone.

        It maps mu (d,) to the matrices (j×k×k) of A and the vectors (j×k) of f, by member, in the unknowns of
        `element_dofs`; what they have where that is -1 is ignored. Their sums over all elements are the members.
        """
        raise NotImplementedError(f"{type(self).__name__} declares {sorted(self.elementwise)} and has no elements")

    def constraint(self, mu: OfBox) -> tuple[SparseMatrix, Array]:
        """B (m×n) and g (m,) at mu (d,), from `contact` if implemented, else from `assemble`."""
        with at_parameter(mu):
            contact = self.contact(mu)
            if contact is None or self.contact_dofs is None:
                vi = self.assemble(mu)
                B = real_matrix(vi.B, "B")
                return B, settled_bounds(B, real_vector(vi.g, "g"))
        # Columns of contact unknowns become those of all unknowns; the entries are shared.
        B = sp.csr_array(contact.B)
        entries = (B.data, self.contact_dofs[B.indices], B.indptr)
        return sp.csr_array(entries, shape=(B.shape[0], self.V.dim)), contact.g

    def start(self, mu: OfBox, nearest: Annotated[Mask, "m"] | None) -> Mask | NestedStart | None:  # noqa: ARG002
        """Initial active set (m,) of the high-fidelity solver at mu (d,); `None` for an empty one.

        Solutions do not depend on it. By default it is the contact set of the nearest parameter solved so far, `None`
        if there is none. Where contact sets move far between parameters, or meshes are so fine that moving there takes
        many iterations, a problem may know a better one: `vibench.NestedStart` takes it from a coarser mesh.
        """
        return nearest

    def multiplier_integrals(self) -> Array:
        """Integrals (m,) of the multiplier basis functions; a constraint violation divided by them is a length.

        By default X_W applied to ones, correct for an L² product and a basis that is a partition of unity.
        """
        return self.W.apply(np.ones(self.W.dim))

    def refuse(self, mu: OfBox, u: OfV, lam: OfW) -> str:  # noqa: ARG002
        """Why a high-fidelity solution u (n,), λ (m,) at mu (d,) is outside the scope of the model; "" if it is not."""
        return ""

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Quantities of interest, whose errors are recorded; none by default."""
        return ()

    def picture(self, mu: OfBox, u: OfV, lam: OfW) -> Picture | None:  # noqa: ARG002
        """The picture of a solution u (n,), λ (m,) at mu (d,); `None` if not implemented."""
        return None

    def mesh_fields(self, mu: OfBox, u: OfV, lam: OfW) -> MeshFields | None:
        """A solution u (n,), λ (m,) at mu (d,) on its mesh, for programs that show meshes; by default its picture."""
        picture = self.picture(mu, u, lam)
        return None if picture is None else MeshFields.of_picture(picture)

    def diagnostics(self, mu: OfBox) -> Mapping[str, float]:  # noqa: ARG002
        """Scalars recorded with a high-fidelity solution at mu (d,), such as mesh quality; none by default."""
        return {}


Points = Annotated[Array, Rule("points (dim×m)", lambda points: points.ndim in (1, 2))]


@bordered
class NestedStart:
    """A problem on a coarser mesh, whose contact set is the initial one at the constraints of a finer mesh.

    The edge of a contact set moves by about one row of nodes in an iteration of the active set method. From the
    interpolated set it has to move by as many as there are on a coarse cell, however fine the mesh. A coarse problem
    with a `start` of its own makes a hierarchy: the iterations of a solution no longer grow with its mesh
    (nested iteration, Hackbusch 1985).

    Parameters
    ----------
    coarse
        The problem on the coarser mesh, for the same parameters.
    coarse_points, points
        Places of the constraints (dim×M) and (dim×m), one for each row of B, on one reference domain.
    """

    def __init__(self, coarse: Problem, coarse_points: Points, points: Points) -> None:
        self.coarse, self._coarse_points, self._points = coarse, np.atleast_2d(coarse_points), np.atleast_2d(points)

    @cached_property
    def nearest(self) -> Indices:
        """The nearest coarse constraint of every fine one (m,)."""
        return np.asarray(KDTree(self._coarse_points.T).query(self._points.T)[1])
