"""A run that is looked at while it is driven: decision by decision, with a clock of its own."""

from evofsm.app.watch.player import SPEEDS, Audience, Clock, Player, Watched
from evofsm.app.watch.session import Session, Watching, learn_first, watched_guard
from evofsm.app.watch.shown import (
    Danger,
    Frame,
    Graph,
    Judged,
    Start,
    StateShown,
    Story,
    Transition,
)
from evofsm.app.watch.story import Chronicle

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
    "watched_guard",
]
