"""Families of scenarios: data in TOML or JSON files, drawn by seed.

Each file of this folder is a family; `load_family` reads them, or one of your own.

A file that ends in ``.json`` is read as JSON, with the same names.

In a file a number is fixed; ``[low, high]`` is drawn evenly from a range; ``{ one_of = [...] }``
is one of several, each as likely. ``{ of = "speed", times = 1.5, plus = 2.0, least = 0.0 }``
relates it to a number in ``[values]``: 1.5 times that, plus 2, at least 0; its parts may be ranges
as well. All are SI units.

==================  ===============================================================================
``about``           what happens, in a sentence
``interval``        time between decisions [s]
``[actions]``       the set of actions, as `evofsm.fsm.actions.IntervalActions`
``[limits]``        true hardest braking: ``decel`` of the follower, ``leader_decel`` of any leader
``[values]``        numbers that others relate to, by names of your choice
``[scenario]``      as `Scenario`, and likewise ``[body]``, ``[sensors]``, whose ``seed`` may be
                    fixed
``[leader]``        as `Leader`; ``driver`` names one of the drivers. ``waves`` holds pairs of a
                    time and an acceleration, ``[leader.traffic]`` makes such waves between a
                    ``fast`` and a ``slow`` speed, and ``[leader.cut_in]`` puts another car in its
                    place
``[follower]``      ``driver`` names one of the drivers, ``changes`` others from given times on;
                    ``[follower.lapses]``: a ``count`` of lapses, each from a ``start`` on for a
                    ``duration``, in which another ``driver`` drives
``[behind]``        a car behind the follower: its ``driver`` and ``gap``
``[drivers.NAME]``  as `evofsm.driving.drivers.idm.IDM`
``[[variant]]``     a ``name``, words ``about`` it, and whatever is otherwise in this variant; they
                    are drawn, each as likely, or taken in turn where ``in_turn = true``
``[shift]``         what is otherwise after the shift
==================  ===============================================================================
"""

from evofsm.driving.families.family import FAMILIES, SWITCHES, Draw, Family, load_family

__all__ = ["FAMILIES", "SWITCHES", "Draw", "Family", "load_family"]
