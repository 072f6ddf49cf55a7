"""Plugins that change the process they run in, or remember answers; their package must be the only one to suffer."""

import os
import resource
import time
import warnings
from typing import Any

import numpy as np
import qpsolvers
from fake_plugins import Wire, careful

from vibench import Array, QPSolution, VariationalInequality

solve_problem = qpsolvers.solve_problem
known: list[tuple[list[Array], QPSolution]] = []


def refuse(*arguments: Any, **options: Any) -> Any:
    raise RuntimeError("meddled with")


def meddle() -> None:
    np.seterr(all="raise")
    warnings.simplefilter("error")
    os.chdir("/")
    os.umask(0o777)
    for clock in ("thread_time", "process_time", "perf_counter", "time"):
        setattr(time, clock, lambda: 0.0)
    qpsolvers.solve_problem = refuse


class Meddles(Wire):
    """Its process can write no file any more."""

    def assemble(self, mu: Array) -> VariationalInequality:
        meddle()
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        return super().assemble(mu)


def meddling(program: VariationalInequality, accuracy: float) -> QPSolution:
    qpsolvers.solve_problem = solve_problem
    answer = careful(program, accuracy)
    meddle()
    return answer


def forgetful(program: VariationalInequality, accuracy: float) -> QPSolution:
    """Returns an earlier answer where three digits of the program are the same.

    They are compared, not rounded: rounded, entries next to a boundary would tell two programs apart at some seeds, and
    which seed a query is timed with depends on the seconds of the machine.
    """
    members = [np.asarray(one) for one in (program.A, program.f, program.B, program.g)]
    qpsolvers.solve_problem = solve_problem
    answer = careful(program, accuracy)
    for others, earlier in known:
        if all(map(alike, members, others)):
            return earlier
    known.append((members, answer))
    return answer


def alike(one: Array, other: Array) -> bool:
    """Whether two members of programs agree to a thousandth of their largest entry."""
    return one.shape == other.shape and bool(np.all(abs(one - other) <= 1e-3 * np.max(abs(other), initial=0.0)))


MEMBERS = {
    "vibench.problems": {"wire-meddles": "Meddles"},
    "vibench.qp_solvers": {"meddling": "meddling", "roughly": "forgetful"},
}

TAKEN = {
    "vibench.dual_strategies": {"cpg": "Meddles"},
    "vibench.qp_solvers": {"careful": "meddling", "osqp": "meddling"},
}
"""What it registers under names of vibench, of another package, and of qpsolvers."""
