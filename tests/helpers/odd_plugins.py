"""Plugins of a third party whose names, messages and numbers are odd; where they solve anything they solve it right."""

from collections.abc import Mapping

import numpy as np
from fake_plugins import Wire, careful

from vibench import Array, InnerProduct, ParameterBox, Picture, QPSolution, VariationalInequality
from vibench.interfaces.strategies import DualStrategy, Enrichment, Kind, Offline, PrimalStrategy, ReducedSet, Stop

LABEL = "=1+1 [/b] [red] $x^{ $ `a` | <img src=x onerror=alert(1)> </script> \x1b[31m\n@ [x](javascript:y)"

ODD = f"{LABEL} \ud800"


class OddWire(Wire):
    """A wire whose parameter, diagnostics and picture have odd names."""

    parameters = ParameterBox((ODD,), np.array([4.0]), np.array([8.0]), (ODD,))

    def diagnostics(self, mu: Array) -> Mapping[str, float]:
        return {ODD: 2.0**70, "-": -0.0}

    def picture(self, mu: Array, u: Array, lam: Array) -> Picture:
        x = np.linspace(0.0, 1.0, self.V.dim)[None]
        return Picture(x, np.zeros((3, 0), int), u, name=ODD, positions=x, multiplier=lam, multiplier_name=ODD)


class OddError(Exception):
    def __str__(self) -> str:
        return ODD + 50_000_000 * "x"


class UnreadableError(Exception):
    def __str__(self) -> str:
        raise ValueError("not to be read")


class OddCone(DualStrategy):
    def reduce(self, snapshots: Array, W: InnerProduct, stop: Stop) -> ReducedSet:
        raise OddError


class OddEnrichment(PrimalStrategy):
    """Adds nothing, and reports a number that no integer of a results file can hold."""

    def build(self, offline: Offline, tolerance: float | None) -> Enrichment:
        history = np.array([2.0**80, 1.0])
        return Enrichment(Kind.NONE, history={ODD: history}, fallbacks=(ODD, 100_000 * ODD))


def counts_far(program: VariationalInequality, accuracy: float) -> QPSolution:
    found = careful(program, accuracy)
    return QPSolution(found.x, found.alpha, ODD, 2**80)


def raises(program: VariationalInequality, accuracy: float) -> QPSolution:
    raise OddError


def raises_unreadably(program: VariationalInequality, accuracy: float) -> QPSolution:
    raise UnreadableError


def gives_up(program: VariationalInequality, accuracy: float) -> QPSolution:
    return QPSolution(None, None, 300_000 * ODD)
