"""Real data: whether risk that was learnt on some runs foretells what came in others."""
