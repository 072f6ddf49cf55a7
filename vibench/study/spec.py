"""The schema of study files: plugins with their options, parameter sets, tolerances, and the settings of a study."""

from __future__ import annotations

import json
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from datetime import date, time
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias, TypeVar, cast

import numpy as np
from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    Tag,
    ValidationError,
    field_validator,
    model_validator,
)

from vibench.errors import RequestError, fault_line, unknown_name
from vibench.interfaces.dual_sets import BlockKind
from vibench.interfaces.formulations import Formulation, axes_of
from vibench.interfaces.strategies import Stop
from vibench.linalg.factorisations import DEFAULT
from vibench.model.affine import INTERPOLATION_RTOL
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import GivenPlugin, Plugin, give
from vibench.plugins.registry import RegisteredPlugin, default_formulation, default_of, find, registered
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers
from vibench.study.parameter_sets import OWN, ParameterSet, blocks_of, check_sets, is_available
from vibench.timing import FEWEST_ROUNDS

Size: TypeAlias = Annotated[int, Ge(1), Le(100_000)]
Name: TypeAlias = Annotated[str, MinLen(1)]


def as_list(value: Any) -> Any:
    """A list, or a single value as a list of one."""
    return value if isinstance(value, list) else [value]


def _is_plain(value: Any) -> bool:
    """Whether a value may occur in a study file, or is an entry already; others are classes or objects."""
    return value is None or isinstance(value, str | int | float | list | dict | date | time | BaseModel)


class _Model(BaseModel):
    # Unknown keys, infinities and NaN are refused, and no type is converted.
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _no_array(cls, value: Any) -> Any:
        # The validation takes whatever has `__float__` for a number, and so an array of one entry.
        if isinstance(value, np.ndarray):
            raise ValueError(f"is an array of shape {value.shape}, expected a value of a study file")
        return value


class Entry(_Model):
    """One entry of an axis of plugins; in Python a class or an object may replace the name or the whole entry."""

    name: Name = Field(description="Name the plugin is registered under.")
    label: str = Field(default="", description="Label in tables; its name by default.")
    options: dict[str, Any] = Field(default={}, description="Keyword arguments of its constructor.")

    _given: Any = PrivateAttr(None)
    _places: Mapping[str, str] = PrivateAttr({})

    @model_validator(mode="wrap")
    @classmethod
    def _from_python(cls, value: Any, build: ModelWrapValidatorHandler[Self]) -> Self:
        given = value.get("name") if isinstance(value, dict) else value
        if _is_plain(given):
            return build(value)
        # The name of the class is that of the entry, and its label in tables.
        name = (given if isinstance(given, type) else type(given)).__name__
        entry = build((value if isinstance(value, dict) else {}) | {"name": name})
        entry._given = given
        return entry

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @property
    def is_registered(self) -> bool:
        """Whether it names a plugin, and does not hold a class or an object."""
        return self._given is None

    def registered(self, kind: PluginKind) -> RegisteredPlugin:
        """The registry entry of its name, or its class or object in the state of the first call."""
        if self.is_registered:
            return find(kind, self.name)
        if not isinstance(self._given, GivenPlugin):
            # Take its state now: later calls must return the same plugin.
            self._given = give(kind, self.title, self._given)
        return self._given

    def plugin(self, kind: PluginKind) -> Plugin:
        return Plugin.of(self.registered(kind), self.options, self._places)

    def at(self, places: Mapping[str, str]) -> Self:
        """The entry with files and folders at these places, by option."""
        self._places = places
        return self

    @property
    def title(self) -> str:
        return self.label or self.name


class FormulationEntry(Entry):
    """One entry of the axis of formulations."""

    @model_validator(mode="after")
    def _no_label_of_another(self) -> FormulationEntry:
        if self.label and self.label == default_formulation() != self.name:
            raise ValueError(f"'{self.label}' is the formulation of studies that name none, and no label of another")
        return self

    @property
    def kind(self) -> type[Formulation]:
        """The class; a formulation that has all axes where several packages use its name: its cells cannot be run."""
        plugin = self.registered(PluginKind.FORMULATION)
        return Formulation if plugin.conflict else cast("type[Formulation]", plugin.load())

    @property
    def uses(self) -> tuple[str, ...]:
        """The axes of a study that it has. Raises a `RequestError` if it declares axes that there are not."""
        return axes_of(self.kind, str(self.registered(PluginKind.FORMULATION)))


