"""The simulator of a study's model, under the name studies use."""

from hvdc_ident.simulate.model_simulator import ModelSimulator

__all__ = ["ModelSimulator"]
