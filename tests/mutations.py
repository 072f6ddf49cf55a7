"""Seeded faults: each is put into a copy of the sources, and the tests have to notice it.

    python tests/mutations.py [NAME …]

Tests that mirror the changed file run first, all others if those pass. Prints which test caught which fault; exit code
1 if one survives, or if the tests fail on the copy as it is.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
IMPORTED = ("", "problems", "strategies", "tests", "tests/helpers")
AT_ONCE = 2
"""Copies that are tested side by side."""

PLACES = "tests/faults/test_mutations.py"
"""Says whether the faults fit the sources, and so fails on every copy with a fault."""

PATIENCE = 600
"""Seconds after which tests that do not end count as failed."""


@dataclass(frozen=True)
class Fault:
    """A fault: the text `right`, found once in a file, becomes `wrong`; `tests` are those that mirror the file."""

    name: str
    file: str
    right: str
    wrong: str
    tests: tuple[str, ...]


FAULTS = (
    Fault(
        "decided-whatever-the-rounds-say",
        "vibench/results/break_even.py",
        "if np.mean(drawn[measured.meaning]) < 1.0 - tail:",
        "if np.mean(drawn[measured.meaning]) < 0.0:",
        ("tests/unit/results/test_break_even.py",),
    ),
    Fault(
        "rounds-drawn-apart",
        "vibench/results/paired_timing.py",
        "[x.online - y.online for x, y in common]",
        "[x.online - y.online for x, y in zip(mine.values(), reversed(others.values()), strict=False)]",
        ("tests/unit/results/test_break_even.py",),
    ),
    Fault(
        "other-runs-left-out",
        "vibench/results/paired_timing.py",
        "return None if within is None else within.of_other_runs()",
        "return within",
        ("tests/unit/results/test_paired_timing.py",),
    ),
    Fault(
        "as-fast-whatever-the-rounds-say",
        "vibench/results/break_even.py",
        "if all(abs(end) <= margin for end in ratio.interval(tail)):",
        "if abs(ratio.mean) <= margin:",
        ("tests/unit/results/test_break_even.py",),
    ),
    Fault(
        "cell-after-cell",
        "vibench/stages/timing_rounds.py",
        "number, within = divmod(item, len(self.cells))\n",
        "within, number = divmod(item, self.rounds)\n",
        ("tests/unit/rounds/test_timing_rounds.py",),
    ),
    Fault(
        "timed-alone",
        "vibench/execution/timing_plan.py",
        "return None if self._open[group] else self._begin(group)",
        "return self._begin(group)",
        ("tests/unit/execution/test_timing_plan.py",),
    ),
    Fault(
        "wrong-sign-of-b",
        "problems/vibench_problems/obstacle.py",
        "tuple(-sp.csr_array(term) for term in masses)",
        "tuple(sp.csr_array(term) for term in masses)",
        ("tests/mathematics/problems/test_obstacle.py",),
    ),
    Fault(
        "euclidean-norm-of-w",
        "vibench/reduction/cones.py",
        "return _project_whitened(W.whiten(generators), W.whiten(theta))",
        "return _project_whitened(generators, theta)",
        ("tests/unit/reduction/test_cones.py",),
    ),
    Fault(
        "generators-not-normalised",
        "vibench/reduction/cones.py",
        "np.column_stack([self.generators, direction / length])",
        "np.column_stack([self.generators, direction])",
        ("tests/unit/reduction/test_cones.py",),
    ),
    Fault(
        "stale-values-in-the-heap",
        "vibench/reduction/cones.py",
        "if not len(stale):",
        "if True:",
        ("tests/unit/reduction/test_cones.py",),
    ),
    Fault(
        "coefficientwise-constraint-dropped",
        "vibench/reduction/cone_subtraction.py",
        "B=np.vstack([-np.eye(count), units[:, None] * generators[support]]),\n"
        "        g=np.concatenate([np.zeros(count), units * theta[support]]),",
        "B=-np.eye(count),\n        g=np.zeros(count),",
        ("tests/mathematics/strategies",),
    ),
    Fault(
        "correction-forgotten",
        "problems/vibench_problems/hertz.py",
        "integrals.gap - integrals.jump @ (self.approach(mu) * self._contact_lift))",
        "integrals.gap)",
        ("tests/mathematics/problems/test_hertz.py",),
    ),
    Fault(
        "approach-halved",
        "problems/vibench_problems/hertz.py",
        "return float(mu[1]) if",
        "return 0.5 * float(mu[1]) if",
        ("tests/mathematics/problems/test_approach.py",),
    ),
    Fault(
        "area-without-its-mixed-term",
        "problems/vibench_problems/disc_map.py",
        "cross(e1, f2) + cross(f1, e2)",
        "cross(e1, f2)",
        ("tests/mathematics/problems/test_bulge.py",),
    ),
    Fault(
        "sigma-not-updated",
        "strategies/vibench_strategies/offline_pga.py",
        "self._gram = self._gram - rows.T @ rows",
        "self._gram = self._gram",
        ("tests/mathematics/strategies",),
    ),
    Fault(
        "one-mode-too-many",
        "vibench/reduction/pod.py",
        "modes = left[:, :size]",
        "modes = left[:, : size + 1]",
        ("tests/unit/reduction/test_pod.py",),
    ),
    Fault(
        "seconds-of-another-stage",
        "vibench/stages/cell_queries.py",
        '"enrichment": (built.enrichment,),',
        '"enrichment": (built.pod,),',
        ("tests/unit/stages/test_offline.py",),
    ),
    Fault(
        "residuals-not-checked",
        "vibench/qp/verification.py",
        "if residuals.worst <= accuracy:",
        "if True:",
        ("tests/unit/qp/test_solve.py",),
    ),
    Fault(
        "gap-not-checked",
        "vibench/qp/verification.py",
        "return float(np.max([self.primal, self.dual, self.gap]))",
        "return float(np.max([self.primal, self.dual]))",
        ("tests/unit/qp/test_verification.py",),
    ),
    Fault(
        "nan-not-seen",
        "vibench/qp/verification.py",
        "if not (np.all(np.isfinite(answer.x)) and np.all(np.isfinite(answer.alpha))):",
        "if False:",
        ("tests/unit/qp/test_solve.py",),
    ),
    Fault(
        "infeasible-without-certificate",
        "vibench/qp/verification.py",
        "if residuals.primal > accuracy and infeasibility_certificate(program) is not None:",
        "if residuals.primal > accuracy:",
        ("tests/unit/qp/test_solve.py",),
    ),
    Fault(
        "multipliers-not-scaled-back",
        "vibench/qp/scaling.py",
        "return self.length * x, self.force * alpha / self.rows",
        "return self.length * x, self.force * alpha",
        ("tests/unit/qp/test_solve.py",),
    ),
    Fault(
        "tail-without-the-square",
        "vibench/reduction/pod.py",
        "np.sqrt(np.cumsum((sigma**2)[::-1])[::-1])",
        "np.cumsum(sigma[::-1])[::-1]",
        ("tests/unit/reduction/test_pod.py",),
    ),
    Fault(
        "supremizers-by-the-wrong-product",
        "vibench/reduction/supremizers.py",
        "return V.riesz(np.asarray(B.T @ eta))",
        "return np.asarray(B.T @ eta)",
        ("tests/unit/reduction/test_supremizers.py",),
    ),
    Fault(
        "span-constant-below-the-rank",
        "vibench/stability/infsup.py",
        "if rows < rank:",
        "if rows < 0:",
        ("tests/unit/stability/test_infsup.py",),
    ),
    Fault(
        "cone-interval-too-narrow",
        "vibench/stability/infsup.py",
        "return max(0.0, float(np.min(M[positive] / G[positive])) - len(G) * negative)",
        "return max(0.0, float(np.min(M[positive] / G[positive])))",
        ("tests/unit/stability/test_infsup.py",),
    ),
    Fault(
        "bound-without-the-mismatch",
        "vibench/model/hsw_bounds.py",
        "(penetration_norm * residual / beta + complementarity) / alpha",
        "(penetration_norm * residual / beta) / alpha",
        ("tests/unit/model/test_hsw_bounds.py",),
    ),
    Fault(
        "bound-without-kappa",
        "vibench/model/bound_terms.py",
        "self.rho**2 + self.omega**2 + 2.0 * self.kappa",
        "self.rho**2 + self.omega**2",
        ("tests/unit/model/test_error_bounds.py",),
    ),
    Fault(
        "correction-not-feasible",
        "vibench/model/error_bounds.py",
        "if not np.all(lacking <= 0.0):",
        "if not np.all(np.isfinite(w)):",
        ("tests/unit/model/test_error_bounds.py",),
    ),
    Fault(
        "correction-of-another-violation",
        "vibench/model/error_bounds.py",
        "least = excess + margin",
        "least = 0.5 * excess + margin",
        ("tests/unit/model/test_error_bounds.py",),
    ),
    Fault(
        "residual-in-the-wrong-norm",
        "vibench/model/contact_form.py",
        "np.sqrt(max(self.rest + float(self.load @ self.values), 0.0))",
        "np.sqrt(max(self.rest + float(self.load @ self.load), 0.0))",
        ("tests/unit/model/test_error_bounds.py",),
    ),
    Fault(
        "duality-gap-without-the-residual",
        "vibench/model/error_bounds.py",
        "contact.norm(riesz.plus(correction.values, correction.load), largest)",
        "omega",
        ("tests/unit/model/test_error_bounds.py",),
    ),
    Fault(
        "multiplier-bounded-by-the-whole-residual",
        "vibench/model/error_bounds.py",
        "    if np.all(lacking <= 0.0):",
        "    if False:",
        ("tests/unit/model/test_error_bounds.py",),
    ),
    Fault(
        "equalities-that-may-be-released",
        "vibench/highfidelity/active_set.py",
        "following = violated | in_contact | always",
        "following = violated | in_contact",
        ("tests/unit/model/test_hard_rows.py",),
    ),
    Fault(
        "equalities-without-their-round-off",
        "vibench/model/bound_terms.py",
        "return 2.0 * float(",
        "return 0.0 * float(",
        ("tests/unit/model/test_equalities.py",),
    ),
    Fault(
        "equality-with-one-side-alone",
        "vibench/qp/exact.py",
        "np.maximum(-forces, 0.0)",
        "0.0 * forces",
        ("tests/unit/qp/test_exact.py", "tests/unit/model/test_hard_rows.py"),
    ),
    Fault(
        "coordinates-without-their-round-off",
        "vibench/model/certificates/residual.py",
        "remainder + round_off",
        "remainder",
        ("tests/unit/model/certificates/test_bounds.py",),
    ),
    Fault(
        "interpolation-errors-outside-the-box",
        "vibench/model/certificates/bounds.py",
        "if not base.is_exact and problem.parameters.outside(mu).any():",
        "if False:",
        ("tests/unit/model/certificates/test_bounds.py",),
    ),
    Fault(
        "exported-bounds-without-errors-of-polynomials",
        "vibench/library/exported_certificate.py",
        "2.0 * polynomial.error * polynomial.scale",
        "0.0",
        ("tests/unit/library/test_c_source.py",),
    ),
    Fault(
        "online-bound-without-kappa",
        "vibench/model/certificates/bounds.py",
        "norm * sqrt(upper), kappa, work)",
        "norm * sqrt(upper), 0.0, work)",
        ("tests/unit/model/certificates/test_bounds.py",),
    ),
    Fault(
        "online-bound-without-interpolation-errors",
        "vibench/model/certificates/bounds.py",
        "lacking = base.load_error + base.stiffness_error * u_norm",
        "lacking = 0.0 * u_norm",
        ("tests/unit/model/certificates/test_bounds.py",),
    ),
    Fault(
        "online-residual-in-the-norm-of-V",
        "vibench/model/certificates/bounds.py",
        "X, dofs, scaled = base.X.matrix,",
        "X, dofs, scaled = problem.V.matrix,",
        ("tests/unit/model/certificates/test_bounds.py",),
    ),
    Fault(
        "residual-basis-of-the-space-before",
        "vibench/model/certificates/bounds.py",
        "problem, Phi, chi, B = model.problem, model.basis, model.generators,",
        "problem, Phi, chi, B = model.problem, np.roll(model.basis, 1, axis=1), model.generators,",
        ("tests/unit/model/certificates/test_bounds.py",),
    ),
    Fault(
        "online-correction-not-feasible",
        "vibench/model/certificates/contact_correction.py",
        "                if np.all(lacking <= 0.0):",
        "                if np.all(np.isfinite(lacking)):",
        ("tests/unit/model/certificates/test_contact_correction.py",),
    ),
    Fault(
        "prepared-correction-not-feasible",
        "vibench/model/certificates/prepared_correction.py",
        "if lacking.max() <= 0.0:",
        "if np.isfinite(lacking.max()):",
        ("tests/unit/model/certificates/test_prepared_correction.py",),
    ),
    Fault(
        "prepared-correction-in-the-wrong-unit",
        "vibench/model/certificates/prepared_correction.py",
        "a = (theta / gamma) * (nu - here)",
        "a = theta * (nu - here)",
        ("tests/unit/model/certificates/test_prepared_correction.py",),
    ),
    Fault(
        "rows-far-from-the-contact-ignored",
        "vibench/model/certificates/contact_correction.py",
        "lacking = np.where(self.near, lacking, far)",
        "lacking = np.where(self.near, lacking, 0.0)",
        ("tests/unit/model/certificates/test_contact_correction.py",),
    ),
    Fault(
        "directions-left-out-and-forgotten",
        "vibench/model/certificates/residual.py",
        "float(remainders[enough])",
        "0.0 * float(remainders[enough])",
        ("tests/unit/model/certificates/test_residual.py",),
    ),
    Fault(
        "terms-left-out-and-forgotten",
        "vibench/model/certificates/residual.py",
        "return self.factor @ represented, beside, float(self.norms @ np.abs(z))",
        "return self.factor @ represented, beside, 0.0",
        ("tests/unit/model/certificates/test_residual.py",),
    ),
    Fault(
        "coercivity-between-anchors",
        "vibench/model/certificates/spectral.py",
        "lacking = float(np.abs(theta - combined[2:]) @ self.norms) + 2.0 * self.error",
        "lacking = 2.0 * self.error",
        ("tests/unit/model/certificates/test_spectral.py",),
    ),
    Fault(
        "verified-called-certified",
        "vibench/model/certificates/base.py",
        'exact = all(is_exact(problem, name, members[name]) for name in "Af")',
        "exact = load == stiffness == 0.0",
        ("tests/unit/model/certificates/test_bounds.py",),
    ),
    Fault(
        "inf-sup-constant-of-a-body-that-moves",
        "vibench/model/certificates/base.py",
        "if np.any(difference.data[self.bodies[difference.indices]] != 0.0):",
        "if False:",
        ("tests/unit/model/certificates/test_bounds.py",),
    ),
    Fault(
        "corrected-pair-without-the-loss-of-spectral-bounds",
        "vibench/model/certificates/bounds.py",
        "rho = bound.rho + (0.5 * (upper - lower) * norm + middle * eta) / sqrt(lower)",
        "rho = bound.rho + middle * eta / sqrt(lower)",
        ("tests/unit/model/certificates/test_bounds.py",),
    ),
    Fault(
        "auto-corrects-all",
        "vibench/model/bound_terms.py",
        "(self is CorrectionMode.AUTO and omega > rho)",
        "self is CorrectionMode.AUTO",
        ("tests/unit/offline/test_correction.py",),
    ),
    Fault(
        "bounds-of-the-uncorrected-solution",
        "vibench/offline/correction.py",
        "return Answer(v, correction.nu, correction.bound, is_corrected=True, share=share)",
        "return Answer(v, correction.nu, bound, is_corrected=True, share=share)",
        ("tests/unit/offline/test_correction.py",),
    ),
    Fault(
        "pair-in-c-without-what-is-left-of-complementarity",
        "vibench/offline/templates/reduced_model_certificate.c.template",
        "sqrt(rho * rho + 2.0 * fmax(0.0, gap))",
        "rho",
        ("tests/unit/library/test_c_source.py",),
    ),
    Fault(
        "proof-without-round-off",
        "vibench/linalg/proofs.py",
        "if error <= shift:\n            return int",
        "if np.isfinite(error):\n            return int",
        ("tests/unit/linalg/test_proofs.py",),
    ),
    Fault(
        "constant-of-the-wrong-side",
        "vibench/stability/coercivity.py",
        "candidates = [accurate * (1.0 + margin) ** sign for margin in MARGINS]",
        "candidates = [accurate * (1.0 + margin) ** -sign for margin in MARGINS]",
        ("tests/unit/stability/test_coercivity.py",),
    ),
    Fault(
        "constant-without-a-proof",
        "vibench/stability/coercivity.py",
        "if proves(closest):",
        "if closest > 0.0:",
        ("tests/unit/stability/test_coercivity.py",),
    ),
    Fault(
        "agreement-too-generous",
        "vibench/qp/verification.py",
        "half = 0.5 * (first.linear + second.linear)",
        "half = 500.0 * (first.linear + second.linear)",
        ("tests/unit/results/test_consistency.py",),
    ),
    Fault(
        "validated-on-the-training-set",
        "vibench/study/parameter_sets.py",
        "return validation_parameters(problem, self.count, self.seed, self.strategy())",
        "return training_parameters(problem)",
        ("tests/unit/stages/test_offline.py",),
    ),
    Fault(
        "active-set-without-release",
        "vibench/highfidelity/active_set.py",
        "in_contact = active & (forces > 1e-14 * np.max(np.abs(forces), initial=0.0))",
        "in_contact = active",
        ("tests/unit/highfidelity/test_active_set.py",),
    ),
    Fault(
        "threshold-the-other-way-round",
        "vibench/results/break_even.py",
        "Meaning.FROM if dearer > 0.0 else Meaning.UNTIL",
        "Meaning.UNTIL if dearer > 0.0 else Meaning.FROM",
        ("tests/unit/results/test_break_even.py",),
    ),
    Fault(
        "warm-up-counted",
        "vibench/timing.py",
        "        runs.append(once()[1])",
        "        runs.append(first)",
        ("tests/unit/test_timing.py",),
    ),
    Fault(
        "checksum-not-verified",
        "vibench/stages/artefacts.py",
        "if digest != _digest(key, content):",
        "if False:",
        ("tests/unit/storage/test_artefacts.py",),
    ),
    Fault(
        "rows-not-compared-with-their-digests",
        "vibench/results/sqlite.py",
        'if written.get(key, "0") != now.get(key, "0")',
        "if False",
        ("tests/faults/test_damaged_files.py",),
    ),
    Fault(
        "folder-not-locked",
        "vibench/files.py",
        "fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)",
        "pass",
        ("tests/unit/results/test_database.py",),
    ),
    Fault(
        "limit-of-a-query-not-enforced",
        "vibench/execution/supervisor.py",
        "if self.seconds > self._item_limit:",
        "if False:",
        ("tests/faults/test_supervisor.py",),
    ),
    Fault(
        "good-items-thrown-away",
        "vibench/execution/supervisor.py",
        "self.progress.done[message.number] = message.value",
        "pass",
        ("tests/faults/test_supervisor.py",),
    ),
    Fault(
        "rows-doubled-at-the-second-write",
        "vibench/results/database.py",
        'self._remove(cell["cell"])',
        "pass",
        ("tests/unit/results/test_database.py",),
    ),
    Fault(
        "interpolation-point-off-by-one",
        "vibench/model/affine.py",
        "return Interpolation(points, cardinal,",
        "return Interpolation(points - 1, cardinal,",
        ("tests/unit/model/test_deim.py",),
    ),
    Fault(
        "half-of-a-symmetric-term",
        "vibench/model/affine.py",
        "return matrix + sp.triu(matrix, 1).T if self._symmetric else matrix",
        "return matrix",
        ("tests/unit/model/test_affine.py",),
    ),
    Fault(
        "declared-terms-in-another-order",
        "vibench/model/affine.py",
        "first.coefficients(mu)",
        "first.coefficients(mu)[::-1]",
        ("tests/unit/model/test_hyperreduced.py",),
    ),
    Fault(
        "lift-left-in-the-bound",
        "vibench/interfaces/affine_problem.py",
        'sums["g"] = _minus(sums["g"], sums["B"], sums["dirichlet_lift"])',
        'sums["g"] = sums["g"]',
        ("tests/unit/test_fem.py",),
    ),
    Fault(
        "patterns-told-apart-by-their-size",
        "vibench/model/affine.py",
        "all(np.array_equal(keys[0], key) for key in keys)",
        "all(len(keys[0]) == len(key) for key in keys)",
        ("tests/unit/model/test_affine.py",),
    ),
    Fault(
        "contact-load-dropped",
        "vibench/model/hyperreduced.py",
        "added = _pivoted_range(added)",
        "added = _pivoted_range(added[:, 1:])",
        ("tests/unit/model/test_hyperreduced.py",),
    ),
    Fault(
        "fixed-loads-forgotten",
        "vibench/reduction/supremizers.py",
        "self._fixed[:used] + self._reached",
        "self._reached",
        ("tests/unit/reduction/test_supremizers.py",),
    ),
    Fault(
        "loads-on-one-node-of-an-edge",
        "problems/vibench_problems/mortar.py",
        "loads[1:] += sums",
        "loads[:-1] += sums",
        ("tests/mathematics/problems/test_hertz.py",),
    ),
    Fault(
        "compiled-answer-outside-the-box-dropped",
        "vibench/offline/compiled.py",
        "if code % OUTSIDE in {0, 1}",
        "if code in {0, 1}",
        ("tests/unit/stages/test_compilation.py",),
    ),
    Fault(
        "compiled-query-repeated-as-it-is",
        "vibench/stages/query.py",
        "replace(self, mu=mu, program=self.program and self.model.online.program(mu).program)",
        "self",
        ("tests/unit/stages/test_compilation.py",),
    ),
    Fault(
        "factor-not-transposed",
        "vibench/qp/solve.py",
        "_solve_factor(factor, load - constraints @ forces, transposed=True)",
        "_solve_factor(factor, load - constraints @ forces)",
        ("tests/unit/qp/test_solve.py",),
    ),
    Fault(
        "condensed-load-without-the-interface",
        "vibench/linalg/schur_complement.py",
        "particular, condensed[self._pattern.interface] = self._factor.eliminate(f[self._pattern.order])",
        "particular, _ = self._factor.eliminate(f[self._pattern.order])",
        ("tests/unit/linalg/test_schur_complement.py",),
    ),
    Fault(
        "extension-with-the-wrong-sign",
        "vibench/linalg/cholesky.py",
        "right[: self._split] = -(self._coupling.T @ last)",
        "right[: self._split] = self._coupling.T @ last",
        ("tests/unit/linalg/test_cholesky.py",),
    ),
    Fault(
        "forces-where-contact-has-ended",
        "vibench/highfidelity/kkt_systems.py",
        "values = np.concatenate([self._g[added], np.zeros(len(removed))])",
        "values = np.concatenate([self._g[added], np.ones(len(removed))])",
        ("tests/unit/highfidelity/test_kkt_systems.py",),
    ),
    Fault(
        "programs-of-too-large-a-space",
        "vibench/model/galerkin.py",
        "(program.A[:size, :size], program.B[:, :size])",
        "(program.A[-size:, -size:], program.B[:, -size:])",
        ("tests/unit/stages/test_offline.py",),
    ),
    Fault(
        "bound-of-a-distance-too-small",
        "vibench/reduction/cones.py",
        "np.linalg.norm(self._snapshots - generators @ self._coefficients, axis=0) / self._largest)",
        "0.9 * np.linalg.norm(self._snapshots - generators @ self._coefficients, axis=0) / self._largest)",
        ("tests/unit/reduction/test_cones.py",),
    ),
    Fault(
        "sampler-with-the-wrong-weight",
        "problems/vibench_problems/obstacle.py",
        "lambda weights: self.load * integrals(weights)",
        "lambda weights: self.load * integrals(weights) / (1.0 + weights[1])",
        ("tests/mathematics/problems/test_p1_entries.py",),
    ),
    Fault(
        "separation-not-paid-for",
        "vibench/stages/cell_queries.py",
        '"assembly": (built.decomposition, built.reduction),',
        '"assembly": (built.reduction,),',
        ("tests/unit/stages/test_assembly.py",),
    ),
    Fault(
        "noise-over-nothing",
        "vibench/model/errors.py",
        "error_lambda=None if zero_lam[k] else ratio(",
        "error_lambda=ratio(",
        ("tests/unit/stability/test_over_parameters.py",),
    ),
    Fault(
        "means-over-whatever-is-ok",
        "vibench/report/figures/data.py",
        "common = by.index[by == len(kept)]",
        "common = by.index",
        ("tests/unit/report/test_common_queries.py",),
    ),
    Fault(
        "lengths-not-scaled-back",
        "vibench/qp/scaling.py",
        "return self.length * x, self.force",
        "return x, self.force",
        ("tests/unit/qp/test_scaling.py",),
    ),
    Fault(
        "modes-instead-of-the-enriched-space",
        "vibench/stages/infsup_constants.py",
        "constants_on(model.fixed_basis, classes",
        "constants_on(model.fixed_basis[:, :1], classes",
        ("tests/unit/stages/test_infsup_constants.py",),
    ),
)


def changed(root: Path, fault: Fault) -> str:
    """The text of the faulty file; refuses a fault that no longer fits the sources."""
    text = (root / fault.file).read_text(encoding="utf-8")
    if text.count(fault.right) != 1:
        raise SystemExit(f"{fault.name}: found {text.count(fault.right)} times in {fault.file}, expected once")
    return text.replace(fault.right, fault.wrong)


def first_failure(root: Path, tests: Sequence[str]) -> str | None:
    """The first test that fails on a tree, or `None`."""
    paths = os.pathsep.join(str(root / folder) for folder in IMPORTED)
    command = [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", "--tb=no", "-rfE", *tests]
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired:
        return f"no end within {PATIENCE} s"
    if done.returncode == 0:
        return None
    failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if done.returncode != 1 or not failed:
        raise SystemExit(f"the tests could not be run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return failed[1]


def copy_of_sources(folder: str) -> Path:
    """A copy of the tree without what it does not need."""
    ignored = shutil.ignore_patterns(".git", ".venv", "runs", "__pycache__", ".*_cache", ".hypothesis")
    return Path(shutil.copytree(ROOT, Path(folder) / "copy", ignore=ignored))


def caught(fault: Fault) -> str | None:
    """The test that notices a fault, or `None`."""
    with tempfile.TemporaryDirectory() as folder:
        root = copy_of_sources(folder)
        (root / fault.file).write_text(changed(root, fault), encoding="utf-8")
        return first_failure(root, fault.tests) or first_failure(root, ["tests", f"--ignore={PLACES}"])


def main(names: Sequence[str]) -> int:
    """Try the faults with these names, or all; the number of those that survive."""
    chosen = [fault for fault in FAULTS if not names or fault.name in names]
    if unknown := set(names) - {fault.name for fault in FAULTS}:
        raise SystemExit(f"no fault named {', '.join(sorted(unknown))}")
    mirrored = sorted({test for fault in chosen for test in fault.tests})
    with tempfile.TemporaryDirectory() as folder:
        broken = first_failure(copy_of_sources(folder), mirrored)
    if broken:
        raise SystemExit(f"{broken} fails without any fault")
    survivors = 0
    with ThreadPoolExecutor(AT_ONCE) as pool:
        for fault, test in zip(chosen, pool.map(caught, chosen), strict=True):
            survivors += test is None
            print(f"{fault.name:40s} {test or 'SURVIVED'}", flush=True)
    print(f"{len(chosen)} faults, {survivors} survived")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
