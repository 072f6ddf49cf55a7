"""vibench: a benchmark framework for reduced-order models of parametrised variational inequalities.

What authors of plugins and users of the library need is importable from here; `__init__.pyi` lists it. A name is
imported when it is first used, so that `import vibench` alone costs next to nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
