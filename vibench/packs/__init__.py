"""Model packs: folders of matrices from any code; their format, what they hold, its checks, and writing them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
