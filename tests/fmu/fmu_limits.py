"""What the tests' FMUs may use."""

from hvdc_ident.fmu import Limits

QUICK = Limits(deadline=1.0, load=30.0, memory=128 * 2**20)
"""A hang costs a second, a leak 128 MiB."""
PATIENT = Limits(deadline=60.0, load=60.0, memory=128 * 2**20)
"""For what ends by itself, however slowly."""
