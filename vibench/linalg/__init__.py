"""Linear algebra: dense and sparse factorisations, Schur complements, and inner products given by a Gram matrix."""

from vibench import surface

# The distance from 1 to the next number, and the largest relative error of one operation, which is half of it: a margin
# that is proved with one of them is wrong by a factor of two with the other.
EPS = 2.0**-52
UNIT_ROUND_OFF = 0.5 * EPS

__getattr__, __dir__, __all__ = surface(__name__, __file__)
