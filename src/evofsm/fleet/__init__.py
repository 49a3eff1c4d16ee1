"""Many at once: machines of a whole fleet as arrays, and campaigns over many processes."""
