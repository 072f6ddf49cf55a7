"""Columns that plugins add to the tables of the results: computed when a table is read, and stored nowhere.

A results file holds what was measured, and stays readable where a plugin is not installed. Whatever is wrong with a
plugin is a line beside the table, which has all other columns.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from vibench.errors import RequestError, VibenchError, in_a_line
from vibench.interfaces.figures import EXTENSIBLE, DerivedColumn, FigurePlugin
from vibench.plugins.kinds import FIGURE
from vibench.plugins.registry import find, registered
from vibench.results import ranking
from vibench.results.database import stored
from vibench.results.schema import BREAK_EVEN, INTEGER, REAL, STORED, TEXT, Column
from vibench.text import brief

TYPES: Mapping[type, str] = {float: REAL, int: INTEGER, str: TEXT}

AFTER = 100
"""Places of columns of plugins in a table for reading: after all others."""

_SHOWN = {**ranking.HEADINGS, **BREAK_EVEN, **ranking.ERROR_COLUMNS}

RESERVED = {"pair", *_SHOWN, *(name.lower() for table in STORED.values() for name in table)}
"""Names of columns of results files, for which SQLite knows no case, and of those that figures and summaries add."""

HEADINGS = {*_SHOWN, *(column.heading for column in _SHOWN.values() if column.heading)}
"""What stands above the columns of the tables for reading."""

PARAMETERS = re.compile(r"mu_\d+")

Read = Callable[[str], pd.DataFrame]
"""Reads a recorded table, by its name."""


class ColumnError(VibenchError):
    """A column of a plugin that cannot be used, in one line."""


@dataclass(frozen=True)
class Extended:
    """A table with the columns that plugins add to it."""

    frame: pd.DataFrame
    columns: Mapping[str, Column] = field(default_factory=dict)
    """The columns of plugins, by their names."""
    better: Mapping[str, str] = field(default_factory=dict)
    """Whether a smaller or a larger value is better, by the names of those of which one is."""
    faults: tuple[str, ...] = ()
    """A line for every plugin or column that could not be used."""

    def of(self, frame: pd.DataFrame) -> Extended:
        """The same with other rows."""
        return replace(self, frame=frame)

    def with_fault(self, line: str) -> Extended:
        """The same with one more line on what could not be used."""
        return replace(self, faults=(*self.faults, line))


def extended_tables(names: Collection[str], read: Read) -> dict[str, Extended]:
    """Recorded tables with the columns of plugins, in the order of their rows.

    Every table is read once, and every plugin created once, whatever the number of tables.
    """
    tables, owners = Copies(read), dict[str, str]()
    extended = {name: Extended(tables.of(name)) for name in names}
    extensible = [name for name in extended if name in EXTENSIBLE]
    for plugin in registered(FIGURE) if extensible else ():
        try:
            columns = list(_named(plugin, declared(plugin, loaded(plugin)), owners))
        except VibenchError as error:
            extended |= {name: extended[name].with_fault(str(error)) for name in extensible}
            continue
        for column, fault in columns:
            if fault:
                extended |= {name: extended[name].with_fault(fault) for name in extensible}
            elif column.table in extended:
                extended[column.table] = _with_column(extended[column.table], plugin, column, tables)
    return extended


def is_extended(table: str) -> bool:
    """Whether a plugin declares a column of a table, which may depend on any of its rows."""
    for plugin in registered(FIGURE):
        with contextlib.suppress(VibenchError):  # the line about it is beside the table
            if any(column.table == table for column in declared(plugin, loaded(plugin))):
                return True
    return False


def faults_of(extended: Iterable[Extended]) -> list[str]:
    """The lines on what could not be used of some tables, each once."""
    return list(dict.fromkeys(line for one in extended for line in one.faults))


def _with_column(table: Extended, plugin: str, column: DerivedColumn, tables: Copies) -> Extended:
    """A table with one more column, or with a line on why it cannot have it."""
    try:
        values = column_values(plugin, column, tables, table.frame)
    except ColumnError as error:
        return table.with_fault(str(error))
    made = Column(TYPES[column.kind], column.unit, column.meaning, column.heading, AFTER + len(table.columns))
    return replace(
        table,
        frame=table.frame.assign(**{column.name: values}),
        columns={**table.columns, column.name: made},
        better={**table.better, column.name: column.better} if column.better else table.better,
    )


def name_faults(plugin: str, columns: Sequence[DerivedColumn]) -> Iterator[str]:
    """A line for each column of a plugin whose name or heading vibench or an earlier column of it has."""
    return (fault for _, fault in _named(plugin, columns, {}) if fault)


def _named(
    plugin: str, columns: Sequence[DerivedColumn], owners: dict[str, str]
) -> Iterator[tuple[DerivedColumn, str]]:
    """Columns of a plugin, each with why it cannot have its name or heading, "" if it can.

    `owners` are the plugins by the names and headings that their columns have; those that this one gets are added.
    """
    for column in columns:
        fault = _taken(plugin, column, owners)
        if not fault:
            owners |= {name: plugin for name in (column.name.lower(), column.heading) if name}
        yield column, fault


def _taken(plugin: str, column: DerivedColumn, owners: Mapping[str, str]) -> str:
    """Why a column cannot have its name or heading; "" if it can."""
    name, title = column.name.lower(), _title(plugin, column)
    if name in RESERVED or PARAMETERS.fullmatch(name):
        return f"{title} has the name of a column of vibench, and needs another"
    if column.heading in HEADINGS:
        return f"{title} has the heading '{column.heading}' of a column of vibench, and needs another"
    for what, text in (("name", name), ("heading", column.heading)):
        if text in owners:
            return f"{title} has the {what} of a column of {FIGURE} '{owners[text]}', and needs another"
    return ""


def loaded(name: str) -> FigurePlugin:
    """A figure plugin.

    Raises a `RequestError` if it cannot be loaded or created.
    """
    registered_plugin = find(FIGURE, name)
    if missing := registered_plugin.missing:
        raise RequestError(f"{registered_plugin} needs {', '.join(missing)}, which is not installed")
    try:
        plugin: FigurePlugin = registered_plugin.create({})
    except RequestError:
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001  third-party code
        raise RequestError(f"{FIGURE} '{name}' cannot be created: {in_a_line(error)}") from None
    return plugin


def declared(name: str, plugin: FigurePlugin) -> Sequence[DerivedColumn]:
    """The columns that a plugin declares.

    Raises a `ColumnError` if it raises, or returns something else.
    """
    try:
        columns = tuple(plugin.columns())
    except (Exception, SystemExit) as error:  # noqa: BLE001  third-party code
        raise ColumnError(f"{FIGURE} '{name}' has no columns: {in_a_line(error)}") from None
    for column in columns:
        if not isinstance(column, DerivedColumn):
            raise ColumnError(f"{FIGURE} '{name}' declares a {type(column).__name__}, expected a vibench.DerivedColumn")
    return columns


def column_values(plugin: str, column: DerivedColumn, tables: Copies, frame: pd.DataFrame) -> pd.Series:
    """The values of a column for the rows of its table.

    Raises a `ColumnError` if the function raises, returns another number of values, or values of another type.
    """
    title = _title(plugin, column)
    try:
        given = column.values(tables)
        values = list(given)
    except (Exception, SystemExit) as error:  # noqa: BLE001  third-party code
        raise ColumnError(f"{title} cannot be computed: {in_a_line(error)}") from None
    if isinstance(given, str | bytes | Mapping | pd.DataFrame):
        raise ColumnError(f"{title} is a {type(given).__name__}, expected a value for each row")
    if len(values) != len(frame):
        raise ColumnError(f"{title} has {len(values)} values for the {len(frame)} rows of '{column.table}'")
    if isinstance(given, pd.Series) and not given.index.equals(frame.index):
        raise ColumnError(f"{title} is a Series with another index than the table '{column.table}' has")
    kept = [_stored(title, column, k, value) for k, value in enumerate(values)]
    kind = {float: "float64", int: "Int64" if None in kept else "int64", str: "object"}[column.kind]
    return pd.Series(kept, index=frame.index, dtype=kind)


def _stored(title: str, column: DerivedColumn, row: int, value: Any) -> Any:
    """A value as a results file would hold it."""
    if value is pd.NA or value is pd.NaT:
        return None
    if isinstance(value, bool | np.bool_):
        raise ColumnError(f"{title} has the value {value} in row {row}, expected {column.kind.__name__}")
    try:
        return stored(Column(TYPES[column.kind], "", ""), value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ColumnError(f"{title} has {brief(repr(value), 40)} in row {row}: {error}") from None


def _title(plugin: str, column: DerivedColumn) -> str:
    return f"column '{column.name}' of {FIGURE} '{plugin}'"


def _copied(table: str) -> property:
    return property(lambda copies: copies.of(table))


class Copies:
    """The recorded tables of a run (`vibench.RunTables`), read when asked for; each access gives a copy."""

    def __init__(self, read: Read) -> None:
        self._read, self._known = read, dict[str, pd.DataFrame]()

    def of(self, table: str) -> pd.DataFrame:
        """A copy of a table, by its name."""
        if table not in self._known:
            self._known[table] = self._read(table)
        return self._known[table].copy()

    cells = _copied("cells")
    queries = _copied("queries")
    histories = _copied("histories")
    timings = _copied("timings")
    thresholds = _copied("thresholds")
    outputs = _copied("outputs")
