"""Shared by the studies of the paper: its numbers, its experiments on the average-value link, and the end of a study."""
