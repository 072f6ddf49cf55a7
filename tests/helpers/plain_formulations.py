"""Plain versions of the formulations, each from its paper alone: what a competitor may be expected to take.

Every function takes the offline phase and returns the query at a parameter: coefficients x (N',) of u and α (R,) of λ.
`tests/benchmarks/competitors.py` measures them.
"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.linalg
import scipy.optimize
from scipy.cluster.vq import kmeans2

from vibench import Array, Reduction, Snapshots, VariationalInequality, projected_members
from vibench.interfaces.formulations import SolveQP

Query = Callable[[Array], tuple[Any, ...]]


def penalty(offline: Reduction, epsilon: float = 1e-6) -> Query:
    """Newton's method for constraints penalised in units of their compliance (Bader, Zhang and Veroy 2016)."""

    def solve(mu: Array) -> tuple[Any, ...]:
        reduced = offline.assembled.assemble(mu)
        A, f, B, g = reduced.program.A, reduced.program.f, reduced.program.B, reduced.program.g
        factor = np.linalg.cholesky(A) if reduced.factor is None else reduced.factor
        weights = 1.0 / (epsilon * np.sum(scipy.linalg.solve_triangular(factor, B.T, lower=True) ** 2, axis=0))
        x, active = scipy.linalg.cho_solve((factor, True), f), None
        for _ in range(100):
            before, active = active, B @ x > g
            if before is not None and np.array_equal(active, before):
                break
            weighted = weights[active, None] * B[active]
            x = np.linalg.solve(A + B[active].T @ weighted, f + weighted.T @ g[active])
        return x, weights * np.maximum(B @ x - g, 0.0)

    return solve


def proximal(offline: Reduction, accuracy: float, growth: float = 2.0) -> Query:
    """The latent variable proximal point method (Keith and Surowiec 2024), with u eliminated from Newton's systems."""

    def solve(mu: Array) -> tuple[Any, ...]:
        program = offline.assembled.assemble(mu).program
        A, f, B, g = program.A, program.f, program.B, program.g
        factor = scipy.linalg.cho_factor(A)
        free, lifted = scipy.linalg.cho_solve(factor, f), scipy.linalg.cho_solve(factor, B.T)
        G, h = B @ lifted, g - B @ free
        unit, ridge = np.abs(h).max(), 1e-12 * np.diag(G)
        step, psi = np.diag(G).max() / unit, np.full(len(g), np.log(unit))
        for _ in range(200):
            before = psi
            for _ in range(50):
                slack = np.exp(psi)
                residual = slack + G @ (psi - before) / step - h
                if np.abs(residual).max() <= 1e-2 * accuracy * unit:
                    break
                change = np.linalg.solve(G / step + np.diag(slack + ridge / step), -residual)
                # exp grows fast: the linearisation holds for a moderate rise
                psi = psi + change * min(1.0, 3.0 / max(change.max(), 3.0))
            nu = np.maximum(before - psi, 0.0) / step
            x = free - lifted @ nu
            if nu @ np.abs(B @ x - g) <= accuracy * (nu @ G @ nu):
                break
            step *= growth
        return free - lifted @ nu, nu

    return solve


def sparse_dictionary(offline: Reduction, accuracy: float) -> Query:
    """A greedy active set (Kollepara et al. 2024): the most violated generator enters, negative ones leave."""

    def solve(mu: Array) -> tuple[Any, ...]:
        reduced = offline.assembled.assemble(mu)
        A, f, B, g = reduced.program.A, reduced.program.f, reduced.program.B, reduced.program.g
        factor = (np.linalg.cholesky(A) if reduced.factor is None else reduced.factor, True)
        free = scipy.linalg.cho_solve(factor, f)
        x, chosen, nu, lifted = free, list[int](), np.zeros(0), np.zeros((len(f), 0))
        tolerance = accuracy * np.abs(B @ free - g).max()
        while (violation := B @ x - g).max() > tolerance:
            chosen, nu = [*chosen, int(violation.argmax())], np.append(nu, 0.0)
            lifted = np.column_stack([lifted, scipy.linalg.cho_solve(factor, B[chosen[-1]])])
            while (wanted := np.linalg.solve(B[chosen] @ lifted, B[chosen] @ free - g[chosen])).min() < 0.0:
                falling = wanted < 0.0
                share = np.min(nu[falling] / (nu[falling] - wanted[falling]))
                nu = nu + share * (wanted - nu)
                kept = nu > 1e-14 * nu.max()
                chosen, nu, lifted = [i for i, k in zip(chosen, kept, strict=True) if k], nu[kept], lifted[:, kept]
            nu, x = wanted, free - lifted @ wanted
        alpha = np.zeros(len(g))
        alpha[chosen] = nu
        return x, alpha

    return solve


def local(offline: Reduction, solve_qp: SolveQP, clusters: int = 4) -> Query:
    """Spaces for clusters of parameters (Amsallem, Zahr and Farhat 2012), of the nearest centroid at a query.

    Answers have the reconstruction of u and the generators of the cluster, too.
    """
    box, snapshots = offline.problem.parameters, offline.snapshots
    points = (snapshots.mu - box.lower) / box.widths
    centroids, owners = kmeans2(points, clusters, minit="++", rng=np.random.default_rng(0))
    models = []
    for own in (owners == k for k in range(clusters)):
        part = Snapshots(snapshots.mu[own], snapshots.u[:, own], snapshots.lam[:, own])
        models.append(replace(offline).given(snapshots=part, members=offline.members).assembled)

    def solve(mu: Array) -> tuple[Any, ...]:
        model = models[np.argmin(np.sum(((mu - box.lower) / box.widths - centroids) ** 2, axis=1))]
        reduced = model.assemble(mu)
        found = solve_qp(reduced.program, factor=reduced.factor)
        return found.x, found.alpha, reduced.reconstruct, model.generators

    return solve


