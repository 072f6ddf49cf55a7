"""The interface of formulation plugins: the models that answer the queries of a study.

A formulation is everything between the offline phase and the answer: the mixed quadratic program of V_N and the reduced
cone, a penalty method, a regression, a model with local bases. The measurements of the answer are the same for all.

The life of a formulation in a study:

1. `Formulation.build` prepares it, offline and timed. Its result is stored under a key and shared by cells.
2. `Formulation.model` makes the model from the stored data, in every process that needs one; not timed.
3. `FormulationModel.solve` answers a query, timed: whatever it assembles is part of the query.
4. `FormulationModel.reconstruct` turns the answer into u (n,) and λ (m,). Its seconds are part of the query unless it
   is linear in the coefficients. Errors, error bounds and high-fidelity residuals are those of this pair.

Two capabilities are optional. With a `FormulationModel.program`, assembly and solution are timed apart, programs are
assembled once for all QP solvers, and solver and assembly errors are reported; `vibench.ProgramModel` has all of it.
With a `FormulationModel.certificate`, cells may ask for error bounds at online cost.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, ClassVar, Protocol, TypeAlias

from vibench.arrays import Array
from vibench.errors import RequestError
from vibench.interfaces.dual_sets import BlockKind
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.strategies import Enrichment, PrimalStrategy, ReducedSet, Stop
from vibench.signatures import Count, bordered
from vibench.text import shown

# The layers above define these classes; nothing here imports them.
AssemblingModel: TypeAlias = Any
"""A reduced model, whose `assemble(mu)` has the reduced `program`."""
Certificate: TypeAlias = Any
"""A certificate at online cost."""

AXES = ("pod", "dual", "primal", "solvers", "accuracy", "assembly")
"""The axes of a study that a formulation may have; it is not repeated over those that it does not have."""


@bordered
@dataclass(frozen=True)
class Snapshots:
    """High-fidelity solutions at some parameters.

    Attributes
    ----------
    mu
        Parameters (P×d).
    u, lam
        Columns u(mu) (n×P) and λ(mu) (m×P).
    skipped
        Reasons why other training parameters have no solution and are left out; each names its parameter.
    """

    mu: Annotated[Array, "P", "d"]
    u: Annotated[Array, "n", "P"]
    lam: Annotated[Array, "m", "P"]
    skipped: tuple[str, ...] = field(default=(), kw_only=True)


class _Steps(Protocol):
    # `dataclasses.replace` makes a phase with other inputs, whose steps are computed again.
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def problem(self) -> Problem: ...
    @property
    def modes(self) -> Stop | None: ...
    @property
    def accuracy(self) -> float: ...
    @property
    def assembly(self) -> str: ...
    @property
    def snapshots(self) -> Snapshots: ...
    @property
    def pod(self) -> Any: ...
    @property
    def cone(self) -> ReducedSet: ...
    @property
    def multipliers(self) -> Any: ...
    @property
    def enrichment(self) -> Enrichment: ...
    @property
    def members(self) -> Mapping[str, Any]: ...
    @property
    def operators(self) -> Any: ...
    @property
    def projection(self) -> AssemblingModel: ...
    @property
    def assembled(self) -> AssemblingModel: ...
    def given(self, **steps: Any) -> OfflinePhase: ...
    def enriched(self, primal: PrimalStrategy, tolerance: float | None) -> OfflinePhase: ...
    def certificate_of(self, reduced: AssemblingModel, answering: Any = None) -> Certificate: ...


class OfflinePhase(_Steps, Protocol):
    """The offline phase that a formulation is given, a `vibench.Reduction`: the attributes that formulations use."""


class Outcome(StrEnum):
    """Outcome of a query as the formulation itself reports it; the status of the row is never better."""

    OK = "ok"
    INACCURATE = "inaccurate"
    INFEASIBLE = "infeasible"
    FAILED = "failed"


class Multiplier(StrEnum):
    """Where the λ of an answer comes from; a column of the results."""

    SOLVED = "solved"
    """Its coefficients are among the unknowns of the query."""
    RECOVERED = "recovered"
    """The formulation computes it from u, in `solve` or in `reconstruct`, as a penalty method does."""
    RESIDUAL = "residual"
    """The formulation has none. vibench takes the λ ≥ 0 that minimises ‖f − A u − Bᵀλ‖ in the norm of A⁻¹, at
    high-fidelity cost and outside all seconds: of all multipliers it has the smallest residual beside u."""


@dataclass(frozen=True)
class FormulationAnswer:
    """The solution of a query by a formulation.

    Attributes
    ----------
    x
        Coefficients of u (N',), of whatever length at this parameter; `None` if there is no answer.
    alpha
        Coefficients of λ (R,), or `None` where u determines it. Their signs are free, those of λ (m,) are not.
    outcome, reason
        Whether its own iteration converged to the accuracy asked for, and why not.
    iterations
        Steps that it took, where it counts any.
    uncertainty
        Its own estimate of ‖u − u_N‖_V, where it makes one; shown beside the error and the proved bound.
    """

    x: Array | None
    alpha: Array | None = None
    outcome: Outcome = Outcome.OK
    reason: str = ""
    iterations: int | None = None
    uncertainty: float | None = None

    @classmethod
    def none(cls, reason: str, outcome: Outcome = Outcome.FAILED) -> FormulationAnswer:
        """No answer, and why."""
        return cls(None, None, outcome, reason)


class ProgramSolution(Protocol):
    """The solution of a quadratic program, as `vibench.QPSolution`."""

    @property
    def x(self) -> Array | None:
        """The unknowns (n,)."""

    @property
    def alpha(self) -> Array | None:
        """The multipliers (m,) ≥ 0."""

    @property
    def solver_status(self) -> str:
        """The status that the solver reports."""

    @property
    def iterations(self) -> int | None:
        """Its steps, where it counts any."""


class SolveQP(Protocol):
    """The QP solver of the cell."""

    def __call__(
        self, program: VariationalInequality, *, factor: Array | None = None, start: tuple[Array, Array] | None = None
    ) -> ProgramSolution:
        """The solution x (n,), α (m,) ≥ 0 of min ½xᵀA x − fᵀx, B x ≤ g, dense; either is `None` if it has found none.

        `factor` is the Cholesky factor (lower) of A where it is known, `start` a solution to start from where the
        solver can. The solution of the last program of a query is verified outside its seconds. The row of the query
        is not ok if its natural residuals exceed the accuracy, or if `x` and `alpha` of the answer are others.
        """


@dataclass(frozen=True)
class QuerySettings:
    """Settings of a query besides its parameter.

    Attributes
    ----------
    accuracy
        Relative accuracy to be reached: of a quadratic program the natural residuals of its KKT conditions.
        Formulations without the axis "accuracy" get 1e-7.
    solve_qp
        The QP solver of the cell, for formulations with the axis "solvers".
    start
        The answer at a neighbouring parameter to start from, if the formulation `takes_start` and the study asks for
        warm starts.
    """

    accuracy: float
    solve_qp: SolveQP
    start: FormulationAnswer | None = None


class FormulationModel(ABC):
    """A model of a formulation. It keeps no state from one query to the next.

    A query must not depend on those before it, and what is timed is repeated at parameters next to the queries' own.
    """

    dimension: Count
    """Largest number N' of coefficients of u in a query."""
    generators: Count | None = None
    """Largest number R of coefficients of λ in a query; `None` where λ has none."""
    enrichment: Count | None = None
    """How many of the coefficients of u are not of V_N, where it is not the enrichment of the offline phase."""
    fallbacks: tuple[str, ...] = ()
    """One line for every step that deviates from the algorithm."""
    reduced: AssemblingModel
    """The model that assembles `program`, of formulations that declare `has_program` or `has_certificate`."""

    @abstractmethod
    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:
        """The answer at mu (d,); its seconds are those of the query."""

    @abstractmethod
    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array | None]:
        """The pair u (n,) and λ (m,) ∈ K of an answer at mu (d,); bases may depend on the parameter.

        It is part of the query where half of the coefficients do not give half of the pair. Of the answer `x` and
        `alpha` alone are kept in results, and given here. λ is `None` for `Multiplier.RESIDUAL`, and for no other. A λ
        outside of K, as one with a negative coefficient, is an error, even one of round-off: every bound needs λ ∈ K.
        """

    def program(self, mu: Array) -> Any:
        """The quadratic program at mu (d,), for formulations that declare `has_program`; `alpha` is on `generators`.

        `x` and `alpha` of answers are its solution, against which they are verified.
        """
        return self.reduced.assemble(mu)

    def coordinates(self, mu: Array, answer: FormulationAnswer) -> tuple[Any, Array, Array]:
        """The problem of `reduced` at mu (d,) with the x and α of an answer, for certificates without a `program`.

        The pair of the answer is U = Z x and λ = χ α ∈ K.
        """
        raise NotImplementedError(f"{type(self).__name__} has a certificate, and no program or coordinates")

    def certificate(self, offline: OfflinePhase) -> Certificate:
        """The certificate of `reduced`, prepared offline and timed, for formulations that declare `has_certificate`.

        Raises an `UnsupportedError` if the problem or the assembly allows none.
        """
        return offline.certificate_of(self.reduced)