class SamplingEntry(Entry):
    """A parameter set: `own`, that of the problem itself, or a sampling strategy; other keys are its options."""

    on_failure: Literal["stop", "skip"] = Field(
        default="stop",
        description="Of a training set: `skip` leaves out parameters without a solution, a tenth at most.",
    )

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            return {"name": value} if isinstance(value, str) else value
        own = {key: part for key, part in value.items() if key in cls.model_fields}
        short = {key: part for key, part in value.items() if key not in cls.model_fields}
        given = own.get("options", {})
        return own | {"options": given | short} if isinstance(given, dict) else own

    @model_validator(mode="after")
    def _no_options_of_own(self) -> SamplingEntry:
        if self.name == OWN and self.options:
            raise ValueError(f"the problem's own set has no options (found {', '.join(map(repr, self.options))})")
        if self.label == OWN != self.name:
            raise ValueError(f"'{OWN}' is the problem's own set and no label of another")
        return self


def _number_or_table(value: Any) -> str:
    return "<number>" if _is_plain(value) and not isinstance(value, dict | str | SamplingEntry) else "<table>"


def _drawn(entry: SamplingEntry) -> SamplingEntry:
    if entry.name == OWN:
        raise ValueError("give the number of parameters in the problem's own set, or a sampling strategy")
    if entry.on_failure == "skip":
        raise ValueError("on_failure is for training sets: every query has a row")
    return entry


Training: TypeAlias = Annotated[list[SamplingEntry], MinLen(1), BeforeValidator(as_list)]
Validation: TypeAlias = Annotated[
    Annotated[Size, Tag("<number>")] | Annotated[SamplingEntry, AfterValidator(_drawn), Tag("<table>")],
    Discriminator(_number_or_table),
]


class ProblemEntry(Entry):
    """One entry of the axis of problems."""

    training: Training | None = Field(default=None, description="Training sets of this problem, not those of all.")
    validation: Validation | None = Field(default=None, description="Validation set of this problem, likewise.")


Tolerance: TypeAlias = Annotated[float, Gt(0.0), Lt(1.0)]
Seconds: TypeAlias = Annotated[float, Gt(0.0), Le(1e7)]
Gibibytes: TypeAlias = Annotated[float, Gt(0.0), Lt(1e6)]
Rounds: TypeAlias = Annotated[int, Ge(1), Lt(1000)]
Tolerances: TypeAlias = Annotated[list[Tolerance], MinLen(1)]
Sizes: TypeAlias = Annotated[list[Size], MinLen(1)]
Names: TypeAlias = Annotated[list[Name], MinLen(1)]
Accuracy: TypeAlias = Annotated[float, Ge(1e-14), Le(1e-2)]
Bounds: TypeAlias = Annotated[list[bool], MinLen(1), BeforeValidator(as_list)]
Accuracies: TypeAlias = Annotated[list[Accuracy], MinLen(1), BeforeValidator(as_list)]


def _only_available(value: Any) -> Any:
    if not isinstance(value, str) or value != "available":
        raise ValueError("expected 'available' or a list of solver names")
    return value


Solvers: TypeAlias = Annotated[
    Annotated[Literal["available"], BeforeValidator(_only_available), Tag("<word>")] | Annotated[Names, Tag("<list>")],
    Discriminator(lambda value: "<list>" if isinstance(value, list) else "<word>"),
]
Values = TypeVar("Values")
PerStrategy: TypeAlias = Annotated[
    Annotated[Values, Tag("<list>")] | Annotated[dict[str, Values], Tag("<table>")],
    Discriminator(lambda value: "<table>" if isinstance(value, dict) else "<list>"),
]


def _file_name(value: str) -> str:
    if not all(c.isalnum() or c in "-_." for c in value) or value.startswith("."):
        raise ValueError("letters, digits, '-', '_' and '.' only, since results are stored under it")
    return value


FileName: TypeAlias = Annotated[Name, AfterValidator(_file_name)]


