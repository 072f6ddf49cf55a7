"""The conformance checks of QP solvers: programs with known solutions, signs, accuracy, and independence of calls."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from functools import partial
from types import FrameType
from typing import NamedTuple

import numpy as np

from vibench.arrays import Array
from vibench.interfaces.problem import VariationalInequality
from vibench.offline.models import ACCURACY
from vibench.qp.scaling import units_of
from vibench.qp.solve import solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, QPSolver, kkt_residuals, verify
from vibench.testing.case import copies, differences
from vibench.testing.checks import SECONDS, Check, ConformanceError, Doubt, Note, raised
from vibench.timing import timed


class KnownProgram(NamedTuple):
    """A dense program with its solution x (n,) and multipliers α (m,); `None` where these are not unique."""

    program: VariationalInequality
    x: Array
    alpha: Array | None


def known_program(x: Array, alpha: Array, slack: Array, B: Array, *, unique: bool = True) -> KnownProgram:
    """The program with this solution (n,), multipliers (m,), slacks g − B x (m,) and constraints (m×n)."""
    root = np.random.default_rng(0).standard_normal((len(x), len(x)))
    A = root.T @ root / len(x) + np.eye(len(x))
    return KnownProgram(VariationalInequality(A, A @ x + B.T @ alpha, B, B @ x + slack), x, alpha if unique else None)


def known_programs() -> dict[str, KnownProgram]:
    """Programs with known solutions, by what is special about them."""
    rng = np.random.default_rng(1)
    n, m = 6, 9
    x, B, size = rng.standard_normal(n), rng.standard_normal((m, n)), 0.5 + rng.random(m)
    active, none = np.arange(m) < 3, np.zeros(m)
    some, away = np.where(active, size, 0.0), np.where(active, 0.0, size)
    few, most = (np.arange(60) < 4).astype(float), (np.arange(60) >= 4).astype(float)
    units = 10.0 ** np.linspace(-5, 5, m)
    one = VariationalInequality(np.eye(1), np.ones(1), np.ones((1, 1)), np.array([0.5]))
    rigid = known_program(np.zeros(n), none, size, B)
    driven = known_program(x, some, away, B)
    # Without load: moving the constraints by A⁻¹f leaves the multipliers as they are.
    offset = np.linalg.solve(driven.program.A, driven.program.f)
    return {
        "some constraints are active": driven,
        "none is active": known_program(x, none, size, B),
        "all are active": known_program(x, size[:4], np.zeros(4), B[:4]),
        "bounds x ≥ 0": known_program(np.maximum(x, 0.0), np.where(x > 0.0, 0.0, 1.0), np.zeros(n), -np.eye(n)),
        "an active constraint has no multiplier": known_program(x, np.where(np.arange(m) < 2, some, 0.0), away, B),
        "active constraints are repeated": known_program(
            x, np.tile(some, 2), np.tile(away, 2), np.tile(B, (2, 1)), unique=False
        ),
        "rows of very different size": known_program(x, some / units, away * units, B * units[:, None]),
        "there is no load": KnownProgram(
            replace(driven.program, f=np.zeros(n), g=driven.program.g - driven.program.B @ offset), x - offset, some
        ),
        "there is neither load nor contact": KnownProgram(replace(rigid.program, f=np.zeros(n)), np.zeros(n), none),
        "one unknown": KnownProgram(one, np.array([0.5]), np.array([0.5])),
        "many constraints": known_program(x, few, most, rng.standard_normal((60, n))),
    }  # fmt: skip


class SolverCase:
    """A QP solver, which is the function that is registered under `vibench.qp_solvers`, and the programs it solves."""

    def __init__(self, create: QPSolver, *, seconds: float = SECONDS) -> None:
        self.create, self.seconds, self.programs = create, seconds, known_programs()
        # The program with some active constraints, scaled as it is when a solver gets it.
        self.typical = _scaled(self.programs["some constraints are active"].program)

    def solve(self, program: VariationalInequality, accuracy: float = ACCURACY) -> QPSolution:
        """The answer as a run gets it: the data scaled, the answer scaled back."""
        return solve_qp(program, "it", accuracy, {"it": self.create})

    def answer(self) -> Iterator[str]:
        """A `QPSolution` with vectors of the right shapes and a text as its status."""
        if not callable(self.create):
            raise ConformanceError(f"a {type(self.create).__name__} is no function of a program and an accuracy")
        answer = self.solve(self.typical)
        if answer.x is None or answer.alpha is None:
            yield f"a program with a solution gets none: {answer.solver_status}"
        yield Note(answer.solver_status)

    def signs(self) -> Iterator[str]:
        """Multipliers α ≥ 0 are those of A x + Bᵀα = f."""
        program, answer = self.typical, self.create(self.typical, ACCURACY)
        assert answer.x is not None and answer.alpha is not None  # noqa: PT018  the check "answer" passed
        rest, forces = program.A @ answer.x - program.f, program.B.T @ answer.alpha
        off = [float(np.max(np.abs(rest + sign * forces))) for sign in (1, -1)]
        if off[0] > 1e-3 > off[1]:
            yield f"multipliers have the other sign: ‖A x + Bᵀα − f‖ is {off[0]:.1g}, with −α {off[1]:.1g}"
        # The conditions of the programs are below 1e3: 1e-3 is what residuals below the accuracy allow.
        elif np.min(answer.alpha) < -1e-3 * np.max(np.abs(answer.alpha)):
            yield f"a multiplier is negative: entry {np.argmin(answer.alpha)} is {np.min(answer.alpha):.2g}"

    def solutions(self) -> Iterator[str]:
        """Programs with known solutions are solved to `ACCURACY`."""
        worst = 0.0
        for name, posed in self.programs.items():
            answer = self.solve(posed.program)
            status, reason, residuals = verify(posed.program, answer, ACCURACY)
            if status is not Status.OK or residuals is None:
                yield f"{name}: {status}, {reason}"
                continue
            worst = max(worst, residuals.worst)
            for symbol, value, right in (("x", answer.x, posed.x), ("α", answer.alpha, posed.alpha)):
                if right is not None and value is not None and len(right):
                    gap, scale = np.abs(value - right), max(1e-3, float(np.max(np.abs(right))))
                    if np.max(gap) > 1e-3 * scale:
                        k = int(np.argmax(gap))
                        yield f"{name}: {symbol}[{k}] is {value[k]:.6g} against {right[k]:.6g}"
        yield Note(f"{len(self.programs)} programs, residuals up to {worst:.0e}")

    def accuracies(self) -> Iterator[str]:
        """Residuals are below the accuracy that is asked for."""
        program = next(iter(self.programs.values())).program
        for accuracy in (1e-3, 1e-5, ACCURACY):
            status, reason, residuals = verify(program, self.solve(program, accuracy), accuracy)
            if status is not Status.OK or residuals is None:
                yield f"accuracy {accuracy:.0e}: {status}, {reason}"
            else:
                yield Note(f"asked for {accuracy:.0e}, residual {residuals.worst:.0e}")

    def infeasible(self) -> Iterator[str]:
        """A program without admissible points is answered, with whatever status, and not by an exception."""
        # x ≤ −1 and x ≥ 1
        impossible = VariationalInequality(np.eye(1), np.ones(1), np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0]))
        try:
            # A run records what a solver raises as a status.
            answer = self.create(_scaled(impossible), ACCURACY)
        except Exception as error:  # a plugin may raise anything
            advice = "return QPSolution(None, None, status) where there is no solution"
            raise ConformanceError(f"it raises {raised(error)}; {advice}") from error
        status, _, _ = verify(impossible, answer, ACCURACY)
        if status is Status.NONFINITE:
            yield "x or α is not finite; return QPSolution(None, None, status) where there is no solution"
        yield Note(answer.solver_status)

    def determinism(self) -> Iterator[str]:
        """A second call gives the same solution, to the accuracy; to the last bit is noted."""
        first, second = (_vectors(self.create(deepcopy(self.typical), ACCURACY)) for _ in range(2))
        for name, what in differences(second, first, 10.0 * ACCURACY):
            yield f"a second call gives another {name}: {what}"
        if list(differences(second, first, 0.0)):
            yield Note("repeated calls differ by round-off")

    def independence(self) -> Iterator[str]:
        """An answer depends on nothing but the program: not on where it is stored, nor on other calls."""
        program = deepcopy(self.typical)
        earlier = self.create(program, ACCURACY)
        kept = copies(_vectors(earlier))
        # The same arrays with other values: a solver that caches by address answers the old program.
        program.f[:] *= -0.5
        later = self.create(program, ACCURACY)
        if later.x is None or later.alpha is None or earlier.x is None:
            yield "a program with a solution gets none at a second call"
            return
        if kkt_residuals(program, later.x, np.maximum(later.alpha, 0.0)).worst > 1e-3:
            yield "where the entries of a program were changed, the solution is that of the program before"
        for name, what in differences(copies(_vectors(earlier)), kept, 0.0):
            yield f"a later call overwrites {name} of an earlier solution: {what} before"

    def repetition(self) -> Iterator[str]:
        """A program that was solved before takes as many function calls and as long as a new one."""
        # Seconds alone depend on what else the machine does, calls alone on the number of iterations.
        program = _scaled(self.programs["many constraints"].program)
        # The first nine are counted, the others timed: the profiler that counts calls slows them down.
        new = [replace(program, f=program.f * (1.0 + 1e-6 * (k + 1))) for k in range(18)]
        again = [deepcopy(program) for _ in new]
        self.create(program, ACCURACY)
        kept, solved = (max(map(self._calls, again[:9])), min(map(self._calls, new[:9])))
        pairs = zip(again[9:], new[9:], strict=True)
        seconds = [[timed(partial(self.create, each, ACCURACY))[1].cpu for each in pair] for pair in pairs]
        fast, slow = map(min, zip(*seconds, strict=True))
        # Calls and seconds together: an early end of the iterations saves calls, a busy machine changes seconds.
        if kept < solved and slow > 5.0 * fast:
            times = f"a program solved before takes {fast:.1g} s of CPU, a new one {slow:.1g} s"
            yield f"{times}: solutions are kept, and their times say nothing"

    def _calls(self, program: VariationalInequality) -> int:
        """Number of Python and C functions that the solver calls for a program."""
        calls, profiler = 0, sys.getprofile()

        def count(_frame: FrameType, event: str, _argument: object) -> None:
            nonlocal calls
            calls += event in ("call", "c_call")

        sys.setprofile(count)
        try:
            self.create(program, ACCURACY)
        finally:
            sys.setprofile(profiler)
        return calls

    def duration(self) -> Iterator[str]:
        """A solution is much quicker than the time limit."""
        seconds = timed(partial(self.create, self.typical, ACCURACY))[1].wall
        if seconds > self.seconds:
            yield f"a solution takes {seconds:.3g} s, above the limit of {self.seconds:g} s"
        elif seconds > 1.0:
            # The machine may have been busy with something else.
            seconds = min(seconds, timed(partial(self.create, self.typical, ACCURACY))[1].wall)
            if seconds > 1.0:
                yield Doubt(f"a solution of a program of 6 unknowns takes {seconds:.3g} s")
        yield Note(f"a solution takes {seconds:.2g} s")

    checks = (
        Check("answer", answer), Check("signs of multipliers", signs, ("answer",)),
        Check("known solutions", solutions, ("signs of multipliers",)),
        Check("accuracy", accuracies, ("signs of multipliers",)), Check("infeasible program", infeasible, ("answer",)),
        Check("determinism", determinism, ("answer",)),
        Check("independent calls", independence, ("known solutions",)),
        Check("repeated programs", repetition, ("answer",)), Check("time", duration, ("answer",)),
    )  # fmt: skip


def _scaled(program: VariationalInequality) -> VariationalInequality:
    return units_of(program).scaled(program)


def _vectors(answer: QPSolution) -> dict[str, Array]:
    return {name: value for name, value in (("x", answer.x), ("α", answer.alpha)) if value is not None}


def of_qpsolvers(program: VariationalInequality, accuracy: float, *, solver: str) -> QPSolution:
    """A solver that qpsolvers has, in the form of one that a plugin registers."""
    return solve_qp(program, solver, accuracy)
