"""The machinery that runs all notebooks; it needs a checkout, and no notebook imports it."""
