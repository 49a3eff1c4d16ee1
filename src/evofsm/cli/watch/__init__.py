"""A run that is looked at while it is driven: decision by decision, with a clock of its own."""
