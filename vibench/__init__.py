"""vibench: a benchmark framework for reduced-order models of parametrised variational inequalities.

What authors of plugins and users of the library need is importable from here; `__init__.pyi` lists it. Tools of
algorithms and figures are in the submodules of `GROUPS`. A name is imported when it is first used, so that
`import vibench` alone costs next to nothing.
"""

from importlib import import_module
from types import FunctionType

import lazy_loader

GROUPS = ("calibration", "linalg", "packs", "qp", "reduction", "report", "stability")
"""Submodules with public names of their own."""

_attached, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """A public name; of a function the one that checks its arguments.

    Raises an `ImportError` that names the submodule if a submodule has it: `from vibench import NAME` would not show
    the message of an `AttributeError`.
    """
    if name not in __all__ and not name.startswith("_"):
        for group in GROUPS:
            if name in import_module(f"vibench.{group}").__all__:
                raise ImportError(f"'{name}' is in vibench.{group}: from vibench.{group} import {name}")
    found = _attached(name)
    # Queries of plugins call `is_absent`: a check would take longer.
    if isinstance(found, FunctionType) and name != "is_absent":
        globals()[name] = found = import_module("vibench.signatures").public(found, __name__)
    return found
