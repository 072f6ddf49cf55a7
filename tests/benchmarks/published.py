"""The algorithms of Niakh, Drouet, Ehrlacher and Ern (2022) as its authors' tools do them, the yardstick of ours.

The authors wrote them in Python around cvxopt (§5): every quadratic program is cvxopt's, bases are orthonormalised by
Gram-Schmidt, every indicator is evaluated at every step, a query assembles and projects high-fidelity matrices. Done
with care for speed within that (sparse matrices, one factorisation of X_V, array operations), by nothing of vibench's.
"""

from collections.abc import Callable, Sequence

import cvxopt
import cvxopt.solvers
import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu

from vibench import Array, Mask, Problem, SparseMatrix, Stop, VariationalInequality

TIE = 1e-9
"""Relative values that differ by less count as equal; the smallest index wins."""

NULL = 1e-12
"""What is smaller than this, relative to what it was or to its largest entry, is round-off."""

SNAPSHOT_ACCURACY = 1e-10
CONE_ACCURACY = 1e-12
"""Of projections and of line 9 of Algorithm 2; with less, ties of distances are lost in the noise of the solver."""


def quadratic_program(
    P: Array | SparseMatrix, q: Array, G: Array | SparseMatrix, h: Array, accuracy: float
) -> tuple[Array, Array]:
    """The minimiser x (n,) of ½ xᵀP x + qᵀx subject to G x ≤ h, and multipliers (m,), by cvxopt: its last iterate.

    The accuracy is that of the gap and the residuals, relative as cvxopt defines them. An absolute gap is accepted that
    is far smaller: the values of these programs are small themselves.
    """
    options = {"show_progress": False, "abstol": 1e-3 * accuracy, "reltol": accuracy, "feastol": accuracy}
    found = cvxopt.solvers.qp(_matrix(P), _matrix(q), _matrix(G), _matrix(h), options=options)
    return np.array(found["x"]).ravel(), np.array(found["z"]).ravel()


def _matrix(data: Array | SparseMatrix) -> cvxopt.matrix | cvxopt.spmatrix:
    if isinstance(data, np.ndarray):
        return cvxopt.matrix(data)
    entries = sp.coo_array(data)
    row, column = (np.asarray(index, dtype=np.int64) for index in (entries.row, entries.col))
    return cvxopt.spmatrix(cvxopt.matrix(entries.data), cvxopt.matrix(row), cvxopt.matrix(column), entries.shape)


def snapshots(problem: Problem, mus: Array) -> tuple[Array, Array]:
    """High-fidelity solutions u (n×P) and λ (m×P) of (7) at the parameters mus (P×d).

    Noise of 1e-7 off the contact set, which interior-point methods leave, changes the dimension R of the cones: the
    active set is taken from cvxopt's solution and one sparse system gives exact zeros.
    """
    found = [_polished(vi, _first_guess(vi)) for vi in map(problem.assemble, mus)]
    return np.column_stack([u for u, _ in found]), np.column_stack([lam for _, lam in found])


def _first_guess(vi: VariationalInequality) -> Mask:
    """Constraints (m,) that are active in cvxopt's solution: the multiplier is larger than the slack, relatively."""
    u, lam = quadratic_program(vi.A, -vi.f, vi.B, vi.g, SNAPSHOT_ACCURACY)
    slack = vi.g - vi.B @ u
    return lam / lam.max() > np.maximum(slack / slack.max(), 1e-8)


def _polished(vi: VariationalInequality, active: Mask, tries: int = 10) -> tuple[Array, Array]:
    """u and λ with the active constraints as equalities, which are corrected where a sign is wrong."""
    n, B = len(vi.f), sp.csr_array(vi.B)
    for _ in range(tries):
        rows, lam = B[active], np.zeros(len(vi.g))
        right = np.concatenate([vi.f, vi.g[active]])
        matrix = sp.csc_array(sp.block_array([[vi.A, rows.T], [rows, None]])) if len(right) > n else sp.csc_array(vi.A)
        factor = splu(matrix)
        solution = factor.solve(right)
        solution += factor.solve(right - matrix @ solution)
        u, lam[active] = solution[:n], solution[n:]
        excess = vi.B @ u - vi.g
        corrected = np.where(active, lam > 0.0, excess > 1e-14 * np.abs(vi.g).max())
        if np.array_equal(corrected, active):
            return u, lam
        active = corrected
    raise ArithmeticError(f"{tries} corrections of the active set were not enough")


def pod(U: Array, X: SparseMatrix, stop: Stop) -> Array:
    """POD basis of V_N (n×N) by the method of snapshots U (n×P): eigenvalues of UᵀX_V U, (10) and (11).

    The tail floors at 1e-8; modes with small eigenvalues are not orthogonal to round-off and are made so.
    """
    values, vectors = np.linalg.eigh(U.T @ (X @ U))
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    tails = np.sqrt(np.append(np.cumsum(values[::-1])[::-1], 0.0) / values.sum())
    size = stop.first_reached(tails)
    return gram_schmidt(U @ (vectors[:, :size] / np.sqrt(values[:size])), X)


