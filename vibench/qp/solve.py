"""One call for all QP solvers; its solutions are unverified until `vibench.qp.verification` has classified them.

A quadratic program is a `VariationalInequality`, dense or sparse: min ½ xᵀA x − fᵀx subject to B x ≤ g, with
multipliers α ≥ 0 such that A x + Bᵀα = f.
"""

from __future__ import annotations

import builtins
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Annotated, Any, TypeVar

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dposv, dpotrf, dtrtrs

from vibench.arrays import Array, Mask, taken
from vibench.errors import NumericalError, UnsupportedError, foreign, in_a_line, message_of, unknown_name
from vibench.interfaces.problem import VariationalInequality
from vibench.linalg.cholesky import SparseCholesky
from vibench.provenance import solver_version
from vibench.qp.scaling import Units, drive, near, row_norms, units_driven, units_of_dual
from vibench.qp.settings import SETTINGS
from vibench.qp.verification import QPSolution, QPSolver
from vibench.signatures import Share
from vibench.text import one_line

T = TypeVar("T")


def _piqp(program: VariationalInequality, bounds: bool = False, **settings: Any) -> QPSolution:
    import piqp  # noqa: PLC0415  an optional solver

    solver = piqp.DenseSolver()
    for name, value in settings.items():
        setattr(solver.settings, name, value)
    if bounds:
        solver.setup(np.asfortranarray(program.A), -program.f, x_l=-program.g)
    else:
        solver.setup(np.asfortranarray(program.A), -program.f, G=np.asfortranarray(program.B), h_u=program.g)
    status, result = solver.solve(), solver.result
    z = np.array(result.z_bl if bounds else result.z_u)
    return QPSolution(np.array(result.x), z, str(status), int(result.info.iter))


# Solvers that take dense programs without qpsolvers, whose checks and conversions cost a third of a small program.
# Every program gets a solver object of its own: updated in place, it would keep what it adapted to the program before
# (step sizes, equilibration), and answers would depend on earlier programs of the process, by up to 1e-5. Where
# `bounds` is set B is minus the identity, and bounds take these solvers less time than rows.
DIRECT: Mapping[str, Callable[..., QPSolution]] = {"piqp": _piqp}


def solve_qp(
    program: VariationalInequality, solver: str, accuracy: Share, extra: Mapping[str, QPSolver] | None = None,
    factor: Annotated[Array, "n", "n"] | None = None, start: QPSolution | None = None,
) -> QPSolution:  # fmt: skip
    """Solve a quadratic program with a named solver.

    The data are scaled first (`Units`), every constraint row to unit norm and x and the objective by what drives them
    (`drive`), so that the absolute tolerances of the solvers correspond to the relative residuals of the benchmark.
    A dense program is shifted by A⁻¹f before: its size is what contact does then, not the load.
    Constraints at a distance of more than 1e4 units are left out at first, and restored if the solution violates one of
    them. The solution is scaled back.

    DAQP is given dense programs as least distance problems (`_least_distance`), which it would make of them itself.

    The program is dense, or sparse for solvers that take sparse data. `solver` is a name that qpsolvers knows, or one
    of `extra`, those registered through the entry point group `vibench.qp_solvers`. The relative `accuracy` is
    translated to its tolerances by `vibench.qp.settings`. With the Cholesky `factor` (lower) of a dense A the dual
    program is solved. `start` is a warm start of the same dimensions, for solvers with `takes_start`.

    Raises a `RequestError` if there is no such solver, a `NumericalError` if it does not return a `QPSolution` of the
    right shapes, with a text as its status. What it raises itself becomes the status of an answer without x.
    """
    if solver not in SETTINGS and solver not in (extra or ()):
        raise unknown_name("QP solver", solver, {*SETTINGS, *(extra or ())})
    if not len(program.g):
        return _unconstrained(program, factor)
    if not program.f.any() and (program.g >= 0.0).all():
        return _free(np.zeros_like(program.f), program)
    found = _solve_shifted(program, solver, accuracy, extra, factor, start)
    if found is not None:
        return found
    rows = row_norms(program.B)
    driven = drive(program, rows)
    kept = near(program, rows, driven)
    if not kept.all():
        solve = partial(solve_qp, solver=solver, accuracy=accuracy, extra=extra, factor=factor)
        if (found := _solve_near(program, kept, start, solve)) is not None:
            return found
    solve = partial(_solve_in, solver=solver, accuracy=accuracy, extra=extra)
    if factor is None or not len(program.f):
        answer = solve(units_driven(rows, driven), program, start)
        hardly = form_of(solver, factor, extra) == "least distance" and isinstance(program.A, np.ndarray)
        note = "; in the primal form, as A is hardly definite" * hardly
        return replace(answer, solver_status=f"{answer.solver_status}{note}")
    return _solve_dual(program, solve, factor, start, rows, driven.loaded)