class ToleranceTable(_Model):
    """A grid of tolerances: the Cartesian product of its lists."""

    pod: Tolerances | None = Field(default=None, description="Tolerances δ_POD of the POD.")
    N: Sizes | None = Field(default=None, description="Dimensions of V_N, in place of `pod`.")
    dual: PerStrategy[Tolerances] | None = Field(
        default=None, description="Tolerances δ_dual of the cones: for all, or by strategy."
    )
    R: PerStrategy[Sizes] | None = Field(default=None, description="Numbers of generators, in place of `dual`.")
    primal: dict[str, Tolerances] = Field(default={}, description="Tolerances δ of the primal strategies, by name.")

    @model_validator(mode="after")
    def _one_of_each(self) -> ToleranceTable:
        if (self.pod is None) == (self.N is None):
            raise ValueError("give either 'pod' (tolerances) or 'N' (sizes)")
        if (self.dual is None) == (self.R is None):
            raise ValueError("give either 'dual' (tolerances) or 'R' (sizes)")
        return self

    def of_dual(self, entry: Entry) -> list[Stop]:
        """Tolerances or sizes of the cone of one dual strategy."""
        if self.dual is not None:
            return [Stop(tolerance=value) for value in _meant_for(self.dual, entry, "tolerances.dual")]
        return [Stop(size=value) for value in _meant_for(self.R or [], entry, "tolerances.R")]

    def of_primal(self, entry: Entry) -> list[float | None]:
        """Tolerances of one primal strategy; [`None`] for a strategy that takes none."""
        plugin = entry.registered(PluginKind.PRIMAL)
        # The cells of an ambiguous name cannot be run, whether it takes a tolerance or not.
        if plugin.conflict:
            return list(self.primal.get(entry.title, self.primal.get(entry.name, [None])))
        if not plugin.load().takes_tolerance:
            return [None]
        return list(_meant_for(self.primal, entry, "tolerances.primal"))


def _meant_for(values: Any, entry: Entry, key: str) -> list[Any]:
    """The values for one entry: of a table those under its label or name, otherwise all."""
    if not isinstance(values, dict):
        return list(values)
    own = values.get(entry.title, values.get(entry.name))
    if own is None:
        raise RequestError(f"{key} gives nothing for '{entry.title}', which takes a tolerance")
    return list(own)


class Limits(_Model):
    """Limits of a query and of a stage; all queries of a cell are one stage."""

    query_seconds: Seconds = Field(default=20.0, description="Wall seconds of one solution of a query.")
    cell_seconds: Seconds = Field(default=600.0, description="Wall seconds of a stage.")
    memory_gib: Gibibytes = Field(
        default=8.0,
        description="Address space of a worker process in GiB; kept artefacts take an eighth, at most 1 GiB.",
    )


class Study(_Model):
    """A study: the axes of the matrix of cells, and the settings that all cells share; the keys of a study file.

    Raises
    ------
    RequestError
        If a setting is wrong, or names a plugin, or an option of one, that there is not; it says what would be right.
    """

    name: FileName = Field(description="Name of the study; its results are in the folder `runs/<name>`.")
    seed: Annotated[int, Ge(0), Lt(2**63)] = Field(default=0, description="Seed of the validation set.")
    validation: Validation = Field(
        description="Validation set, the queries of every cell: a number for the problem's own, or a sampling."
    )
    training: Training = Field(
        default=[SamplingEntry(name=OWN)], description="Training sets: an axis; `own` is that of the problem itself."
    )
    accuracy: Accuracies = Field(default=[1e-7], description="Relative accuracy prescribed to QP solvers: an axis.")
    formulation: Annotated[list[FormulationEntry], MinLen(1)] = Field(
        default_factory=lambda: [FormulationEntry(name=default_formulation())],
        description="Formulations; by default one that serves the problems' K, `mixed` for contact.",
    )
    solvers: Solvers = Field(default=[], description="QP solvers; `available` for all installed. By default `daqp`.")
    dual: Annotated[list[Entry], MinLen(1)] = Field(
        default=[], description="Dual strategies; by default one that serves K."
    )
    primal: Annotated[list[Entry], MinLen(1)] = Field(default=[], description="Primal strategies. Required by `mixed`.")
    assembly: Annotated[list[Literal["full", "reduced"]], MinLen(1)] = Field(
        default=["full"], description="Assembly of queries."
    )
    bounds: Bounds = Field(default=[False], description="Error bounds of queries, with reduced assembly: an axis.")
    correction: Annotated[list[Literal["none", "feasible", "auto"]], MinLen(1)] = Field(
        default=["none"],
        description="Whether solutions are corrected; `auto` for those whose violation dominates the bound.",
    )
    interpolation: Tolerance = Field(
        default=INTERPOLATION_RTOL, description="Tolerance of interpolation in reduced assembly."
    )
    warm_start: bool = Field(
        default=False,
        description="Whether QP solvers start from a solution at another parameter if they can: the one before it in "
        "an ordered validation set, else a neighbour.",
    )
    timing_rounds: Rounds = Field(
        default=18,
        description="Maximal number of timing rounds of a cell; with fewer than six, break-even is undecided.",
    )
    timing_rounds_min: Rounds = Field(
        default=FEWEST_ROUNDS,
        description="Minimal number of timing rounds, after which a cell with decided comparisons ends.",
    )
    timing_budget: Annotated[float, Ge(0.0), Le(100.0)] = Field(
        default=0.25,
        description="CPU seconds of rounds beyond the minimal ones at most, as a fraction of all other CPU seconds of "
        "the run.",
    )
    factorisation: Literal["superlu", "pardiso", "cholmod", "multigrid", "available"] = Field(
        default="superlu",
        description="Factorisation of high-fidelity matrices; a problem may have an option of the same name.",
    )
    problem: Annotated[list[ProblemEntry], MinLen(1)] = Field(description="Problems.")
    tolerances: Annotated[list[ToleranceTable], MinLen(1)] = Field(
        description="Grids of tolerances; cells are their union."
    )
    task: list[Literal["calibration"]] = Field(
        default=[], description="What else a cell does: `calibration` walks Metropolis chains at three levels of noise."
    )
    limits: Limits = Field(default=Limits(), description="Limits of a query and of a stage.")

    @model_validator(mode="wrap")
    @classmethod
    def _checked(cls, given: Any, build: ModelWrapValidatorHandler[Study]) -> Study:
        named = ("problem", "formulation", "dual", "primal", "training", "validation")
        try:
            study = build(_completed(_in_present_words(given)))
        except ValidationError as error:
            raise RequestError(fault_line(error, cls, named)) from None
        if study.factorisation != DEFAULT:
            # A factorisation in the options of a problem wins.
            given = {"factorisation": study.factorisation}
            study.problem[:] = (one.model_copy(update={"options": given | one.options}) for one in study.problem)
        # After the types: messages about names need valid entries.
        _check_options(study)
        _choose_defaults(study)
        _check_names(study)
        return study

    def training_sets(self, problem: ProblemEntry) -> list[ParameterSet]:
        entries = problem.training or self.training
        skips = [(entry, entry.on_failure == "skip") for entry in entries]
        return [ParameterSet("training", 0, 0, _sampling(entry), entry.title, skip) for entry, skip in skips]

    def validation_set(self, problem: ProblemEntry) -> ParameterSet:
        """The validation set of a problem; that of a sampling strategy has no size yet."""
        entry = self.validation if problem.validation is None else problem.validation
        if isinstance(entry, int):
            return ParameterSet("validation", entry, self.seed)
        return ParameterSet("validation", 0, self.seed, _sampling(entry), entry.title)

    def solver_names(self) -> list[str]:
        return installed_solvers(registered(PluginKind.SOLVER)) if self.solvers == "available" else list(self.solvers)


