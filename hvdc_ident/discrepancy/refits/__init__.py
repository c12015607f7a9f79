"""Gains and effects fitted together, and whether what a fit leaves looks like noise."""
