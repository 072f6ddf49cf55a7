"""Certificates at online cost: violations at random parameters, effectivities, and seconds beside those of a query.

Usage: python tests/benchmarks/certified.py RUN [COUNT [PROBLEM]] [--table FILE]

For every certified cell of a run, or of one problem of it: bounds at COUNT random parameters (10000 by default) that
the model has not seen, compared with high-fidelity solutions, which the models of a problem share. The same of the
corrected pairs, how many times more accurate λ is in W (at online cost, and at high-fidelity cost), and how often it is
at all, in the queries where ω > ρ and in the others. Every tenth query is timed, and corrected at high-fidelity cost.
`--table` also writes the numbers, without seconds, as CSV.

Usage: python tests/benchmarks/certified.py --meshes [COUNT]

What a certificate of a square membrane costs with N and with at least 4 N unknowns and the same contact unknowns, a
strip of nodes on its lower edge: the mesh grows away from it. Its members are declared affine: tension, load and depth
of the obstacle vary. COUNT parameters (200 by default), taken in turns; violations and effectivities, too.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
import scipy.sparse as sp

import vibench
from vibench import AffineProblem, Array, InnerProduct, ParameterBox
from vibench.execution.recorded_cell import recorded_cells
from vibench.highfidelity.active_set import HighFidelitySolution, HighFidelitySolver
from vibench.interfaces.strategies import Enrichment, Kind
from vibench.model.affine import affine_decomposition
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import Guarantee, certificate_base
from vibench.model.certificates.bounds import OnlineCertificate, prepare
from vibench.model.galerkin import ReducedModel
from vibench.model.hyperreduced import HyperReducedModel, hyper_reduce
from vibench.offline.assemblies import Assemblies
from vibench.offline.correction import Answer, Corrector
from vibench.offline.models import Model
from vibench.plugins.plugin import Plugin
from vibench.qp.solve import solve_qp
from vibench.stages.assessment import is_violated

SEED = 2027

REPORTED = 1000
"""Parameters between two reports."""

EVERY = 10
"""Parameters between two that are timed, and corrected at high-fidelity cost, too: what a query does is done again."""


@dataclass
class Tally:
    """What the queries of one certified model gave so far.

    Attributes
    ----------
    row, model, certificate
        Of the cell.
    parameters, violations, without
        All parameters, those with an error above its bound, and those without a bound.
    effectivities, seconds
        Of u and λ by parameter, and of the query, its certificate, and that with the correction, by timed parameter.
    gains
        Errors of λ in W over those of the pairs corrected at online and at high-fidelity cost, and whether ω > ρ.
    """

    row: Mapping[str, Any]
    model: Model
    certificate: OnlineCertificate
    parameters: int = 0
    violations: int = 0
    without: int = 0
    effectivities: list[tuple[float, float]] = field(default_factory=list)
    seconds: list[tuple[float, float, float]] = field(default_factory=list)
    gains: dict[str, list[tuple[float, bool]]] = field(default_factory=lambda: {"online": [], "in full": []})

    def answers(self, mu: Array) -> Iterator[tuple[str, Answer]]:
        """The reduced solution at mu (d,) and its corrected pairs, each with its bounds where it has any."""
        solution, self.parameters = self.model.solve(mu, corrected=False), self.parameters + 1
        bound = solution.bound
        if bound is None or bound.guarantee is Guarantee.NONE or solution.x is None or solution.alpha is None:
            self.without += 1
            return
        own = solution.x, solution.alpha, solution.u, solution.lam
        yield "reduced", Answer(solution.u, solution.lam, bound)
        yield "online", Corrector(self.model.reduced, self.certificate, CorrectionMode.FEASIBLE).answer(mu, *own)
        if self.parameters % EVERY == 1:
            self.time(mu, solution.x, solution.alpha, solution.solution)
            yield "in full", Corrector(self.model.reduced, None, CorrectionMode.FEASIBLE).answer(mu, *own)

    def judge(self, answers: Mapping[str, Answer], errors: Mapping[str, Array], sizes: Array) -> None:
        """Compare errors (3,) of u in the energy norm and of λ in the natural norm and in W with bounds."""
        for which, answer in answers.items():
            if (bound := answer.bound) is not None:
                above = zip(errors[which], (bound.u_energy, bound.lambda_natural, bound.lam), sizes, strict=True)
                self.violations += any(is_violated(error, limit, size) for error, limit, size in above)
        if (bound := answers["reduced"].bound) is not None:
            self.effectivities.append(
                (bound.u_energy / errors["reduced"][0], bound.lambda_natural / errors["reduced"][1])
            )
            for which in answers.keys() - {"reduced"}:
                if answers[which].is_corrected:
                    gain = errors["reduced"][2] / errors[which][2]
                    self.gains[which].append((gain, bound.omega > bound.rho))

    def time(self, mu: Array, x: Array, alpha: Array, solved: float) -> None:
        """Seconds of the assembly and the solution, of which `solved` are known, and of the certificate, at mu (d,)."""
        start = time.process_time_ns()
        reduced = self.model.reduced.assemble(mu)
        middle = time.process_time_ns()
        self.certificate.evaluate(self.model.problem, mu, reduced, x, alpha)
        end = time.process_time_ns()
        self.certificate.certify(self.model.problem, mu, reduced, x, alpha)
        corrected = time.process_time_ns()
        self.seconds.append((1e-9 * (middle - start) + solved, 1e-9 * (end - middle), 1e-9 * (corrected - end)))

    def __str__(self) -> str:
        """One line."""
        of_u, of_lam = np.median(self.effectivities, axis=0)
        query, certify, correct = 1e3 * np.median(self.seconds, axis=0)
        least = np.min(self.effectivities, axis=0)
        training, primal, size = (self.row[name] for name in ("training", "primal", "snapshots"))
        return (
            f"{self.row['problem']}, {size} solutions ({training}), {primal}, {self.row['cell']}, "
            f"{self.certificate.base.guarantee.value}: {self.parameters} parameters, "
            f"{self.violations} violations, {self.without} without a bound; effectivity of u {of_u:.2f} (least "
            f"{least[0]:.4f}), of λ {of_lam:.2f} (least {least[1]:.4f}); query {query:.2f} ms, certificate "
            f"{certify:.2f} ms, with correction {correct:.2f} ms{self.corrected}"
        )

    @property
    def corrected(self) -> str:
        """How much more accurate corrected pairs are."""
        return "".join(
            f"\n    corrected {which}, {name}: {len(divided)} queries, error of λ in W divided by "
            f"{np.median(divided):.2f} (median), smaller in {100.0 * np.mean(divided > 1.0):.1f} %"
            for which, name, divided in self._divided()
        )

    def _divided(self) -> Iterator[tuple[str, str, Array]]:
        """Factors by which corrections at some cost divide the error of λ in W, where ω > ρ and where not."""
        for which, of_all in self.gains.items():
            gains = np.array(of_all).reshape(-1, 2)
            for name, chosen in (("ω > ρ", gains[:, 1] == 1.0), ("ω ≤ ρ", gains[:, 1] == 0.0)):
                if chosen.any():
                    yield which, name, gains[chosen, 0]

    def numbers(self) -> dict[str, Any]:
        """One row of a table: what does not depend on the machine."""
        quantiles = {"least": 0.0, "median": 0.5, "largest": 1.0}
        named = ("problem", "training", "dual", "primal", "primal_tol", "pod_tol", "dual_tol", "snapshots")
        return {
            **{name: self.row[name] for name in named},
            "certificate": self.certificate.base.guarantee.value,
            **{"parameters": self.parameters, "violations": self.violations, "without a bound": self.without},
            **{
                f"{name} effectivity of {vector}": float(np.quantile(values, level))
                for vector, values in zip("uλ", np.array(self.effectivities).reshape(-1, 2).T, strict=True)
                for name, level in quantiles.items()
            },
            **{
                f"{what}, corrected {which}, {name}": value
                for which, name, divided in self._divided()
                for what, value in (
                    ("queries", len(divided)),
                    ("error of λ divided by (median)", float(np.median(divided))),
                    ("smaller in", float(np.mean(divided > 1.0))),
                )
            },
        }


def compare(tallies: list[Tally], kept: Assemblies, mu: Array, exact: HighFidelitySolution) -> None:
    """Compare all answers at mu (d,) with the high-fidelity solution; one factorisation serves all errors."""
    answers = [dict(tally.answers(mu)) for tally in tallies]
    every = [answer for of_model in answers for answer in of_model.values()]
    vi, energy = kept.at(mu), kept.energy_at(mu)
    u = np.column_stack([exact.u, *(exact.u - answer.u for answer in every)])
    lam = np.column_stack([exact.lam, *(exact.lam - answer.lam for answer in every)])
    forces = vi.B.T @ lam
    squares = np.sum(u * (vi.A @ u), axis=0), np.sum(forces * energy.factor.solve(forces), axis=0)
    norms = np.vstack([np.sqrt(np.maximum(squares, 0.0)), tallies[0].model.problem.W.norm(lam)])
    columns = iter(norms.T[1:])
    for tally, of_model in zip(tallies, answers, strict=True):
        if of_model:
            tally.judge(of_model, {which: next(columns) for which in of_model}, norms[:, 0])


def main(run: str, count: int, only: str = "", table: str | None = None) -> int:
    """Print one line per certified cell, every thousand parameters; the number of cells with a violation.

    Models of one problem are compared with the same high-fidelity solutions. At the end a table is written, if asked.
    """
    models: dict[Plugin, list[Tally]] = {}
    opened = vibench.open_run(run)
    for recorded in recorded_cells(run):
        if only not in ("", recorded.row["problem"]):
            continue
        certificate = recorded.certificate
        if certificate is not None and recorded.row["correction"] == CorrectionMode.NONE:  # the model is the same
            tally = Tally(recorded.row, opened.model(recorded.row["cell"]), certificate)
            models.setdefault(recorded.cell.problem, []).append(tally)
    for tallies in models.values():
        problem = tallies[0].model.problem
        solver, kept = HighFidelitySolver(problem), Assemblies(problem)
        for k, mu in enumerate(problem.parameters.sample(count, SEED), 1):
            exact = solver.solve(mu)
            compare(tallies, kept, mu, exact)
            if k % REPORTED == 0 or k == count:
                print(*tallies, sep="\n", flush=True)
    every = [tally for tallies in models.values() for tally in tallies]
    if table is not None:
        pd.DataFrame([tally.numbers() for tally in every]).to_csv(table, index=False, float_format="%.6g")
    return sum(tally.violations > 0 for tally in every)


class Membrane(AffineProblem):
    """A membrane whose edge lies on a line of nodes above an obstacle; all members are exactly affine.

    Parameters
    ----------
    rows
        Rows of nodes above the line.
    """

    parameters = ParameterBox(
        ("tension", "load", "depth"), np.array([0.5, 2.0, 0.01]), np.array([2.0, 4.0, 0.03]), ("1", "1", "1")
    )

    def __init__(self, rows: int) -> None:
        width = 160
        across = sp.diags_array(
            [np.full(width - 1, -1.0), np.full(width, 2.0), np.full(width - 1, -1.0)], offsets=[-1, 0, 1]
        )
        below = np.full(rows, 2.0)
        below[0] = 1.0  # the free edge
        up = sp.diags_array([np.full(rows - 1, -1.0), below, np.full(rows - 1, -1.0)], offsets=[-1, 0, 1])
        h, dy = 1.0 / (width + 1), 1.0 / rows
        share = np.ones(rows)
        share[0] = 0.5
        x = sp.kron(sp.diags_array(share), across) * (dy / h)
        y = sp.kron(up, sp.eye_array(width)) * (h / dy)
        soft = np.tile(np.arange(1, width + 1) * h < 0.5, rows).astype(float)
        stiff = sp.csr_array(x + y)
        left = sp.csr_array(sp.diags_array(soft) @ stiff @ sp.diags_array(soft))
        n = width * rows
        self.V, self.W = InnerProduct(sp.csc_array(stiff)), InnerProduct(sp.eye_array(width, format="csc") * h)
        B = sp.csr_array((np.full(width, -h), (np.arange(width), np.arange(width))), shape=(width, n))
        at = np.arange(1, width + 1) * h
        self.declare(
            A=[(1.0, stiff), ("tension", left)],
            f=[("load", -np.repeat(share, width) * h * dy)],
            B=B,
            g=[("depth", np.full(width, h)), (1.0, 0.05 * h * (at - 0.5) ** 2)],
        )

    def training_set(self) -> np.ndarray:
        """The 4×4×3 grid."""
        return self.parameters.grid(4, 4, 3)


def reduced_membrane(rows: int) -> tuple[Membrane, HyperReducedModel, OnlineCertificate]:
    """A membrane, its model with 12 snapshots of displacements and multipliers, and its certificate."""
    problem = Membrane(rows)
    training = problem.training_set()
    members = affine_decomposition(problem, training, 1e-8)
    solved = [solve_membrane(problem, mu) for mu in training[::4]]
    chi = np.column_stack([lam / np.linalg.norm(lam) for _, lam in solved if np.any(lam)])
    supremizers = problem.V.riesz(np.asarray(problem.assemble(training[0]).B.T @ chi))
    basis = problem.V.orthonormalise(np.column_stack([*(u for u, _ in solved), supremizers]))
    model = ReducedModel(problem, basis, Enrichment(Kind.NONE), chi, np.linalg.qr(chi)[0])
    reduced = HyperReducedModel(model, hyper_reduce(model, members))
    return problem, reduced, prepare(reduced, members, certificate_base(problem, members, training), training)


def solve_membrane(problem: Membrane, mu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The high-fidelity solution."""
    found = HighFidelitySolver(problem).solve(mu)
    return found.u, found.lam


