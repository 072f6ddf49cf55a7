"""Calibration: measured data, decisions that bounds prove, and methods that consist of such decisions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
