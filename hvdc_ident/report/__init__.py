"""The report and the letter: self-contained pages from the JSON and CSV in a folder of results alone. Nothing is simulated.

`summary` decides what the results say; `first_screen` and `letter` show it. Every other part of the report is
a file in `sections/` with `SECTION = Section(...)`, which opens on demand; no part is registered anywhere else. `drawing` and
`overlay` make figures, `html` tables and words, `page` the page.
"""
