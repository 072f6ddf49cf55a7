"""Reduced bases: POD, projection on cones, supremizers, nested enrichments, lazy greedy selection, cubatures."""

from vibench import surface

__getattr__, __dir__, __all__ = surface(__name__, __file__)
