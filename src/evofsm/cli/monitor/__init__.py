"""The guard beside a stack of others: rows or scenes in, decisions out, a JSON line each."""
