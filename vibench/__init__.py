"""vibench: a benchmark framework for reduced-order models of parametrised variational inequalities."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vibench.assembly import Model


def load(run: str, cell: str) -> Model:
    """The reduced model of a row of a run, ready for queries.

    Parameters
    ----------
    run
        Run folder, or name of a study run before.
    cell
        Key of the cell, or its beginning.

    Raises
    ------
    RequestError
        If there is no such run or cell, or other code computed it.
    """
    from vibench.loading import recorded_cell  # noqa: PLC0415  `import vibench` alone stays cheap

    return recorded_cell(run, cell).model
