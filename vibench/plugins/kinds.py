"""The kinds of plugins, and what each is called: completion and help read this, so it imports nothing heavy."""

from __future__ import annotations

from enum import StrEnum
from functools import cached_property
from pkgutil import resolve_name


class PluginKind(StrEnum):
    """A kind of plugin; as a text it is what messages and records call it: "dual strategy"."""

    plural: str
    """The list of `vibench list` that shows it."""
    entry_points: str
    """Its group of entry points."""
    cli_name: str
    """What stands for it on the command line, in `vibench check NAME:…`; "" where no plugin of it is checked."""
    module: str
    """The module that `vibench new` writes it to."""
    _base: str

    def __new__(
        cls, title: str, plural: str = "", group: str = "", cli_name: str = "", module: str = "", base: str = ""
    ) -> PluginKind:
        kind = str.__new__(cls, title)
        kind._value_, kind.plural, kind.entry_points = title, plural, f"vibench.{group}"
        kind.cli_name, kind.module, kind._base = cli_name, module, base
        return kind

    PROBLEM = "problem", "problems", "problems", "problem", "problem", "vibench.interfaces.problem:Problem"
    SAMPLING = (
        "sampling strategy", "sampling", "sampling", "sampling", "sampling", "vibench.interfaces.strategies:Sampling",
    )  # fmt: skip
    PRIMAL = (
        "primal strategy", "primal", "primal_strategies", "primal", "strategy",
        "vibench.interfaces.strategies:PrimalStrategy",
    )  # fmt: skip
    DUAL = (
        "dual strategy", "dual", "dual_strategies", "dual", "strategy", "vibench.interfaces.strategies:DualStrategy",
    )  # fmt: skip
    FORMULATION = (
        "formulation", "formulations", "formulations", "formulation", "formulation",
        "vibench.interfaces.formulations:Formulation",
    )  # fmt: skip
    STUDY = "study", "studies", "studies"
    SOLVER = "QP solver", "solvers", "qp_solvers", "solver", "solver"

    @cached_property
    def base(self) -> type | None:
        """The abstract base class of its plugins; `None` where they are no classes."""
        return resolve_name(self._base) if self._base else None


PROBLEM, SAMPLING, PRIMAL, DUAL, FORMULATION, STUDY, SOLVER = PluginKind

CHECKED = {kind.cli_name: kind for kind in PluginKind if kind.cli_name}
"""The kinds whose plugins `vibench check` examines and `vibench new` writes, by their names on the command line."""
