"""Calibration: measured data, decisions that bounds prove, and methods that consist of such decisions."""

from vibench import surface

__getattr__, __dir__, __all__ = surface(__name__, __file__)
