"""vibench: a benchmark framework for reduced-order models of parametrised variational inequalities.

What authors of plugins and users of the library need is importable from here; `__init__.pyi` lists it. Tools of
algorithms and figures are in the submodules of `GROUPS`. A name is imported when it is first used, so that
`import vibench` alone costs next to nothing.
"""

import sys
from collections.abc import Callable
from importlib import import_module
from inspect import isfunction

import lazy_loader

GROUPS = ("calibration", "linalg", "packs", "qp", "reduction", "report", "stability")
"""Submodules with public names of their own."""


def surface(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package by its stub; its functions check their arguments."""
    attached, listed, names = lazy_loader.attach_stub(package, file)

    def found(name: str) -> object:
        value = attached(name)
        # Queries of plugins call `is_absent`: a check would take longer.
        if isfunction(value) and name != "is_absent":
            value = import_module("vibench.signatures").public(value, package)
            setattr(sys.modules[package], name, value)
        return value

    return found, listed, names


_found, __dir__, __all__ = surface(__name__, __file__)


def __getattr__(name: str) -> object:
    """A public name; of a function the one that checks its arguments.

    Raises an `ImportError` that names the submodule if a submodule has it: `from vibench import NAME` would not show
    the message of an `AttributeError`.
    """
    if name not in __all__ and not name.startswith("_"):
        for group in GROUPS:
            if name in import_module(f"vibench.{group}").__all__:
                raise ImportError(f"'{name}' is in vibench.{group}: from vibench.{group} import {name}")
    return _found(name)
