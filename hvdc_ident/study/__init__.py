"""The study: one TOML file that says which model, which data and which questions; and the stages that answer them."""
