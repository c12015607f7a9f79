"""Candidates picked, refitted in a race, and what a refit must bring to count."""
