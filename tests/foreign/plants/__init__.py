"""The plants, one a file; `PLANT` is each one's."""
