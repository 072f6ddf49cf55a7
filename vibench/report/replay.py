"""Quadratic programs of a run as files: one query solved again by every solver, or all programs as a test set."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.execution.isolated import Trial, solver_trials
from vibench.execution.recorded_cell import RecordedCell, recorded_cells
from vibench.files import scratch, write_atomically, writing
from vibench.interfaces.problem import VariationalInequality
from vibench.plugins.kinds import PluginKind
from vibench.plugins.registry import registered
from vibench.qp.solve import installed_solvers, load_qpsolvers
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, verify
from vibench.results.consistency import vectors
from vibench.results.formats import to_csv


def worst_query(recorded: RecordedCell) -> int:
    """The query of a cell with the most severe status, the first of several."""
    rows = recorded.rows("queries")
    return max(sorted(rows), key=lambda query: Status(rows[query]["status"]).severity)


def replay(recorded: RecordedCell, query: int, file: Path) -> pd.DataFrame:
    """Write the program of one query to a file, and solve it with every installed solver, each within limits.

    The table has a row for the recorded solution, if there is one, and a row per solver: the status that the solver
    claims, the verified status with residuals, seconds, and the distance of u in V from the recorded solution.

    Raises a `RequestError` if the cell has no such query, or the file is no npz file or cannot be written.
    """
    if file.suffix != ".npz":
        raise RequestError(f"'{file}': the program is written as an npz file, whose name must end in .npz")
    rows = recorded.rows("queries")
    if query not in rows:
        raise RequestError(f"cell {recorded.row['cell']} has no query {query}; it has 0 to {len(rows) - 1}")
    program, accuracy = recorded.program(query), recorded.cell.accuracy
    # A cell with a quadratic program has an accuracy.
    assert accuracy is not None
    with writing(file):
        write_program(program, file)
    recorded_x: Array | None = None
    table: list[dict[str, Any]] = []
    # The recorded solution is verified again, not its recorded residuals repeated.
    if solved := recorded.rows("solutions").get(query):
        recorded_x, alpha = vectors(solved)
        solution = QPSolution(recorded_x, alpha, rows[query]["solver_status"] or "", rows[query]["iterations"])
        status, reason, residuals = verify(program, solution, accuracy)
        line = _line(Trial(status, reason, solution, residuals), None) | {"seconds": rows[query]["solve_s"]}
        by = recorded.cell.solver or recorded.cell.formulation_label
        table.append({"solver": f"{by} (recorded)"} | line)
    solvers = installed_solvers(registered(PluginKind.SOLVER))
    for solver, trial in solver_trials(program, accuracy, solvers, 60.0).items():
        table.append({"solver": solver} | _line(trial, recorded_x))
    return pd.DataFrame(table)


def _line(trial: Trial, recorded_x: Array | None) -> dict[str, Any]:
    solution = trial.solution
    if solution is None:
        return {"claims": trial.reason, "status": trial.status.value}
    line: dict[str, Any] = {"claims": solution.solver_status, "status": trial.status.value}
    line |= {"iterations": solution.iterations, "seconds": trial.seconds.cpu}
    if trial.residuals is not None:
        line |= {name: getattr(trial.residuals, name) for name in ("primal", "dual", "gap")}
    if recorded_x is not None and solution.x is not None:
        line["distance"] = float(np.linalg.norm(solution.x - recorded_x))
    return line


def write_program(program: VariationalInequality, file: Path) -> None:
    """Write min ½xᵀPx + qᵀx, Gx ≤ h in the format of qpsolvers: an npz file with P, q, G, h.

    Raises an `OSError` if it cannot be written; nothing is left behind.
    """
    # In memory: on a full disk zipfile leaves half a file, and a traceback when that is closed.
    content = io.BytesIO()
    load_qpsolvers()[0].Problem(program.A, -program.f, program.B, program.g).save(content)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, content.getvalue())


def export(run: str, folder: Path, places: Mapping[str, str] = {}, *, sequence: bool = False) -> int:
    """Write every reduced program of a run, with its solutions and their verification; returns their number.

    The folder holds `programs/NAME.npz` (P, q, G, h), `solutions/NAME.npz` (x_CELL, z_CELL for every cell with a
    solution: a solver at an accuracy), `rows.csv` (a line per solution: status, accuracy, residuals) and `check.py`,
    which recomputes the residuals of every solution. It gets its name when it is complete.

    With `sequence` it has the programs along the ordered validation sets alone, one sequence per reduced model, and
    `sequences.csv` (a line per program: sequence, position, parameter) with `sequences.py`, a test set of qpbenchmark.

    Raises a `RequestError` if there is no such run, the folder is not empty or cannot be written, other code computed
    the run, or no validation set is ordered where sequences are asked for.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise RequestError(f"'{folder}' exists and is not an empty folder; choose another")
    models: dict[str, list[RecordedCell]] = {}
    for recorded in recorded_cells(run, places):
        if not sequence or recorded.cell.validation.is_ordered:
            models.setdefault(recorded.row["model"], []).append(recorded)
    if not models:
        which = " along an ordered validation set, such as that of random-walk" if sequence else ""
        raise RequestError(f"no cell of '{run}' has a reduced program{which}")
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with scratch(folder.parent) as part:
            # An interruption leaves nothing under the name of the folder.
            new = part / folder.name
            new.mkdir()
            programs = [rows for cells in models.values() for rows in _exported(cells, new)]
            (new / "rows.csv").write_text(to_csv(pd.DataFrame(chain.from_iterable(programs))), encoding="utf-8")
            (new / "check.py").write_bytes((files("vibench.report") / "qps_checker.py").read_bytes())
            if sequence:
                _write_sequences([cells[0] for cells in models.values()], new)
            new.replace(folder)
    return len(programs)


