"""The kinds of plugins, and what each is called: completion and help read this, so it imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """A kind of plugin.

    Attributes
    ----------
    title
        What messages, records and the registry call it.
    listed
        The list of `vibench list` that shows it.
    group
        Its group of entry points, without `vibench.`.
    word
        What stands for it on the command line, in `vibench check WORD:NAME`; "" where no plugin of it is checked.
    module
        The module that `vibench new` writes it to.
    base
        The abstract base class of its plugins, "module:class"; "" where they are no classes.
    """

    title: str
    listed: str
    group: str
    word: str = ""
    module: str = ""
    base: str = ""

    @property
    def entry_points(self) -> str:
        """Its group of entry points."""
        return f"vibench.{self.group}"


SOLVER = Kind("QP solver", "solvers", "qp_solvers", "solver", "solver")
STUDY = Kind("study", "studies", "studies")
FIGURE = Kind("figure plugin", "figures", "figures", "figure", "figures", "vibench.interfaces.figures:FigurePlugin")

KINDS = (
    Kind("problem", "problems", "problems", "problem", "problem", "vibench.interfaces.problem:Problem"),
    Kind("sampling strategy", "sampling", "sampling", "sampling", "sampling", "vibench.interfaces.sampling:Sampling"),
    Kind(
        "primal strategy", "primal", "primal_strategies", "primal", "strategy",
        "vibench.interfaces.strategies:PrimalStrategy",
    ),
    Kind(
        "dual strategy", "dual", "dual_strategies", "dual", "strategy", "vibench.interfaces.strategies:DualStrategy",
    ),
    FIGURE,
    STUDY,
    SOLVER,
)  # fmt: skip
"""All of them, in the order of `vibench list`."""

CHECKED = tuple(kind for kind in KINDS if kind.word)
"""Those whose plugins `vibench check` examines and `vibench new` writes."""
