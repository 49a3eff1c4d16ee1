"""A run that is looked at while it is driven: decision by decision, with a clock of its own."""

from evofsm.studies.watching.player import SPEEDS, Audience, Clock, Player, Watched
from evofsm.studies.watching.session import (
    Session,
    Watching,
    learn_first,
    watched_learner,
)
from evofsm.studies.watching.shown import Frame, Graph, Judged, Start, StateShown, Transition
from evofsm.studies.watching.story import Chronicle, Danger, Story

__all__ = [
    "SPEEDS",
    "Audience",
    "Chronicle",
    "Clock",
    "Danger",
    "Frame",
    "Graph",
    "Judged",
    "Player",
    "Session",
    "Start",
    "StateShown",
    "Story",
    "Transition",
    "Watched",
    "Watching",
    "learn_first",
    "watched_learner",
]
