"""Regression of coefficients over the parameter: the non-intrusive baseline, with an uncertainty of its own."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import scipy.linalg
from annotated_types import Gt, Le
from scipy.optimize import nnls

from vibench import Array, Formulation, FormulationAnswer, FormulationModel, QuerySettings, UnsupportedError, foreign
from vibench_strategies.formulations.reduced_programs import FixedSpacesModel, refuse_free

if TYPE_CHECKING:
    from vibench import OfflinePhase

SMOOTHEST, ROUGHEST = 100.0, 0.05
"""Length scales between which the likelihood is maximised, relative to the widths of the box."""

VARIANCES = 1e-3, 1e6
"""Between which that of the process is, relative to that of the snapshots' values."""

NOISE = 1e-8
"""Variance of the noise that every process has, relative to that of its values: the interpolation is regular. Radial
basis functions are smoothed by the same number."""


class Regression(Formulation):
    """POD coefficients of u and coefficients of λ as functions of the parameter, fitted to snapshots, λ in the cone.

    Each coefficient of u in V_N, and of λ in an orthonormal basis of the span of the cone, is a Gaussian process in
    the parameter with a Matérn 5/2 covariance and a length scale for each parameter, which maximise the likelihood of
    the snapshots (Guo and Hesthaven 2018, scikit-learn); or a sum of cubic radial basis functions and a linear function
    (Audouze et al. 2009, SciPy), the interpolation of the least bending, in the unit cube. The predicted λ
    is projected on the cone in the norm of W, so that it is in W⁺. No assembled matrix has a part in a query; nothing
    makes u satisfy the constraints. The uncertainty stated beside u is the root of the sum of the predicted variances
    of its coefficients and of the mean square that V_N leaves out; radial basis functions state none.

    Parameters
    ----------
    kind
        "gaussian" processes, or "radial" basis functions.
    length
        Length scale, relative to the widths of the box, from which the likelihood of processes is maximised.
    """

    requires: ClassVar[tuple[str, ...]] = ("scikit-learn",)
    uses: ClassVar[tuple[str, ...]] = ("pod", "dual")

    def __init__(
        self,
        kind: Literal["gaussian", "radial"] = "gaussian",
        length: Annotated[float, Gt(ROUGHEST), Le(SMOOTHEST)] = 1.0,
    ) -> None:
        self.kind, self.length = kind, length

    def build(self, offline: OfflinePhase) -> Mapping[str, Any]:
        """What is fitted to u and to λ, and the Gram matrix with which λ is projected."""
        problem, snapshots, cone = offline.problem, offline.snapshots, offline.cone
        refuse_free(cone)
        box, span = problem.parameters, offline.multipliers.span
        places = box.to_unit(snapshots.mu)
        if self.kind == "radial" and np.linalg.matrix_rank(places - places.mean(axis=0)) < box.dim:
            raise UnsupportedError(f"the training parameters are in a hyperplane, no linear function of {box.dim} fits")
        values = {"u": problem.V.gram(offline.pod.basis, snapshots.u), "lam": problem.W.gram(span, snapshots.lam)}
        rest = problem.V.norm(snapshots.u - offline.pod.basis @ values["u"])
        fit = _radial if self.kind == "radial" else self._processes
        fitted = {name: fit(places, of) for name, of in values.items()}
        rays = problem.W.gram(span, cone.generators)
        return {"places": places, "left_out": float(np.mean(rest**2)), "rays": rays, **fitted}

    def _processes(self, places: Array, values: Array) -> dict[str, Array]:
        """Processes of values (k×P): covariances by length scales (k×d) and variances (k,), means and spreads (k,).

        Also K⁻¹ times the values, shifted and scaled (k×P), and the inverses of the Cholesky factors of K (k×P×P).
        """
        with foreign("scikit-learn cannot be used"):
            from sklearn.exceptions import ConvergenceWarning  # noqa: PLC0415  an extra
            from sklearn.gaussian_process import GaussianProcessRegressor  # noqa: PLC0415
            from sklearn.gaussian_process.kernels import ConstantKernel, Matern  # noqa: PLC0415

        means, spreads, (count, d) = values.mean(axis=1), values.std(axis=1), places.shape
        scaled = (values - means[:, None]) / np.where(spreads > 0.0, spreads, 1.0)[:, None]
        kernel = ConstantKernel(1.0, VARIANCES) * Matern(np.full(d, self.length), (ROUGHEST, SMOOTHEST), nu=2.5)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # what fits best may be at a bound
            processes = [GaussianProcessRegressor(kernel, alpha=NOISE).fit(places, row) for row in scaled]
        inverses = [scipy.linalg.solve_triangular(process.L_, np.eye(count), lower=True) for process in processes]
        return {
            "lengths": np.reshape([process.kernel_.k2.length_scale for process in processes], (len(values), d)),
            "variances": np.array([process.kernel_.k1.constant_value for process in processes], float),
            "means": means,
            "spreads": spreads,
            "weights": np.reshape([process.alpha_ for process in processes], values.shape),
            "inverses": np.reshape(inverses, (len(values), count, count)),
        }

    def model(self, offline: OfflinePhase, built: Mapping[str, Any]) -> FormulationModel:
        """The fitted functions, and the bases of their coefficients."""
        return RegressionModel(offline, built, (Radial if self.kind == "radial" else Processes)(built))


