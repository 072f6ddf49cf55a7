"""Problems that are wrong, each in one way; what `vibench check` has to find, and nothing else."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from fake_plugins import Wire

import vibench
from vibench import Array, Contact, ContactSource, InnerProduct, MeshFields, Output, Picture, VariationalInequality


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


def variant(module: str, name: str, base: Any = Wire, **members: Any) -> Any:
    return type(name, (base,), {"__module__": module, **members})


def changed(module: str, name: str, member: str, wrong: Callable[..., Any], base: Any = Wire, above: Any = None) -> Any:
    """A problem of which one member is made wrong, from some force on, by its value, mu and the problem."""

    def assemble(self: Any, mu: Array) -> VariationalInequality:
        vi = base.assemble(self, mu)
        return vi if above and mu[0] < above else replace(vi, **{member: wrong(getattr(vi, member), mu, self)})

    return variant(module, name, base, assemble=assemble)


def built(module: str, name: str, base: Any = Wire, **members: Callable[[Any], Any]) -> Any:
    def init(self: Any) -> None:
        base.__init__(self)
        for member, made in members.items():
            setattr(self, member, made(self))

    return variant(module, name, base, __init__=init)


_variant, _changed, _built = (partial(make, __name__) for make in (variant, changed, built))


Asymmetric = _changed("Asymmetric", "A", lambda A, mu, _: A + sp.csr_array(([1e-3 * mu[0]], ([2], [3])), shape=A.shape))
Indefinite = _changed("Indefinite", "A", lambda A, mu, wire: A - 4.0 * (mu[0] - 4.0) * Wire().mass / 0.9)
InfiniteMatrix = _changed("InfiniteMatrix", "B", lambda B, mu, wire: B + sp.csr_array(([np.inf], ([5], [5])), B.shape))
Column = _changed("Column", "f", lambda f, mu, wire: f[:, None])
# The support gives way by a hundredth above a force of 5.4321 N/m.
Jumps = _changed("Jumps", "g", lambda g, mu, wire: 1.01 * g, above=5.4321)
# At one force alone it is another wire.
JumpsAtTheCentre = _changed("JumpsAtTheCentre", "A", lambda A, mu, wire: 2.0 * A if mu[0] == 6.0 else A)

ConstantOfNothing = _variant("ConstantOfNothing", constant=frozenset({"a"}))
ConstantText = _variant("ConstantText", constant="A")
SamplesNothing = _variant("SamplesNothing", entrywise=frozenset({"f"}))
OneSample = _variant("OneSample", training_set=lambda self: np.array([[5.0]]))
Twice = _variant("Twice", training_set=lambda self: np.array([[5.0], [6.0], [5.0]]))
Outside = _variant("Outside", training_set=lambda self: np.linspace(3.0, 8.0, 6)[:, None])
Flat = _variant("Flat", training_set=lambda self: np.linspace(4.0, 8.0, 6))
OtherValidation = _variant(
    "OtherValidation",
    validation_set=lambda self, count, seed: self.parameters.sample(
        count, int(np.random.default_rng().integers(2**31))
    ),
)
OutputsOfOneName = _variant(
    "OutputsOfOneName",
    outputs=property(
        lambda self: (Output("force", "N", lam=np.ones(self.W.dim)), Output("force", "N", u=np.ones(self.V.dim)))
    ),
)
OutputOfNothing = _variant(
    "OutputOfNothing",
    outputs=property(lambda self: (Output("peak", "m", function=lambda mu, u, lam: float(u[lam > 0.0].max())),)),
)
OutputOfAnotherSize = _variant(
    "OutputOfAnotherSize", outputs=property(lambda self: (Output("force", "N", lam=np.ones(self.W.dim + 1)),))
)
OutOfReach = _variant("OutOfReach", refuse=lambda self, mu, u, lam: "more than the wire bears" if mu[0] > 7.0 else "")
ContactOfNothing = _variant(
    "ContactOfNothing", contact=lambda self, mu: Contact(-self.mass, np.full(self.W.dim, self.depth * self.step))
)

# The loads of multipliers are those of others.
LoadsWrong = _variant("LoadsWrong", Declared, contact_loads=lambda self, eta: Declared.contact_loads(self, 2.0 * eta))
# Loads vary on more rows than it says.
LoadsReachFarther = _variant(
    "LoadsReachFarther", Declared, contact_loads=lambda self, eta: replace(Declared.contact_loads(self, eta), reach=1)
)
# The C code of its constraint lacks a part of g.
SourceWrong = _variant(
    "SourceWrong",
    Declared,
    contact_source=lambda self: ContactSource(
        """static int contact(const double *mu, int *ends, int *columns, double *values, double *g)
        {
            (void)mu;
            for (int i = 0; i < contact_rows; i++) {
                for (ends[i + 1] = ends[i]; ends[i + 1] < contact_last[i]; ends[i + 1]++) {
                    columns[ends[i + 1]] = contact_columns[ends[i + 1]];
                    values[ends[i + 1]] = contact_values[ends[i + 1]];
                }
                g[i] = 0.999 * contact_g;
            }
            return 1;
        }""",
        {
            "rows": self.W.dim, "last": self.mass.indptr[1:], "columns": self.mass.indices, "values": -self.mass.data,
            "g": self.depth * self.step,
        },
        self.mass.nnz,
    ),
)  # fmt: skip
NoInequality = _variant(
    "NoInequality", assemble=lambda self, mu: tuple(getattr(Wire.assemble(self, mu), name) for name in "AfBg")
)
# On the contact alone the bound is another one.
PartlyWrong = _variant(
    "PartlyWrong", Declared, contact=lambda self, mu: Contact(-self.mass, Declared.contact(self, mu).g * (1.0 + 1e-6))
)
PaintsNothing = _variant(
    "PaintsNothing", Declared, picture=lambda self, mu, u, lam: Declared.picture(self, mu, u[1:], lam[1:])
)
NoContact = _variant("NoContact", Declared, contact=lambda self, mu: None)
# B touches an unknown that is not declared.
Overlooked = _variant("Overlooked", Declared, contact_dofs=property(lambda self: np.arange(1, self.V.dim)))
Falling = _variant("Falling", Declared, contact_dofs=property(lambda self: np.arange(self.V.dim)[::-1]))
NoMeasure = _variant("NoMeasure", Declared, multiplier_integrals=lambda self: np.zeros(self.W.dim))


class IndefiniteNorm(Wire):
    def __init__(self) -> None:
        super().__init__()
        self.V = InnerProduct(self.stiffness - 1e3 * self.mass)


NoSpace = _built("NoSpace", V=lambda wire: wire.stiffness)
NoConstraint = _built("NoConstraint", W=lambda wire: InnerProduct(sp.csr_array((0, 0))))
Unpicklable = _built("Unpicklable", load=lambda wire: lambda force: -force)


class Raises(Wire):
    def assemble(self, mu: Array) -> VariationalInequality:
        if mu[0] > 7.5:
            raise ArithmeticError("the wire snapped")
        return super().assemble(mu)


class CountsInstances(Wire):
    """Every instance has finer steps than the one before."""

    made = 0

    def __init__(self) -> None:
        super().__init__()
        CountsInstances.made += 1
        self.depth += 1e-6 * CountsInstances.made


class OneBuffer(Wire):
    def __init__(self) -> None:
        super().__init__()
        self._load = np.zeros(self.V.dim)

    def assemble(self, mu: Array) -> VariationalInequality:
        self._load[:] = -mu[0] * self.step
        return replace(super().assemble(mu), f=self._load)


class ContactChangesTheParameter(Declared):
    def contact(self, mu: Array) -> Contact:
        mu += 1.0
        return super().contact(mu)


class SamplesWrong(Declared):
    """One entry of the load, evaluated alone, is another one."""

    def sampler(self, wanted: Any) -> Any:
        sample = super().sampler(wanted)

        def wrong(mu: Array) -> Any:
            found = sample(mu)
            return found | ({"f": np.where(wanted["f"][0] == 4, 1.0, found["f"])} if "f" in found else {})

        return wrong


class Worse(Outside, Unpicklable):
    """Wrong in two ways."""


class InsideOut(Declared):
    def mesh_fields(self, mu: Array, u: Array, lam: Array) -> MeshFields:
        corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
        return MeshFields(corners, {"tetra": np.arange(4)[None]}, {}, {})


class Unfinished(vibench.Problem):
    def training_set(self) -> Array:
        return np.zeros((2, 1))
