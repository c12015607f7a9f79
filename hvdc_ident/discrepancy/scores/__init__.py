"""What can be told before any refit: where model and data differ, and which candidates could explain it."""
