"""Study files: what may stand in one, and the line that says what is wrong with it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic import AllowInfNan, BaseModel, ConfigDict, ValidationError, model_validator

from vibench import plugins, qp
from vibench.errors import RequestError, unknown_name

Tolerance: TypeAlias = Annotated[float, Gt(0.0), Lt(1.0), AllowInfNan(False)]
Size: TypeAlias = Annotated[int, Ge(1), Le(100_000)]
Seconds: TypeAlias = Annotated[float, Gt(0.0), AllowInfNan(False)]
Tolerances: TypeAlias = Annotated[list[Tolerance], MinLen(1)]
Sizes: TypeAlias = Annotated[list[Size], MinLen(1)]
Name: TypeAlias = Annotated[str, MinLen(1)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Entry(_Model):
    """One entry of an axis of plugins.

    Attributes
    ----------
    name
        Name the plugin is registered under.
    label
        How tables call it; the name unless given.
    options
        Keyword arguments of its constructor.
    """

    name: Name
    label: str = ""
    options: dict[str, Any] = {}

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

    pod: Tolerances | None = None
    N: Sizes | None = None
    dual: Tolerances | dict[str, Tolerances] | None = None
    R: Sizes | dict[str, Sizes] | None = None
    primal: dict[str, Tolerances] = {}

    @model_validator(mode="after")
    def _one_of_each(self) -> ToleranceTable:
        if (self.pod is None) == (self.N is None):
            raise ValueError("give either 'pod' (tolerances) or 'N' (sizes)")
        if (self.dual is None) == (self.R is None):
            raise ValueError("give either 'dual' (tolerances) or 'R' (sizes)")
        return self


class Limits(_Model):
    """What a query and a stage may take; a stage is everything of a cell that is computed in one go."""

    query_seconds: Seconds = 20.0
    cell_seconds: Seconds = 600.0
    memory_gib: Seconds = 8.0


class Study(_Model):
    """A study file: the axes of the matrix and what all its cells share."""

    name: Annotated[str, MinLen(1)]
    seed: Annotated[int, Ge(0)] = 0
    validation: Annotated[int, Ge(1), Le(100_000)]
    accuracy: Annotated[float, Ge(1e-14), Le(1e-2), AllowInfNan(False)] = 1e-7
    solvers: Literal["available"] | Annotated[list[Name], MinLen(1)]
    dual: Annotated[list[Entry], MinLen(1)]
    primal: Annotated[list[Entry], MinLen(1)]
    assembly: Annotated[list[Literal["full"]], MinLen(1)] = ["full"]
    problem: Annotated[list[Entry], MinLen(1)]
    tolerances: Annotated[list[ToleranceTable], MinLen(1)]
    limits: Limits = Limits()

    @model_validator(mode="after")
    def _file_name(self) -> Study:
        if not all(c.isalnum() or c in "-_." for c in self.name) or self.name.startswith("."):
            raise ValueError("name: letters, digits, '-', '_' and '.' only, since results are stored under it")
        return self

    def solver_names(self) -> list[str]:
        """Solvers to run: those named, or all that are installed."""
        return qp.installed_solvers(plugins.qp_solvers()) if self.solvers == "available" else list(self.solvers)


def find_study(request: str) -> Path:
    """File behind what the user called a study: a path, or the name of a registered one."""
    path = Path(request)
    if path.suffix == ".toml" or path.exists():
        if not path.is_file():
            raise RequestError(f"study file '{request}' {'is not a file' if path.exists() else 'does not exist'}")
        return path
    return plugins.study_path(request)


def load_study(request: str, overrides: Mapping[str, Sequence[Any]] | None = None) -> Study:
    """Read and check a study.

    Parameters
    ----------
    request
        Path of a TOML file, or the name of a registered study.
    overrides
        Axes to replace everywhere, keys of `OVERRIDES`; empty sequences replace nothing.

    Raises
    ------
    RequestError
        With file, key, what was found and what is expected.
    """
    path = find_study(request)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"{path}: cannot be read: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise RequestError(f"{path}: not valid TOML: {error}") from None
    given = {key: list(values) for key, values in (overrides or {}).items() if values}
    source = str(path) if path == Path(request) else f"study '{request}'"
    source += " with the options of the command line" if given else ""
    study = _validate(_replace_axes(content, given), source)
    _check_names(study, source)
    return study


OVERRIDES = ("problem", "dual", "primal", "solvers", "pod", "dual_tol", "primal_tol")


def _replace_axes(content: dict[str, Any], given: Mapping[str, list[Any]]) -> dict[str, Any]:
    """The content of a study file with whole axes replaced, as the options of the command line ask."""
    content = dict(content)
    for axis in ("problem", "dual", "primal", "solvers"):
        if axis in given:
            content[axis] = [_entry_in(content.get(axis), name) for name in given[axis]]
    tables = content.get("tolerances")
    if isinstance(tables, list) and all(isinstance(table, dict) for table in tables):
        content["tolerances"] = [_replace_tolerances(dict(table), given) for table in tables]
    return content


def _replace_tolerances(table: dict[str, Any], given: Mapping[str, list[Any]]) -> dict[str, Any]:
    for key, tolerance, size in (("pod", "pod", "N"), ("dual_tol", "dual", "R")):
        if key in given:
            table.pop(size, None)
            table[tolerance] = given[key]
    primal = table.get("primal")
    if "primal_tol" in given and isinstance(primal, dict):
        table["primal"] = dict.fromkeys(primal, given["primal_tol"])
    return table


def _entry_in(axis: Any, name: str) -> Any:
    """The axis entry with this name or label, its options included; the bare name where the file has none."""
    for entry in axis if isinstance(axis, list) else []:
        if isinstance(entry, dict) and name in (entry.get("name"), entry.get("label")):
            return entry
    return name


def _validate(content: dict[str, Any], source: str) -> Study:
    try:
        return Study.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        found = f" (found {first['input']!r})" if isinstance(first["input"], str | int | float) else ""
        if first["type"] == "extra_forbidden":
            known = [key for model in (Study, Entry, ToleranceTable, Limits) for key in model.model_fields]
            raise RequestError(f"{source}: {unknown_name('key', where.rsplit('.', 1)[-1], set(known))}") from None
        raise RequestError(f"{source}: {where + ': ' if where else ''}{message}{found}") from None


def _check_names(study: Study, source: str) -> None:
    """Refuse names no plugin has, options it does not take and tolerances that name no entry of their axis."""
    try:
        for kind, axis in (
            ("problem", study.problem),
            ("dual strategy", study.dual),
            ("primal strategy", study.primal),
        ):
            for entry in axis:
                plugins.check_options(kind, entry.name, entry.options)
        extra = plugins.qp_solvers()
        for solver in study.solver_names():
            qp.check_solver_name(solver, extra)
        for table in study.tolerances:
            for kind, axis, tolerances in (
                ("dual strategy of this study", study.dual, table.dual),
                ("dual strategy of this study", study.dual, table.R),
                ("primal strategy of this study", study.primal, table.primal),
            ):
                known = {name for entry in axis for name in (entry.name, entry.title)}
                for name in tolerances if isinstance(tolerances, dict) else ():
                    if name not in known and not _registered_elsewhere(kind, name):
                        raise unknown_name(kind, name, known)
    except RequestError as error:
        raise RequestError(f"{source}: {error}") from None


def _registered_elsewhere(kind: str, name: str) -> bool:
    """Whether a tolerance names a plugin that exists, though an option of the command line took it off the axis."""
    return name in plugins.names(kind.removesuffix(" of this study"))
