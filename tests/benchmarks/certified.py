"""Certificates at online cost: violations at random parameters, effectivities, and seconds beside those of a query.

Usage: python tests/benchmarks/certified.py RUN [COUNT [PROBLEM]] [--table FILE]

For every certified cell of a run, or of one problem of it: bounds at COUNT random parameters (10000 by default) that
the model has not seen, compared with high-fidelity solutions, which the models of a problem share. The same of the
corrected pairs, how many times more accurate λ is in W (at online cost, and at high-fidelity cost), and how often it is
at all, in the queries where ω > ρ and in the others. Every tenth query is timed, and corrected at high-fidelity cost.
`--table` also writes the numbers, without seconds, as CSV.
"""

import argparse
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

import vibench
from vibench import Array, HighFidelitySolution, HighFidelitySolver, Model
from vibench.execution.recorded_cell import recorded_cells
from vibench.model.bound_terms import CorrectionMode
from vibench.model.certificates.base import Guarantee
from vibench.model.certificates.bounds import OnlineCertificate
from vibench.offline.assemblies import Assemblies
from vibench.offline.solution import Answer, Corrector
from vibench.plugins.plugin import Plugin
from vibench.stages.assessment import is_violated


@dataclass
class Tally:
    """Results of the queries of one certified model so far."""

    row: Mapping[str, Any]
    model: Model
    certificate: OnlineCertificate
    parameters: int = 0
    violations: int = 0  # parameters with an error above its bound
    without: int = 0  # parameters without a bound
    # of u and λ by parameter; seconds of the query, its certificate, and that with the correction, by timed parameter
    effectivities: list[tuple[float, float]] = field(default_factory=list)
    seconds: list[tuple[float, float, float]] = field(default_factory=list)
    # errors of λ in W over those of the pairs corrected at online and at high-fidelity cost, and whether ω > ρ
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
        if self.parameters % 10 == 1:  # also corrected at high-fidelity cost: what a query does is done again
            self.time(mu, solution.x, solution.alpha, solution.solution)
            yield "in full", Corrector(self.model.reduced, None, CorrectionMode.FEASIBLE).answer(mu, *own)

    def judge(self, answers: Mapping[str, Answer], errors: Mapping[str, Array], sizes: Array) -> None:
        """Compare errors (3,) of u in the energy norm and of λ in the natural norm and in W with bounds."""
        for which, answer in answers.items():
            if (bound := answer.bound) is not None:
                above = zip(errors[which], (bound.u_energy, bound.lambda_natural, bound.lam), sizes, strict=True)
                self.violations += any(is_violated(error, limit, size) for error, limit, size in above)
        if (bound := answers["reduced"].bound) is not None:
            of_u, of_lam, _ = errors["reduced"]
            self.effectivities.append((bound.u_energy / of_u, bound.lambda_natural / of_lam))
            for which in answers.keys() - {"reduced"}:
                if answers[which].is_corrected:
                    self.gains[which].append((errors["reduced"][2] / errors[which][2], bound.omega > bound.rho))

    def time(self, mu: Array, x: Array, alpha: Array, solved: float) -> None:
        """Seconds of the assembly and the solution, of which `solved` are known, and of the certificate, at mu (d,)."""
        start = time.process_time_ns()
        reduced = self.model.reduced.assemble(mu)
        middle = time.process_time_ns()
        self.certificate.certify(self.model.problem, mu, reduced, x, alpha, CorrectionMode.NONE)
        end = time.process_time_ns()
        self.certificate.certify(self.model.problem, mu, reduced, x, alpha, CorrectionMode.FEASIBLE)
        corrected = time.process_time_ns()
        self.seconds.append((1e-9 * (middle - start) + solved, 1e-9 * (end - middle), 1e-9 * (corrected - end)))

    def __str__(self) -> str:

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
        row = {name: self.row[name] for name in named} | {"certificate": self.certificate.base.guarantee.value}
        row |= {"parameters": self.parameters, "violations": self.violations, "without a bound": self.without}
        for vector, values in zip("uλ", np.array(self.effectivities).reshape(-1, 2).T, strict=True):
            for name, level in quantiles.items():
                row[f"{name} effectivity of {vector}"] = float(np.quantile(values, level))
        for which, name, divided in self._divided():
            row[f"queries, corrected {which}, {name}"] = len(divided)
            row[f"error of λ divided by (median), corrected {which}, {name}"] = float(np.median(divided))
            row[f"smaller in, corrected {which}, {name}"] = float(np.mean(divided > 1.0))
        return row


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
        if recorded.row["correction"] != CorrectionMode.NONE:  # the model is the same
            continue
        model = opened.model(recorded.row["cell"])
        if model.certificate is not None:
            models.setdefault(recorded.cell.problem, []).append(Tally(recorded.row, model, model.certificate))
    for tallies in models.values():
        problem = tallies[0].model.problem
        solver, kept = HighFidelitySolver(problem), Assemblies(problem)
        for k, mu in enumerate(problem.parameters.sample(count, 2027), 1):
            exact = solver.solve(mu)
            compare(tallies, kept, mu, exact)
            if k % 1000 == 0 or k == count:
                print(*tallies, sep="\n", flush=True)
    every = [tally for tallies in models.values() for tally in tallies]
    if table is not None:
        pd.DataFrame([tally.numbers() for tally in every]).to_csv(table, index=False, float_format="%.6g")
    return sum(tally.violations > 0 for tally in every)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("count", nargs="?", type=int, default=10_000)
    parser.add_argument("problem", nargs="?", default="")
    parser.add_argument("--table")
    given = parser.parse_args()
    sys.exit(main(given.run, given.count, given.problem, given.table))
