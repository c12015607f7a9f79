"""What the studies of the paper share: its numbers, its experiments on the average-value link, and how a study ends."""
