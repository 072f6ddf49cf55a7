"""What may stand in a study file."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import (
    AllowInfNan,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    model_validator,
)

from vibench.errors import RequestError
from vibench.interfaces.strategies import Stop
from vibench.qp.solve import installed_solvers
from vibench.study import registry

Tolerance: TypeAlias = Annotated[float, Gt(0.0), Lt(1.0), AllowInfNan(False)]
Size: TypeAlias = Annotated[int, Ge(1), Le(100_000)]
Seconds: TypeAlias = Annotated[float, Gt(0.0), Le(1e7), AllowInfNan(False)]
Tolerances: TypeAlias = Annotated[list[Tolerance], MinLen(1)]
Sizes: TypeAlias = Annotated[list[Size], MinLen(1)]
Name: TypeAlias = Annotated[str, MinLen(1)]
Names: TypeAlias = Annotated[list[Name], MinLen(1)]


def _word_or_list(value: Any) -> str:
    return "<list>" if isinstance(value, list) else "<word>"


def _table_or_list(value: Any) -> str:
    return "<table>" if isinstance(value, dict) else "<list>"


def _only_available(value: Any) -> Any:
    if value != "available":
        raise ValueError("expected 'available' or a list of solver names")
    return value


Solvers: TypeAlias = Annotated[
    Annotated[Literal["available"], BeforeValidator(_only_available), Tag("<word>")] | Annotated[Names, Tag("<list>")],
    Discriminator(_word_or_list),
]
PerStrategyTolerances: TypeAlias = Annotated[
    Annotated[Tolerances, Tag("<list>")] | Annotated[dict[str, Tolerances], Tag("<table>")],
    Discriminator(_table_or_list),
]
PerStrategySizes: TypeAlias = Annotated[
    Annotated[Sizes, Tag("<list>")] | Annotated[dict[str, Sizes], Tag("<table>")], Discriminator(_table_or_list)
]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Entry(_Model):
    """One entry of an axis of plugins."""

    name: Annotated[Name, Field(description="Name the plugin is registered under.")]
    label: Annotated[str, Field(description="How tables call it; its name unless given.")] = ""
    options: Annotated[dict[str, Any], Field(description="Keyword arguments of its constructor.")] = {}

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @property
    def title(self) -> str:
        """Label, or name."""
        return self.label or self.name


class ToleranceTable(_Model):
    """A grid of tolerances: the product of what is given."""

    pod: Annotated[Tolerances | None, Field(description="Tolerances δ_POD of the POD.")] = None
    N: Annotated[Sizes | None, Field(description="Dimensions of V_N, in place of `pod`.")] = None
    dual: Annotated[
        PerStrategyTolerances | None, Field(description="Tolerances δ_dual of the cones: for all, or by strategy.")
    ] = None
    R: Annotated[
        PerStrategySizes | None,
        Field(description="Numbers of generators, in place of `dual`: for all, or by strategy."),
    ] = None
    primal: Annotated[
        dict[str, Tolerances], Field(description="Tolerances δ of the primal strategies that take one, by strategy.")
    ] = {}

    @model_validator(mode="after")
    def _one_of_each(self) -> ToleranceTable:
        if (self.pod is None) == (self.N is None):
            raise ValueError("give either 'pod' (tolerances) or 'N' (sizes)")
        if (self.dual is None) == (self.R is None):
            raise ValueError("give either 'dual' (tolerances) or 'R' (sizes)")
        return self

    def of_dual(self, entry: Entry) -> list[Stop]:
        """Where the cone of one dual strategy is to stop."""
        if self.dual is not None:
            return [Stop(tolerance=value) for value in _meant_for(self.dual, entry, "tolerances.dual")]
        return [Stop(size=value) for value in _meant_for(self.R or [], entry, "tolerances.R")]

    def of_primal(self, entry: Entry) -> list[float | None]:
        """Tolerances of one primal strategy; `None` alone for a strategy that takes none."""
        if not registry.load("primal strategy", entry.name).takes_tolerance:
            return [None]
        return list(_meant_for(self.primal, entry, "tolerances.primal"))


def _meant_for(values: Any, entry: Entry, key: str) -> list[Any]:
    """The values meant for one entry: a plain list is for all, a table says for whom."""
    if not isinstance(values, dict):
        return list(values)
    found = values.get(entry.title, values.get(entry.name))
    if found is None:
        raise RequestError(f"{key} gives nothing for '{entry.title}', which takes a tolerance")
    return list(found)


class Limits(_Model):
    """What a query and a stage may take; a stage is everything of a cell that is computed in one go."""

    query_seconds: Annotated[Seconds, Field(description="Wall seconds of one solution of a query.")] = 20.0
    cell_seconds: Annotated[Seconds, Field(description="Wall seconds of a stage; all queries of a cell are one.")] = (
        600.0
    )
    memory_gib: Annotated[
        float, Gt(0.0), Lt(1e6), AllowInfNan(False), Field(description="Address space of a worker process in GiB.")
    ] = 8.0


class Study(_Model):
    """A study file: the axes of the matrix and what all its cells share."""

    name: Annotated[str, MinLen(1), Field(description="Name of the study; results go to `runs/` and this name.")]
    seed: Annotated[int, Ge(0), Lt(2**63), Field(description="Seed of the validation set.")] = 0
    validation: Annotated[
        int, Ge(1), Le(100_000), Field(description="Number of validation parameters, on which every cell is judged.")
    ]
    accuracy: Annotated[
        float,
        Ge(1e-14),
        Le(1e-2),
        AllowInfNan(False),
        Field(description="Relative accuracy every solver is asked for and every query is judged by."),
    ] = 1e-7
    solvers: Annotated[Solvers, Field(description="QP solvers; `available` for all that are installed.")]
    dual: Annotated[list[Entry], MinLen(1), Field(description="Dual strategies.")]
    primal: Annotated[list[Entry], MinLen(1), Field(description="Primal strategies.")]
    assembly: Annotated[
        list[Literal["full", "reduced"]], MinLen(1), Field(description="How queries are assembled.")
    ] = ["full"]
    interpolation: Annotated[
        Tolerance, Field(description="Largest relative interpolation error accepted in reduced assembly.")
    ] = 1e-6
    warm_start: Annotated[
        bool, Field(description="Whether solvers that can start from the solution of a neighbouring parameter.")
    ] = False
    problem: Annotated[list[Entry], MinLen(1), Field(description="Problems.")]
    tolerances: Annotated[
        list[ToleranceTable], MinLen(1), Field(description="Grids of tolerances; several of them add up.")
    ]
    limits: Annotated[Limits, Field(description="What a query and a stage may take.")] = Limits()

    @model_validator(mode="after")
    def _file_name(self) -> Study:
        if not all(c.isalnum() or c in "-_." for c in self.name) or self.name.startswith("."):
            raise ValueError("name: letters, digits, '-', '_' and '.' only, since results are stored under it")
        return self

    def solver_names(self) -> list[str]:
        """Solvers to run: those named, or all that are installed."""
        return installed_solvers(registry.names("QP solver")) if self.solvers == "available" else list(self.solvers)
