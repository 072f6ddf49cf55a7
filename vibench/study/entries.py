"""The schema of the entries on the axes of a study file: plugins with their options, problems, parameter sets."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import date, time
from typing import Annotated, Any, Literal, Self, TypeAlias

from annotated_types import Ge, Le, MinLen
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
    model_validator,
)

from vibench.interfaces.formulations import Formulation, axes_of
from vibench.plugins.kinds import PluginKind
from vibench.plugins.plugin import GivenPlugin, Plugin, give
from vibench.plugins.registry import RegisteredPlugin, default_formulation, find
from vibench.study.parameter_sets import OWN

Size: TypeAlias = Annotated[int, Ge(1), Le(100_000)]
Name: TypeAlias = Annotated[str, MinLen(1)]


def as_list(value: Any) -> Any:
    """A list, or a single value as a list of one."""
    return value if isinstance(value, list) else [value]


def _is_plain(value: Any) -> bool:
    """Whether a value may occur in a study file, or is an entry already; others are classes or objects."""
    return value is None or isinstance(value, str | int | float | list | dict | date | time | BaseModel)


class Entry(BaseModel):
    """One entry of an axis of plugins; in Python a class or an object may replace the name or the whole entry."""

    # Unknown keys are refused, and no type is converted.
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    name: Annotated[Name, Field(description="Name the plugin is registered under.")]
    label: Annotated[str, Field(description="Label in tables; its name by default.")] = ""
    options: Annotated[dict[str, Any], Field(description="Keyword arguments of its constructor.")] = {}

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
        return Plugin.of(self.registered(kind), self.options, self.places)

    @property
    def places(self) -> Mapping[str, str]:
        """Paths of files and folders, by option, where the options have only their names."""
        return self._places

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
        kind: type[Formulation] = Formulation if plugin.conflict else plugin.load()
        return kind

    @property
    def uses(self) -> tuple[str, ...]:
        """The axes of a study that it has. Raises a `RequestError` if it declares axes that there are not."""
        return axes_of(self.kind, str(self.registered(PluginKind.FORMULATION)))


class SamplingEntry(Entry):
    """A parameter set: `own`, that of the problem itself, or a sampling strategy; other keys are its options."""

    on_failure: Annotated[
        Literal["stop", "skip"],
        Field(description="Of a training set: `skip` leaves out parameters without a solution, a tenth at most."),
    ] = "stop"

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

    training: Annotated[Training | None, Field(description="Training sets of this problem, not those of all.")] = None
    validation: Annotated[Validation | None, Field(description="Validation set of this problem, likewise.")] = None
