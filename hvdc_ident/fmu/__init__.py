"""Functional mock-up units (FMUs) of FMI 2.0 and 3.0: read, simulated in worker processes, and exported.

Load only FMUs you trust: their machine code runs on this computer. It runs in processes of its own, which contains
crashes, hangs and leaks, not malice.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