def meshes(count: int) -> int:
    """Print seconds and violations of two meshes, and the ratio; the number of violations."""
    found = [reduced_membrane(rows) for rows in (30, 120)]
    mus, violations, effectivities = Membrane.parameters.sample(count, SEED), 0, []
    seconds = np.zeros((2, 3, count))
    for at, mu in enumerate(mus):
        for which, (problem, model, certificate) in enumerate(found):
            times = [time.perf_counter_ns()]
            reduced = model.assemble(mu)
            answer = solve_qp(reduced.program, "piqp", 1e-10, factor=reduced.factor)
            times.append(time.perf_counter_ns())
            alpha = np.maximum(answer.alpha, 0.0)
            bounds = []
            for _ in range(2):  # the second one finds its arrays in the caches, of either mesh
                bounds.append(certificate.evaluate(problem, mu, reduced, answer.x, alpha))
                times.append(time.perf_counter_ns())
            seconds[which, :, at] = 1e-6 * np.diff(times)
            if which or at % 10:
                continue
            u, lam = solve_membrane(problem, mu)
            vi = problem.assemble(mu)
            energy = InnerProduct(vi.A)
            errors = (
                energy.norm(u - reduced.reconstruct(answer.x[:, None])[:, 0]),
                float(np.linalg.norm(energy.whiten_functional(vi.B.T @ (lam - model.generators @ alpha)))),
            )
            limits = bounds[0].u_energy, bounds[0].lambda_natural
            size = energy.norm(u)
            violations += any(is_violated(e, b, size) for e, b in zip(errors, limits, strict=True))
            effectivities.append([b / e for e, b in zip(errors, limits, strict=True)])
    query, first, again = np.median(seconds, axis=2).T
    sizes = [problem.V.dim for problem, *_ in found]
    guarantee = found[0][2].base.guarantee.value
    print(
        f"membrane {guarantee}, {sizes[0]} and {sizes[1]} unknowns, {len(found[0][2].contact_basis)} on the contact: "
        f"query {query[0]:.3f} and {query[1]:.3f} ms, certificate {first[0]:.3f} and {first[1]:.3f} ms, ratio "
        f"{first[1] / first[0]:.3f} (repeated at once {again[1] / again[0]:.3f}); {violations} violations of "
        f"{len(effectivities)}, effectivities {np.median(effectivities, axis=0).round(2).tolist()}"
    )
    return violations


def asked() -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", nargs="?")
    parser.add_argument("count", nargs="?", type=int, default=10_000)
    parser.add_argument("problem", nargs="?", default="")
    parser.add_argument("--table")
    parser.add_argument("--meshes", nargs="?", type=int, const=200)
    given = parser.parse_args()
    if (given.run is None) == (given.meshes is None):
        parser.error("either a run or --meshes is needed")
    return given


if __name__ == "__main__":
    given = asked()
    if given.meshes is not None:
        sys.exit(meshes(given.meshes))
    sys.exit(main(given.run, given.count, given.problem, given.table))
