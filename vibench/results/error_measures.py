"""Measures of the error by which models are compared: of u and λ, or of a quantity of interest."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from vibench.errors import RequestError, unknown_name
from vibench.results.columns import REAL, Column

SOLUTION = "solution"
"""The larger of the mean relative errors of u and λ; the other one where one is missing."""

OF_SOLUTION: Mapping[str, tuple[str, ...]] = {
    SOLUTION: ("error_u_mean", "error_lambda_mean"), "u": ("error_u_mean",), "lambda": ("error_lambda_mean",),
}  # fmt: skip
"""Columns of the cells table whose maximum is the measure."""

OUTPUT = "output:"
"""Before the name of a quantity of interest."""

COLUMNS: Mapping[str, Column] = {
    "error_a": Column(REAL, "1", "Error of model a by the chosen measure; 0 of the high-fidelity one.", "error a", 22),
    "error_b": Column(REAL, "1", "Error of model b by the chosen measure.", "error b", 23),
}
"""What a measure adds to a table of break-even points."""


def measures(outputs: pd.DataFrame) -> list[str]:
    """The measures that a run has, from its table of outputs."""
    return [*OF_SOLUTION, *(f"{OUTPUT}{name}" for name in outputs["output"].unique())]


def errors_of(cells: pd.DataFrame, outputs: pd.DataFrame, measure: str = SOLUTION) -> pd.Series:
    """Mean relative errors, one for each row of the cells table; missing where none is known.

    A quantity of interest is measured by its mean relative error over the ok queries where it is not zero.

    Raises
    ------
    RequestError
        If there is no such measure.
    """
    known = measures(outputs)
    if measure not in known:
        raise unknown_name("error measure", measure, known)
    if measure in OF_SOLUTION:
        return errors_of_solution(cells, measure)
    of_output = outputs[outputs["output"] == measure.removeprefix(OUTPUT)]
    return cells["cell"].map(of_output.set_index("cell")["error_mean"]).astype(float)


def errors_of_solution(cells: pd.DataFrame, measure: str = SOLUTION) -> pd.Series:
    """Mean relative errors of u, of λ, or the larger one of these; the other one where one is missing."""
    return cells[list(OF_SOLUTION[measure])].astype(float).max(axis=1, skipna=True)


def with_errors(thresholds: pd.DataFrame, cells: pd.DataFrame, errors: pd.Series) -> pd.DataFrame:
    """Break-even points with the errors of both models; `errors` are those of the cells, in their rows."""
    known = pd.Series(errors.to_numpy(float), index=cells["cell"])
    model = thresholds["cell_a"].isna()
    return thresholds.assign(
        error_a=thresholds["cell_a"].map(known).astype(float).mask(model, 0.0),
        error_b=thresholds["cell_b"].map(known).astype(float),
    )


def within(thresholds: pd.DataFrame, largest: float) -> pd.DataFrame:
    """The break-even points of models that both have errors of at most `largest`.

    Raises
    ------
    RequestError
        If it is no positive number.
    """
    if not largest > 0.0:
        raise RequestError(f"the largest error is {largest:g}, expected a positive number")
    return thresholds[(thresholds["error_a"] <= largest) & (thresholds["error_b"] <= largest)]
