"""The report: one self-contained page from the JSON and CSV in a folder of results alone.

A part of the page is a file in `sections/` with `SECTION = Section(...)`; a figure is a function of a result, it
computes nothing. No part is registered anywhere else.
"""
