"""What samplings of a given size from a seed have in common."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated

from annotated_types import Ge, Le, Lt

from vibench import Array, ParameterBox, Sampling


class Drawn(Sampling):
    """Points drawn in the unit cube and mapped to the box.

    Parameters
    ----------
    size
        Number of points.
    seed
        Seed of what is random; another purpose should have another one.
    log
        Names of the parameters on a logarithmic scale.
    """

    def __init__(
        self,
        size: Annotated[int, Ge(1), Le(100_000)],
        seed: Annotated[int, Ge(0), Lt(2**63)],
        log: list[str] = [],  # noqa: B006  never changed
    ) -> None:
        self.size, self.seed, self.log = size, seed, log

    @abstractmethod
    def drawn(self, dim: int) -> Array:
        """The points (size×dim) in the unit cube."""

    def parameters(self, box: ParameterBox) -> Array:
        """The points in the box, in the order in which they are drawn."""
        return box.from_unit(self.drawn(box.dim), self.log)