def gram_schmidt(Y: Array, X: SparseMatrix, against: Array | None = None) -> Array:
    """Orthonormal basis (n×r), r ≤ k, of what the columns of Y (n×k) add to orthonormal columns `against` (n×l).

    Modified Gram-Schmidt in the inner product X (n×n): every new vector is taken out of all that follow. Vectors are
    orthogonalised once more when their turn comes, null directions dropped.
    """
    lengths = np.sqrt(np.einsum("ij,ij->j", Y, X @ Y))
    if against is not None and against.shape[1]:
        Y = project_out(Y, against, X @ against)
    rows = Y.T.copy()
    basis, duals, rank = np.empty_like(rows), np.empty_like(rows), 0
    for j, length in enumerate(lengths):
        y = rows[j] - (duals[:rank] @ rows[j]) @ basis[:rank]  # again
        rest = np.sqrt(y @ (X @ y))
        if rest > NULL * length:
            basis[rank] = y / rest
            duals[rank] = X @ basis[rank]
            rows[j + 1 :] -= np.outer(rows[j + 1 :] @ duals[rank], basis[rank])
            rank += 1
    return np.ascontiguousarray(basis[:rank].T)


def project_out(Y: Array, Z: Array, XZ: Array) -> Array:
    """(I − Π_Z) Y for Z (n×l) with orthonormal columns, its products X Z (n×l) and Y (n×k); projected out twice."""
    for _ in range(2):
        Y = Y - Z @ (XZ.T @ Y)
    return Y


def cpg(theta: Array, X: SparseMatrix, stop: Stop) -> Array:
    """Generators (m×R) of the cone projected greedy algorithm for snapshots θ_q (m×Q) in W, Remark 4.3."""
    return _greedy_cone(theta, X, stop, lambda q, chi: theta[:, q])


def mcpg(theta: Array, X: SparseMatrix, stop: Stop) -> Array:
    """Generators (m×R) of Algorithm 2 for snapshots θ_q (m×Q) in W."""
    return _greedy_cone(theta, X, stop, lambda q, chi: _line_9(theta[:, q], chi, X) if chi.shape[1] else theta[:, q])


def _greedy_cone(theta: Array, X: SparseMatrix, stop: Stop, widen: Callable[[int, Array], Array]) -> Array:
    """Lines 1 to 16 of Algorithm 2: every step projects every snapshot that has not been chosen.

    `widen(q, χ)` is what becomes of the chosen snapshot θ_q, before it is normalised.
    """
    squares = np.einsum("ij,ij->j", theta, X @ theta)
    largest = np.sqrt(squares.max())
    chi, remaining = np.zeros((len(theta), 0)), np.ones(len(squares), dtype=bool)
    distances, error = np.sqrt(squares) / largest, 1.0
    while not stop.reached(chi.shape[1], error) and np.any(remaining):
        pick = first_largest(distances)
        remaining[pick] = False
        nu = widen(pick, chi)
        length = np.sqrt(nu @ (X @ nu))
        if length <= NULL * largest:  # Remark 4.2
            break
        chi = np.column_stack([chi, nu / length])
        gram, cross = chi.T @ (X @ chi), chi.T @ (X @ theta) / largest
        distances = np.full(len(squares), -np.inf)
        for q in np.flatnonzero(remaining):
            distances[q] = _distance(gram, cross[:, q], squares[q] / largest**2)
        error = float(distances.max(initial=0.0))
    return chi


def _distance(gram: Array, cross: Array, square: float) -> float:
    """Distance of θ from the cone of χ: G = χᵀX_Wχ (r×r), b = χᵀX_Wθ (r,), θᵀX_Wθ; min ½αᵀGα − bᵀα over α ≥ 0."""
    r = len(cross)
    alpha, _ = quadratic_program(gram, -cross, -sp.eye_array(r), np.zeros(r), CONE_ACCURACY)
    alpha = np.maximum(alpha, 0.0)
    return float(np.sqrt(max(square - 2.0 * (cross @ alpha) + alpha @ gram @ alpha, 0.0)))


def _line_9(theta: Array, chi: Array, X: SparseMatrix) -> Array:
    """θ − Υ (m,) of Algorithm 2, line 9: Υ in the cone of χ (m×r) nearest to θ with θ − Υ ≥ 0 coefficientwise.

    A generator that is positive where θ is zero cannot take part, and would leave no strictly feasible point; on the
    support of θ the others have some. What the solver's round-off leaves of constraints and zeros is set right.
    """
    support = theta > 0.0
    chi = chi[:, ~np.any(chi[~support] > 0.0, axis=0)]
    r = chi.shape[1]
    if not r:
        return theta
    unit = theta / np.sqrt(theta @ (X @ theta))
    above = np.vstack([-np.eye(r), chi[support]])
    bound = np.concatenate([np.zeros(r), unit[support]])
    alpha, _ = quadratic_program(chi.T @ (X @ chi), -chi.T @ (X @ unit), above, bound, CONE_ACCURACY)
    rest = unit - chi @ np.maximum(alpha, 0.0)
    if not rest.min() >= -1e-9 * unit.max():
        raise ArithmeticError(f"line 9 solved to {-rest.min():.0e} only: the cone would lose the snapshot")
    rest[rest < NULL * unit.max()] = 0.0
    return rest


