"""Every QP solver tried on one small program, in a process that may hang or die of it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vibench.errors import in_a_line
from vibench.interfaces.problem import VariationalInequality
from vibench.qp import verification
from vibench.qp.solve import solve_qp
from vibench.qp.status import Status
from vibench.study import registry
from vibench.timing import ONE_THREAD

ACCURACY = 1e-7
"""What the solvers are asked for: what a study asks for by default."""

UNKNOWNS = 12

SECONDS = 60.0
"""What a process may take, its start included."""


@dataclass(frozen=True)
class Trial:
    """What became of a solver: status, the largest residual reached (`None` without a solution), and a reason."""

    status: Status
    residual: float | None
    reason: str


def program() -> VariationalInequality:
    """A wire of `UNKNOWNS` nodes pressed on a flat support, which carries its middle; dense, like reduced programs."""
    step = 1.0 / (UNKNOWNS + 1)
    A = (2.0 * np.eye(UNKNOWNS) - np.eye(UNKNOWNS, k=1) - np.eye(UNKNOWNS, k=-1)) / step
    return VariationalInequality(
        A, np.full(UNKNOWNS, -4.0 * step), -step * np.eye(UNKNOWNS), np.full(UNKNOWNS, 0.2 * step)
    )


def attempt(solver: str) -> Trial:
    """Solve the program in this process and judge the answer; what a solver raises is its reason."""
    try:
        answer = solve_qp(program(), solver, ACCURACY, registry.qp_solver(solver))
        status, reason, residuals = verification.verify(program(), answer, ACCURACY)
    except (Exception, SystemExit) as error:  # noqa: BLE001  solvers and plugins may raise anything
        return Trial(Status.ERROR, None, in_a_line(error))
    return Trial(status, None if residuals is None else residuals.worst, reason)


def attempts(solvers: Sequence[str], seconds: float = SECONDS) -> dict[str, Trial]:
    """Try solvers in a process of their own, another one after each that ends it.

    Parameters
    ----------
    solvers
        Names, installed.
    seconds
        What a process may take for all that are left.
    """
    found: dict[str, Trial] = {}
    left = list(solvers)
    while left:
        done, death = _process(left, seconds)
        found |= zip(left, done, strict=False)
        left = left[len(done) :]
        if left:
            found[left.pop(0)] = death
    return found


def _process(solvers: Sequence[str], seconds: float) -> tuple[list[Trial], Trial]:
    """What one process found out about the first of the solvers, and what the next one is to blame for."""
    path = os.pathsep.join(folder for folder in sys.path if folder)
    command = [sys.executable, "-P", "-m", "vibench.cli.solver_check", *solvers]
    with subprocess.Popen(
        command,
        env={**os.environ, **ONE_THREAD, "PYTHONPATH": path},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        try:
            printed, _ = process.communicate(timeout=seconds)
            death = Trial(Status.CRASHED, None, f"the process died with exit code {process.returncode}")
        except subprocess.TimeoutExpired:
            process.kill()
            printed, _ = process.communicate()
            death = Trial(Status.TIMEOUT, None, f"no answer after {seconds:g} s")
    return list(_trials(printed)), death


def _trials(printed: str) -> Iterator[Trial]:
    """Trials from whole lines; a process that died may leave a broken one."""
    for line in printed.splitlines(keepends=True):
        if line.endswith("\n"):
            status, residual, reason = json.loads(line)
            yield Trial(Status(status), residual, reason)


def main() -> None:
    """Try the solvers named as arguments; one line each on the standard output, where nobody else writes."""
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as output:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        for solver in sys.argv[1:]:
            trial = attempt(solver)
            output.write(json.dumps([trial.status, trial.residual, trial.reason]) + "\n")
            output.flush()


if __name__ == "__main__":
    main()
