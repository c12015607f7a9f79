"""Hidden effects: the parts of the study. Its simulator is independent of the package that it tests."""
