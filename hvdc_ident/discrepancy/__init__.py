"""Find where simulation and data disagree, name the missing effect, add it, show the gap shrink.

The rooms inside, each of which imports only from those above it:

    noise       the noise of the records: size, correlation, resolution
    signatures  the change of the outputs with a candidate effect at a slot, without compiling it in
    refits      the fit of the model with effects in it, and its tests
    scores      scores before any refit: where model and data differ, which candidates could explain it
    trials      candidates picked and refitted, and what a refit must bring to count
    outside     forms outside the catalogue: laws, filters, curves
    search      round after round: score, refit, choose, add
    findings    the result: ambiguity sets, explanations, sizes, frequency responses
    verdict     the verdict and the checks against it

`diagnosis.diagnose` goes through them.
"""

from hvdc_ident.discrepancy.diagnosis import diagnose
from hvdc_ident.discrepancy.findings.conclusion import Diagnosis
from hvdc_ident.discrepancy.options import DiagnosisOptions

__all__ = ["Diagnosis", "DiagnosisOptions", "diagnose"]
