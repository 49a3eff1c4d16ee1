"""Judges of others, to be held against: most of them are told how their system moves."""