def first_largest(values: Array) -> int:
    """Index of the largest value, the smallest one within `TIE`."""
    return int(np.argmax(values >= values.max() - TIE))


def factorise(X: SparseMatrix) -> SuperLU:
    """The factorisation of X_V (n×n) that serves the supremizers of every parameter."""
    return splu(sp.csc_array(X), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def supremizers(factor: SuperLU, B: SparseMatrix, chi: Array) -> Array:
    """T(mu)χ = X_V⁻¹Bᵀχ (n×R), equation (15)."""
    return np.asarray(factor.solve(np.asarray(B.T @ chi)))


def pga(problem: Problem, basis: Array, chi: Array, delta: float, kept: bool = False) -> Array:
    """S^red (n×S), orthonormal and orthogonal to V_N: Algorithm 1, σ_S(mu) for every training mu at every step.

    As printed, every step applies I − Π_{V_N+S} to every S_R(mu), until no σ_S(mu) is above δ, (27). With `kept` it
    keeps what V_N + S leaves of every S_R(mu) and takes only the new vector out of it: less work than printed.
    """
    X, factor = sp.csr_array(problem.V.matrix), factorise(problem.V.matrix)
    matrices = (problem.assemble(mu).B for mu in problem.training_set())
    spaces = [gram_schmidt(supremizers(factor, B, chi), X) for B in matrices]
    space, left = basis, residuals(X, spaces, basis)
    while True:
        eigen = [np.linalg.eigh(E.T @ (X @ E)) for E in left]
        sigma = np.sqrt([max(values[-1], 0.0) for values, _ in eigen])
        worst = first_largest(sigma)
        if sigma.max() <= delta:
            return space[:, basis.shape[1] :]
        v = gram_schmidt(left[worst] @ _canonical(*eigen[worst])[:, None], X, space)
        if not v.shape[1]:
            raise ArithmeticError(f"all supremizers leave σ = {sigma.max():.0e}, above the tolerance {delta:g}")
        space = np.column_stack([space, v])
        left = residuals(X, left, v) if kept else residuals(X, spaces, space)


def residuals(X: SparseMatrix, spaces: Sequence[Array], Z: Array) -> list[Array]:
    """(I − Π_Z) Q (n×R) for orthonormal bases Q (n×R) of the S_R(mu) and Z (n×l) of the space they are tried on."""
    XZ = X @ Z
    return [project_out(Q, Z, XZ) for Q in spaces]


def _canonical(values: Array, vectors: Array) -> Array:
    """Coefficients (R,) of the worst v in S_R(mu) from eigenvalues σ², rising, and eigenvectors of its Gram matrix.

    In a cluster of equal σ it is the projection on the cluster of the basis vector that is closest to it.
    """
    sines = np.sqrt(np.maximum(values, 0.0))
    cluster = vectors[:, sines >= sines[-1] - TIE]
    return np.asarray(cluster @ cluster[first_largest(np.linalg.norm(cluster, axis=1))])


Answer = tuple[VariationalInequality, Array, Array, Callable[[], Array]]
"""The reduced program (dense A, f, B, g), its solution x (N',) and α (R,), and what gives the basis Z (n×N'): u = Z x,
λ = χ α."""


def query_online(problem: Problem, factor: SuperLU, basis: Array, chi: Array, mu: Array, accuracy: float) -> Answer:
    """Answer at mu (d,) with V_N + S_R(mu), (17): assembly, supremizers, Gram-Schmidt against V_N, projection, cvxopt.

    `factor` is that of X_V, `basis` V_N (n×N), `chi` the generators (m×R).
    """
    vi = problem.assemble(mu)
    added = gram_schmidt(supremizers(factor, vi.B, chi), problem.V.matrix, basis)
    return _reduced(vi, np.column_stack([basis, added]), chi, accuracy)


def query_offline(problem: Problem, Z: Array, chi: Array, mu: Array, accuracy: float) -> Answer:
    """Answer at mu (d,) with V_N + S^red, (29), of basis Z (n×N'): assembly, projection, cvxopt."""
    return _reduced(problem.assemble(mu), Z, chi, accuracy)


def _reduced(vi: VariationalInequality, Z: Array, chi: Array, accuracy: float) -> Answer:
    A, B = Z.T @ (vi.A @ Z), chi.T @ (vi.B @ Z)
    program = VariationalInequality(A=0.5 * (A + A.T), f=Z.T @ vi.f, B=B, g=chi.T @ vi.g)
    x, alpha = quadratic_program(program.A, -program.f, program.B, program.g, accuracy)
    return program, x, np.maximum(alpha, 0.0), lambda: Z
