"""The American put option: one implicit step in time, or no maturity at all; both have closed-form prices."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
import scipy.sparse as sp
from annotated_types import Ge, Le
from numpy.polynomial import chebyshev
from skfem import Basis, ElementLineP1, LinearForm, MeshLine
from skfem.models.poisson import laplace

from vibench import AffineProblem, AffineSum, Array, InnerProduct, Mask, NestedStart, Output, ParameterBox, Picture, fem

NODES = {"coarse": 200, "medium": 800, "paper": 2400, "fine": 4000}
"""Number of unknowns behind each named resolution."""

LOWEST, HIGHEST = -1.5, 0.5
"""Ends of the interval of x = ln(S/K). The exercise boundary is above the lower one in the whole box."""

FEWEST = 40
"""Smallest number of unknowns."""

COARSENING = 4
"""Ratio of the meshes from which initial active sets are taken."""

DEGREE = 20
"""Degree of the Chebyshev expansion of exp(a x) in a: over the box its remainder is below round-off."""

WITH_MATURITY = ParameterBox(
    names=("rate", "volatility", "maturity"),
    lower=np.array([0.02, 0.15, 0.25]),
    upper=np.array([0.06, 0.35, 2.0]),
    units=("1/year", "1/√year", "year"),
)
"""The parameter box of one implicit step."""

PERPETUAL = ParameterBox(
    names=("rate", "volatility"),
    lower=np.array([0.02, 0.15]),
    upper=np.array([0.06, 0.35]),
    units=("1/year", "1/√year"),
)
"""The parameter box without a maturity."""


RANGE = -0.5 + 0.02 / 0.35**2, -0.5 + 0.06 / 0.15**2
"""Least and largest a = r/σ² − ½ of the boxes."""


@dataclass(frozen=True)
class PutSolution:
    """The exact price at one parameter, in units of the strike, as a function of x = ln(S/K).

    With k = 2r/σ² and τ = 2/(σ²T), or τ = 0 without a maturity, V solves −V″ − (k − 1)V′ + (k + τ)V ≥ τψ with V ≥ ψ,
    ψ = max(1 − eˣ, 0). Solutions of the homogeneous equation are exp(m± x) with m± = −a ± c, a = (k − 1)/2 and
    c² = (k + 1)²/4 + τ. The excess u = V − ψ is b exp(m₋x) for x ≥ 0, p exp(m₊x) + q exp(m₋x) − κ, κ = k/(k + τ), from
    x* to 0, and zero below; u and u′ vanish at x*, and u′ jumps by −1 at the strike.

    Attributes
    ----------
    rate, volatility
        r [1/year] and σ [1/√year].
    maturity
        T [year], infinite for the perpetual put (Merton 1973). For a finite one the maturity is exponentially
        distributed with mean T, which is the first of Carr's (1998) approximations of a fixed maturity.
    """

    rate: float
    volatility: float
    maturity: float = math.inf

    @property
    def k(self) -> float:
        """2r/σ²."""
        return 2.0 * self.rate / self.volatility**2

    @property
    def a(self) -> float:
        """Exponent of the symmetrisation, (k − 1)/2."""
        return 0.5 * (self.k - 1.0)

    @property
    def c(self) -> float:
        """Decay of the symmetrised solution, ((k + 1)²/4 + τ)^½."""
        return math.sqrt(0.25 * (self.k + 1.0) ** 2 + 2.0 / (self.volatility**2 * self.maturity))

    @property
    def _constants(self) -> tuple[float, float, float, float, float, float]:
        """The constants m₊, m₋, κ, p, m₊x* and q."""
        up, down = self.c - self.a, -self.c - self.a
        kappa = self.k / (self.k + 2.0 / (self.volatility**2 * self.maturity))
        p = (1.0 - down * kappa) / (up - down)
        level = math.log(-down * kappa / (1.0 - down * kappa))
        return up, down, kappa, p, level, -up * p * math.exp(level * (1.0 - down / up)) / down

    @property
    def boundary(self) -> float:
        """S*/K, below which the option is exercised."""
        up, _, _, _, level, _ = self._constants
        return math.exp(level / up)

    def excess(self, x: Array) -> Array:
        """V − ψ at x, any shape."""
        up, down, kappa, p, _, q = self._constants
        below, above = np.minimum(x, 0.0), np.maximum(x, 0.0)
        held = p * np.exp(up * below) + q * np.exp(down * below) - kappa
        return np.where(
            x < math.log(self.boundary), 0.0, np.where(x < 0.0, held, (p + q - kappa) * np.exp(down * above))
        )

    def price(self, spot: Array) -> Array:
        """V at S/K, any shape."""
        return self.excess(np.log(spot)) + np.maximum(1.0 - spot, 0.0)


class Put(AffineProblem):
    """American put on a share without dividends, in units of the strike; parameters r, σ and T, closed-form price.

    The Black–Scholes inequality in x = ln(S/K) is taken by one implicit step from maturity. In w = exp(a x)(V − ψ),
    a = r/σ² − ½, it is symmetric; ψ = max(1 − eˣ, 0). Divided by σ²/2 it reads

        −w″ + c² w ≥ δ₀ − k exp(a x) 1{x < 0},    w ≥ 0,    w = 0 at the lower end,    w′ = −c w at the upper end

    with k = 2r/σ² and c² = (k + 1)²/4 + 2/(σ²T): the payoff ψ leaves a Dirac measure at the strike and a load below it.
    Both conditions at the ends are those of the exact solution. The strike K is a factor of prices, and of S.

    P1 functions on a uniform mesh with a node at the strike, multipliers at the nodes up to it. A has three affine
    terms; f has that of the strike and those of the Chebyshev expansion of exp(a x) in a, exact to round-off.

    Parameters
    ----------
    resolution
        "coarse" (200 unknowns), "medium" (800), "paper" (2400), "fine" (4000), or a number of unknowns, which is
        rounded to a multiple of four.
    perpetual
        Whether there is no maturity: the parameters are r and σ.
    """

    def __init__(
        self,
        resolution: Literal["coarse", "medium", "paper", "fine"] | Annotated[int, Ge(FEWEST), Le(200_000)] = "paper",
        perpetual: bool = False,
    ) -> None:
        n = NODES[resolution] if isinstance(resolution, str) else 4 * round(resolution / 4)
        self.perpetual, self.parameters = perpetual, PERPETUAL if perpetual else WITH_MATURITY
        basis = Basis(MeshLine(np.linspace(LOWEST, HIGHEST, n + 1)), ElementLineP1(), intorder=9)
        below = basis.with_elements(np.arange(3 * n // 4))
        free, at_strike, at_end = np.arange(1, n + 1), np.zeros(n + 1), np.zeros(n + 1)
        at_strike[3 * n // 4] = at_end[-1] = 1.0
        contact = fem.unilateral(below, ">=", free=free)
        self.x, self.exercised, self._at_strike = basis.mesh.p[0, free], contact.points[0], at_strike[free]
        self.V, self.W = InnerProduct(fem.h1_gram(basis, free, self._decay_length())), contact.W

        def loads(exponents: Array) -> Array:
            forms = [LinearForm(lambda v, w, a=a: np.exp(a * w.x[0]) * v) for a in exponents]
            return np.array([form.assemble(below) for form in forms])

        low, high = RANGE
        points = chebyshev.chebpts1(DEGREE + 1)
        values = loads(low + 0.5 * (high - low) * (points + 1.0))
        expansion = np.linalg.solve(chebyshev.chebvander(points, DEGREE), values)
        stiffness, end = laplace.assemble(basis), sp.csr_array(np.outer(at_end, at_end))
        self.declare(
            A=AffineSum(tuple(map(sp.csr_array, (stiffness, fem.mass(basis), end))), stiffness_coefficients),
            f=AffineSum((at_strike, *expansion), load_coefficients),
            B=contact.B,
            g=np.zeros(len(contact.nodes)),
            free=free,
        )

    def training_set(self) -> Array:
        """The 5×5×5 grid; 11×11 without a maturity."""
        return self.parameters.grid(5, 5, 5) if self.parameters.dim == 3 else self.parameters.grid(11, 11)

    def exact(self, mu: Array) -> PutSolution:
        """The solution in closed form at mu = (r, σ, T), or (r, σ)."""
        return PutSolution(*map(float, mu))

    def _decay_length(self) -> float:
        """Length ℓ of the norm ∫ w² + ℓ² ∫ w′²: the geometric mean of the shortest and the longest 1/c of the box."""
        signs = np.array([1.0, -1.0, -1.0])[: self.parameters.dim]  # c rises with r, and falls with σ and T
        ends = [np.where(sign > 0.0, self.parameters.upper, self.parameters.lower) for sign in (signs, -signs)]
        return float(np.prod([self.exact(mu).c for mu in ends]) ** -0.5)

    def start(self, mu: Array, nearest: Mask | None) -> Mask | NestedStart | None:  # noqa: ARG002
        """The contact set on a coarser mesh, from which the exercise boundary has a few nodes to go, and not many."""
        return nearest if self._on_coarser_mesh is None else self._on_coarser_mesh

    @cached_property
    def _on_coarser_mesh(self) -> NestedStart | None:
        n = len(self.x) // COARSENING
        if n < FEWEST:
            return None
        coarser = Put(n, self.perpetual)
        return NestedStart(coarser, coarser.exercised, self.exercised)

    def refuse(self, mu: Array, u: Array, lam: Array) -> str:  # noqa: ARG002
        """The exercise boundary is not on the mesh where the option is held at the lower end."""
        return (
            "" if lam[0] > 0.0 else f"the option is not exercised at S/K = {math.exp(LOWEST):.3g}, where the mesh ends"
        )

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The price at S = K, and the largest S of a node at which the option is exercised, both in units of K."""
        return (
            Output("price at the strike", "1", u=self._at_strike),
            Output("exercise boundary", "1", function=lambda _, __, lam: self.boundary(lam)),
        )

    def boundary(self, lam: Array) -> float:
        """S*/K of a multiplier (m,): the last node in contact; zero without any."""
        (active,) = np.nonzero(lam > 0.0)
        return math.exp(self.exercised[active[-1]]) if len(active) else 0.0

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:
        """The price over S/K, and the multiplier."""
        spot = np.exp(self.x)
        price = np.maximum(1.0 - spot, 0.0) + np.exp(-self.exact(mu).a * self.x) * u
        line, positions = spot[None], np.exp(self.exercised)[None]
        return Picture(line, np.zeros((3, 0), int), price, "price V/K [1]", positions, lam, "multiplier λ [1]", "S/K")


def stiffness_coefficients(mu: Array) -> Array:
    """Coefficients (3,) of ∫ w′v′, ∫ w v, and w v at the upper end."""
    c = PutSolution(*mu).c
    return np.array([1.0, c * c, c])


def load_coefficients(mu: Array) -> Array:
    """Coefficients (DEGREE + 2,) of the strike, and of the Chebyshev expansion of ∫ exp(a x) v below it."""
    exact, (low, high) = PutSolution(*mu), RANGE
    place = (2.0 * exact.a - low - high) / (high - low)
    return np.append(1.0, -exact.k * chebyshev.chebvander(np.array([place]), DEGREE)[0])
