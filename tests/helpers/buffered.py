"""Problems that write every result into the same arrays, as a careful programmer of large systems might."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.sparse as sp

from vibench import Array, Contact, Picture, Problem, VariationalInequality


def buffered(plain: type[Problem]) -> type[Problem]:
    """The same problem with one set of arrays for all that it returns."""

    class Buffered(plain):  # type: ignore[valid-type, misc]
        def __init__(self, *arguments: Any, **options: Any) -> None:
            self._buffers: dict[str, Any] = {}
            super().__init__(*arguments, **options)

        def _own(self, name: str, value: Any) -> Any:
            if sp.issparse(value):  # its entries alone: with the pattern of another one a matrix would be corrupt
                data = self._own(f"{name}, {value.nnz}", value.data)
                return type(value)((data, value.indices, value.indptr), shape=value.shape, copy=False)
            kept = self._buffers.get(name)
            if kept is None or kept.shape != value.shape:
                kept = self._buffers[name] = np.empty_like(value)
            kept[...] = value
            return kept

        def assemble(self, mu: Array) -> VariationalInequality:
            vi = super().assemble(mu)
            members = {name: self._own(name, getattr(vi, name)) for name in ("A", "f", "B", "g")}
            return VariationalInequality(**members, dirichlet_lift=vi.dirichlet_lift)

        def contact(self, mu: Array) -> Contact | None:
            found = super().contact(mu)
            return found and Contact(self._own("contact B", found.B), self._own("contact g", found.g))

        def sampler(self, wanted: Mapping[str, tuple[Array, Array]]) -> Any:
            sample = super().sampler(wanted)
            return lambda mu: {name: self._own(f"sampled {name}", value) for name, value in sample(mu).items()}

        def picture(self, mu: Array, u: Array, lam: Array) -> Picture | None:
            found = super().picture(mu, u, lam)
            if found is None:
                return None
            names = ("points", "triangles", "values", "positions", "multiplier")
            drawn = {name: self._own(f"picture {name}", getattr(found, name)) for name in names}
            return Picture(**drawn, name=found.name, multiplier_name=found.multiplier_name)

    return Buffered