def _projected(offline: Reduction) -> tuple[Array, Array, Array]:
    """Coefficients of the snapshots in V_N (P×N) and in the span of the cone (P×r), and the generators in that span."""
    problem, snapshots, span = offline.problem, offline.snapshots, offline.multipliers.span
    tested = problem.W.apply(span)
    return (
        (problem.V.apply(offline.pod.basis).T @ snapshots.u).T,
        (tested.T @ snapshots.lam).T,
        tested.T @ offline.cone.generators,
    )


def radial_regression(offline: Reduction) -> Query:
    """Cubic radial basis functions and a linear one for all coefficients (Audouze, De Vuyst and Nair 2009)."""
    box = offline.problem.parameters
    points = (offline.snapshots.mu - box.lower) / box.widths
    of_u, of_lam, rays = _projected(offline)
    cubes = np.linalg.norm(points[:, None] - points[None], axis=2) ** 3
    linear = np.column_stack([np.ones(len(points)), points])
    zero, count = np.zeros((linear.shape[1], linear.shape[1])), of_u.shape[1]
    values = np.vstack([np.hstack([of_u, of_lam]), np.zeros((len(zero), count + of_lam.shape[1]))])
    weights = np.linalg.solve(np.block([[cubes, linear], [linear.T, zero]]), values)

    def solve(mu: Array) -> tuple[Any, ...]:
        point = (mu - box.lower) / box.widths
        away = np.sqrt(np.sum((points - point) ** 2, axis=1)) ** 3
        values = np.concatenate([away, [1.0], point]) @ weights
        return values[:count], scipy.optimize.nnls(rays, values[count:])[0]

    return solve


def gaussian_regression(offline: Reduction) -> Query:
    """A Gaussian process for every coefficient (Guo and Hesthaven 2018); the third answer is the deviation of u."""
    from sklearn.exceptions import ConvergenceWarning  # noqa: PLC0415  an extra, and slow to import
    from sklearn.gaussian_process import GaussianProcessRegressor  # noqa: PLC0415
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern  # noqa: PLC0415

    box = offline.problem.parameters
    points = (offline.snapshots.mu - box.lower) / box.widths
    of_u, of_lam, rays = _projected(offline)
    kernel = ConstantKernel(1.0, (1e-3, 1e6)) * Matern(np.ones(box.dim), (5e-2, 1e2), nu=2.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # what fits best may be at a bound
        processes = [
            GaussianProcessRegressor(kernel, alpha=1e-8, normalize_y=True).fit(points, values)
            for values in np.hstack([of_u, of_lam]).T
        ]
    count, identity = of_u.shape[1], np.eye(len(points))
    scaled = 5.0 / np.array([np.broadcast_to(each.kernel_.k2.length_scale, box.dim) for each in processes]) ** 2
    variance = np.array([each.kernel_.k1.constant_value for each in processes])
    mean, spread = (np.array([getattr(each, name) for each in processes]) for name in ("_y_train_mean", "_y_train_std"))
    weights = (variance * spread)[:, None] * np.array([each.alpha_ for each in processes])
    inverse = np.array([scipy.linalg.solve_triangular(each.L_, identity, lower=True) for each in processes[:count]])
    left_out = np.mean(offline.problem.V.norm(offline.snapshots.u - offline.pod.basis @ of_u.T) ** 2)

    def solve(mu: Array) -> tuple[Any, ...]:
        square = scaled @ ((points - (mu - box.lower) / box.widths) ** 2).T
        r = np.sqrt(square)
        k = (1.0 + r + square / 3.0) * np.exp(-r)
        values = mean + np.sum(k * weights, axis=1)
        explained = np.sum((inverse @ (variance[:count, None] * k[:count])[:, :, None]) ** 2, axis=(1, 2))
        deviation = np.sqrt(np.maximum(variance[:count] - explained, 0.0) @ spread[:count] ** 2 + left_out)
        return values[:count], scipy.optimize.nnls(rays, values[count:])[0], deviation

    return solve


def hyper_reduced(
    offline: Reduction, solve_qp: SolveQP, Z: Array, elements: tuple[Array, Array] | None, tested: Array
) -> Query:
    """Integrals over weighted elements (Farhat, Chapman and Avery 2015), the constraint tested with Ω χ on few rows.

    Spaces and domains are given: the basis Z (n×N'), elements with their weights where A and f are integrated, and the
    weighted generators (m×R), zero outside the rows of the domain (Fauque, Ramière and Ryckelynck 2018).
    """
    problem = offline.problem
    members = projected_members(problem, Z, tested, () if elements is None else ("A", "f"))
    if elements is not None:
        chosen, weights = elements
        sample, dofs = problem.element_sampler(chosen), problem.element_dofs[:, chosen].T
        on = np.where(dofs[:, :, None] < 0, 0.0, Z[dofs])
        weighted = weights[:, None, None] * on

    def solve(mu: Array) -> tuple[Any, ...]:
        found = members(mu)
        if elements is not None:
            values = sample(mu)
            flat = weighted.reshape(-1, Z.shape[1])
            found |= {"A": flat.T @ (values["A"] @ on).reshape(flat.shape), "f": flat.T @ values["f"].ravel()}
        answer = solve_qp(VariationalInequality(**found))
        return answer.x, answer.alpha

    return solve
