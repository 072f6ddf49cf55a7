"""A reduced model, for queries at any parameter."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vibench.arrays import Array
from vibench.errors import RequestError, unknown_name
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.interfaces.parameters import ParameterBox
from vibench.interfaces.problem import Problem
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import contact_unknowns, output_weights
from vibench.model.certificates.bounds import OnlineBound, OnlineCertificate, OnlineCorrection, output_error_bound
from vibench.model.error_bounds import ErrorBounds, bound_errors_at
from vibench.model.galerkin import ReducedModel, ReducedProblem
from vibench.model.hyperreduced import HyperReducedModel
from vibench.offline.assemblies import assemblies
from vibench.offline.correction import Answer, Corrector
from vibench.offline.shown import about_model, about_solution, html
from vibench.plugins import registry
from vibench.plugins.kinds import SOLVER
from vibench.qp.settings import SETTINGS
from vibench.qp.solve import installed_solvers, solve_qp
from vibench.qp.status import Status
from vibench.qp.verification import Residuals, verify
from vibench.text import brief, normal_name
from vibench.timing import timed

if TYPE_CHECKING:
    import pandas as pd

Parameters = Sequence[float] | Array | Mapping[str, float]
"""A parameter mu: its components in the order of `ParameterBox.names`, or by these names."""

AnyReducedModel = ReducedModel | HyperReducedModel
"""A model that assembles the reduced program at a parameter."""


BLOCK = 256
"""Programs that `Model.solve_all` assembles at once."""

NO_TOLERANCE = "no tolerance"
"""The verdict on a solution for which no tolerance was given."""


@dataclass(frozen=True)
class Solution:
    """The solution of a reduced model at one parameter; the fields are those of a row of the queries table.

    Attributes
    ----------
    mu
        The parameter (d,).
    status, reason
        What verification says of the quadratic program's solution, and why it is not ok.
    x, alpha
        Coordinates of u in the primal basis (N',) and of λ on the generators (R,); `None` if the solver gave none.
    residuals
        Its relative KKT residuals, recomputed; `None` without x and α.
    assembly, solution
        CPU seconds of the assembly of the program, and of its solution.
    bound, tolerance
        Its error bounds at online cost where the cell is certified, and the relative error asked for; else `None`.
    correction
        What corrects it at online cost: `u`, `lam` and `bound` are of the corrected pair, x and α are not.
    mode
        Whether a correction was asked for. Without a certificate it is made when `u` or `lam` is, at high-fidelity
        cost.
    """

    mu: Array
    status: Status
    reason: str
    x: Array | None
    alpha: Array | None
    residuals: Residuals | None
    assembly: float
    solution: float
    _model: Model = field(repr=False)
    _reduced: ReducedProblem = field(repr=False)
    bound: OnlineBound | None = None
    tolerance: float | None = None
    correction: OnlineCorrection | None = None
    mode: CorrectionMode = CorrectionMode.NONE

    @property
    def verdict(self) -> str:
        """Whether the bound is within the tolerance: "certified" or "verified", as its guarantee, or "not certified".

        "no tolerance" where none was asked for. A solution that is not ok is not certified, however small its bound is.
        """
        if self.tolerance is None or self.bound is None:
            return NO_TOLERANCE
        kept = self.status is Status.OK and self.bound.relative <= self.tolerance
        return self.bound.guarantee.value if kept else "not certified"

    def _repr_html_(self) -> str:
        return html("solution", about_solution(self, self._model.parameters.names))

    @property
    def u(self) -> Array:
        """The primal solution u (n,)."""
        return self.answer.u

    @property
    def lam(self) -> Array:
        """The multiplier λ (m,)."""
        return self.answer.lam

    @cached_property
    def answer(self) -> Answer:
        """Both of these, whether they are a corrected pair, and why not."""
        certificate = self._model.certificate
        u = np.asarray(self._reduced.reconstruct(self._given(self.x)[:, None])[:, 0])
        lam = np.asarray(self._model.reduced.generators @ self._given(self.alpha))
        if certificate is None and self.mode is not CorrectionMode.NONE:
            return Corrector(self._model.reduced, None, self.mode).in_full(self.mu, u, lam)
        if certificate is None or self.correction is None:
            return Answer(u, lam, self.bound)
        v = certificate.corrected(u, self.correction, contact_unknowns(self._model.problem))
        return Answer(v, self.correction.nu, self.bound, is_corrected=True)

    @cached_property
    def outputs(self) -> dict[str, float]:
        """Values of the problem's quantities of interest, by name; of the corrected pair where `answer` is one."""
        given = self.mu[None], self.u[:, None], self.lam[:, None]
        return {output.name: float(output.values(*given)[0]) for output in self._model.problem.outputs}

    @property
    def output_bounds(self) -> dict[str, float]:
        """Bounds of the absolute errors of `outputs`, by name, from `bound`; infinite where there are none.

        There are none without `bound`, of outputs that are not linear, and of those of λ without a bound in W.
        """
        bound, certificate, found = self.bound, self._model.certificate, self._model.output_weights
        if bound is None or certificate is None:
            return dict.fromkeys(found, inf)
        return {
            name: inf if of is None else output_error_bound(of, certificate.base, bound) for name, of in found.items()
        }

    @cached_property
    def error_bounds(self) -> ErrorBounds:
        """Proved bounds on the errors of u and λ in four norms, at the cost of high-fidelity factorisations at mu."""
        kept = assemblies(self._model.problem)
        alpha, beta = kept.coercivity_at(self.mu), kept.energy_inf_sup_at(self.mu)
        return bound_errors_at(kept.at(self.mu), kept.energy_at(self.mu), alpha, beta, self.u, self.lam)

    def _given(self, vector: Array | None) -> Array:
        if vector is None:
            raise RequestError(f"there is no solution at mu = {self.mu.tolist()}: {self.status.value}: {self.reason}")
        return vector


class _Asked(NamedTuple):
    """Solver, accuracy, tolerance and corrections of a query."""

    solver: str
    accuracy: float
    tolerance: float | None
    mode: CorrectionMode


class Model:
    """A reduced model of a run or of a `Reduction`, which can be evaluated at any parameter.

    Attributes
    ----------
    reduced
        What assembles the reduced programs: `reduced.assemble(mu)` has `program` and `reconstruct`.
    problem
        The high-fidelity problem.
    solver, accuracy
        QP solver of queries where no other is asked for, and the relative accuracy that it has to reach.
    certificate
        What bounds errors at online cost; `None` where the model is not certified.
    row
        Its row of the cells table; empty for a model that belongs to no run.
    correction
        Which solutions are corrected where nothing else is asked for: as in its cell.
    """

    def __init__(
        self,
        reduced: AnyReducedModel,
        solver: str,
        accuracy: float,
        certificate: OnlineCertificate | None = None,
        row: Mapping[str, Any] = MappingProxyType({}),
        correction: CorrectionMode = CorrectionMode.NONE,
    ) -> None:
        self.reduced, self.solver, self.accuracy = reduced, solver, accuracy
        self.certificate, self.row, self.correction = certificate, row, correction
        self.problem: Problem = reduced.problem

    def __repr__(self) -> str:
        return f"Model({', '.join(f'{name}={value!r}' for name, value in about_model(self).items())})"

    def _repr_html_(self) -> str:
        return html("reduced model", about_model(self))

    @property
    def parameters(self) -> ParameterBox:
        """The parameter domain."""
        return self.problem.parameters

    def solve(
        self,
        mu: Parameters,
        solver: str | None = None,
        accuracy: float | None = None,
        tolerance: float | None = None,
        corrected: bool | None = None,
    ) -> Solution:
        """Assemble and solve the reduced program at a parameter, verify the solution, and bound its errors.

        Bounds need a model with `assembly = "certified"`.

        The solver runs in this process, without the limits of a study.

        Parameters
        ----------
        mu
            The parameter; outside the domain there is a warning, since the model was not trained there.
        solver, accuracy
            QP solver and the relative accuracy that it has to reach; those of the model by default.
        tolerance
            Largest relative error of u in the energy norm; `verdict` of the solution says if the bound is within it.
        corrected
            Whether `u` and `lam` of the solution are corrected: they satisfy the constraints, and are usually more
            accurate where the violation dominates the bound (`omega` > `rho`). A certificate does that at online cost;
            without one it takes factorisations at mu. Where there is no bound there is no correction either, as
            `solution.answer` says. By default as in the cell of the model.

        Raises
        ------
        RequestError
            If mu is not a parameter of the problem, the solver is not installed, the tolerance is not positive, or
            there is one and the model is not certified.
        """
        asked = self._asked(solver, accuracy, tolerance, corrected)
        at = self._parameter(mu)
        reduced, assembly = timed(lambda: self.reduced.assemble(at))
        return self._solution(at, reduced, assembly.cpu, asked)

    def _asked(
        self, solver: str | None, accuracy: float | None, tolerance: float | None, corrected: bool | None
    ) -> _Asked:
        """What `solve` is asked for, checked, with what the model has by default."""
        if tolerance is not None and not 0.0 < tolerance < inf:
            raise RequestError(f"the tolerance is {tolerance:g}, expected a positive finite number")
        if tolerance is not None and self.certificate is None:
            raise RequestError('the model has no error bounds: a tolerance needs one with assembly = "certified"')
        mode = self.correction if corrected is None else CorrectionMode("feasible" if corrected else "none")
        name, own = solver or self.solver, registry.registered(SOLVER)
        if name not in installed_solvers(own):
            if name in SETTINGS:
                raise RequestError(f"the QP solver '{name}' is not installed")
            raise unknown_name(SOLVER, name, {*SETTINGS, *own})
        return _Asked(name, self.accuracy if accuracy is None else accuracy, tolerance, mode)

    def _solution(self, at: Array, reduced: ReducedProblem, assembly: float, asked: _Asked) -> Solution:
        """The verified solution of a reduced program that took some seconds to assemble, with its bounds."""
        name, accuracy, mode = asked.solver, asked.accuracy, asked.mode
        solve = partial(solve_qp, reduced.program, name, accuracy, registry.qp_solver(name), reduced.factor)
        found, solution = timed(solve)
        status, reason, residuals = verify(reduced.program, found, accuracy)
        bound = correction = None
        if self.certificate is not None:
            bound = OnlineBound.none(f"the program has no solution: {reason}")
            if residuals is not None and found.x is not None and found.alpha is not None:
                given = self.problem, at, reduced, found.x, found.alpha
                bound, correction = self.certificate.certify(*given, mode)
                bound = bound if correction is None else correction.bound
        answer = at, status, reason, found.x, found.alpha, residuals
        return Solution(*answer, assembly, solution.cpu, self, reduced, bound, asked.tolerance, correction, mode)

    @cached_property
    def output_weights(self) -> dict[str, tuple[float, float] | None]:
        """Weights that bound errors of outputs by those of u and λ; `None` without any."""
        certificate, found = self.certificate, dict[str, tuple[float, float] | None]()
        for output in self.problem.outputs:
            known = None if certificate is None or not output.linear else certificate.base
            found[output.name] = None if known is None else output_weights(self.problem, known, output)
        return found

    def solve_all(
        self,
        mus: Sequence[Sequence[float]] | Array,
        solver: str | None = None,
        accuracy: float | None = None,
        tolerance: float | None = None,
        corrected: bool | None = None,
    ) -> pd.DataFrame:
        """A table of `solve` at parameters (P×d), a row for each: what a sample or an optimisation needs.

        Its columns are the parameters by name, status, reason and the worst residual; of a certified model the bounds
        and the verdict; `output:NAME` and with bounds `bound:NAME` of every quantity of interest; and CPU seconds.
        Reduced assembly evaluates the sums of terms of up to `BLOCK` programs at once, and each is said to have taken
        an equal share of the seconds; programs are solved one after the other.

        Raises
        ------
        RequestError
            As `solve`, or if the array has another shape.
        """
        import pandas as pd  # noqa: PLC0415  workers load models, and no tables

        given = np.asarray(mus, dtype=float)
        if given.ndim != 2:
            raise RequestError(f"the parameters have the shape {given.shape}, expected (P, {self.parameters.dim})")
        asked, names = self._asked(solver, accuracy, tolerance, corrected), self.parameters.names
        points = [self._parameter(mu) for mu in given]
        rows = []
        for start in range(0, len(points), BLOCK):
            block = points[start : start + BLOCK]
            if isinstance(self.reduced, HyperReducedModel):
                together, spent = timed(partial(self.reduced.assemble_all, np.array(block)))
                assembled = ((reduced, spent.cpu / len(block)) for reduced in together)
            else:
                timings = (timed(partial(self.reduced.assemble, at)) for at in block)
                assembled = ((reduced, spent.cpu) for reduced, spent in timings)
            for at, (reduced, seconds) in zip(block, assembled, strict=True):
                rows.append(about_solution(self._solution(at, reduced, seconds, asked), names))
        return pd.DataFrame(rows)

    def reconstruct(self, mu: Parameters, x: Array, alpha: Array) -> tuple[Array, Array]:
        """The solution u (n,), λ (m,) with coordinates x (N',) in the primal basis at mu and α (R,) on generators."""
        reduced = self.reduced.assemble(self._parameter(mu))
        sizes = {"x": (x, len(reduced.program.f)), "alpha": (alpha, self.reduced.generators.shape[1])}
        for name, (given, size) in sizes.items():
            if np.shape(given) != (size,) or np.asarray(given).dtype.kind not in "fiu":
                raise RequestError(f"{name} is {brief(repr(given), 80)}, expected {size} numbers")
        u = reduced.reconstruct(np.asarray(x)[:, None])[:, 0]
        return np.asarray(u), np.asarray(self.reduced.generators @ alpha)

    def high_fidelity(self, mu: Parameters) -> HighFidelitySolution:
        """The high-fidelity solution at a parameter, to compare with."""
        return self._high_fidelity.solve(self._parameter(mu))

    @cached_property
    def _high_fidelity(self) -> HighFidelitySolver:
        return HighFidelitySolver(self.problem)

    def _parameter(self, mu: Parameters) -> Array:
        """A parameter as an array (d,)."""
        return parameter_in(self.parameters, mu, stacklevel=4)


def parameter_in(box: ParameterBox, mu: Parameters, stacklevel: int = 3) -> Array:
    """A parameter as an array (d,); outside the box there is a warning of the caller so many calls above.

    Raises a `RequestError` if it is no parameter of the box.
    """
    if isinstance(mu, Mapping):
        names = [normal_name(name) for name in box.names]
        given = {normal_name(str(name)): value for name, value in mu.items()}
        if set(given) != set(names) or len(mu) != len(names):
            raise RequestError(f"mu has the components {sorted(map(str, mu))}, expected {sorted(box.names)}")
        mu = [given[name] for name in names]
    try:
        at = np.asarray(mu, dtype=float)
    except (TypeError, ValueError):
        raise RequestError(f"mu is {brief(repr(mu), 80)}, expected numbers ({', '.join(box.names)})") from None
    if at.ndim == 2:
        raise RequestError(f"mu has the shape {at.shape}: `solve_all` takes an array of parameters (P, {box.dim})")
    if at.shape != (box.dim,) or not np.all(np.isfinite(at)):
        raise RequestError(f"mu is {np.asarray(mu).tolist()}, expected finite numbers ({', '.join(box.names)})")
    if outside := [name for name, out in zip(box.names, box.outside(at), strict=True) if out]:
        warnings.warn(
            f"{', '.join(outside)}: outside the parameter domain, where the model was not trained",
            stacklevel=stacklevel,
        )
    return at
