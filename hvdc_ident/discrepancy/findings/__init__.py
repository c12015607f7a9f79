"""What a diagnosis tells: its result, the sets of what cannot be told apart, words, sizes and figures."""
