"""Reduced models, which answer queries at any parameter.

An answer of a formulation is judged before anything is measured of it: a vector of the wrong size, one that is not
finite, and a negative multiplier are broken answers, whatever the formulation says of them.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import inf
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, cast

import numpy as np

from vibench import signatures
from vibench.arrays import Array, is_sound, read_only, taken
from vibench.errors import NumericalError, RequestError, unknown_name
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.interfaces import formulations
from vibench.interfaces.dual_sets import refuse_blocks
from vibench.interfaces.formulations import Formulation, FormulationAnswer, FormulationModel, QuerySettings
from vibench.interfaces.parameters import ParameterBox, outside
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import Kind
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import output_weights
from vibench.model.certificates.bounds import OnlineBound, OnlineCertificate
from vibench.model.errors import residual_multiplier
from vibench.model.galerkin import ReducedProblem
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel
from vibench.offline.assemblies import assemblies
from vibench.offline.solution import Solution, html
from vibench.plugins import registry
from vibench.plugins.kinds import PluginKind
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers, solve_qp, takes_start
from vibench.qp.status import Status
from vibench.qp.verification import QPSolution, Residuals, verify
from vibench.signatures import Count, Judged, NotNegative, Positive, Share, bordered, bordered_constructor, rule_of
from vibench.text import normal_name, shown
from vibench.timing import NO_TIME, Seconds, timed

if TYPE_CHECKING:
    import pandas as pd

Parameters = Annotated[Sequence[float] | Array | Mapping[str, float], Judged]
"""A parameter mu: its components in the order of `ParameterBox.names`, or by these names."""

Measure = Literal["solution", "contact"]

ACCURACY = 1e-7  # of formulations without an axis of accuracies


class CellSolver:
    """The QP solver of a query, which keeps the last program that it was given and its solution."""

    def __init__(self, solver: str | None, accuracy: float) -> None:
        self._solver, self._accuracy = solver, accuracy
        self._extra = {} if solver is None else registry.qp_solver(solver)
        self.last: tuple[VariationalInequality, QPSolution] | None = None

    def __call__(
        self, program: VariationalInequality, *, factor: Array | None = None, start: tuple[Array, Array] | None = None
    ) -> QPSolution:
        """The solution of a dense program; see `vibench.interfaces.formulations.SolveQP`."""
        if self._solver is None:
            raise NumericalError("the formulation solves a quadratic program without 'solvers' among its axes (`uses`)")
        # Other solvers cannot use a start.
        begun = None if start is None or not takes_start(self._solver) else QPSolution(*start, "the start")
        solution = solve_qp(program, self._solver, self._accuracy, self._extra, factor, begun)
        self.last = program, solution
        return solution

    def verdict(self, answer: FormulationAnswer, slackened: float) -> tuple[Status, str, Residuals | None]:
        """The verdict of verification on an answer, to some multiple of the accuracy; ok if no program was solved."""
        if self.last is None:
            return Status.OK, "", None
        status, reason, residuals = verify(*self.last, slackened * self._accuracy)
        of_last = (answer.x, self.last[1].x), (answer.alpha, self.last[1].alpha)
        # Any program may be solved last: what is verified has to be what is answered.
        if status is Status.OK and any(
            one is not None and (known is None or not np.array_equal(one, known)) for one, known in of_last
        ):
            return Status.INACCURATE, "its solution is not the answer, which nothing verifies", None
        return status, reason, residuals


class QueryStatus(NamedTuple):
    """Status of an answer, why it is not ok, and its pair u (n,), λ (m,) unless it is broken or has a program."""

    status: Status
    reason: str
    pair: tuple[Array, Array] | None = None
    residuals: Residuals | None = None  # of the program, or of the last one that the formulation solved
    reconstruction: Seconds | None = None  # of `reconstruct`, where the pair is its work
    counts: bool = False  # whether these seconds are part of the query

    @property
    def counted(self) -> Seconds:
        """Seconds of reconstruction that are part of the query: its answer is more than a linear map of (x, α)."""
        return self.reconstruction if self.counts and self.reconstruction is not None else NO_TIME


class _Settings(NamedTuple):
    """Solver, accuracy, tolerance and corrections of a query."""

    solver: str | None
    accuracy: float
    tolerance: float | None
    mode: CorrectionMode
    of: str


@dataclass(frozen=True, eq=False)
class Model:
    """A reduced model of a run or of a `Reduction`, which can be evaluated at any parameter.

    Attributes
    ----------
    formulation, offline, built
        The formulation that makes it, the offline phase, and what the formulation has built on that.
    solver, accuracy
        QP solver of queries where no other is asked for, `None` for formulations without, and the relative accuracy
        that answers have to reach.
    certificate
        The certificate that bounds errors at online cost; `None` for a model without bounds.
    row
        Its row of the cells table; empty for a model that belongs to no run.
    correction
        Which solutions are corrected where nothing else is asked for: as in its cell.
    """

    formulation: Formulation
    offline: formulations.OfflinePhase = field(repr=False)
    built: Mapping[str, Any] = field(repr=False)
    solver: str | None
    accuracy: float
    certificate: OnlineCertificate | None = field(default=None, repr=False)
    row: Mapping[str, Any] = field(default_factory=dict, repr=False)
    correction: CorrectionMode = CorrectionMode.NONE

    def __repr__(self) -> str:
        return f"Model({', '.join(f'{name}={value!r}' for name, value in self._about().items())})"

    def _repr_html_(self) -> str:
        return html("reduced model", self._about())

    def _about(self) -> dict[str, Any]:
        return {
            "problem": str(self.row.get("problem") or type(self.problem).__name__), "R": self.online.generators,
            "parameters": ", ".join(self.parameters.names), "solver": self.solver, "accuracy": self.accuracy,
            "bounds": "none" if self.certificate is None else self.certificate.base.guarantee.value,
        }  # fmt: skip

    @property
    def problem(self) -> Problem:
        """The high-fidelity problem."""
        return self.offline.problem

    @property
    def parameters(self) -> ParameterBox:
        """The parameter domain."""
        return self.problem.parameters

    @cached_property
    def online(self) -> FormulationModel:
        """The model of the formulation, which answers queries; a `NumericalError` if it makes something else."""
        refuse_blocks(self.problem.K, self.formulation.blocks, f"the formulation {type(self.formulation).__name__}")
        made = self.formulation.model(self.offline, self.built)
        if not isinstance(made, FormulationModel):
            raise NumericalError(f"the formulation made a {type(made).__name__}, expected a FormulationModel")
        signatures.check_attributes(made, FormulationModel, NumericalError)
        if (added := made.enrichment or 0) > made.dimension:
            what = f"`enrichment` of the model is {added}, more than its `dimension`"
            raise NumericalError(f"{what}, {made.dimension}")
        if self.formulation.has_program and not hasattr(made, "reduced"):
            raise NumericalError("the formulation declares `has_program`, but its model has no `reduced`")
        return made

    @property
    def reduced(self) -> AnyReducedModel:
        """The model that assembles: `reduced.assemble(mu)` has `program` and `reconstruct`; refused if it has none."""
        if not self.formulation.has_program:
            name = type(self.formulation).__name__
            raise RequestError(f"the formulation {name} has no program to be replayed, corrected or exported")
        return cast("AnyReducedModel", self.online.reduced)

    @property
    def solves_programs(self) -> bool:
        """Whether queries are programs for a QP solver; otherwise the formulation solves them by itself."""
        return self.formulation.has_program and "solvers" in self.formulation.uses

    def solving(self, solver: str | None, accuracy: float | None = None) -> Model:
        """The same model for another solver and accuracy."""
        other = replace(self, solver=solver, accuracy=self.accuracy if accuracy is None else accuracy)
        # The model of the formulation depends on neither, and making it may be costly.
        other.__dict__["online"] = self.online
        return other

    def settings(self, start: FormulationAnswer | None = None) -> tuple[QuerySettings, CellSolver]:
        """Settings of a query that the formulation solves, and the solver in them."""
        solver = CellSolver(self.solver, self.accuracy)
        return QuerySettings(self.accuracy, solver, start), solver

    def status_of(
        self, mu: Array, answer: FormulationAnswer, solver: CellSolver, slackened: float,
        program: VariationalInequality | None = None,
    ) -> QueryStatus:  # fmt: skip
        """The status of an answer of the formulation at mu (d,), found with this solver, or of its `program`.

        Residuals may be `slackened` times the accuracy.
        """
        if program is not None:
            solution = QPSolution(answer.x, answer.alpha, answer.reason)
            status, reason, residuals = verify(program, solution, slackened * self.accuracy)
            return QueryStatus(status, reason, residuals=residuals)
        status, reason = Status(answer.outcome.value), answer.reason
        if answer.x is None:
            return QueryStatus(Status.FAILED if status is Status.OK else status, reason or "there is no answer")
        # A formulation may take a failed program for solved: its own outcome never improves on the verification.
        of_qp, why, residuals = solver.verdict(answer, slackened)
        if of_qp.severity > status.severity:
            status, reason = of_qp, f"its last quadratic program: {why}"
        if not (is_sound(answer.x) and is_sound(answer.alpha)):
            return QueryStatus(Status.NONFINITE, "x or alpha of the answer is not finite", residuals=residuals)
        made, spent = timed(lambda: self.online.reconstruct(mu, answer))
        u, lam = self._pair(made)
        counts = not self._is_linear(mu, answer, u, lam)
        lam = self._multiplier(mu, u) if lam is None else lam
        if not (is_sound(u) and is_sound(lam)):
            return QueryStatus(Status.NONFINITE, "the reconstructed u or λ is not finite", residuals=residuals)
        # Even round-off beyond K is refused: every bound needs λ ∈ K.
        if not (K := self.problem.K).contains(lam):
            rows = np.abs(K.project(lam) - lam)
            worst = f"{lam[rows.argmax()]:.1e} in row {int(rows.argmax())}"
            what = "is outside K" if K.blocks else "has negative coefficients"
            return QueryStatus(Status.FAILED, f"a broken answer: λ {what}, as {worst}")
        return QueryStatus(status, reason, (u, lam), residuals, spent, counts)

    def answered(self, mu: Array, settings: QuerySettings) -> tuple[FormulationAnswer, Seconds]:
        """The answer of the formulation at mu (d,), and its seconds; a `NumericalError` names what is none."""
        answer, seconds = timed(lambda: self.online.solve(mu, settings))
        return _taken(answer, self.online), seconds

    def pair(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:
        """The pair u (n,), λ (m,) of an answer, its sizes checked; λ from the residual if the formulation has none."""
        u, lam = self._pair(self.online.reconstruct(mu, answer))
        return u, self._multiplier(mu, u) if lam is None else lam

    def _pair(self, made: object) -> tuple[Array, Array | None]:
        """The pair that `reconstruct` returned."""
        problem, declared = self.problem, self.formulation.multiplier
        if not isinstance(made, tuple) or len(made) != 2:
            raise NumericalError(f"`reconstruct` returned a {type(made).__name__}, expected a pair (u, λ)")
        u, lam = made
        if (lam is None) != (declared is formulations.Multiplier.RESIDUAL):
            which = "no λ" if lam is None else "a λ"
            raise NumericalError(f"`reconstruct` returned {which}, and the formulation declares `{declared.value}`")
        u = taken(u, "u of `reconstruct`", problem.V.dim, finite=False)
        return u, None if lam is None else taken(lam, "λ of `reconstruct`", problem.W.dim, finite=False)

    def _multiplier(self, mu: Array, u: Array) -> Array:
        cache = assemblies(self.problem)
        return residual_multiplier(cache.at(mu), cache.energy_at(mu), u)

    def _is_linear(self, mu: Array, answer: FormulationAnswer, u: Array, lam: Array | None) -> bool:
        """Whether half of the coefficients make half of the pair."""
        alpha = None if answer.alpha is None else read_only(0.5 * answer.alpha)
        half = FormulationAnswer(None if answer.x is None else read_only(0.5 * answer.x), alpha)
        try:
            halved = self._pair(self.online.reconstruct(mu, half))
        except MemoryError:
            raise
        except Exception:  # noqa: BLE001  it may refuse other coefficients than its own
            return False
        return all(
            one is None or whole is None or np.abs(2.0 * one - whole).max() <= 1e-12 * np.abs(whole).max()
            for one, whole in zip(halved, (u, lam), strict=True)
        )

    @bordered
    def solve(
        self, mu: Parameters, solver: str | None = None, accuracy: Share | None = None,
        tolerance: Positive | None = None, corrected: bool | None = None, of: Measure = "solution",
    ) -> Solution:  # fmt: skip
        """Answer a query at a parameter, verify the answer, and bound its errors where the model has bounds.

        The formulation and the solver run in this process, without the limits of a study.

        Parameters
        ----------
        mu
            The parameter; outside the domain there is a warning, since the model was not trained there.
        solver, accuracy
            QP solver and the relative accuracy that it has to reach; those of the model by default.
        tolerance
            Largest relative error of u in the energy norm; `verdict` of the solution says if the bound is within it.
        of
            "solution", or "contact": the bounds of u and of λ are relative to ‖u − A⁻¹f‖_A, what contact does to the
            solution, then, which a load beside the contact does not enlarge.
        corrected
            Whether `u` and `lam` of the solution are corrected: they satisfy the constraints, and are usually more
            accurate where the violation dominates the bound (`omega` > `rho`). A certificate does that at online cost;
            without one it takes factorisations at mu. Where there is no bound there is no correction either, as
            `solution.answer` says. By default as in the cell of the model.

        Raises
        ------
        RequestError
            If mu is not a parameter of the problem, the solver is not installed or the formulation uses none, the
            tolerance is not positive, there is one and the model has no bounds, or a correction and it has no program.
        NumericalError
            If the answer is of another type or size.
        """
        settings = self._settings(solver, accuracy, tolerance, corrected, of)
        at = parameter_in(self.parameters, mu)
        # Assembly and solution are timed apart only where the QP solver of the cell solves.
        if not self.solves_programs:
            return self._answered(at, settings)
        assembled, assembly = timed(lambda: self.online.program(at))
        return self._solution(at, assembled, assembly.cpu, settings)

    def _settings(
        self, solver: str | None, accuracy: float | None, tolerance: float | None, corrected: bool | None, of: Measure
    ) -> _Settings:
        """The checked arguments of `solve`, with the defaults of the model."""
        if tolerance is not None and self.certificate is None:
            raise RequestError("the model has no error bounds: a tolerance needs one with bounds = true")
        # Corrections are made of programs: refuse a formulation without them before anything is solved.
        if corrected:
            self.reduced  # noqa: B018
        mode = self.correction if corrected is None else CorrectionMode("feasible" if corrected else "none")
        if solver is not None and self.solver is None:
            raise RequestError(f"the formulation {type(self.formulation).__name__} uses no QP solver")
        name, own = self.solver if solver is None else solver, registry.registered(PluginKind.SOLVER)
        if name is not None and name not in installed_solvers(own):
            if name in SETTINGS:
                raise RequestError(f"the QP solver '{name}' is not installed")
            raise unknown_name(PluginKind.SOLVER, name, {*SETTINGS, *own})
        return _Settings(name, self.accuracy if accuracy is None else accuracy, tolerance, mode, of)

    def _answered(self, at: Array, settings: _Settings) -> Solution:
        model, online = self.solving(settings.solver, settings.accuracy), self.online
        query, solver = model.settings()
        answer, seconds = model.answered(at, query)
        # An answer to a program is verified against the program, not by what the formulation says of it.
        if self.formulation.has_program:
            found = QPSolution(answer.x, answer.alpha, answer.reason, answer.iterations)
            return self._program_solution(at, online.program(at), found, (0.0, seconds.cpu), settings)
        judged = model.status_of(at, answer, solver, 1.0)
        coefficients = judged.status, judged.reason, answer.x, answer.alpha, judged.residuals
        bound = self.bound_of(at, answer) if judged.pair is not None else None
        own = None, settings.mode, answer.iterations, answer.uncertainty
        spent = seconds + judged.counted
        return Solution(at, *coefficients, 0.0, spent.cpu, self, lambda: judged.pair, bound, settings.tolerance, *own)

    def bound_of(self, mu: Array, answer: FormulationAnswer) -> OnlineBound | None:
        """The bound at mu (d,) of an answer that is no solution of a program; `None` without a certificate."""
        if self.certificate is None:
            return None
        given = self.online.coordinates(mu, answer)
        return self.certificate.certify(self.problem, mu, *given, CorrectionMode.NONE)[0]

    def _solution(self, at: Array, assembled: ReducedProblem, assembly: float, settings: _Settings) -> Solution:
        assert settings.solver is not None  # `solves_programs`
        extra = registry.qp_solver(settings.solver)
        solve = partial(solve_qp, assembled.program, settings.solver, settings.accuracy, extra, assembled.factor)
        found, solution = timed(solve)
        return self._program_solution(at, assembled, found, (assembly, solution.cpu), settings)

    def _program_solution(
        self, at: Array, assembled: ReducedProblem, found: QPSolution, seconds: tuple[float, float], settings: _Settings
    ) -> Solution:
        status, reason, residuals = verify(assembled.program, found, settings.accuracy)
        bound = correction = None
        x, alpha = found.x, found.alpha
        if self.certificate is not None:
            bound = OnlineBound.none(f"the program has no solution: {reason}")
            if residuals is not None and x is not None and alpha is not None:
                bound, correction = self.certificate.certify(self.problem, at, assembled, x, alpha, settings.mode)
                last = bound if correction is None else correction.bound
                if settings.of == "contact":
                    lam = self.reduced.generators @ alpha if correction is None else correction.nu
                    known = alpha, lam, last.lambda_natural
                    of_contact = self.certificate.least_contact(self.problem, at, assembled, *known)
                    worst = max(last.u_energy, last.lambda_natural)
                    last = replace(last, relative=worst / of_contact if of_contact > 0.0 else inf)
                bound = last

        def pair() -> tuple[Array, Array] | None:
            if x is None or alpha is None:
                return None
            u = np.asarray(assembled.reconstruct(x[:, None])[:, 0])
            return u, np.asarray(self.reduced.generators @ alpha)

        fields = status, reason, x, alpha, residuals, *seconds
        given = bound, settings.tolerance, correction, settings.mode
        return Solution(at, *fields, self, pair, *given, found.iterations)

    @cached_property
    def output_weights(self) -> dict[str, tuple[float, float] | None]:
        """Weights that bound errors of outputs by those of u and λ; `None` without any."""
        certificate, found = self.certificate, dict[str, tuple[float, float] | None]()
        for output in self.problem.outputs:
            known = None if certificate is None or not output.linear else certificate.base
            found[output.name] = None if known is None else output_weights(self.problem, known, output)
        return found

    @bordered
    def solve_all(
        self, mus: Annotated[Sequence[Sequence[float]] | Array, Judged], solver: str | None = None,
        accuracy: Share | None = None, tolerance: Positive | None = None, corrected: bool | None = None,
        of: Measure = "solution",
    ) -> pd.DataFrame:  # fmt: skip
        """A table of `solve` at parameters (P×d), a row for each: what a sample or an optimisation needs.

        Its columns are the parameters by name, status, reason and the worst residual; of a model with bounds these
        and the verdict; `output:NAME` and with bounds `bound:NAME` of every quantity of interest; and CPU seconds.
        Reduced assembly evaluates the sums of terms of up to 256 programs at once, and each row has an equal part
        of the seconds; programs are solved one after the other.

        Raises a `RequestError` as `solve`, or if the array has another shape.
        """
        import pandas as pd  # noqa: PLC0415  workers load models, and no tables

        given = _numbers("mus", mus, f"parameters (P, {self.parameters.dim})")
        if given.ndim != 2:
            raise RequestError(f"the parameters have the shape {given.shape}, expected (P, {self.parameters.dim})")
        settings = self._settings(solver, accuracy, tolerance, corrected, of)
        points = [parameter_in(self.parameters, mu) for mu in given]
        if not self.solves_programs:
            return pd.DataFrame([self._answered(at, settings).columns() for at in points])
        rows = []
        # Blocks bound the memory of the programs that are assembled together.
        for block in (points[start : start + 256] for start in range(0, len(points), 256)):
            if isinstance(self.reduced, HyperReducedModel):
                together, spent = timed(partial(self.reduced.assemble_all, np.array(block)))
                assembled = ((reduced, spent.cpu / len(block)) for reduced in together)
            else:
                timings = (timed(partial(self.online.program, at)) for at in block)
                assembled = ((reduced, spent.cpu) for reduced, spent in timings)
            for at, (reduced, seconds) in zip(block, assembled, strict=True):
                rows.append(self._solution(at, reduced, seconds, settings).columns())
        return pd.DataFrame(rows)

    @bordered
    def reconstruct(self, mu: Parameters, x: Array, alpha: Array) -> tuple[Array, Array]:
        """The solution u (n,), λ (m,) with coordinates x (N',) in the primal basis at mu and α (R,) on generators."""
        reduced = self.reduced.assemble(parameter_in(self.parameters, mu))
        sizes = {"x": (x, len(reduced.program.f)), "alpha": (alpha, self.reduced.generators.shape[1])}
        for name, (given, size) in sizes.items():
            if given.shape != (size,):
                raise RequestError(f"{name} has the shape {given.shape}, expected ({size},)")
        u = reduced.reconstruct(x[:, None])[:, 0]
        return np.asarray(u), np.asarray(self.reduced.generators @ alpha)

    @bordered
    def high_fidelity(self, mu: Parameters) -> HighFidelitySolution:
        """The high-fidelity solution at a parameter, to compare with."""
        return self._high_fidelity.solve(parameter_in(self.parameters, mu))

    @cached_property
    def _high_fidelity(self) -> HighFidelitySolver:
        return HighFidelitySolver(self.problem)


def parameter_in(box: ParameterBox, mu: Parameters) -> Array:
    """A parameter as an array (d,); outside the box there is a warning of the caller of a `bordered` method."""
    if isinstance(mu, Mapping):
        names = [normal_name(name) for name in box.names]
        given = {normal_name(str(name)): value for name, value in mu.items()}
        if set(given) != set(names) or len(mu) != len(names):
            raise RequestError(f"mu has the components {sorted(map(str, mu))}, expected {sorted(box.names)}")
        mu = [given[name] for name in names]
    at = _numbers("mu", mu, expected := f"finite numbers ({', '.join(box.names)})")
    if at.ndim == 2:
        raise RequestError(f"mu has the shape {at.shape}: `solve_all` takes an array of parameters (P, {box.dim})")
    if at.shape != (box.dim,):
        raise RequestError(f"mu is {shown(mu)}, expected {expected}")
    if (beyond := outside(box, at)).any():
        beside = ", ".join(np.array(box.names)[beyond])
        warnings.warn(f"{beside}: outside the parameter domain, where the model was not trained", stacklevel=4)
    return read_only(at)


def _numbers(name: str, value: Any, expected: str) -> Array:
    """The array of finite numbers that a value is, of any type that NumPy converts."""
    try:
        array = np.asarray(value)
    except Exception:  # noqa: BLE001  a conversion is code of the value's type
        array = np.zeros(0, object)
    # Truth values in a list, and masked entries, become numbers in the array.
    listed = value if isinstance(value, list | tuple) else ()
    is_mixed = isinstance(value, np.ma.MaskedArray) or any(isinstance(one, bool) for one in listed)
    if is_mixed or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise RequestError(f"{name} is {shown(value)}, expected {expected}")
    return np.asarray(array, float)


def check_built(built: object) -> Mapping[str, Any]:
    """Return what a formulation has built, or refuse what is no mapping with texts as names."""
    signatures.refuse_others("what `build` returned", built, rule_of(Mapping[str, Any]), NumericalError)
    return cast("Mapping[str, Any]", built)


def _taken(answer: object, model: FormulationModel) -> FormulationAnswer:
    """A copy of what `solve` returned, its vectors read-only, or a `NumericalError` that names what it cannot be."""
    if not isinstance(answer, FormulationAnswer):
        raise NumericalError(f"`solve` returned a {type(answer).__name__}, expected a FormulationAnswer")
    vectors = dict[str, Array | None]()
    for name, most in (("x", model.dimension), ("alpha", model.generators or 0)):
        value = getattr(answer, name)
        vectors[name] = None if value is None else taken(value, f"{name} of the answer", "count", finite=False)
        if value is not None and len(value) > most:
            raise NumericalError(f"{name} of the answer has {len(value)} coefficients, the model declares {most}")
    kinds = {"outcome": formulations.Outcome, "reason": str, "iterations": Count | None}
    for name, kind in (kinds | {"uncertainty": NotNegative | None}).items():
        signatures.refuse_others(f"{name} of the answer", getattr(answer, name), rule_of(kind), NumericalError)
    return replace(answer, x=vectors["x"], alpha=vectors["alpha"])


@bordered_constructor
class ProgramModel(FormulationModel):
    """Assembles the program of a reduced model at a parameter, and leaves its solution to the QP solver of the cell."""

    def __init__(self, reduced: AnyReducedModel) -> None:
        self.reduced = reduced
        spaces = reduced.model if isinstance(reduced, HyperReducedModel) else reduced
        varying = spaces.span.shape[1] if spaces.enrichment.kind is Kind.PER_PARAMETER else 0
        self.dimension = int(reduced.fixed_basis.shape[1] + varying)
        self.generators = int(reduced.generators.shape[1])

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        """The solution of the program at mu (d,)."""
        assembled = self.program(mu)
        found = settings.solve_qp(assembled.program, factor=assembled.factor)
        if found.x is None or found.alpha is None:
            return FormulationAnswer.none(found.solver_status)
        return FormulationAnswer(found.x, found.alpha, reason=found.solver_status, iterations=found.iterations)

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:
        """The pair u = Z x and λ = χ α; it assembles again."""
        assert answer.x is not None
        assert answer.alpha is not None
        u = self.program(mu).reconstruct(answer.x[:, None])[:, 0]
        return np.asarray(u), np.asarray(self.reduced.generators @ answer.alpha)
