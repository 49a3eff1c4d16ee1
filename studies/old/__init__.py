"""What studies stand on that are not rewritten on `studies.lib` yet: it leaves with them."""
