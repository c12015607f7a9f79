"""Derivatives and ranks: sweeps, structural identifiability, information; no optimiser."""