def _radial(places: Array, values: Array) -> dict[str, Array]:
    """Weights (P+1+d×k) of cubic functions around the places (P×d), of 1 and of the coordinates, for values (k×P)."""
    linear = np.column_stack([np.ones(len(places)), places])
    cubes = np.linalg.norm(places[:, None] - places, axis=2) ** 3 + NOISE * np.eye(len(places))
    matrix = np.block([[cubes, linear], [linear.T, np.zeros((linear.shape[1], linear.shape[1]))]])
    return {"weights": np.linalg.solve(matrix, np.pad(values.T, ((0, linear.shape[1]), (0, 0))))}


class Radial:
    """Sums of radial basis functions and a linear function, from what `Regression` stores of them."""

    def __init__(self, built: Mapping[str, Any]) -> None:
        self._places, self._count = built["places"], built["u"]["weights"].shape[1]
        self._weights = np.hstack([built["u"]["weights"], built["lam"]["weights"]])

    def at(self, place: Array) -> tuple[Array, Array, None]:
        """Coefficients of u and of λ at a place (d,), without a variance."""
        away = self._places - place
        squares = np.einsum("ij,ij->i", away, away)
        values = np.concatenate([squares * np.sqrt(squares), [1.0], place]) @ self._weights
        return values[: self._count], values[self._count :], None


class Processes:
    """Gaussian processes, from what `Regression` stores of them."""

    def __init__(self, built: Mapping[str, Any]) -> None:
        u, lam = built["u"], built["lam"]
        self._places, self._count, self._u = built["places"], len(u["means"]), u
        self._means = np.append(u["means"], lam["means"])
        self._scales = 5.0 * np.vstack([u["lengths"], lam["lengths"]]) ** -2.0
        self._weights = np.vstack([(of["spreads"] * of["variances"])[:, None] * of["weights"] for of in (u, lam)])
        self._factors = u["variances"][:, None, None] * u["inverses"]

    def at(self, place: Array) -> tuple[Array, Array, float]:
        """Means of the coefficients of u and of λ at a place (d,), and the sum of the variances of those of u."""
        count, squares = self._count, self._scales @ ((self._places - place) ** 2).T
        r = np.sqrt(squares)
        correlations = (1.0 + r + squares / 3.0) * np.exp(-r)
        values = self._means + np.einsum("kp,kp->k", self._weights, correlations)
        explained = (self._factors @ correlations[:count, :, None])[:, :, 0]
        left = np.maximum(self._u["variances"] - np.einsum("kp,kp->k", explained, explained), 0.0)
        return values[:count], values[count:], float(left @ self._u["spreads"] ** 2)


class RegressionModel(FixedSpacesModel):
    """Evaluates fitted coefficients at a parameter."""

    def __init__(self, offline: OfflinePhase, built: Mapping[str, Any], functions: Radial | Processes) -> None:
        super().__init__(offline.pod.basis, offline.cone.generators)
        # `to_unit` would check in every query what comes from a study.
        box, self.functions = offline.problem.parameters, functions
        self._lower, self._widths = box.lower, box.widths
        self._left_out, self._rays = built["left_out"], built["rays"]

    def solve(self, mu: Array, settings: QuerySettings) -> FormulationAnswer:  # noqa: ARG002
        """The coefficients, those of λ projected on the cone, and the uncertainty of u."""
        x, lam, variance = self.functions.at((mu - self._lower) / self._widths)
        alpha = nnls(self._rays, lam)[0] if self._rays.size else np.zeros(self._rays.shape[1])
        stated = None if variance is None else np.sqrt(variance + self._left_out)
        return FormulationAnswer(x, alpha, uncertainty=stated)
