"""Studies of notebook 11."""
