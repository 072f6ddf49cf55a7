from dataclasses import replace

import numpy as np
import pytest
from numerics import Varying

from vibench import Array, VariationalInequality
from vibench.linalg.factorisations import IMPLEMENTATIONS
from vibench.offline import assemblies
from vibench.offline.assemblies import Assemblies
from vibench.stability import coercivity


def test_assemblies_are_kept_up_to_a_limit_and_those_of_longest_ago_go_first() -> None:
    problem = Varying()
    one, two, three = (np.array([value]) for value in (0.2, 0.5, 0.8))
    given_before = problem.assemble(one)
    size = 12 * (given_before.A.nnz + given_before.B.nnz) + given_before.f.nbytes + given_before.g.nbytes
    kept = Assemblies(problem, limit=int(2.5 * size))
    first = kept.at(one)
    second = kept.at(two)
    assert kept.at(one) is first
    assert kept.at(two) is second
    kept.at(one)
    kept.at(three)  # for which the second has to go
    assert kept.at(one) is first
    assert kept.at(two) is not second


def test_parameters_with_the_same_stiffness_share_its_constants_of_v(monkeypatch: pytest.MonkeyPatch) -> None:
    """A of this problem does not depend on the angle, which it does not declare; of the other one it does."""

    class SameStiffness(Varying):
        def assemble(self, mu: Array) -> VariationalInequality:
            return replace(super().assemble(mu), A=self._laplacian)

    counted: list[str] = []
    for name in ("coercivity", "continuity"):
        original = getattr(coercivity, name)
        monkeypatch.setattr(
            f"vibench.offline.assemblies.{name}",
            lambda *given, name=name, original=original: (counted.append(name), original(*given))[1],
        )
    mus = np.array([[0.2], [0.5], [0.2]])
    for problem, expected in ((SameStiffness(), 2), (Varying(), 4)):
        kept = Assemblies(problem)
        found = [(kept.coercivity_at(mu), kept.continuity_at(mu)) for mu in mus]
        assert len(counted) == expected
        for mu, pair in zip(mus, found, strict=True):
            assert pair == coercivity.coercivity_and_continuity(problem.assemble(mu).A, problem.V)
        counted.clear()


@pytest.mark.parametrize("name", [name for name, one in IMPLEMENTATIONS.items() if one.is_installed])
def test_constants_are_those_of_the_default_whoever_factorises(name: str) -> None:
    plain, other, mu = Varying(n=90), Varying(n=90), np.array([0.4])
    other.factorised_by(name)
    assert len(Assemblies(other).energy_at(mu).stiffness.retained) < 90
    for constant in ("coercivity_at", "continuity_at", "energy_inf_sup_at"):
        expected, found = (getattr(Assemblies(problem), constant)(mu) for problem in (plain, other))
        assert expected.proved
        assert found.proved is (constant == "energy_inf_sup_at" or not IMPLEMENTATIONS[name].is_iterative)
        assert found.value == pytest.approx(expected.value, rel=1e-6 if found.proved else 1e-3)


def test_factors_and_parameters_are_kept_as_they_fit() -> None:
    """Otherwise α, β_A and the bounds at one parameter would each factorise A."""
    kept, one, two = Assemblies(Varying(), factor_limit=1), np.array([0.2]), np.array([0.5])
    first = kept.energy_at(one)
    assert kept.energy_at(one) is first
    assert kept.energy_at(one).contact_form(kept.at(one)) is first.contact_form(kept.at(one))
    assert (kept.energy_at(two).A != first.A).nnz
    assert kept.energy_at(one) is not first
    mu = np.array([0.2])
    factors, matrices = Assemblies(Varying()).energy_at(mu).nbytes, assemblies._bytes(Assemblies(Varying()).at(mu))
    assert Assemblies(Varying(), limit=5 * matrices).together(mu) == 5
    assert Assemblies(Varying(), limit=matrices // 2).together(mu) == 1
    assert Assemblies(Varying(), limit=5 * matrices, factor_limit=3 * factors + 1).together(mu) == 3