def _solve_shifted(
    program: VariationalInequality, solver: str, accuracy: float, extra: Mapping[str, QPSolver] | None,
    factor: Array | None, start: QPSolution | None,
) -> QPSolution | None:  # fmt: skip
    """Solve a dense program as a least distance problem, or shifted by A⁻¹f; `None` for neither."""
    if not (isinstance(program.A, np.ndarray) and len(program.f)):
        return None
    if form_of(solver, factor, extra) == "least distance":
        return _or_its_error(partial(_least_distance, program, SETTINGS[solver].at(accuracy), factor, start))
    if factor is not None or not program.f.any():
        return None
    L, free, failed = dposv(program.A, program.f)
    if failed or not _is_definite(L, program.A):
        return None
    shifted = replace(program, f=np.zeros_like(free), g=program.g - program.B @ free)
    begun = start if start is None or start.x is None else replace(start, x=start.x - free)
    answer = solve_qp(shifted, solver, accuracy, extra, start=begun)
    return answer if answer.x is None else replace(answer, x=answer.x + free)


def _solve_near(
    program: VariationalInequality, kept: Mask, start: QPSolution | None, solve: Callable[..., QPSolution]
) -> QPSolution | None:
    """Solve with the constraints that are `kept` (m,) alone; `None` if the solution violates one of the others."""
    B = program.B[kept] if isinstance(program.B, np.ndarray) else sp.csr_array(program.B)[kept]
    near_start = None if start is None or start.alpha is None else replace(start, alpha=start.alpha[kept])
    answer = solve(replace(program, B=B, g=program.g[kept]), start=near_start)
    if answer.x is None or answer.alpha is None:
        return answer
    if not np.all(program.B[~kept] @ answer.x <= program.g[~kept]):
        return None
    alpha = np.zeros(len(kept))
    alpha[kept] = answer.alpha
    return replace(answer, alpha=alpha)


def _unconstrained(program: VariationalInequality, factor: Array | None) -> QPSolution:
    """Solve a program without constraints, which many solvers do not take, by Cholesky; `factor` as in `solve_qp`."""
    try:
        if not isinstance(program.A, np.ndarray):
            x = SparseCholesky(program.A, "A").solve(program.f)
        elif len(program.f):
            L = np.linalg.cholesky(program.A) if factor is None else factor
            x = _solve_factor(L, _solve_factor(L, program.f.copy()), transposed=True)
        else:
            x = np.zeros(0)
    except (NumericalError, np.linalg.LinAlgError) as error:
        return QPSolution(None, None, message_of(error))
    return QPSolution(x, np.zeros(0), "no constraints: solved by Cholesky")


def _solve_in(
    units: Units, program: VariationalInequality, start: QPSolution | None, solver: str, accuracy: float,
    extra: Mapping[str, QPSolver] | None, bounds: bool = False,
) -> QPSolution:  # fmt: skip
    """Solve a program in these units; an answer without x or without multipliers counts as none."""
    if not len(program.f):
        return QPSolution(np.zeros(0), np.zeros(len(program.g)), "nothing to solve: no unknowns")
    scaled = units.scaled_dual(program) if bounds else units.scaled(program)
    warm_start, starter = dict[str, Any](), None if extra and solver in extra else SETTINGS[solver].start
    if start is not None and starter is not None and start.x is not None and start.alpha is not None:
        warm_start |= starter(*units.to(start.x, start.alpha))
    call = partial(_call, scaled, solver, accuracy, warm_start, bounds)
    answer = _or_its_error(partial(extra[solver], scaled, accuracy) if extra and solver in extra else call)
    if not isinstance(answer, QPSolution):
        raise NumericalError(f"the solver returned a {type(answer).__name__}, expected a QPSolution")
    status, iterations = _report(answer, program)
    if answer.x is None or answer.alpha is None:
        return QPSolution(None, None, status, iterations, answer.negative)
    x, alpha = units.back(answer.x, answer.alpha)
    return QPSolution(x, np.maximum(alpha, 0.0), status, iterations, -float(alpha.min(initial=0.0)))