def _write_sequences(models: Sequence[RecordedCell], folder: Path) -> None:
    """Write the order of the programs of some reduced models, each given by its first cell."""
    rows = [
        {"sequence": model.row["cell"], "position": query, "program": _name(model, query)}
        | dict(zip(model.model.problem.parameters.names, map(float, mu), strict=True))
        for model in models
        for query, mu in enumerate(model.parameters)
    ]
    (folder / "sequences.csv").write_text(to_csv(pd.DataFrame(rows)), encoding="utf-8")
    template = files("vibench.report") / "templates" / "sequences.py.template"
    (folder / "sequences.py").write_bytes(template.read_bytes())


def _name(model: RecordedCell, query: int) -> str:
    return f"{model.row['cell']}-{query}"


def _exported(cells: list[RecordedCell], folder: Path) -> Iterator[list[dict[str, Any]]]:
    """Write the programs of one reduced model; yields the rows of every program, one per solution."""
    tables = [(recorded, recorded.rows("queries"), recorded.rows("solutions")) for recorded in cells]
    for query in sorted(set().union(*(queries for _, queries, _ in tables))):
        name = _name(cells[0], query)
        write_program(cells[0].program(query), folder / "programs" / f"{name}.npz")
        repeated = ("status", "primal_residual", "dual_residual", "gap", "solver_status")
        rows: list[dict[str, Any]] = []
        arrays: dict[str, Any] = {}
        for recorded, queries, solutions in tables:
            if query in solutions:
                cell, row = recorded.row["cell"], queries[query]
                arrays[f"x_{cell}"], arrays[f"z_{cell}"] = vectors(solutions[query])
                about = {"program": name, "solver": recorded.cell.solver, "cell": cell}
                rows.append(about | {"accuracy": recorded.cell.accuracy} | {key: row[key] for key in repeated})
        content = io.BytesIO()
        np.savez(content, **arrays)
        (folder / "solutions").mkdir(exist_ok=True)
        (folder / "solutions" / f"{name}.npz").write_bytes(content.getvalue())
        yield rows
