"""Quadratic programs of a run as files: one row solved again by every solver, or all of them as a test set."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import qpsolvers

from vibench.arrays import Array
from vibench.errors import RequestError, in_a_line
from vibench.execution.recorded_cell import RecordedCell, recorded_cells
from vibench.interfaces.problem import VariationalInequality
from vibench.qp import verification
from vibench.qp.solution import QPSolution
from vibench.qp.solve import installed_solvers, solve_qp
from vibench.qp.status import Status
from vibench.results.solver_agreement import vectors
from vibench.study import registry
from vibench.timing import median_seconds

CHECKER = "check.py"
"""The script that goes with an exported test set; it needs NumPy and nothing else."""


def worst_query(recorded: RecordedCell) -> int:
    """The query of a cell with the most severe status, the first of several."""
    rows = recorded.rows("queries")
    return max(sorted(rows), key=lambda query: Status(rows[query]["status"]).severity)


def replay(recorded: RecordedCell, query: int, file: Path) -> pd.DataFrame:
    """Write the program of one query to a file, and solve it with every solver installed here.

    Returns
    -------
    DataFrame
        One line per solver, and a first one for the recorded answer if there is one: what the solver claims, what our
        residuals say, seconds, and the distance of u in V from the recorded answer.

    Raises
    ------
    RequestError
        If the cell has no such query, or the file is no npz file.
    """
    if file.suffix != ".npz":
        raise RequestError(f"'{file}': the program goes into an npz file, its name must end in .npz")
    rows = recorded.rows("queries")
    if query not in rows:
        raise RequestError(f"cell {recorded.row['cell']} has no query {query}; it has 0 to {len(rows) - 1}")
    program, accuracy = recorded.program(query), recorded.cell.accuracy
    write_program(program, file)
    solutions = recorded.rows("solutions")
    known: Array | None = None
    table: list[dict[str, Any]] = []
    if query in solutions:
        known, alpha = vectors(solutions[query])
        answer = QPSolution(known, alpha, rows[query]["solver_status"] or "", rows[query]["iterations"])
        name = f"{recorded.cell.solver} (recorded)"
        table.append({"solver": name, **_line(program, answer, accuracy, None), "seconds": rows[query]["solve_s"]})
    solvers = installed_solvers(registry.names("QP solver"))
    table += [{"solver": solver, **_solved(program, solver, accuracy, known)} for solver in solvers]
    return pd.DataFrame(table)


def _solved(program: VariationalInequality, solver: str, accuracy: float, known: Array | None) -> dict[str, Any]:
    try:
        answer, seconds = median_seconds(lambda: solve_qp(program, solver, accuracy, registry.qp_solver(solver)))
    except (Exception, SystemExit) as error:  # noqa: BLE001  a solver may raise anything; the line says what
        claim = in_a_line(error)
        return {"claims": claim, "status": Status.ERROR.value}
    return _line(program, answer, accuracy, known) | {"seconds": seconds.cpu}


def _line(program: VariationalInequality, answer: QPSolution, accuracy: float, known: Array | None) -> dict[str, Any]:
    status, _, residuals = verification.verify(program, answer, accuracy)
    line: dict[str, Any] = {"claims": answer.solver_status, "status": status.value, "iterations": answer.iterations}
    if residuals is not None:
        line |= {"primal": residuals.primal, "dual": residuals.dual, "gap": residuals.gap}
    if known is not None and answer.x is not None:
        line["distance"] = float(np.linalg.norm(answer.x - known))
    return line


def write_program(program: VariationalInequality, file: Path) -> None:
    """Write min ½xᵀPx + qᵀx, Gx ≤ h as qpsolvers does: an npz file with P, q, G, h."""
    file.parent.mkdir(parents=True, exist_ok=True)
    qpsolvers.Problem(program.A, -program.f, program.B, program.g).save(str(file))


def export(run: str, folder: Path) -> int:
    """Write every reduced program of a run, every solution, and what vibench said of it; returns their number.

    The folder holds `programs/NAME.npz` (P, q, G, h), `solutions/NAME.npz` (x_SOLVER, z_SOLVER for every cell that
    solved it), `rows.csv` (one line per solution: status, accuracy, residuals) and `check.py`, which recomputes the
    residuals of every solution.

    Raises
    ------
    RequestError
        If there is no such run, the folder is not empty, or other code computed the run.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise RequestError(f"'{folder}' is there already and not an empty folder; choose another")
    models: dict[str, list[RecordedCell]] = {}
    for recorded in recorded_cells(run):
        models.setdefault(recorded.row["model"], []).append(recorded)
    lines: list[dict[str, Any]] = []
    count = 0
    for cells in models.values():
        for name, program, solved in _programs(cells):
            write_program(program, folder / "programs" / f"{name}.npz")
            arrays = {f"{letter}_{row['solver']}": row[letter] for row in solved for letter in ("x", "z")}
            (folder / "solutions").mkdir(exist_ok=True)
            np.savez(folder / "solutions" / f"{name}.npz", **arrays)
            lines += [{"program": name, **{k: v for k, v in row.items() if k not in ("x", "z")}} for row in solved]
            count += 1
    if not count:
        raise RequestError(f"no cell of '{run}' has a reduced program")
    pd.DataFrame(lines).to_csv(folder / "rows.csv", index=False)
    with (files("vibench.report") / "qps_checker.py").open("rb") as source, (folder / CHECKER).open("wb") as target:
        shutil.copyfileobj(source, target)
    return count


def _programs(
    cells: list[RecordedCell],
) -> Iterator[tuple[str, VariationalInequality, list[dict[str, Any]]]]:
    """Programs of one reduced model: a name, the program, and what its cells made of it."""
    queries = [recorded.rows("queries") for recorded in cells]
    solutions = [recorded.rows("solutions") for recorded in cells]
    for query in sorted(set().union(*queries)):
        solved = []
        for recorded, of_queries, of_solutions in zip(cells, queries, solutions, strict=True):
            if query in of_solutions:
                x, alpha = vectors(of_solutions[query])
                kept = ("status", "primal_residual", "dual_residual", "gap", "solver_status")
                solved.append(
                    {"solver": recorded.cell.solver, "cell": recorded.row["cell"], "accuracy": recorded.cell.accuracy}
                    | {name: of_queries[query][name] for name in kept}
                    | {"x": x, "z": alpha}
                )
        yield f"{cells[0].row['cell']}-{query}", cells[0].program(query), solved
