"""A cache of assembled matrices and their factors for assessments, which use the same parameters repeatedly."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from operator import attrgetter

import numpy as np
from cachetools import LRUCache, cachedmethod

from vibench.arrays import Array, digest
from vibench.highfidelity.active_set import HighFidelitySolver
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.interfaces.problem import Problem, VariationalInequality
from vibench.interfaces.validation import checked_assembly
from vibench.model.errors import EnergyNorm
from vibench.stability.coercivity import Constant, Quotients, coercivity, continuity, energy_inf_sup, share_of_diagonal
from vibench.stability.contact_infsup import ContactInfSup, multiple_of


class Assemblies:
    """Cached assemblies of one problem; timed code must use none of it but `energy_of`."""

    def __init__(self, problem: Problem, limit: int | None = None, factor_limit: int | None = None) -> None:
        self._problem = problem
        # Limits in bytes: 256 MiB of assemblies, and 768 MiB of factors of A and compliances. Cells use the same
        # parameters in the same order, so a cache that does not hold all of them never hits.
        self._kept: LRUCache[bytes, VariationalInequality] = LRUCache(limit or 2**28, getsizeof=_bytes)
        self._energies: LRUCache[bytes, EnergyNorm] = LRUCache(factor_limit or 3 * 2**28, getsizeof=self._own_bytes)
        self._last: tuple[bytes, EnergyNorm] | None = None
        self._solver = HighFidelitySolver(problem, condensing=True)
        self._contact: tuple[CondensedStiffness, ContactInfSup] | None = None
        # Quotients hold vectors of mesh size, unlike the constants below: keep one.
        self._quotients: LRUCache[bytes, Quotients] = LRUCache(1)
        self._alphas: LRUCache[bytes, Constant] = LRUCache(1000)
        self._gammas: LRUCache[bytes, Constant] = LRUCache(1000)
        self._digests: LRUCache[tuple[str, bytes], bytes] = LRUCache(2000)
        self._betas: LRUCache[tuple[bytes, bytes], Constant] = LRUCache(1000)

    @cachedmethod(attrgetter("_kept"), key=lambda _, mu: _key(mu))
    def at(self, mu: Array) -> VariationalInequality:
        """A copy of `checked_assembly` at mu (d,), which later assemblies leave as it is."""
        return checked_assembly(self._problem, mu).copy()

    def energy_at(self, mu: Array) -> EnergyNorm:
        """Factorisations of A at mu (d,) and what errors and bounds at mu share; a constant A is factorised once."""
        vi, key = self.at(mu), _key(mu)
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        # Release the last factorisation first: two large ones may not fit in memory.
        found, self._last = self._energies.get(key), None
        if found is None:
            found = replace(self.energy_of(vi), shared=True)
            # A constant A is factorised once, and timed code uses that factorisation, too.
            if "A" not in self._problem.constant:
                found.stiffness.serve_many(len(vi.g))
            # Made now, since it counts in the size by which the cache decides.
            found.contact_form(vi)
            if self._own_bytes(found) <= self._energies.maxsize:
                self._energies[key] = found
        self._last = key, found
        return found

    def together(self, mu: Array) -> int:
        """At how many parameters like mu (d,) what `at` and `energy_at` return may be held at once: one at least."""
        sizes = (self._kept.maxsize, _bytes(self.at(mu))), (self._energies.maxsize, self._own_bytes(self.energy_at(mu)))
        return max(1, min(int(limit // max(size, 1)) for limit, size in sizes))

    def energy_of(self, vi: VariationalInequality) -> EnergyNorm:
        """Factorisations of an assembled A, which are not kept unless it is constant: this may be timed."""
        return EnergyNorm(vi.A, self._solver.condensed(vi))

    @cachedmethod(attrgetter("_digests"), key=lambda _, mu, member: (member, _key(mu)))
    def _digest_at(self, mu: Array, member: str) -> bytes:
        """The digest of A or B at mu (d,), the key of all parameters with it; "" where it is constant."""
        # A often depends on a few components of the parameter alone.
        return b"" if member in self._problem.constant else digest(getattr(self.at(mu), member))

    @cachedmethod(attrgetter("_alphas"), key=lambda self, mu: self._digest_at(mu, "A"))
    def coercivity_at(self, mu: Array) -> Constant:
        """Lower bound of α at mu (d,), with the factorisation of `energy_at`; computed once for all mu with one A."""
        order = self.energy_at(mu).stiffness.order
        return coercivity(self._quotients_at(mu), order)

    @cachedmethod(attrgetter("_gammas"), key=lambda self, mu: self._digest_at(mu, "A"))
    def continuity_at(self, mu: Array) -> Constant:
        """Upper bound of γ_a, likewise."""
        found = continuity(self._quotients_at(mu))
        # γ_a is asked for last, and the vectors are large.
        self._quotients.clear()
        return found

    @cachedmethod(attrgetter("_quotients"), key=lambda self, mu: self._digest_at(mu, "A"))
    def _quotients_at(self, mu: Array) -> Quotients:
        return Quotients(self.at(mu).A, self._problem.V, self.energy_at(mu).stiffness.solve)

    @cachedmethod(attrgetter("_betas"), key=lambda self, mu: (self._digest_at(mu, "A"), self._digest_at(mu, "B")))
    def energy_inf_sup_at(self, mu: Array) -> Constant:
        """Lower bound of β_A at mu (d,), computed once for all mu with one A and one B."""
        # By matrices of contact size, dense but for multiples of X_W; where they are large, by sparse ones.
        vi, energy, W = self.at(mu), self.energy_at(mu), self._problem.W
        on, stiffness = energy.contact_form(vi), energy.stiffness
        if stiffness.has_known_round_off and (theta := multiple_of(on.B, W)):
            found = self._contact_at(mu).of_multiple(theta, on.B, W)
            if found is not None:
                return found
        # Dense matrices of contact size would be too large here.
        if not on.is_dense:
            return energy_inf_sup(vi.A, vi.B, W)
        if stiffness.has_known_round_off:
            known = self._contact_at(mu)
            if known.inverse is not None:
                return known.of_inverse(on.B, on.compliance, W)
            return known.energy_inf_sup(on.B, on.liftings, W)
        # Without a known round-off of the condensation A itself is used, where nothing is lost.
        contact = ContactInfSup(vi.A, vi.A.diagonal(), 0.0, stiffness.extend)
        return contact.energy_inf_sup(vi.B, on.liftings, W)

    def _contact_at(self, mu: Array) -> ContactInfSup:
        """A at mu (d,) as its factorisation has condensed it; one object where it is constant."""
        # A constant A is condensed anew where B touches further unknowns.
        stiffness = self.energy_at(mu).stiffness
        if self._contact is None or self._contact[0] is not stiffness:
            squares = self.at(mu).A.diagonal()
            schur, round_off = stiffness.schur_with_round_off(squares)
            # A ≽ σ diag(A), proved by α where that is.
            V, alpha = self._problem.V, self.coercivity_at(mu)
            share, smallest = share_of_diagonal(V), float(np.min(V.matrix.diagonal() / squares))
            sigma = alpha.value * share.value * smallest if alpha.proved and share.proved else 0.0
            lost = round_off / sigma if sigma > 0.0 else np.inf
            inverse = stiffness.inverse if stiffness.dense and "A" in self._problem.constant else None
            found = ContactInfSup(schur, squares[stiffness.retained], lost, inverse=inverse)
            self._contact = stiffness, found
        return self._contact[1]

    def _own_bytes(self, energy: EnergyNorm) -> int:
        """Memory of what is of one parameter alone."""
        return energy.nbytes if "A" not in self._problem.constant else energy.contact_nbytes


@lru_cache(maxsize=1)
def assemblies(problem: Problem) -> Assemblies:
    """The cache of the problem that this process works on; another problem replaces it."""
    return Assemblies(problem)


def _key(mu: Array) -> bytes:
    return np.ascontiguousarray(mu, float).tobytes()


def _bytes(vi: VariationalInequality) -> int:
    """Memory of the matrices, as if none were shared."""
    # A value of 8 bytes and an index of 4 per nonzero.
    return int(12 * (vi.A.nnz + vi.B.nnz)) + vi.f.nbytes + vi.g.nbytes