def _in_present_words(given: Any) -> Any:
    """A study in the words of before: "certified" and "compiled" were assemblies. A warning says what to write now."""
    assembly = given.get("assembly") if isinstance(given, dict) else None
    if not isinstance(assembly, list) or not (before := [w for w in ("certified", "compiled") if w in assembly]):
        return given
    now = dict(given) | {"assembly": [word for word in assembly if word not in before]}
    if "certified" in before:
        now["bounds"] = [False, True] if "reduced" in now["assembly"] else [True]
        now["assembly"] += [] if "reduced" in now["assembly"] else ["reduced"]
    if "compiled" in before:
        named = list(given.get("formulation", [default_formulation()])) if now["assembly"] else []
        now["formulation"] = [*named, *({"compiled": None}.keys() - {n for n in named if isinstance(n, str)})]
        now["assembly"] = now["assembly"] or ["reduced"]
    keys = [key for key in ("formulation", "assembly", "bounds") if key in now and now[key] != given.get(key)]
    written = "; ".join(f"{key} = {json.dumps(now[key], default=str)}" for key in keys)
    warnings.warn(f"assembly = {json.dumps(assembly)} is of before; write now: {written}", stacklevel=2)
    return now


def _completed(given: Any) -> Any:
    """A study with what it leaves out, from the registered study `default`: the smallest names its problem alone."""
    usual, together = registered(PluginKind.STUDY).get("default"), ("dual", "primal", "tolerances")
    if not isinstance(given, dict) or usual is None or usual.conflict:
        return given
    # Tolerances name strategies: these keys are left out together or not at all.
    others = () if any(key in given for key in together) else (*together, "assembly")
    lacking = [key for key in ("name", "validation", "solvers", *others) if key not in given]
    if not lacking:
        return given
    content = tomllib.loads(Path(usual.load()).read_text(encoding="utf-8"))
    return {key: content[key] for key in lacking if key in content} | given


