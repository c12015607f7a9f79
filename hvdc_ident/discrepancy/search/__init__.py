"""Round after round: what is looked at, beside what was found before, until nothing more is told."""
