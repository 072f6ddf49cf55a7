"""The schema of study files."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import (
    AfterValidator,
    AllowInfNan,
    BaseModel,
    BeforeValidator,
    Discriminator,
    Field,
    ModelWrapValidatorHandler,
    Tag,
    ValidationError,
    model_validator,
)

from vibench.errors import RequestError, fault_line, unknown_name
from vibench.interfaces.strategies import Stop
from vibench.linalg.factorisations import DEFAULT
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import Plugin
from vibench.plugins.registry import default_formulation, find, registered
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers
from vibench.study.entries import (
    Entry,
    FormulationEntry,
    Name,
    ProblemEntry,
    SamplingEntry,
    Size,
    Training,
    Validation,
    as_list,
)
from vibench.study.parameter_sets import OWN, ParameterSet, check_sets, is_available

Tolerance: TypeAlias = Annotated[float, Gt(0.0), Lt(1.0), AllowInfNan(False)]
Seconds: TypeAlias = Annotated[float, Gt(0.0), Le(1e7), AllowInfNan(False)]
Gibibytes: TypeAlias = Annotated[float, Gt(0.0), Lt(1e6), AllowInfNan(False)]
Rounds: TypeAlias = Annotated[int, Ge(1), Lt(1000)]
Tolerances: TypeAlias = Annotated[list[Tolerance], MinLen(1)]
Sizes: TypeAlias = Annotated[list[Size], MinLen(1)]
Names: TypeAlias = Annotated[list[Name], MinLen(1)]


Accuracy: TypeAlias = Annotated[float, Ge(1e-14), Le(1e-2), AllowInfNan(False)]
Bounds: TypeAlias = Annotated[list[bool], MinLen(1), BeforeValidator(as_list)]
Accuracies: TypeAlias = Annotated[list[Accuracy], MinLen(1), BeforeValidator(as_list)]


def _only_available(value: Any) -> Any:
    if value != "available":
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


class _Model(BaseModel):
    model_config = Entry.model_config


class ToleranceTable(_Model):
    """A grid of tolerances: the Cartesian product of its lists."""

    pod: Annotated[Tolerances | None, Field(description="Tolerances δ_POD of the POD.")] = None
    N: Annotated[Sizes | None, Field(description="Dimensions of V_N, in place of `pod`.")] = None
    dual: Annotated[
        PerStrategy[Tolerances] | None, Field(description="Tolerances δ_dual of the cones: for all, or by strategy.")
    ] = None
    R: Annotated[
        PerStrategy[Sizes] | None, Field(description="Numbers of generators, in place of `dual`: likewise.")
    ] = None
    primal: Annotated[dict[str, Tolerances], Field(description="Tolerances δ of the primal strategies, by name.")] = {}

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

    query_seconds: Annotated[Seconds, Field(description="Wall seconds of one solution of a query.")] = 20.0
    cell_seconds: Annotated[Seconds, Field(description="Wall seconds of a stage.")] = 600.0
    memory_gib: Annotated[
        Gibibytes,
        Field(description="Address space of a worker process in GiB; kept artefacts take an eighth, at most 1 GiB."),
    ] = 8.0


class Study(_Model):
    """A study: the axes of the matrix of cells, and the settings that all cells share; the keys of a study file.

    Raises
    ------
    RequestError
        If a setting is wrong, or names a plugin, or an option of one, that there is not; it says what would be right.
    """

    name: Annotated[FileName, Field(description="Name of the study; its results are in the folder `runs/<name>`.")]
    seed: Annotated[int, Ge(0), Lt(2**63), Field(description="Seed of the validation set.")] = 0
    validation: Annotated[
        Validation,
        Field(description="Validation set, the queries of every cell: a number for the problem's own, or a sampling."),
    ]
    training: Annotated[Training, Field(description="Training sets: an axis; `own` is that of the problem itself.")] = [
        SamplingEntry(name=OWN)
    ]
    accuracy: Annotated[
        Accuracies, Field(description="Relative accuracy prescribed to QP solvers, or a list of accuracies: an axis.")
    ] = [1e-7]
    formulation: Annotated[
        list[FormulationEntry],
        MinLen(1),
        Field(
            description="Formulations; `mixed` is the program of V_N and the cone. None has axes that it does not use.",
            default_factory=lambda: [FormulationEntry(name=default_formulation())],
        ),
    ]
    solvers: Annotated[
        Solvers, Field(description="QP solvers; `available` for all installed ones. Required by `mixed`.")
    ] = []
    dual: Annotated[list[Entry], MinLen(1), Field(description="Dual strategies. Required by `mixed`.")] = []
    primal: Annotated[list[Entry], MinLen(1), Field(description="Primal strategies. Required by `mixed`.")] = []
    assembly: Annotated[list[Literal["full", "reduced"]], MinLen(1), Field(description="Assembly of queries.")] = [
        "full"
    ]
    bounds: Annotated[Bounds, Field(description="Error bounds of queries, with reduced assembly: an axis.")] = [False]
    correction: Annotated[
        list[Literal["none", "feasible", "auto"]],
        MinLen(1),
        Field(description="Whether solutions are corrected; `auto` for those whose violation dominates the bound."),
    ] = ["none"]
    interpolation: Annotated[Tolerance, Field(description="Tolerance of interpolation in reduced assembly.")] = 1e-6
    warm_start: Annotated[
        bool,
        Field(
            description="Whether QP solvers start from a solution at another parameter if they can: the one before it "
            "in an ordered validation set, else a neighbour."
        ),
    ] = False
    timing_rounds: Annotated[
        Rounds,
        Field(description="Maximal number of timing rounds of a cell; with fewer than six, break-even is undecided."),
    ] = 18
    timing_rounds_min: Annotated[
        Rounds,
        Field(description="Minimal number of timing rounds, after which a cell with decided comparisons ends."),
    ] = 6
    factorisation: Annotated[
        Literal["superlu", "pardiso", "cholmod", "available"],
        Field(description="Factorisation of high-fidelity matrices; a problem may have an option of the same name."),
    ] = "superlu"
    problem: Annotated[list[ProblemEntry], MinLen(1), Field(description="Problems.")]
    tolerances: Annotated[
        list[ToleranceTable], MinLen(1), Field(description="Grids of tolerances; cells are their union.")
    ]
    limits: Annotated[Limits, Field(description="Limits of a query and of a stage.")] = Limits()

    @model_validator(mode="wrap")
    @classmethod
    def _checked(cls, given: Any, build: ModelWrapValidatorHandler[Study]) -> Study:
        named = ("problem", "formulation", "dual", "primal", "training", "validation")
        try:
            study = build(_in_present_words(given))
        except ValidationError as error:
            raise RequestError(fault_line(error, cls, named)) from None
        if study.factorisation != DEFAULT:
            # A factorisation in the options of a problem wins.
            given = {"factorisation": study.factorisation}
            study.problem[:] = (one.model_copy(update={"options": given | one.options}) for one in study.problem)
        # After the types: messages about names need valid entries.
        _check_names(study)
        return study

    def training_sets(self, problem: ProblemEntry) -> list[ParameterSet]:
        entries = problem.training or self.training
        return [
            ParameterSet("training", 0, 0, _sampling(entry), entry.title, entry.on_failure == "skip")
            for entry in entries
        ]

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
    if not isinstance(assembly, list) or not (before := {"certified", "compiled"}.intersection(map(str, assembly))):
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


def _sampling(entry: SamplingEntry) -> Plugin | None:
    return None if entry.name == OWN else entry.plugin(PluginKind.SAMPLING)


def _check_names(study: Study) -> None:
    """Check names and options of plugins, and that exactly the strategies that take a tolerance have one."""
    axes: dict[PluginKind, Sequence[Entry]] = {
        PluginKind.PROBLEM: study.problem,
        PluginKind.DUAL: study.dual,
        PluginKind.PRIMAL: study.primal,
    }
    for kind, axis in (*axes.items(), (PluginKind.FORMULATION, study.formulation)):
        for entry in axis:
            entry.registered(kind).check_options(entry.options)
        _check_given(kind, axis)
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
    if not samplings and not entry.registered(PluginKind.PROBLEM).data_digest({**entry.options, **entry.places}):
        return
    problem, validation = entry.plugin(PluginKind.PROBLEM), study.validation_set(entry)
    training = study.training_sets(entry)
    if is_available(problem, *(one.sampling for one in (validation, *training) if one.sampling is not None)):
        for trained in training:
            check_sets(problem, trained, validation)


def _check_tolerances(study: Study, table: ToleranceTable) -> None:
    given = (
        (PluginKind.DUAL, study.dual, table.dual),
        (PluginKind.DUAL, study.dual, table.R),
        (PluginKind.PRIMAL, study.primal, table.primal),
    )
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
