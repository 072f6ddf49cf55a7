"""Quadratic programs: solvers and their settings, KKT verification, and a bound on how far two solutions may differ."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
