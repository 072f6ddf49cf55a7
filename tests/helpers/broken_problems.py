"""Problems that are wrong, each in one way; what `vibench check` has to find, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from fake_plugins import Wire

from vibench import (
    Array,
    Contact,
    ContactLoads,
    InnerProduct,
    MeshFields,
    Output,
    ParameterBox,
    Picture,
    Problem,
    VariationalInequality,
)


class Declared(Wire):
    """A wire that says all it can: on which unknowns, and how to get single entries."""

    constant: ClassVar[frozenset[str]] = frozenset({"A", "B", "g"})
    entrywise: ClassVar[frozenset[str]] = frozenset({"A", "f"})

    @property
    def contact_dofs(self) -> Any:
        return np.arange(self.V.dim)

    def contact(self, mu: Array) -> Contact:
        return Contact(-self.mass, np.full(self.W.dim, self.depth * self.step))

    def sampler(self, wanted: Any) -> Any:
        return lambda mu: {
            name: -mu[0] * self.step * np.ones(len(rows)) if name == "f" else self.stiffness[rows, columns]
            for name, (rows, columns) in wanted.items()
        }

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:
        x = np.linspace(0.0, 1.0, len(u))
        points = np.stack([x, u])
        return Picture(points, np.array([[0], [1], [2]]), u, "deflection [m]", x[None], lam, "multiplier [N/m²]")


class Changed(Wire):
    """A wire of which one member is made wrong from some force on."""

    member, above = "A", -np.inf

    def wrong(self, value: Any, mu: Array) -> Any:
        raise NotImplementedError

    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        if mu[0] < self.above:
            return vi
        return replace(vi, **{self.member: self.wrong(getattr(vi, self.member), mu)})


class Asymmetric(Changed):
    def wrong(self, value: Any, mu: Array) -> Any:
        return value + sp.csr_array(([1e-3 * mu[0]], ([2], [3])), shape=value.shape)


class Indefinite(Changed):
    def wrong(self, value: Any, mu: Array) -> Any:
        return value - 4.0 * (mu[0] - 4.0) * self.mass / 0.9


class NotFinite(Changed):
    member, above = "f", 5.0

    def wrong(self, value: Any, mu: Array) -> Any:
        return np.where(np.arange(len(value)) == 7, np.nan, value)


class InfiniteMatrix(Changed):
    member = "B"

    def wrong(self, value: Any, mu: Array) -> Any:
        return sp.csr_array((np.where(np.arange(12) == 5, np.inf, value.data), value.indices, value.indptr))


class WrongShape(Changed):
    member = "B"

    def wrong(self, value: Any, mu: Array) -> Any:
        return value[:, :-1]


class Integers(Changed):
    member = "g"

    def wrong(self, value: Any, mu: Array) -> Any:
        return np.zeros(len(value), dtype=int)


class Column(Changed):
    member = "f"

    def wrong(self, value: Any, mu: Array) -> Any:
        return value[:, None]


class Dense(Changed):
    def wrong(self, value: Any, mu: Array) -> Any:
        return value.toarray()


class RowList(Changed):
    member = "B"

    def wrong(self, value: Any, mu: Array) -> Any:
        return value.tolil()


class NoInequality(Wire):
    def assemble(self, mu: Array) -> Any:
        vi = super().assemble(mu)
        return vi.A, vi.f, vi.B, vi.g


class Raises(Wire):
    def assemble(self, mu: Array) -> VariationalInequality:
        if mu[0] > 7.5:
            raise ArithmeticError("the wire snapped")
        return super().assemble(mu)


class IndefiniteNorm(Wire):
    def __init__(self) -> None:
        super().__init__()
        self.V = InnerProduct(self.stiffness - 1e3 * self.mass)


class IndefiniteDualNorm(Wire):
    def __init__(self) -> None:
        super().__init__()
        self.W = InnerProduct(self.mass - 2.0 * self.step * sp.eye_array(self.mass.shape[0]), "X_W")


class NormChangedLater(Wire):
    def __init__(self) -> None:
        super().__init__()
        self.V.matrix.data *= -1.0


class NoSpace(Wire):
    def __init__(self) -> None:
        super().__init__()
        self.V = self.stiffness  # type: ignore[assignment]


class NoConstraint(Wire):
    def __init__(self) -> None:
        super().__init__()
        self.W = InnerProduct(sp.csr_array((0, 0)))


class Jumps(Changed):
    """The support gives way by a hundredth above a force of 5.4321 N/m."""

    member, above = "g", 5.4321

    def wrong(self, value: Any, mu: Array) -> Any:
        return 1.01 * value


class JumpsAtTheCentre(Changed):
    """At one force alone it is another wire."""

    def wrong(self, value: Any, mu: Array) -> Any:
        return 2.0 * value if mu[0] == 6.0 else value


class Random(Changed):
    member = "f"

    def wrong(self, value: Any, mu: Array) -> Any:
        return value * (1.0 + 1e-15 * np.random.default_rng().random(len(value)))


class Remembers(Changed):
    """The load depends on the force before."""

    member, last = "f", 4.0

    def wrong(self, value: Any, mu: Array) -> Any:
        found, self.last = value + 1e-9 * self.last, float(mu[0])
        return found


class CountsInstances(Wire):
    """Every instance has finer steps than the one before."""

    made = 0

    def __init__(self) -> None:
        super().__init__()
        CountsInstances.made += 1
        self.depth += 1e-6 * CountsInstances.made


class ChangesTheParameter(Wire):
    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        mu -= self.parameters.lower
        return vi


class OneBuffer(Wire):
    """Every load is written into the same vector."""

    def __init__(self) -> None:
        super().__init__()
        self._load = np.zeros(self.V.dim)

    def assemble(self, mu: Array) -> VariationalInequality:
        self._load[:] = -mu[0] * self.step
        return replace(super().assemble(mu), f=self._load)


class FalselyConstant(Wire):
    constant: ClassVar[frozenset[str]] = frozenset({"A", "f"})


class ConstantOfNothing(Wire):
    constant: ClassVar[frozenset[str]] = frozenset({"a"})


class ConstantText(Wire):
    constant: ClassVar[frozenset[str]] = "A"  # type: ignore[assignment]


class PartlyWrong(Declared):
    """On the contact alone the bound is another one."""

    def contact(self, mu: Array) -> Contact:
        found = super().contact(mu)
        return Contact(found.B, found.g * (1.0 + 1e-6))


class LoadsWrong(Declared):
    """The loads of multipliers are those of others."""

    def contact_loads(self, eta: Array) -> ContactLoads:
        return super().contact_loads(2.0 * eta)


class LoadsReachFarther(Declared):
    """Loads vary on more rows than it says."""

    def contact_loads(self, eta: Array) -> ContactLoads:
        return replace(super().contact_loads(eta), reach=1)


class NoContact(Declared):
    def contact(self, mu: Array) -> Any:
        return None


class ContactOfNothing(Wire):
    def contact(self, mu: Array) -> Contact:
        return Contact(-self.mass, np.full(self.W.dim, self.depth * self.step))


class ContactChangesTheParameter(Declared):
    def contact(self, mu: Array) -> Contact:
        mu += 1.0
        return super().contact(mu)


class Overlooked(Declared):
    """B touches an unknown that is not declared."""

    @property
    def contact_dofs(self) -> Any:
        return np.arange(1, self.V.dim)


class Falling(Declared):
    @property
    def contact_dofs(self) -> Any:
        return np.arange(self.V.dim)[::-1]


class SamplesWrong(Declared):
    """One entry of the load, evaluated alone, is another one."""

    def sampler(self, wanted: Any) -> Any:
        sample = super().sampler(wanted)

        def wrong(mu: Array) -> Any:
            found = sample(mu)
            return found | ({"f": np.where(wanted["f"][0] == 4, 1.0, found["f"])} if "f" in found else {})

        return wrong


class SamplesNothing(Wire):
    entrywise: ClassVar[frozenset[str]] = frozenset({"f"})


class OneSample(Wire):
    def training_set(self) -> Array:
        return np.array([[5.0], [5.0]])


class OutputsOfOneName(Wire):
    @property
    def outputs(self) -> tuple[Output, ...]:
        return (Output("force", "N", lam=np.ones(self.W.dim)), Output("force", "N", u=np.ones(self.V.dim)))


class OutputOfNothing(Wire):
    @property
    def outputs(self) -> tuple[Output, ...]:
        return (Output("peak", "m", function=lambda mu, u, lam: float(u[lam > 0.0].max())),)


class OutputOfAnotherSize(Wire):
    @property
    def outputs(self) -> tuple[Output, ...]:
        return (Output("force", "N", lam=np.ones(self.W.dim + 1)),)


class Outside(Wire):
    def training_set(self) -> Array:
        return np.linspace(3.0, 8.0, 6)[:, None]


class Flat(Wire):
    def training_set(self) -> Array:
        return np.linspace(4.0, 8.0, 6)


class OtherValidation(Wire):
    def validation_set(self, count: int, seed: int) -> Array:
        return self.parameters.sample(count, int(np.random.default_rng().integers(2**31)))


class BackwardsBox(Wire):
    parameters = ParameterBox(("force",), np.array([8.0]), np.array([4.0]), ("N/m",))


class NamedByText(Wire):
    parameters = ParameterBox("force", np.array([4.0]), np.array([8.0]), ("N/m",))  # type: ignore[arg-type]


class Unpicklable(Wire):
    def __init__(self) -> None:
        super().__init__()
        self.load = lambda force: -force


class Worse(Outside, Unpicklable):
    """Wrong in two ways."""


class WrongSign(Wire):
    """The wire is pulled off its support."""

    def assemble(self, mu: Array) -> VariationalInequality:
        vi = super().assemble(mu)
        return replace(vi, B=-vi.B)


class OutOfReach(Wire):
    def refuse(self, mu: Array, u: Array, lam: Array) -> str:
        return "the force is more than the wire bears" if mu[0] > 7.0 else ""


class PaintsNothing(Declared):
    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:
        found = super().picture(mu, u, lam)
        return replace(found, triangles=np.array([[0], [1], [len(u)]]), values=u[:-1])


class InsideOut(Declared):
    def mesh_fields(self, mu: Array, u: Array, lam: Array) -> MeshFields:
        corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
        return MeshFields(corners, {"tetra": np.arange(4)[None]}, {}, {})


class NoMeasure(Declared):
    def multiplier_integrals(self) -> Array:
        return np.zeros(self.W.dim)


class Unfinished(Problem):
    def training_set(self) -> Array:
        return np.zeros((2, 1))
