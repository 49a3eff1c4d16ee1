"""Tasks that others set: how often each judge lets them fail, and what it was told."""
