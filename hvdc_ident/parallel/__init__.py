"""Work in other processes: limited in time, contained where it crashes or hangs, and ended with its owner, even where
that is killed.

Many items go to a `LocalPool`, on the library pebble. One piece of work goes to a `Child`, whose progress can be watched
(`Watch`) and whose end is told (`Ending`); `call` is one function there. Neither inherits threads or locks of this process:
pools fork from a server that has one thread, children begin as a new interpreter.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
