"""Find where simulation and data disagree, name the missing effect, add it, show the gap shrink.

A hypothesis is the model with some effects at insertion points, their sizes and its parameters refitted together. The way
of one diagnosis through the modules:

    nominal, record_noise   the model without effects at its own best, and the noise of the records
    candidates, movable     every effect at every place in a few sizes; an effect compiled once whose place is chosen at run time
    screen, stand           all of them simulated, with the parameters' answer; the best refitted in a race
    met                     sizes that no slope leads to: levels of a quantiser, periods of a sampler
    refit, race             effects with sizes and the model's parameters, refitted together
    released, clocks        parameters that were held, set free where the records speak against their values; and their clocks
    rounds, search          one effect after the other, each looked for again beside the others, or done without
    outside, alternatives   forms that the catalogue has no name for
    evidence, classes       what each hypothesis gains; effects that are one equation, wherever they are
    pushes, latent          what any effect at an insertion point could explain
    remainder, verdict      what is left, whether anything more could explain it, and what is told
    diagnosis, result       the verb and its result
"""

from hvdc_ident.discrepancy.diagnosis import diagnose
from hvdc_ident.discrepancy.options import DiagnosisOptions
from hvdc_ident.discrepancy.result import Diagnosis

__all__ = ["Diagnosis", "DiagnosisOptions", "diagnose"]
