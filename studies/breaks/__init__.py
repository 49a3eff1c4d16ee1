"""Broken on purpose: which scenarios of a family end in a collision, and how likely they are."""
