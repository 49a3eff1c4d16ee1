"""A family of our own protocol: one short lapse of a careful driver, seldom with a collision.

Unrevised, some 3 of 10,000 draws collide: splitting and plain sampling can both see that.
"""

from evofsm.driving import IDM, Body, ChangingIDM, Family, Leader, Numbers, Scenario

_LEADER = IDM(1.2, 25.0, 1.0, 1.0, 2.5)
_CAREFUL = IDM(1.25, 25.0, 2.0, 1.5, 2.0, lowest=-4.0, highest=2.5)
_CARELESS = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)


def make(numbers: Numbers) -> tuple[Scenario, IDM | ChangingIDM]:
    """Both cars under way; a step is a fifth of a decision, as a million episodes are driven."""
    speed = numbers.between("values.speed", 15.0, 20.0)
    leader = Leader(
        _LEADER,
        initial_speed=speed,
        brake_time=numbers.between("leader.brake_time", 2.0, 8.0),
        brake_decel=numbers.between("leader.brake_decel", 2.0, 4.2),
    )
    gap = numbers.between("scenario.initial_gap", 40.0, 60.0)
    body = Body(-4.0, 2.5)
    scenario = Scenario(leader, gap, duration=12.0, dt=0.05, initial_speed=speed, body=body)
    start = numbers.between("follower.lapses.0.start", 0.5, 7.5)
    end = start + numbers.between("follower.lapses.0.duration", 0.5, 1.5)
    return scenario, ChangingIDM(_CAREFUL, ((start, _CARELESS), (end, _CAREFUL)))


family = Family(
    "seldom",
    "A careful driver under way lapses once, for a second or so, behind a leader that brakes.",
    make,
    low=-4.0,
    high=2.5,
    decel=4.0,
    leader_decel=4.2,
)
