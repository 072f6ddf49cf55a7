"""Regression of coefficients over the parameter: the non-intrusive baseline, with an uncertainty of its own."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import scipy.linalg
from annotated_types import Gt, Le
from scipy.optimize import nnls

from vibench import Array, Asked, Formulation, FormulationAnswer, FormulationModel, UnsupportedError

if TYPE_CHECKING:
    from vibench import Reduction

SMOOTHEST, ROUGHEST = 100.0, 0.05
"""Length scales between which the likelihood is maximised, relative to the widths of the box."""

VARIANCES = 1e-3, 1e6
"""Between which that of the process is, relative to that of the snapshots' values."""

NOISE = 1e-8
"""Variance of the noise that every process has, relative to that of its values: the interpolation is regular."""


class Regression(Formulation):
    """POD coefficients of u and coefficients of λ by Gaussian processes (Guo and Hesthaven 2018), λ put into the cone.

    Each coefficient of u in V_N, and of λ in an orthonormal basis of the span of the cone, is a Gaussian process in
    the parameter with a Matérn 5/2 covariance and a length scale for each parameter, which maximise the likelihood of
    the snapshots (scikit-learn). The predicted λ is projected on the cone in the norm of W, so that it is in W⁺. No
    assembled matrix has a part in a query; nothing makes u satisfy the constraints. The uncertainty stated beside u is
    the root of the sum of the predicted variances of its coefficients and of the mean square that V_N leaves out.

    Parameters
    ----------
    length
        Length scale, relative to the widths of the box, from which the likelihood is maximised.
    """

    requires: ClassVar[tuple[str, ...]] = ("scikit-learn",)
    uses: ClassVar[tuple[str, ...]] = ("pod", "dual")

    def __init__(self, length: Annotated[float, Gt(ROUGHEST), Le(SMOOTHEST)] = 1.0) -> None:
        self.length = length

    def build(self, offline: Reduction) -> Mapping[str, Any]:
        """The processes of u and of λ, and the Gram matrices with which λ is projected."""
        problem, snapshots, cone = offline.problem, offline.snapshots, offline.cone
        if cone.free.any():
            raise UnsupportedError("the formulation needs λ ≥ 0, and the cone has generators that are free in sign")
        box, span = problem.parameters, offline.multipliers.span
        places = (snapshots.mu - box.lower) / box.widths
        coefficients = problem.V.gram(offline.pod.basis, snapshots.u)
        rest = problem.V.norm(snapshots.u - offline.pod.basis @ coefficients)
        return {
            "places": places,
            "left_out": float(np.mean(rest**2)),
            "u": self._processes(places, coefficients),
            "lam": self._processes(places, problem.W.gram(span, snapshots.lam)),
            "rays": problem.W.gram(span, cone.generators),
        }

    def _processes(self, places: Array, values: Array) -> dict[str, Array]:
        """Processes of values (k×P): covariances by length scales (k×d) and variances (k,), means and spreads (k,).

        Also K⁻¹ times the values, shifted and scaled (k×P), and the inverses of the Cholesky factors of K (k×P×P).
        """
        from sklearn.exceptions import ConvergenceWarning  # noqa: PLC0415  an extra
        from sklearn.gaussian_process import GaussianProcessRegressor  # noqa: PLC0415
        from sklearn.gaussian_process.kernels import ConstantKernel, Matern  # noqa: PLC0415

        count, d = places.shape
        found: dict[str, Array] = {
            "lengths": np.ones((len(values), d)),
            "variances": np.zeros(len(values)),
            "means": values.mean(axis=1),
            "spreads": values.std(axis=1),
            "weights": np.zeros((len(values), count)),
            "inverses": np.zeros((len(values), count, count)),
        }
        for k in np.flatnonzero(found["spreads"] > 0.0):
            scaled = (values[k] - found["means"][k]) / found["spreads"][k]
            matern = Matern(np.full(d, self.length), (ROUGHEST, SMOOTHEST), nu=2.5)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ConvergenceWarning)  # what fits best may be at a bound
                process = GaussianProcessRegressor(ConstantKernel(1.0, VARIANCES) * matern, alpha=NOISE)
                process.fit(places, scaled)
            found["lengths"][k] = process.kernel_.k2.length_scale
            found["variances"][k] = process.kernel_.k1.constant_value
            found["weights"][k] = process.alpha_
            found["inverses"][k] = scipy.linalg.solve_triangular(process.L_, np.eye(count), lower=True)
        return found

    def model(self, offline: Reduction, built: Mapping[str, Any]) -> FormulationModel:
        """The processes, and the bases of their coefficients."""
        return RegressionModel(offline, built)


class RegressionModel(FormulationModel):
    """Evaluates the processes at a parameter."""

    def __init__(self, offline: Reduction, built: Mapping[str, Any]) -> None:
        self._box, self._basis, self._chi = offline.problem.parameters, offline.pod.basis, offline.cone.generators
        self.dimension, self.generators = int(self._basis.shape[1]), int(self._chi.shape[1])
        self._places, self._left_out, self._rays = built["places"], built["left_out"], built["rays"]
        self._u, self._lam = built["u"], built["lam"]

    def solve(self, mu: Array, asked: Asked) -> FormulationAnswer:  # noqa: ARG002
        """Means of the coefficients, those of λ projected on the cone, and the uncertainty of u."""
        place = (mu - self._box.lower) / self._box.widths
        covariances = self._covariances(self._u, place)
        x, lam = _mean(self._u, covariances), _mean(self._lam, self._covariances(self._lam, place))
        explained = np.einsum("kpq,kq->kp", self._u["inverses"], covariances)
        variances = np.maximum(self._u["variances"] - np.sum(explained**2, axis=1), 0.0) * self._u["spreads"] ** 2
        alpha = nnls(self._rays, lam)[0] if self._rays.size else np.zeros(self._rays.shape[1])
        return FormulationAnswer(x, alpha, uncertainty=float(np.sqrt(variances.sum() + self._left_out)))

    def reconstruct(self, mu: Array, answer: FormulationAnswer) -> tuple[Array, Array]:  # noqa: ARG002
        """The pair in V_N and in the cone."""
        assert answer.x is not None
        assert answer.alpha is not None
        return self._basis @ answer.x, self._chi @ answer.alpha

    def _covariances(self, of: Mapping[str, Array], place: Array) -> Array:
        """Covariances (k×P) of the values at a place (d,) with those at the training parameters."""
        r = np.sqrt(5.0 * (of["lengths"] ** -2.0) @ ((self._places - place) ** 2).T)
        return np.asarray(of["variances"][:, None] * (1.0 + r + r**2 / 3.0) * np.exp(-r))


def _mean(of: Mapping[str, Array], covariances: Array) -> Array:
    """Predicted means (k,) of processes."""
    return np.asarray(of["means"] + of["spreads"] * np.sum(of["weights"] * covariances, axis=1))
