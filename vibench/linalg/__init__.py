"""Linear algebra: dense and sparse factorisations, Schur complements, and inner products given by a Gram matrix."""

import lazy_loader

EPS = 2.0**-52
UNIT_ROUND_OFF = 0.5 * EPS  # the largest relative error of one operation; EPS is the distance from 1 to the next number

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