def _or_its_error(solve: Callable[[], T]) -> T | QPSolution:
    """The answer of a solver, or one without x whose status is the error that it raises."""
    try:
        return solve()
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001  a solver may raise anything, and others go on
        return QPSolution(None, None, in_a_line(error))


def _report(answer: QPSolution, program: VariationalInequality) -> tuple[str, int | None]:
    """Status in one line, and iterations if they are a number of them; refuses vectors of wrong shapes."""
    for name, value, count in (("x", answer.x, len(program.f)), ("α", answer.alpha, len(program.g))):
        if value is not None:
            taken(value, f"{name} of the solver", count, finite=False)
    status, steps = answer.solver_status, answer.iterations
    if not isinstance(status, str):
        raise NumericalError(f"the solver reports the status {status!r:.40}; expected a text")
    # Results files hold whole numbers of 64 bits.
    iterations = int(steps) if isinstance(steps, int | np.integer) and 0 <= steps < 2**63 else None
    return one_line(status), iterations


def _solve_dual(
    program: VariationalInequality, solve: Callable[..., QPSolution], factor: Array, start: QPSolution | None,
    rows: Array, loaded: bool,
) -> QPSolution:  # fmt: skip
    """Solve a dense program with A = L Lᵀ through its dual, which has one unknown per constraint.

    The multipliers minimise ½ αᵀ(B A⁻¹Bᵀ)α − (B A⁻¹f − g)ᵀα over α ≥ 0; then x = A⁻¹(f − Bᵀα).
    """
    # Scale rows before products are taken: the matrix of the dual has their squares.
    constraints, load = _whitened(program, factor, rows[:, None])
    A, f = constraints @ constraints.T, constraints @ load - program.g / rows
    if not (f > 0.0).any():
        return _free(_solve_factor(factor, load.copy(), transposed=True), program)
    dual = VariationalInequality(A, f, B=-np.eye(len(f)), g=np.zeros(len(f)))
    if start is not None and start.alpha is not None and start.x is not None:
        # The multipliers of the constraints −α ≤ 0 are the slacks g − Bx.
        slack = np.maximum(program.g - program.B @ start.x, 0.0) / rows
        start = replace(start, x=rows * start.alpha, alpha=slack)
    answer = solve(units_of_dual(dual, loaded), dual, start, bounds=True)
    if answer.x is None:
        return answer
    forces = np.maximum(answer.x, 0.0)
    x = _solve_factor(factor, load - forces @ constraints, transposed=True)
    negative = -float((answer.x / rows).min(initial=0.0))
    return QPSolution(x, forces / rows, answer.solver_status, answer.iterations, negative)


def _least_distance(
    program: VariationalInequality, settings: Mapping[str, Any], factor: Array | None, start: QPSolution | None
) -> QPSolution | None:
    """Solve a dense program with A = L Lᵀ as DAQP does inside, with the help of LAPACK; `None` if A is hardly definite.

    For y = Lᵀx − L⁻¹f it is min ½|y|² subject to K y ≤ g − K L⁻¹f, where K = B L⁻ᵀ. DAQP scales rows of K to length 1:
    with the deepest violation at y = 0 as the unit its tolerances are those of the natural residuals.
    """
    import daqp  # noqa: PLC0415  processes that use it alone load it

    if factor is None:
        factor, failed = dpotrf(program.A.T, lower=True)
        if failed or not _is_definite(factor, program.A):
            return None
    K, load = _whitened(program, factor, 1.0)
    depths = K @ load - program.g
    if (deepest := float((depths / row_norms(K)).max())) <= 0.0:
        return _free(_solve_factor(factor, load.copy(), transposed=True), program)
    begun = None if start is None else start.alpha
    active = np.zeros(len(K), np.int32) if begun is None else (begun > 0.0).astype(np.int32)
    # DAQP takes no matrix for the identity, and 1e30 for no bound on this side.
    bounds = depths / -deepest, np.full(len(K), -1e30)
    _, _, outcome, info = daqp.solve(None, None, K, *bounds, active, **settings)
    if outcome <= 0:
        return QPSolution(None, None, f"not found: exit flag {outcome}")
    multipliers = deepest * info["lam"]
    alpha = np.maximum(multipliers, 0.0)
    x = _solve_factor(factor, load - alpha @ K, transposed=True)
    return QPSolution(x, alpha, "found", int(info["iterations"]), -float(multipliers.min(initial=0.0)))


def _is_definite(L: Array, A: Array) -> bool:
    """Whether no pivot of A = L Lᵀ leaves next to nothing of it: A⁻¹f would be round-off."""
    return bool((np.square(L.diagonal()) > 1e-10 * A.diagonal()).all())


