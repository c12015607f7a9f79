"""The comparisons of peers.py, one kind a file."""
