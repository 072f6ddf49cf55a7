"""Model packs: folders of matrices from any code; their format, what they hold, its checks, and writing them."""

from vibench import surface

__getattr__, __dir__, __all__ = surface(__name__, __file__)
