"""The offline phase as an object: snapshots ▸ POD, cone ▸ enrichment ▸ reduced model ▸ certificate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal, TypeAlias, get_type_hints

import numpy as np

from vibench.arrays import Array
from vibench.errors import NumericalError, RequestError, UnsupportedError, message_of, unknown_name
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.interfaces import strategies, validation
from vibench.interfaces.dual_sets import refuse_blocks
from vibench.interfaces.formulations import Formulation, FormulationModel, QuerySettings, Snapshots, axes_of
from vibench.interfaces.problem import Problem
from vibench.interfaces.strategies import AdaptiveSampling, DualStrategy, PrimalStrategy, ReducedSet, Sampling, Stop
from vibench.linalg.inner_product import check_symmetric
from vibench.model import hyperreduced
from vibench.model.affine import INTERPOLATION_RTOL, AffineMember, affine_decomposition
from vibench.model.certificates.base import CertificateBase, certificate_base
from vibench.model.certificates.bounds import OnlineCertificate, prepare
from vibench.model.certificates.greedy import GreedyTrainer
from vibench.model.galerkin import ReducedModel
from vibench.model.hyperreduced import AnyReducedModel, HyperReducedModel, ReducedOperators
from vibench.offline.models import CellSolver, Model, check_built
from vibench.plugins import registry
from vibench.plugins.kinds import PluginKind
from vibench.reduction.pod import POD, pod
from vibench.signatures import Share, bordered, refuse_others, rule_of
from vibench.stability.infsup import ConeBasis, cone_basis

Assembly: TypeAlias = Literal["full", "reduced"]  # of the programs, as in a study


def high_fidelity_sweep(
    problem: Problem, mus: Array, *, skip: bool = False, reference: validation.ReferenceAssembly | None = None
) -> Snapshots:
    """High-fidelity solutions at parameters (P×d); `skip` leaves out those without one, as many as may be skipped.

    With a `reference`, a `NumericalError` names the first declaration that is not what is assembled.
    """
    solver, solutions, skipped, solved = HighFidelitySolver(problem), [], [], np.zeros(len(mus), bool)
    for k, mu in enumerate(mus):
        try:
            vi = validation.checked_assembly(problem, mu)
            solutions.append(solver.solve_next(mu, vi))
        except NumericalError as error:
            if not skip:
                raise
            skipped.append(message_of(error))
            continue
        solved[k] = True
        if reference is not None:
            reference.refuse_false_declarations(mu, vi)
    check_skipped(skipped, len(solutions))
    u, lam = (np.column_stack([getattr(s, name) for s in solutions]) for name in ("u", "lam"))
    return Snapshots(mus[solved], u, lam, skipped=tuple(skipped))


def check_skipped(skipped: Sequence[str], solved: int) -> None:
    """Raise a `NumericalError` if more training parameters were skipped than a training set can lack."""
    # With more failures it is the problem that fails, and the rest of the set trains for another box.
    limit = max(1, (solved + len(skipped)) // 10)
    if skipped and (len(skipped) > limit or not solved):
        count = f"{len(skipped)} of {solved + len(skipped)} training parameters have no solution"
        raise NumericalError(f"{count}, at most {limit} may be skipped; the first one: {skipped[0]}")


@bordered
@dataclass(frozen=True, eq=False)
class Reduction:
    """The offline phase for one problem and one pair of strategies; every step is computed when it is first asked for.

    The steps are the attributes `snapshots`, `pod`, `cone`, `enrichment`, `model` and, for certified models,
    `certificate`; what a strategy returns is checked. `given` makes a reduction that takes some steps over.

    Attributes
    ----------
    problem
        The high-fidelity problem.
    dual, primal
        The strategies that make the cone and enrich V_N; with `None` the cone is empty, or nothing is added.
    modes, generators
        Where V_N and the cone stop, at a tolerance or at a size; `None` where there is no V_N or no dual strategy.
    tolerance
        Of the primal strategy, where it takes one.
    training
        A sampling strategy in place of the problem's own training set.
    assembly, interpolation
        "full" or "reduced" as in a study, and the tolerance of empirical interpolation of the latter.
    solver, accuracy
        QP solver of the model's queries, and the relative accuracy that it has to reach.
    formulation
        The formulation of the model, by default that of studies which name none.
    bounds
        Whether the model has error bounds at online cost; that needs reduced assembly.
    on_failure
        What a training parameter without a solution does: "stop", or "skip", which leaves out a tenth of them at most;
        `snapshots.skipped` says why. An adaptive sampling strategy skips none.

    Raises
    ------
    RequestError
        If a class is given in place of an instance, or a primal strategy misses its tolerance or has none.
    """

    problem: Problem
    dual: DualStrategy | None
    primal: PrimalStrategy | None
    modes: Stop | None
    generators: Stop | None
    tolerance: float | None = None
    training: Sampling | None = None
    assembly: Assembly = "full"
    interpolation: Share = INTERPOLATION_RTOL
    solver: str = "daqp"
    accuracy: Share = 1e-9
    formulation: Formulation | None = None
    bounds: bool = False
    on_failure: Literal["stop", "skip"] = "stop"

    def __post_init__(self) -> None:
        for name, by in (("modes", self.primal), ("generators", self.dual)):
            if getattr(self, name) is None and by is not None:
                raise RequestError(f"{name} of Reduction is None, expected a Stop: Stop(tolerance=…) or Stop(size=…)")
        takes = self.primal is not None and self.primal.takes_tolerance
        if takes == (self.tolerance is None):
            of_one = f"{type(self.primal).__qualname__} {'needs a' if takes else 'takes no'} tolerance"
            raise RequestError("without a primal strategy there is no tolerance" if self.primal is None else of_one)

    def given(self, **steps: Any) -> Reduction:
        """A reduction with the same inputs and these steps prescribed, by the names of the attributes.

        Steps that were given before are kept; computed ones are computed again, since they may depend on the new.
        """
        for name, step in steps.items():
            if not isinstance(own := getattr(Reduction, name, None), cached_property):
                known = (k for k, value in vars(Reduction).items() if isinstance(value, cached_property))
                raise unknown_name("step of a Reduction", name, known)
            hint = get_type_hints(own.func, include_extras=True)["return"]
            refuse_others(f"{name} of Reduction.given", step, rule_of(hint))
        other, kept = replace(self), self.__dict__.get("_given", {}) | steps
        # Cached properties look at the attributes of the instance first, so that these steps are never computed.
        other.__dict__.update(kept, _given=kept)
        return other

    def enriched(self, primal: PrimalStrategy, tolerance: float | None) -> Reduction:
        """The reduction with the same V_N and cone, and the enrichment of another primal strategy."""
        known = {name: getattr(self, name) for name in ("snapshots", "pod", "cone", "multipliers")}
        return replace(self, primal=primal, tolerance=tolerance).given(**known)

    @cached_property
    def snapshots(self) -> Snapshots:
        """High-fidelity solutions at the training parameters; an adaptive sampling strategy chooses these itself."""
        reference = validation.ReferenceAssembly(self.problem)
        if not isinstance(self.training, AdaptiveSampling):
            mus = validation.training_parameters(self.problem, self.training)
            swept = high_fidelity_sweep(self.problem, mus, skip=self.on_failure == "skip", reference=reference)
            # Bounds rest on declarations at any parameter.
            reference.refuse_at_random(16 if self.bounds else 0, 1)
            return swept
        trainer = GreedyTrainer(self.problem, reference)
        self.training.train(self.problem.parameters, trainer)
        mus, solutions = np.array([s.mu for s in trainer.solved]), [s.solution for s in trainer.solved]
        return Snapshots(mus, np.column_stack([s.u for s in solutions]), np.column_stack([s.lam for s in solutions]))

    @cached_property
    def parameters(self) -> Array:
        """The training parameters (P×d): those of the snapshots, where these are known, or it depends on solutions."""
        if "snapshots" in self.__dict__ or isinstance(self.training, AdaptiveSampling) or self.on_failure == "skip":
            return self.snapshots.mu
        return validation.training_parameters(self.problem, self.training)

    @cached_property
    def pod(self) -> POD:
        """V_N, and the error of the POD for every number of modes (paper, (10) and (11)); needs `modes`."""
        if self.modes is None:
            raise RequestError("the offline phase has no V_N: modes is None")
        return pod(self.snapshots.u, self.problem.V, self.modes)

    @cached_property
    def cone(self) -> ReducedSet:
        """The reduced cone K_R (paper, (12))."""
        W, K = self.problem.W, self.problem.K
        if self.dual is None or self.generators is None:
            return ReducedSet(np.zeros((W.dim, 0)), np.ones(1), strategies.no_free(0))
        refuse_blocks(K, self.dual.blocks, type(self.dual).__qualname__)
        return validation.check_cone(self.dual.reduce(self.snapshots.lam, W, self.generators), W, K)

    @cached_property
    def multipliers(self) -> ConeBasis:
        """The generators of the cone with their span and Gram matrix, for inf-sup constants."""
        return cone_basis(self.cone.generators, self.problem.W, self.cone.free)

    @cached_property
    def offline(self) -> strategies.Offline:
        """The input of the primal strategy."""
        return strategies.Offline(self.problem, self.pod.basis, self.cone, self.multipliers.span, self.parameters)

    @cached_property
    def enrichment(self) -> strategies.Enrichment:
        """The vectors that the primal strategy adds to V_N."""
        if self.primal is None:
            return strategies.Enrichment(strategies.Kind.NONE)
        built = self.primal.build(self.offline, self.tolerance)
        return validation.check_enrichment(built, self.problem.V, self.pod.basis)

    @cached_property
    def projection(self) -> ReducedModel:
        """The Galerkin projection on the reduced spaces, assembled in full."""
        return ReducedModel(self.problem, self.pod.basis, self.enrichment, self.cone.rays, self.multipliers.span)

    @cached_property
    def members(self) -> Mapping[str, AffineMember]:
        """A, f, B and g as sums of terms that do not depend on the parameter, or samples of them."""
        return affine_decomposition(self.problem, self.decomposed, self.interpolation)

    @cached_property
    def decomposed(self) -> Array:
        """Parameters (P×d) of the decomposition: the problem's own where training is adaptive, with few parameters."""
        is_adaptive = isinstance(self.training, AdaptiveSampling)
        return validation.training_parameters(self.problem) if is_adaptive else self.parameters

    @cached_property
    def operators(self) -> ReducedOperators | str:
        """The members projected on the reduced spaces, or why queries are assembled in full."""
        why = hyperreduced.reason_for_full_assembly(self.projection, self.members)
        return why or hyperreduced.hyper_reduce(self.projection, self.members)

    @cached_property
    def assembled(self) -> AnyReducedModel:
        """The model that assembles the programs of queries, in full where that is asked for or nothing else works."""
        # Do not compute reduced operators for a full assembly: they are costly.
        if self.assembly == "full" or isinstance(self.operators, str):
            return self.projection
        return HyperReducedModel(self.projection, self.operators)

    @cached_property
    def certificate_base(self) -> CertificateBase:
        """Offline data shared by the certificates of all reduced models of the problem."""
        return certificate_base(self.problem, self.members, self.decomposed)

    def certificate_of(self, reduced: AnyReducedModel, answering: FormulationModel | None = None) -> OnlineCertificate:
        """The certificate of a reduced model (`docs/tolerances.md`); an `UnsupportedError` where none is possible.

        `answering` is the model whose answers it bounds, where they are no solutions of programs.
        """
        if not isinstance(reduced, HyperReducedModel):
            why = "as asked for" if self.assembly == "full" else self.operators
            needed = "a certificate at online cost needs reduced assembly"
            raise UnsupportedError(f"{needed}, and the model is assembled in full: {why}")
        solve = None if answering is None else partial(_answer_in_coordinates, answering)
        return prepare(reduced, self.members, self.certificate_base, self.decomposed, solve)

    @cached_property
    def model(self) -> Model:
        """The model of the formulation, which is built now: `model.solve(mu)` answers queries at any parameter.

        Raises a `RequestError` if the formulation uses steps that the offline phase does not have, or bounds are asked
        for and it has no certificate, an `UnsupportedError` if the problem does not have what it needs, and a
        `NumericalError` if A is not symmetric.
        """
        # Solutions of this phase would show an A that is not symmetric; projections are symmetrised, and hide it.
        if "snapshots" not in self.__dict__ or "snapshots" in self.__dict__.get("_given", {}):
            mus = self.parameters
            for mu in mus[:1] if "A" in self.problem.constant else mus[[0, len(mus) // 2, -1]]:
                check_symmetric(validation.checked_assembly(self.problem, mu).A, f"A at mu = {mu.tolist()}")
        formulation = self.formulation
        # The default is found by its declaration: the core knows no formulation by name.
        if formulation is None:
            name = registry.default_of(PluginKind.FORMULATION, self.problem.K.kinds)
            formulation = registry.find(PluginKind.FORMULATION, name).create({})
        name = type(formulation).__qualname__
        uses = axes_of(formulation, f"formulation {name}")
        for axis, step, what in (("pod", self.modes, "modes"), ("dual", self.dual, "a dual strategy")):
            if axis in uses and step is None:
                raise RequestError(f"{name} uses '{axis}': the offline phase needs {what}")
        built = check_built(formulation.build(self))
        made = Model(formulation, self, built, self.solver if "solvers" in uses else None, self.accuracy)
        if not self.bounds:
            return made
        if not formulation.has_certificate:
            raise RequestError(f"{name} has no certificate: no bounds at online cost")
        return replace(made, certificate=made.online.certificate(self))

    @cached_property
    def certificate(self) -> OnlineCertificate:
        """The certificate of the reduced model of this phase; raises an `UnsupportedError` as `certificate_of`."""
        return self.certificate_of(self.assembled)

    def with_formulation(self, formulation: Formulation) -> Reduction:
        """The same phase with another formulation: `with_formulation(…).model`; all steps of this one are kept."""
        # The model belongs to the formulation that is replaced; all other steps are independent of it.
        names = {name for name, value in vars(Reduction).items() if isinstance(value, cached_property)} - {"model"}
        steps = {name: value for name, value in self.__dict__.items() if name in names}
        return replace(self, formulation=formulation).given(**self.__dict__.get("_given", {}) | steps)


def _answer_in_coordinates(model: FormulationModel, mu: Array) -> tuple[Any, Array, Array] | None:
    """The reduced problem at mu (d,) with the x and α of the answer of a model; `None` without one."""
    answer = model.solve(mu, QuerySettings(1e-8, CellSolver("daqp", 1e-8)))
    return None if answer.x is None or not np.isfinite(answer.x).all() else model.coordinates(mu, answer)
