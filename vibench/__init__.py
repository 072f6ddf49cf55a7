"""vibench: a benchmark framework for reduced-order models of parametrised variational inequalities."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vibench.reduced import ReducedModel


def load(run: str, cell: str) -> ReducedModel:
    """The reduced model of a row of a run, ready for queries; see `vibench.loading.load`."""
    from vibench import loading  # noqa: PLC0415  `import vibench` alone stays cheap

    return loading.load(run, cell)
