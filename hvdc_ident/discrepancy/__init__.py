"""Find where simulation and data disagree, name the missing effect, add it, show the gap shrink.

A hypothesis is the model with some effects at insertion points, their sizes and its parameters refitted together. The way
of one diagnosis through the modules:

    nominal                 the model without effects at its own best, and the noise of the records
    candidates, movable     every effect at every place in a few sizes; an effect compiled once whose place is chosen at run time
    screen, rounds          all of them simulated, with the parameters' answer; the best refitted in a race
    hypothesis, evidence    effects with sizes and the model's parameters, refitted together; what that gains and leaves
    prediction              how likely records that it has not seen are under a refit
    size_search             sizes that no slope leads to: levels of a quantiser, periods of a sampler
    search                  one effect after the other, each looked for again beside the others, or done without
    moves                   parameters that were held, and clocks, set free where the records speak against their values
    forms                   what is tried where no effect of the catalogue explains the records
    classes, implied        effects that are one equation, wherever they are, and the values of the parameters that they imply
    pushes, remainder       what any effect at an insertion point could explain, and what of it is left
    verdict, findings       what is said, in sentences (explain, stand_ins), of what is where (location, residual_checks)
    diagnosis, result       the verb and its result
"""

from hvdc_ident.discrepancy.diagnosis import diagnose
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.result import Diagnosis

__all__ = ["Diagnosis", "DiagnosisOptions", "diagnose"]
