import numpy as np
import pytest
import scipy.sparse as sp

from vibench import NumericalError, RequestError
from vibench.linalg.factorisations import IMPLEMENTATIONS, Implementation, implementation
from vibench.linalg.proofs import is_proved_definite

EVERY = pytest.mark.parametrize("chosen", [pytest.param(one, id=name) for name, one in IMPLEMENTATIONS.items()])


@pytest.fixture(autouse=True)
def _installed(request: pytest.FixtureRequest) -> None:
    chosen = request.node.callspec.params.get("chosen") if hasattr(request.node, "callspec") else None
    if chosen is not None and not chosen.is_installed:
        pytest.skip(f"{chosen.distribution} is not installed")


Sizes = tuple[int, ...]
BODIES = pytest.mark.parametrize("sizes", [(15,), (9, 12)], ids=["one body", "two bodies"])


def membranes(sizes: Sizes, weight: float = 1.0) -> sp.csc_array:
    blocks = []
    for n in sizes:
        line = sp.diags_array([-np.ones(n - 1), 2.1 * np.ones(n), -np.ones(n - 1)], offsets=[-1, 0, 1])
        blocks.append(sp.kron(line, sp.eye_array(n)) + sp.kron(sp.eye_array(n), line))
    return sp.csc_array(weight * sp.block_diag(blocks))


def condensed(A: np.ndarray, last: np.ndarray) -> np.ndarray:
    rest = np.setdiff1d(np.arange(len(A)), last)
    return A[np.ix_(last, last)] - A[np.ix_(last, rest)] @ np.linalg.solve(A[np.ix_(rest, rest)], A[np.ix_(rest, last)])


@EVERY
@BODIES
@pytest.mark.parametrize("weight", [1e-9, 2e11])
def test_solutions_and_schur_complements_are_dense_ones(chosen: Implementation, sizes: Sizes, weight: float) -> None:
    A, rng = membranes(sizes, weight), np.random.default_rng(0)
    n, dense, factor = A.shape[0], A.toarray(), chosen.factorise(A, "A")
    for right in (rng.standard_normal(n), rng.standard_normal((n, 3)), np.zeros((n, 0)), np.zeros(n)):
        np.testing.assert_allclose(factor.solve(right), np.linalg.solve(dense, right), atol=1e-12 / weight)
    last = np.concatenate([np.arange(5), np.arange(n - 4, n)])
    order = np.concatenate([np.setdiff1d(np.arange(n), last), last])
    partly = chosen.eliminate(A, order, len(last), "A")
    schur = partly.schur_blocks()
    assert len(schur.blocks) == len(sizes)
    np.testing.assert_allclose(schur.toarray(), condensed(dense, last), atol=1e-12 * weight)
    for values in (rng.standard_normal(9), rng.standard_normal((9, 2))):
        u = partly.extend(values)
        np.testing.assert_array_equal(u[last], values)
        np.testing.assert_allclose((dense @ u)[order[:-9]], 0.0, atol=1e-12 * weight)
    solved, load = partly.eliminate(right := rng.standard_normal((n, 2)))
    np.testing.assert_allclose(load, schur.toarray() @ np.linalg.solve(dense, right)[last], atol=1e-11)
    np.testing.assert_allclose(dense[np.ix_(order[:-9], order[:-9])] @ solved, right[order[:-9]], atol=1e-11)


@EVERY
@BODIES
def test_a_factor_with_some_unknowns_last_makes_inner_products_euclidean(chosen: Implementation, sizes: Sizes) -> None:
    A, rng = membranes(sizes), np.random.default_rng(1)
    n, dense = A.shape[0], A.toarray()
    last = np.concatenate([np.arange(5), np.arange(n - 4, n)])
    both = [chosen.eliminate_with_factor(A, last, "A") for _ in range(2)]  # two at once, in one process
    u, right = rng.standard_normal((n, 3)), rng.standard_normal((n, 2))
    for factored in both:
        F, whitened = factored.apply_factor(u), factored.solve_factor_transposed(right)
        np.testing.assert_allclose(F.T @ F, u.T @ dense @ u, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(whitened.T @ whitened, right.T @ np.linalg.solve(dense, right), rtol=1e-12)
        np.testing.assert_allclose(F.T @ whitened, u.T @ right, rtol=1e-12, atol=1e-12)
        on_last = factored.solve_factor_transposed(np.eye(n)[:, last])
        assert not on_last[:-9].any()
        np.testing.assert_allclose(on_last[-9:], np.linalg.inv(factored.trailing_factor.T), atol=1e-13)


@EVERY
def test_tiny_matrices_and_what_is_not_definite_by_name(chosen: Implementation) -> None:
    A = sp.csc_array(np.diag([2.0, 3.0, 4.0, 5.0]) - 0.5 * np.eye(4, k=1) - 0.5 * np.eye(4, k=-1))
    for count in (0, 1, 4):
        partly = chosen.eliminate(A, np.arange(4), count, "A")
        np.testing.assert_allclose(partly.schur_blocks().toarray(), condensed(A.toarray(), np.arange(4 - count, 4)))
        assert partly.extend(np.ones(count)).shape == (4,)
    assert chosen.factorise(sp.csc_array([[4.0]]), "A").solve(np.array([2.0])) == pytest.approx(0.5)
    assert chosen.factorise(sp.csc_array((0, 0)), "A").solve(np.zeros((0, 2))).shape == (0, 2)
    for matrix in (
        -np.eye(3), np.diag([1.0, 0.0, 1.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([[1.0, 1.0], [1.0, 1.0]]),
        np.diag([1.0, np.nan]), np.diag([1.0, np.inf]), np.array([[1.0, np.nan], [np.nan, 1.0]]),
        membranes((8,)).toarray() - 1.0 * np.eye(64),
    ):  # fmt: skip
        with pytest.raises(NumericalError, match="the thing"):
            chosen.factorise(sp.csc_array(matrix), "the thing")
        assert not is_proved_definite([sp.csc_array(matrix)], chosen)


def test_names() -> None:
    assert next(iter(IMPLEMENTATIONS)) == "superlu"
    assert implementation("available").is_installed
    with pytest.raises(RequestError, match="superlu"):
        implementation("superlo")
