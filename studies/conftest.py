"""Doctests of a study that needs more than the others are not collected where that is missing."""

from importlib.util import find_spec

collect_ignore = [] if find_spec("stable_baselines3") else ["learners.py"]
