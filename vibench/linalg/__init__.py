"""Linear algebra: dense and sparse factorisations, Schur complements, and inner products given by a Gram matrix."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
