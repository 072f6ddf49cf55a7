"""Reduced bases: POD, projection on cones, supremizers, nested enrichments, lazy greedy selection, cubatures."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
