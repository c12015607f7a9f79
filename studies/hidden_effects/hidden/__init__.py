"""Hidden effects: what the study is made of. Its simulator knows nothing of the package it judges."""
