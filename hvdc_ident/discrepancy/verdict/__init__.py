"""What is said in the end, and what speaks against saying it."""
