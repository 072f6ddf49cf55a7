"""Outputs and their bounds from the exported C program of a model, compiled and loaded into this process."""

from __future__ import annotations

import ctypes
from dataclasses import replace
from math import inf

import numpy as np

from vibench.arrays import Array
from vibench.calibration.decisions import BoundedSensors, Prediction, distance_of_computed
from vibench.errors import UnsupportedError
from vibench.library.export import exported
from vibench.model.certificates.base import Guarantee
from vibench.model.certificates.bounds import OnlineBound
from vibench.model.galerkin import contact_at
from vibench.offline import c_source
from vibench.offline.compiled import loaded
from vibench.offline.models import Model


class CertifiedProgram:
    """Predictions as those of `BoundedSensors` in a fraction of their time, but verified at most where A varies.

    Raises an `UnsupportedError` if the model cannot be exported with its bounds, or there is no C compiler.
    """

    def __init__(self, model: Model, names: tuple[str, ...]) -> None:
        bounded = BoundedSensors(model, names)
        self._problem, self._base = model.problem, bounded.base
        # Known before polynomials are computed, which may take long.
        if self._base.bound_terms is None or bounded.certificate.prepared is None:
            raise UnsupportedError("the C program has no bounds: B and g are no declared sums, or B has several terms")
        found = exported(model, bases=False, c=True)
        if why := found.about["no_bounds"]:
            raise UnsupportedError(f"the C program of the model has no bounds: {why}")
        program = loaded(
            c_source.source(found.members, found.arrays, found.about, "model", found.thetas, found.exact)[0]
        )
        self._solve, self._certify = program.model_solve, program.model_certify
        self._evaluate = program.model_certified_outputs
        linear = [output["name"] for output in found.about["outputs"]["linear"]]
        self._rows, count = [linear.index(name) for name in names], len(linear)
        loads = found.arrays["certificate_responses"].shape[1]
        # The arrays of all calls: x, α and residuals; λ, the shift and bounds; outputs and their errors.
        unknowns, constraints = (found.members[name].terms.shape[1] for name in "fg")
        sizes = unknowns, constraints, 3, model.problem.W.dim, loads, 3, count, count
        self._arrays = [np.zeros(max(size, 1)) for size in sizes]
        # The spectrum of A may be a little wider between its anchors, which are all that this reads.
        spectral, worth = self._base.spectral, Guarantee(found.about["certificate"])
        self._alpha = 1.0 if spectral is None else float(spectral.alpha.min())
        self._gamma = 1.0 if spectral is None else float(spectral.gamma.max())
        self._guarantee = worth if spectral is None else Guarantee.VERIFIED

    def __call__(self, mu: Array) -> Prediction:
        """The outputs at mu (d,), with bounds that allow for the accuracy of the high-fidelity solution."""
        at = np.ascontiguousarray(mu, dtype=float)
        start, x, alpha, residuals, lam, shift, bounds, outputs, errors = (
            ctypes.c_void_p(one.ctypes.data) for one in (at, *self._arrays)
        )
        # Codes above 1 have no solution; those of certificates other than 0 no bounds.
        if self._solve(start, x, alpha, residuals) > 1 or self._certify(start, x, alpha, 0, lam, shift, bounds):
            return Prediction(np.zeros(len(self._rows)), np.full(len(self._rows), inf), Guarantee.CERTIFIED)
        contact, multiplier, own = contact_at(self._problem, mu), self._arrays[3], self._arrays[5]
        declared = self._problem.affine.get("B")
        theta = 1.0 if declared is None else float(declared.coefficients(mu)[0])
        beta, _ = self._base.inf_sup.lower_bound(theta, lambda: contact.B, self._gamma)
        bound = replace(
            OnlineBound.none(""), u_energy=own[0], lambda_natural=own[1], relative=own[2], coercivity=self._alpha,
            lam=own[1] / beta if beta > 0.0 else inf,
        )  # fmt: skip
        own[:2] += distance_of_computed(self._problem.W, self._base.compliance, contact, multiplier, bound)
        self._evaluate(start, x, lam, shift, bounds, outputs, errors)
        return Prediction(self._arrays[6][self._rows], self._arrays[7][self._rows], self._guarantee)
