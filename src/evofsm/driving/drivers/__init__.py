"""Car-following models: each a compiled kernel, and a controller around it."""
