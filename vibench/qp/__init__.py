"""Quadratic programs: solvers and their settings, KKT verification, and a bound on how far two solutions may differ."""

from vibench import surface

__getattr__, __dir__, __all__ = surface(__name__, __file__)
