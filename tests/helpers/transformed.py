"""Problems written down in another way: other units, rows, unknowns and inner products, and rows that are far away."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench import AffineSum, Array, Contact, Indices, InnerProduct, Problem, Sampler, VariationalInequality
from vibench_problems.hertz import Hertz
from vibench_problems.obstacle import Obstacle
from vibench_problems.pack import Pack
from vibench_problems.radial import Radial

BASES = {"hertz": Hertz, "obstacle": Obstacle, "radial-obstacle": Radial, "pack": Pack}
FAR_ROWS, TRAINING = 3, 24


class Transformed(Problem):
    """A problem with u = length · S P u' and λ = force/length · D λ', diagonal S and D, and a permutation P.

    Energies are those of the problem times force · length, in which the norms of both spaces are measured, too, so that
    inf-sup constants and relative errors stay what they are. `rows` and `unknowns` are the largest powers of ten in D
    and S; with `far` the first rows appear once more with this bound.
    """

    def __init__(
        self, base: str, options: dict[str, Any] | None = None, length: int = 0, force: int = 0, rows: float = 0.0,
        unknowns: float = 0.0, far: float = 0.0, seed: int = 0,
    ) -> None:  # fmt: skip
        self._base = problem = BASES[base](**(options or {}))
        rng, n, m = np.random.default_rng(seed), problem.V.dim, problem.W.dim
        self.parameters, self.constant, self.entrywise = problem.parameters, problem.constant, problem.entrywise
        self._energy, self._far = 10.0 ** (force + length), far
        self._order = rng.permutation(n) if unknowns else np.arange(n)
        S = 10.0 ** (length + rng.uniform(-unknowns, unknowns, n))
        self._T = sp.csr_array((S, (self._order, np.arange(n))), shape=(n, n))  # u = T u'
        self._columns, self._S = np.argsort(self._order), S
        added = FAR_ROWS if far else 0
        self._repeated = np.concatenate([np.arange(m), np.arange(added)])
        self._D = 10.0 ** rng.uniform(-rows, rows, m + added)
        self.V = InnerProduct(self._transformed("A", problem.V.matrix))
        apart = sp.block_diag([problem.W.matrix, sp.diags_array(problem.W.matrix.diagonal()[:added])], format="csr")
        # ‖λ‖²_W energy, with λ = D λ' / energy
        self.W = InnerProduct(sp.diags_array(self._D) @ apart @ sp.diags_array(self._D) / self._energy)
        self.affine = {name: self._sum(name, declared) for name, declared in problem.affine.items()}

    def _transformed(self, name: str, member: Any) -> Any:
        T, D = self._T, sp.diags_array(self._D)
        if name == "A":
            return self._energy * sp.csr_array(T.T @ member @ T)
        if name == "f":
            return self._energy * (T.T @ member)
        if name == "B":
            return sp.csr_array(D @ sp.csr_array(member)[self._repeated] @ T)
        return self._D * member[self._repeated]

    def _away(self, g: Array) -> Array:
        count = self._base.W.dim
        return np.concatenate([g[:count], np.full(len(g) - count, self._far)])

    def _sum(self, name: str, declared: AffineSum) -> AffineSum:
        terms = tuple(self._transformed(name, term) for term in declared.terms)
        if name != "g" or not self._far:
            return AffineSum(terms, declared.coefficients)
        none = np.zeros(len(self._D))
        none[self._base.W.dim :] = self._far
        terms = (*(term * (none == 0.0) for term in terms), none)
        return AffineSum(terms, lambda mu: np.append(declared.coefficients(mu), 1.0))

    def training_set(self) -> Array:
        """A few of the parameters, spread over the training set."""
        mus = self._base.training_set()
        return mus[np.linspace(0, len(mus) - 1, min(len(mus), TRAINING)).round().astype(int)]

    def validation_set(self, count: int, seed: int) -> Array:
        return self._base.validation_set(count, seed)

    def assemble(self, mu: Array) -> VariationalInequality:
        vi = self._base.assemble(mu)
        A, f, B, g = (self._transformed(name, getattr(vi, name)) for name in ("A", "f", "B", "g"))
        return VariationalInequality(A, f, B, self._away(g))

    @property
    def contact_dofs(self) -> Indices | None:
        dofs = self._base.contact_dofs
        return None if dofs is None else np.sort(self._columns[dofs])

    def contact(self, mu: Array) -> Contact:
        contact, dofs = self._base.contact(mu), self._base.contact_dofs
        order = np.argsort(self._columns[dofs])
        B = sp.csr_array(contact.B)[self._repeated][:, order] @ sp.diags_array(self._S[self.contact_dofs])
        return Contact(sp.csr_array(sp.diags_array(self._D) @ B), self._away(self._D * contact.g[self._repeated]))

    @property
    def has_contact(self) -> bool:
        return self._base.has_contact

    def sampler(self, wanted: Mapping[str, tuple[Indices, Indices]]) -> Sampler:
        places, factors = {}, {}
        for name, (rows, columns) in wanted.items():
            if name in "Af":
                i, j = self._order[rows], self._order[columns]
                # only the upper triangle of the symmetric A is asked for
                places[name] = (np.minimum(i, j), np.maximum(i, j)) if name == "A" else (i, columns)
                factors[name] = self._energy * self._S[rows] * (self._S[columns] if name == "A" else 1.0)
            else:
                places[name] = (self._repeated[rows], self._order[columns] if name == "B" else columns)
                factors[name] = self._D[rows] * (self._S[columns] if name == "B" else 1.0)
        sample, count = self._base.sampler(places), self._base.W.dim

        def evaluate(mu: Array) -> Mapping[str, Array]:
            values = {name: factors[name] * value for name, value in sample(mu).items()}
            if "g" in values:
                values["g"] = np.where(wanted["g"][0] < count, values["g"], self._far)
            return values

        return evaluate

    def multiplier_integrals(self) -> Array:
        return self._D * self._base.multiplier_integrals()[self._repeated] / self._energy
