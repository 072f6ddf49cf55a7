"""Problems that are hard for solvers and bounds: stiff ones, and ones with dependent rows and equalities."""

from itertools import pairwise

import numpy as np
import scipy.sparse as sp

from vibench import AffineProblem, Array, InnerProduct, ParameterBox


def scattered(parts: list[tuple[Array, Array]], n: int) -> sp.csr_array:
    """The sum of element matrices (k×k) on their unknowns (k,), those below 0 left out."""
    rows, columns, data = [], [], []
    for matrix, dofs in parts:
        kept = dofs >= 0
        i, j = np.meshgrid(dofs[kept], dofs[kept], indexing="ij")
        rows.append(i.ravel())
        columns.append(j.ravel())
        data.append(matrix[np.ix_(kept, kept)].ravel())
    places = np.concatenate(rows), np.concatenate(columns)
    return sp.csr_array(sp.coo_array((np.concatenate(data), places), shape=(n, n)))


class Beam(AffineProblem):
    """A clamped beam of cubic Hermite elements over an obstacle, whose condition number grows as their number⁴."""

    parameters = ParameterBox(("load", "bias", "depth"), np.array([1, -1, 4e-4]), np.array([4, 1, 2e-3]), ("1",) * 3)

    def __init__(self, elements: int) -> None:
        h, inner, n = 1.0 / elements, elements - 1, 2 * (elements - 1)
        K = np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h]]) / h**3
        K = np.vstack([K, K[:1] * [-1, -1, -1, -1], [6 * h / h**3, 2 / h, -6 * h / h**3, 4 / h]])
        places = [np.array([2 * e - 2, 2 * e - 1, 2 * e, 2 * e + 1]) for e in range(elements)]
        places = [np.where((dofs < 0) | (dofs >= n), -1, dofs) for dofs in places]
        A = scattered([(K, dofs) for dofs in places], n)
        B = sp.csr_array((np.full(inner, -h), (np.arange(inner), 2 * np.arange(inner))), shape=(inner, n))
        load, x = np.zeros(n), h * np.arange(1, elements)
        load[::2] = -h
        bias = np.zeros(n)
        bias[::2] = -h * np.sin(2.0 * np.pi * x)
        self.V, self.W = InnerProduct(A), InnerProduct(h * sp.eye_array(inner, format="csc"))
        g = [("depth", np.full(inner, h)), (1.0, 1e-3 * h * (x - 0.4) ** 2)]
        self.declare(A=A, f=[("load", load), ("bias", bias)], B=B, g=g)

    def training_set(self) -> Array:
        return self.parameters.grid(5, 4, 3)


class Floating(AffineProblem):
    """A string with free ends on springs so weak that the stiffness is nearly singular, above a floor near one end.

    Where A varies its tension does, too.
    """

    parameters = ParameterBox(("load", "bias", "tension"), np.array([1, -1, 0.5]), np.array([2, 1, 2.0]), ("1",) * 3)

    def __init__(self, springs: float, varying: bool, nodes: int = 14, contact: int = 5) -> None:
        off, rng = -np.ones(nodes - 1), np.random.default_rng(0)
        diagonal = np.where((np.arange(nodes) == 0) | (np.arange(nodes) == nodes - 1), 1.0, 2.0)
        string = sp.csr_array(sp.diags_array([diagonal, off, off], offsets=[0, 1, -1]))
        spring = sp.csr_array(springs * sp.eye_array(nodes))
        B = sp.csr_array((-np.ones(contact), (np.arange(contact), np.arange(contact))), shape=(contact, nodes))
        self.V, self.W = (InnerProduct(sp.eye_array(size, format="csc")) for size in (nodes, contact))
        loads = ((string + spring) @ rng.standard_normal((nodes, 2))).T
        self.declare(
            A=[("tension", string), (1.0, spring)] if varying else string + spring,
            f=[("load", loads[0]), ("bias", loads[1])], B=B, g=np.full(contact, 0.1),
        )  # fmt: skip

    def training_set(self) -> Array:
        return self.parameters.grid(4, 4, 2)


