"""The kinds of plugins and their names; completion and help read this, so that it imports nothing heavy."""

from __future__ import annotations

from enum import StrEnum
from functools import cached_property
from pkgutil import resolve_name


class PluginKind(StrEnum):
    """A kind of plugin; its text, such as "dual strategy", is its name in messages and records."""

    # `plural` names the list of `vibench list`, `cli_name` is the prefix in `vibench check NAME:…`, "" where its
    # plugins are not checked, `module` is the module that `vibench new` writes.

    plural: str
    entry_points: str
    cli_name: str
    module: str
    _base: str

    def __new__(
        cls, title: str, plural: str = "", group: str = "", cli_name: str = "", module: str = "", base: str = ""
    ) -> PluginKind:
        kind = str.__new__(cls, title)
        kind._value_, kind.plural, kind.entry_points = title, plural, f"vibench.{group}"
        kind.cli_name, kind.module, kind._base = cli_name, module, base
        return kind

    PROBLEM = "problem", "problems", "problems", "problem", "problem", "problem:Problem"
    SAMPLING = "sampling strategy", "sampling", "sampling", "sampling", "sampling", "strategies:Sampling"
    PRIMAL = "primal strategy", "primal", "primal_strategies", "primal", "strategy", "strategies:PrimalStrategy"
    DUAL = "dual strategy", "dual", "dual_strategies", "dual", "strategy", "strategies:DualStrategy"
    FORMULATION = (
        "formulation", "formulations", "formulations", "formulation", "formulation", "formulations:Formulation",
    )  # fmt: skip
    STUDY = "study", "studies", "studies"
    SOLVER = "QP solver", "solvers", "qp_solvers", "solver", "solver"

    @cached_property
    def base(self) -> type | None:
        """Abstract base class of its plugins; `None` where they are not classes."""
        return resolve_name(f"vibench.interfaces.{self._base}") if self._base else None


# Kinds that `vibench check` and `vibench new` know, by their names on the command line.
CHECKED = {kind.cli_name: kind for kind in PluginKind if kind.cli_name}
