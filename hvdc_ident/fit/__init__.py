"""Estimation of parameters from experiments, for anything that can be simulated.

`fit` solves a `Problem`: the parameters to estimate, the experiments, the noise. `fit_each` and `fit_individually` fit parts
of it. Profile likelihoods and uncertainties are in modules of their own.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
