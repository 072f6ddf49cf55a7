"""The functions on arrays of the public surface: wrong arguments are a `RequestError` that names them.

The packages of vibench call the functions themselves, often, with arrays that were checked where they came from.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from numbers import Real
from typing import Any, ParamSpec, TypeVar

import numpy as np
import scipy.sparse as sp

from vibench.arrays import Array
from vibench.errors import RequestError, unknown_name
from vibench.highfidelity import active_set
from vibench.highfidelity.kkt_systems import CondensedStiffness
from vibench.interfaces.problem import VariationalInequality
from vibench.interfaces.strategies import Stop
from vibench.linalg.inner_product import InnerProduct
from vibench.qp import solve
from vibench.qp.verification import QPSolution, QPSolver
from vibench.reduction import cones
from vibench.reduction import pod as proper_orthogonal
from vibench.reduction import supremizers as enriching
from vibench.text import brief

P = ParamSpec("P")
T = TypeVar("T")

Shape = tuple[str, ...]  # names of the axes of an array: what has one name has one size in a call


def checked(**expected: Shape | type) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """A function whose arguments of these names are checked: arrays of finite numbers by shapes, others by classes."""
    # An argument that is `None` by default may be so. Spaces have the dimension "n" as V and "m" as W.

    def wrap(function: Callable[P, T]) -> Callable[P, T]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def call(*given: P.args, **named: P.kwargs) -> T:
            sizes = dict[str, tuple[int, str]]()
            for name, value in signature.bind(*given, **named).arguments.items():
                if name not in expected or (value is None and signature.parameters[name].default is None):
                    continue
                for size, count in _sizes(f"{name} of {function.__name__}", value, expected[name], name):
                    known, whose = sizes.setdefault(size, (count, name))
                    if known != count:
                        what = f"{name} of {function.__name__} has {size} = {count}"
                        raise RequestError(f"{what}, but that of {whose} is {known}")
            return function(*given, **named)

        call.__module__ = __name__  # by which it is pickled
        return call

    return wrap


def _sizes(what: str, value: Any, expected: Shape | type, name: str) -> Iterator[tuple[str, int]]:
    """The sizes of an argument by name."""
    if isinstance(expected, type):
        if not isinstance(value, expected) or (isinstance(value, Real) and not 0.0 < float(value) < np.inf):
            right = "a positive number" if expected is Real else f"a {expected.__name__}"
            raise RequestError(f"{what} is {brief(repr(value), 80)}, expected {right}")
        if isinstance(value, InnerProduct):
            yield {"V": "n", "W": "m"}[name], value.dim
        if isinstance(value, VariationalInequality):
            for member, axes in {"A": ("n", "n"), "f": ("n",), "B": ("m", "n"), "g": ("m",)}.items():
                yield from _sizes(f"{member} in {what}", getattr(value, member), axes, member)
        return
    shape = f"({', '.join(expected)}{',' * (len(expected) == 1)})"
    if not (isinstance(value, np.ndarray) or sp.issparse(value)) or value.dtype.kind not in "fiub":
        raise RequestError(f"{what} is {brief(repr(value), 80)}, expected an array {shape} of real numbers")
    if value.ndim != len(expected):
        raise RequestError(f"{what} has the shape {value.shape}, expected {shape}")
    if not np.all(np.isfinite(sp.coo_array(value).data if sp.issparse(value) else value)):
        raise RequestError(f"{what} has an entry that is not finite")
    yield from zip(expected, value.shape, strict=True)


pod = checked(snapshots=("n", "P"), V=InnerProduct, stop=Stop)(proper_orthogonal.pod)
project_on_cone = checked(generators=("m", "R"), theta=("m",), W=InnerProduct)(cones.project_on_cone)
greedy_cone = checked(snapshots=("m", "P"), W=InnerProduct, stop=Stop)(cones.greedy_cone)
supremizers = checked(V=InnerProduct, B=("m", "n"), eta=("m", "k"))(enriching.supremizers)
solve_high_fidelity = checked(vi=VariationalInequality, stiffness=CondensedStiffness, start=("m",))(
    active_set.solve_high_fidelity
)


@checked(program=VariationalInequality, solver=str, accuracy=Real, extra=Mapping, factor=("n", "n"), start=QPSolution)
@functools.wraps(solve.solve_qp)
def solve_qp(
    program: VariationalInequality,
    solver: str,
    accuracy: float,
    extra: Mapping[str, QPSolver] | None = None,
    factor: Array | None = None,
    start: QPSolution | None = None,
) -> QPSolution:
    """`vibench.qp.solve.solve_qp` with a solver that is installed."""
    if solver not in solve.installed_solvers(extra or ()):
        raise unknown_name("QP solver", solver, solve.installed_solvers(extra or ()))
    return solve.solve_qp(program, solver, accuracy, extra, factor, start)
