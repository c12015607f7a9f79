"""Ranks for structural identifiability: rings, Taylor series over them, random points, and invariants of the parameters."""
