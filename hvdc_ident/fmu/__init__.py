"""Functional mock-up units, FMI 2.0 and 3.0: read and run in a process of their own, and written."""
