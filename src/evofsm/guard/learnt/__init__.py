"""A judge that was told nothing but which episodes failed: see `judge.LearntRisk`."""
