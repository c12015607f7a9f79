"""What the records say of their own noise: how large, how correlated, how coarse."""
