"""The moves of the search, one kind of term a module: `MOVE` or `MOVES`.

values      a stated value set free
clocks      records moved to where their clocks are right
cards       another component, or one more
effects     an effect of the catalogue (with sizes: those that no slope leads to)
outside     a form outside the catalogue
given       an effect in the stead of other values of the parameters
"""

from hvdc_ident.discrepancy.moves import cards, clocks, effects, given, outside, values
from hvdc_ident.discrepancy.search import Move

MOVES: tuple[Move, ...] = (values.MOVE, clocks.MOVE, *cards.MOVES, *effects.MOVES, *outside.MOVES, given.MOVE)
"""Every move; of those whose turn is at once the first begins."""

__all__ = ["MOVES"]