class Truss(AffineProblem):
    """A truss with two chords on two hinges, over unilateral springs under every lower node: they push and do not pull.

    The end of a spring is an unknown of its own, below the node: node − end ≥ −gap.
    """

    parameters = ParameterBox(
        ("load", "bias", "stiffness"), np.array([0.5, -1, 0.1]), np.array([2, 1, 1.0]), ("1",) * 3
    )

    def __init__(self, bays: int) -> None:
        nodes = np.stack(np.meshgrid(np.arange(bays + 1.0), [0.0, 1.0]), axis=-1).transpose(1, 0, 2).reshape(-1, 2)
        lower, upper = 2 * np.arange(bays + 1), 2 * np.arange(bays + 1) + 1
        bars = [*pairwise(lower), *pairwise(upper)]
        bars += [*zip(lower, upper, strict=True), *zip(lower[:-1], upper[1:], strict=True)]
        fixed = np.zeros(2 * len(nodes), bool)
        fixed[[2 * lower[0], 2 * lower[0] + 1, 2 * lower[-1] + 1]] = True
        number = np.where(fixed, -1, np.cumsum(~fixed) - 1)
        count, springs = int(np.count_nonzero(~fixed)), bays - 1
        n, parts = count + springs, []
        for i, j in bars:
            along = nodes[j] - nodes[i]
            length = np.linalg.norm(along)
            axis = np.concatenate([-along, along]) / length
            dofs = number[[2 * i, 2 * i + 1, 2 * j, 2 * j + 1]]
            parts.append((np.outer(axis, axis) / length, dofs))
        A, ends = scattered(parts, n), count + np.arange(springs)
        spring = sp.csr_array((np.ones(springs), (ends, ends)), shape=(n, n))
        heights, rows = number[2 * lower[1:-1] + 1], np.arange(springs)
        pair = np.concatenate([rows, rows]), np.concatenate([heights, ends])
        B = sp.csr_array((np.repeat([-1.0, 1.0], springs), pair), shape=(springs, n))
        load, x = np.zeros(n), (rows + 1.0) / bays
        load[heights] = -1.0 / bays**3
        bias = np.zeros(n)
        bias[heights] = -4.0 * np.sin(3.0 * np.pi * x) / bays**3
        self.V, self.W = InnerProduct(A + spring), InnerProduct(sp.eye_array(springs, format="csc") / bays)
        terms = [(1.0, A), (1e-3 / bays**3, spring), (f"stiffness / {bays**3}", spring)]
        self.declare(A=terms, f=[("load", load), ("bias", bias)], B=B, g=0.02 * (1.0 + x) ** 2)

    def training_set(self) -> Array:
        return self.parameters.grid(5, 4, 3)


class DoubleObstacle(AffineProblem):
    """A string between two obstacles on its middle part, with rows that depend on others, and equalities.

    Both obstacles hold at the nodes; the sums over neighbours, all rows of the upper one scaled by powers of two, and
    copies of some say the same again, one with an error of 1.5e-8. The mean is prescribed by a row and its opposite.
    """

    parameters = ParameterBox(("load", "bias", "mean"), np.array([1, -3, -0.02]), np.array([3, 3, 0.02]), ("1",) * 3)

    def __init__(self, nodes: int) -> None:
        h, rng = 1.0 / (nodes + 1), np.random.default_rng(0)
        x, off = h * np.arange(1, nodes + 1), -np.ones(nodes - 1)
        A = sp.csr_array(sp.diags_array([2.0 * np.ones(nodes), off, off], offsets=[0, 1, -1]) / h)
        middle = np.flatnonzero((x > 0.3) & (x < 0.7))
        above = sp.csr_array(sp.eye_array(nodes, format="csr")[middle])
        bounds = 0.06 + 0.1 * (x[middle] - 0.5) ** 2, 0.05 + 0.2 * (x[middle] - 0.45) ** 2
        ceiling, floor = (np.round(bound * 2.0**24) / 2.0**24 for bound in bounds)  # all sums below are exact
        sums = sp.csr_array(above[:-1] + above[1:])
        scale = 2.0 ** np.round(rng.uniform(-26.0, 26.0, len(middle)))
        near = sp.csr_array(above[3:4] + 2.0**-26 * above[4:5])
        mean = sp.csr_array(np.full((1, len(middle)), 1.0 / len(middle)) @ above)
        rows = [above, -above, sums, sp.diags_array(scale) @ above, -above[::5], near, mean, -mean]
        fixed = [ceiling, floor, ceiling[:-1] + ceiling[1:], scale * ceiling, floor[::5]]
        fixed += [ceiling[3:4] + 2.0**-26 * ceiling[4:5], np.zeros(2)]
        varying = np.zeros(sum(row.shape[0] for row in rows))
        varying[-2:] = 1.0, -1.0
        self.V, self.W = InnerProduct(A), InnerProduct(sp.eye_array(len(varying), format="csc"))
        load = h * np.sin(2.0 * np.pi * x) * 6.0
        g = [(1.0, np.concatenate(fixed)), ("mean", varying)]
        self.declare(A=A, f=[("load", load), ("bias", h * np.ones(nodes))], B=sp.csr_array(sp.vstack(rows)), g=g)

    def training_set(self) -> Array:
        return self.parameters.grid(5, 4, 3)
