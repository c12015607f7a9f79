"""Find where simulation and data disagree, name what is missing or wrong, put it into the model, show the gap shrink.

A hypothesis is the model with some terms: effects at insertion points, stated values set free, another component, clocks that are off; all
free parameters are refitted with them. The way of one diagnosis through the modules:

    nominal                 the model without terms at its own best, and the noise of the records
    hypothesis, misfit      a refit, what it leaves beyond noise, and whether that has a shape
    prediction, score       how likely records that it has not seen are under a refit; refits compared, and what speaks against one
    candidates, movable     every effect at every place in a few sizes; an effect compiled once whose place is chosen at run time
    screen, expansion       all of them simulated, with the parameters' answer; the best refitted in a race
    stated                  stated values, slightly or plainly wrong
    search                  one queue of hypotheses and moves, the best first by one score
    moves                   what makes of a hypothesis others, one kind of term a module: a new one is a module more
    rivals                  terms that the records do not distinguish, and the values of the parameters that they imply
    pushes, remainder       what any effect at an insertion point could explain, and what of it is left
    conclusion              the verdict; description, sentences: what is said of each thing found, of what is where (location,
                            residual_checks)
    diagnosis, result       the verb and its result
"""

from hvdc_ident.discrepancy.diagnosis import diagnose
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.result import Diagnosis

__all__ = ["Diagnosis", "DiagnosisOptions", "diagnose"]
