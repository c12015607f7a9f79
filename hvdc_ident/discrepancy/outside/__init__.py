"""What is not in the catalogue: laws of the model's own signals, filters, and curves with their band."""