def _whitened(program: VariationalInequality, L: Array, rows: Array | float) -> tuple[Array, Array]:
    """B L⁻ᵀ (m×n), its rows over `rows` (m×1), and L⁻¹f (n,), in one solve."""
    right = np.empty((len(program.g) + 1, len(program.f)))
    np.divide(program.B, rows, out=right[:-1])
    right[-1] = program.f
    whitened = _solve_factor(L, right.T).T
    return whitened[:-1], whitened[-1]


def _free(x: Array, program: VariationalInequality) -> QPSolution:
    """The solution x (n,) of a program, which presses on no constraint."""
    return QPSolution(x, np.zeros_like(program.g), "nothing to solve: no constraint acts")


def _solve_factor(L: Array, right: Array, *, transposed: bool = False) -> Array:
    """The solution L⁻¹ r or L⁻ᵀ r for r (n,) or (n×k), which may be overwritten, without a copy of L."""
    lower = L.flags.f_contiguous
    solution, _ = dtrtrs(L if lower else L.T, right, lower=lower, trans=transposed is lower, overwrite_b=True)
    return np.asarray(solution)


def installed_solvers(extra: Iterable[str] = ()) -> list[str]:
    """Names of the installed solvers, with those that plugins register as `extra`.

    A solver counts only with its distribution: a folder of that name in the working directory can be imported, too.
    """
    installed = {name for name in load_qpsolvers()[0].available_solvers if name in SETTINGS and solver_version(name)}
    return sorted(installed | set(extra))


@cache
def load_qpsolvers() -> tuple[Any, Mapping[str, str]]:
    """The module qpsolvers, and why it cannot import some solvers, by name; an `UnsupportedError` if it is broken."""
    usual, faults = builtins.__import__, dict[str, str]()

    def importing(name: str, within: Any = None, *given: Any, **named: Any) -> Any:
        if (within or {}).get("__name__") != "qpsolvers.solvers":
            return usual(name, within, *given, **named)
        try:
            with foreign(f"{name} cannot be used"):
                return usual(name, within, *given, **named)
        except UnsupportedError as error:
            faults[name.removesuffix("_")] = str(error)
            # It catches nothing else: one broken library would stop every study.
            raise ImportError(str(error)) from None

    builtins.__import__ = importing  # type: ignore[assignment]
    try:
        with foreign("qpsolvers cannot be used"):
            import qpsolvers  # noqa: PLC0415  loads every solver there is, which processes that use none need not
    finally:
        builtins.__import__ = usual
    return qpsolvers, faults


def form_of(solver: str, factor: Array | None, extra: Iterable[str] | None = ()) -> str:
    """The form in which a solver is given dense programs: the dual where the factor of A is known, but for DAQP."""
    own = "primal" if factor is None else "dual"
    return "least distance" if solver == "daqp" and solver not in (extra or ()) else own


def takes_start(solver: str) -> bool:
    """Whether a solver can be warm-started."""
    return solver in SETTINGS and SETTINGS[solver].start is not None


def _call(
    program: VariationalInequality, solver: str, accuracy: float, start: Mapping[str, Any], bounds: bool
) -> QPSolution:
    """The answer of a solver to a program with data of order one.

    Where B is minus the identity the constraints are `bounds`, which some solvers are given as such.
    """
    settings, bounds = SETTINGS[solver].at(accuracy), bounds and SETTINGS[solver].bounds
    if solver in DIRECT and isinstance(program.A, np.ndarray) and isinstance(program.B, np.ndarray):
        return DIRECT[solver](program, bounds, **settings, **start)
    library, _ = load_qpsolvers()
    rows = {"lb": -program.g} if bounds else {"G": _as_csc(program.B), "h": program.g}
    problem = library.Problem(_as_csc(program.A), -program.f, **rows)
    with warnings.catch_warnings():
        # Warnings repeat the status, which is part of the solution and is verified later.
        warnings.simplefilter("ignore")
        solution = library.solve_problem(problem, solver=solver, **settings, **start)
    status, iterations = SETTINGS[solver].report(solution)
    x, z = solution.x, solution.z_box if bounds else solution.z
    if x is None or z is None:
        return QPSolution(None, None, status, iterations)
    return QPSolution(np.asarray(x, float), np.asarray(-z if bounds else z, float), status, iterations)


def _as_csc(matrix: Any) -> Any:
    return matrix if isinstance(matrix, np.ndarray) else sp.csc_matrix(matrix)
