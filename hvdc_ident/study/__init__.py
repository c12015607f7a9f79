"""The study: one TOML file that says which model, which data and which questions; and the stages that answer them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
