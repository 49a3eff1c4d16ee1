"""What pytest leaves alone here: the site's own code, and pages that `tests/test_docs.py` runs."""

collect_ignore_glob = ["*.py", "tutorials/*", "how-to/*"]
