"""Declarations that differ from assembly are refuted, wherever assembly is called."""

from typing import Any, ClassVar

import numpy as np
import pytest
import scipy.sparse as sp
from broken_problems import Declared
from broken_variants import ByElements
from fake_plugins import Wire

from vibench.errors import NumericalError
from vibench.interfaces.affine import AffineSum
from vibench.interfaces.problem import Contact, ContactLoads, Problem
from vibench.interfaces.validation import ReferenceAssembly, contradictions


def variant(base: type[Problem], **members: Any) -> Problem:
    return type("Variant", (base,), {"__module__": __name__, **members})()


def contact_of(B: float = 1.0, g: float = 1.0, above: float = 0.0) -> Any:
    """The contact of a wire, wrong by these factors above a force."""

    def contact(self: Any, mu: np.ndarray) -> Contact:
        right = Declared.contact(self, mu)
        return Contact(B * right.B, g * right.g) if mu[0] > above else right

    return contact


def loads_of(loads: float = 1.0, bounds: float = 1.0) -> Any:
    def contact_loads(self: Any, eta: np.ndarray) -> ContactLoads:
        right = Problem.contact_loads(self, eta)
        varying = lambda mu: tuple(f * one for f, one in zip((loads, bounds), right.varying(mu), strict=True))  # noqa: E731
        return ContactLoads(right.fixed, varying, 0)

    return contact_loads


def sampler_of(wrong: str) -> Any:
    def sampler(self: Any, wanted: Any) -> Any:
        right = Declared.sampler(self, wanted)
        return lambda mu: {name: (1.01 if name == wrong else 1.0) * one for name, one in right(mu).items()}

    return sampler


def sum_of(name: str, theta: Any) -> dict[str, AffineSum]:
    """A member of a wire as one term with this coefficient at a force."""
    at_six = getattr(Wire().assemble(np.array([6.0])), name)
    return {name: AffineSum((at_six,), lambda mu: np.array([theta(mu[0])]))}


class Elements(ByElements):
    wrong: ClassVar[str] = ""

    def element_sampler(self, elements: Any) -> Any:
        right = super().element_sampler(elements)
        return lambda mu: {name: (1.01 if name == self.wrong else 1.0) * one for name, one in right(mu).items()}


WRONG = {
    "`contact`, g": variant(Declared, contact=contact_of(g=1.2)),
    "`contact`, B": variant(Declared, contact=contact_of(B=1.2)),
    "`contact`, g at some parameters": variant(Declared, contact=contact_of(g=1.2, above=5.0)),
    "`contact_loads`, Bᵀη": variant(Declared, contact_loads=loads_of(loads=0.9)),
    "`contact_loads`, ηᵀg": variant(Declared, contact_loads=loads_of(bounds=0.9)),
    "`sampler` of A": variant(Declared, sampler=sampler_of("A")),
    "`sampler` of f": variant(Declared, sampler=sampler_of("f")),
    "`affine` of f": variant(Wire, affine=sum_of("f", lambda force: force / 6.0 + 0.1 * (force > 5.0))),
    "`affine` of A": variant(Wire, affine=sum_of("A", lambda force: 1.0 + 1e-6 * force)),
    "`element_sampler` of A": variant(Elements, wrong="A"),
    "`affine` of g": variant(Wire, affine=sum_of("g", lambda force: force / 6.0)),
}
RIGHT = [Declared(), variant(Declared, contact_loads=loads_of()), Elements(), Wire(),
         variant(Wire, affine=sum_of("f", lambda force: force / 6.0))]  # fmt: skip


def middle(problem: Problem) -> np.ndarray:
    return 0.45 * problem.parameters.lower + 0.55 * problem.parameters.upper


@pytest.mark.parametrize("what", WRONG)
def test_what_assembly_does_not_confirm_is_named_with_its_parameter(what: str) -> None:
    problem = WRONG[what]
    mu = middle(problem)
    (said, *_) = contradictions(problem, mu, problem.assemble(mu))
    assert said.startswith(what.removesuffix(" at some parameters"))
    with pytest.raises(NumericalError, match=rf"refuted at mu = \[{mu[0]}.*\]: `"):
        ReferenceAssembly(problem).refuse_false_declarations(mu, problem.assemble(mu))


def test_what_is_true_is_confirmed_whatever_the_units_and_absent_rows() -> None:
    for problem in RIGHT:
        mu = middle(problem)
        vi = problem.assemble(mu)
        assert not [*contradictions(problem, mu, vi)]
        ReferenceAssembly(problem).refuse_false_declarations(mu, vi)
    absent = variant(Declared, contact=lambda self, mu: Contact(-self.mass, np.where(np.arange(12) == 3, np.inf, 0.0)))
    vi = absent.assemble(mu := middle(absent))
    said = [*contradictions(absent, mu, vi)]
    assert [one.split(",")[0] for one in said] == ["`contact`"]
    assert sp.issparse(vi.B)