def _choose_defaults(study: Study) -> None:
    """Fill in a formulation and a dual strategy that serve the dual sets of the problems, where a study names none."""
    unnamed = "formulation" not in study.model_fields_set
    if not unnamed and study.dual:
        return
    blocks = frozenset[BlockKind]().union(*(blocks_of(one.plugin(PluginKind.PROBLEM)) for one in study.problem))
    if unnamed:
        study.formulation[:] = [FormulationEntry(name=default_of(PluginKind.FORMULATION, blocks))]
    name = default_of(PluginKind.DUAL, blocks)
    if name and not study.dual and any("dual" in one.uses for one in study.formulation):
        study.dual[:] = [Entry(name=name)]


def _sampling(entry: SamplingEntry) -> Plugin | None:
    return None if entry.name == OWN else entry.plugin(PluginKind.SAMPLING)


def _check_options(study: Study) -> None:
    """Check names and options of plugins."""
    axes: Sequence[tuple[PluginKind, Sequence[Entry]]] = [
        (PluginKind.PROBLEM, study.problem), (PluginKind.DUAL, study.dual), (PluginKind.PRIMAL, study.primal),
        (PluginKind.FORMULATION, study.formulation),
    ]  # fmt: skip
    for kind, axis in axes:
        for entry in axis:
            entry.registered(kind).check_options(entry.options)
        _check_given(kind, axis)


def _check_names(study: Study) -> None:
    """Check that axes are not empty, names of solvers, and that exactly strategies that take a tolerance have one."""
    _check_axes(study)
    for problem in study.problem:
        _check_sets(study, problem)
    solvers = {*SETTINGS, *registered(PluginKind.SOLVER)}
    for plugin in (find(PluginKind.SOLVER, name) for name in study.solver_names()):
        # A known solver need not be installed: its cells are unavailable then.
        if plugin.name not in solvers:
            raise unknown_name(PluginKind.SOLVER, plugin.name, solvers)
        if plugin.entries and not plugin.conflict:
            plugin.load()
    for table in study.tolerances:
        _check_tolerances(study, table)


def _check_axes(study: Study) -> None:
    for formulation in study.formulation:
        for axis in formulation.uses:
            if not getattr(study, axis, True):
                raise RequestError(f"{axis}: required, but not given")
    if any(study.bounds) and "reduced" not in study.assembly:
        raise RequestError('bounds = true needs assembly = "reduced": without arrays of mesh size there is no other')


def _check_given(kind: PluginKind, axis: Sequence[Entry]) -> None:
    """Refuse a class or an object with the name of another plugin of its axis."""
    # Registered plugins are told apart by their names and options.
    if all(entry.is_registered for entry in axis):
        return
    plugins = {entry.plugin(kind) for entry in axis}
    names = [(plugin.name, plugin.options) for plugin in plugins]
    for plugin in plugins:
        if names.count((plugin.name, plugin.options)) > 1:
            remedy = "give each a label, as in {'name': …, 'label': 'coarse'}"
            raise RequestError(f"several plugins of the study are called {plugin}: {remedy}")


def _check_sets(study: Study, entry: ProblemEntry) -> None:
    """Check the parameter sets of a problem before a run, so that a fault does not appear in each of its cells."""
    entries = [*(entry.training or study.training), entry.validation or study.validation]
    samplings = [one for one in entries if isinstance(one, SamplingEntry) and one.name != OWN]
    for sampling in samplings:
        sampling.registered(PluginKind.SAMPLING).check_options(sampling.options)
    # Without files and samplings nothing can be wrong with them, and building a problem takes seconds.
    if not samplings and not entry.registered(PluginKind.PROBLEM).data_digest({**entry.options, **entry._places}):
        return
    problem, validation = entry.plugin(PluginKind.PROBLEM), study.validation_set(entry)
    training = study.training_sets(entry)
    if is_available(problem, *(one.sampling for one in (validation, *training) if one.sampling is not None)):
        for trained in training:
            check_sets(problem, trained, validation)


def _check_tolerances(study: Study, table: ToleranceTable) -> None:
    given = (
        (PluginKind.DUAL, study.dual, table.dual), (PluginKind.DUAL, study.dual, table.R),
        (PluginKind.PRIMAL, study.primal, table.primal),
    )  # fmt: skip
    for kind, axis, tolerances in given:
        # A tolerance may name a plugin that an option of the command line has removed from the axis.
        names = {name for entry in axis for name in (entry.name, entry.title)}
        for name in tolerances if isinstance(tolerances, dict) else ():
            if name not in names and name not in registered(kind):
                raise unknown_name(f"{kind} of this study", name, names)
    for entry in study.dual:
        table.of_dual(entry)
    for entry in study.primal:
        if table.of_primal(entry) == [None] and not table.primal.keys().isdisjoint({entry.name, entry.title}):
            raise RequestError(f"tolerances.primal gives something for '{entry.title}', which takes no tolerance")
