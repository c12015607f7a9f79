"""Operating points, linear models, modes, frequency responses and margins, on exact derivatives."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