class Formulation(ABC):
    """Makes models of a problem from its offline phase. Constructor arguments are the plugin's options."""

    requires: ClassVar[tuple[str, ...]] = ()
    """Optional distributions it cannot do without; where one is not installed its cells are unavailable."""
    uses: ClassVar[tuple[str, ...]] = AXES
    """The `AXES` of a study that it has. Without "pod" there is no V_N, without "dual" no cone and without "primal" no
    enrichment in the offline phase; "primal" needs "pod" and "dual". Without "solvers" the cell has no QP solver,
    without "accuracy" the answer has none to reach, without "assembly" queries are assembled as `assembled` says."""
    multiplier: ClassVar[Multiplier] = Multiplier.SOLVED
    """Where λ comes from."""
    takes_start: ClassVar[bool] = False
    """Whether queries can start from the answer at a neighbouring parameter."""
    has_program: ClassVar[bool] = False
    """Whether its models have a `program`. If it has the axis "solvers", too, that is solved in place of `solve`."""
    has_certificate: ClassVar[bool] = False
    """Whether its models have a `certificate`: cells may then ask for bounds."""
    assembled: ClassVar[str] = "full"
    """Assembly of the offline phase where "assembly" is none of its axes: "full" or "reduced"."""
    blocks: ClassVar[tuple[BlockKind, ...]] = ()
    """Kinds of blocks besides rays that the dual set K of a problem may have."""
    is_default: ClassVar[bool] = False
    """Whether studies that name no formulation have this one, where no other default serves K with fewer `blocks`."""

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:  # noqa: ARG002
        """Data that the formulation adds to the offline phase, by default none; its seconds are recorded apart.

        Parameters
        ----------
        offline
            The offline phase: `problem`, `snapshots` (`mu` (P×d), `u` (n×P), `lam` (m×P)), and of the axes that the
            formulation has `pod`, `cone`, `enrichment` and the model `assembled`, whose `assemble(mu)` has the reduced
            `program`; with assembly = "reduced" `members`, A, f, B and g as sums of terms, and `operators`. Other
            spaces come from `replace(offline, …).given(snapshots=…)`.

        Returns
        -------
        What `model` needs and `offline` does not have, by name: numbers, texts, `None`, arrays, sparse matrices, the
        `pod`, `cone` and `enrichment` of another offline phase (without a supply), and tuples, lists and dictionaries
        of these. It is stored as arrays and JSON, so nothing else is taken, and must be the same whenever it is built.
        {} if there is nothing. Raises an `UnsupportedError` if the problem does not have what the formulation needs;
        its cells say so.
        """
        return {}

    @abstractmethod
    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        """The model, from the offline phase and from what `build` returned, which may have been stored in between.

        Steps of `offline` are read from where they are stored, and not computed again. Without a `build` of its own, a
        formulation that `has_program` is given spaces and reduced operators, but no snapshots.
        """


def axes_of(formulation: type[Formulation] | Formulation, title: str) -> tuple[str, ...]:
    """The axes that a formulation declares, in the order of `AXES`.

    Raises a `RequestError` if there is no such axis, or an enrichment without V_N and cone.
    """
    declared = formulation.uses
    if not isinstance(declared, tuple) or not all(one in AXES for one in declared):
        raise RequestError(f"the {title} declares uses = {shown(declared)}, expected a tuple of {', '.join(AXES)}")
    # An enrichment enriches V_N, for the generators of a cone.
    if "primal" in declared and not {"pod", "dual"} <= set(declared):
        raise RequestError(f"the {title} declares uses = {shown(declared)}: 'primal' needs 'pod' and 'dual'")
    return tuple(axis for axis in AXES if axis in declared)
