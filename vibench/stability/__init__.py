"""Inf-sup constants over the span and the cone of reduced multipliers."""

from vibench import surface

__getattr__, __dir__, __all__ = surface(__name__, __file__)
