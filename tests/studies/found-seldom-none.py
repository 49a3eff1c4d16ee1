# fmt: off
# ruff: noqa
from math import inf
from pathlib import Path

from evofsm.driving.drivers import IDM, ChangingIDM
from evofsm.driving.family import Draw, Family
from evofsm.driving.scenarios import Behind, Body, CutIn, Leader, Scenario, Sensors

cases = {
    'found 1': Draw(scenario=Scenario(leader=Leader(driver=IDM(accel=1.2, desired_speed=25.0, min_gap=1.0, time_headway=1.0, decel=2.5, exponent=4.0, lowest=-inf, highest=inf), brake_decel=4.025367885024146, brake_speed=inf, brake_time=3.5913829626493827, initial_speed=18.767171911111255, waves=(), cut_in=None), initial_gap=41.907709435721365, duration=12.0, dt=0.01, initial_speed=18.767171911111255, body=Body(lowest=-4.0, highest=2.5, delay=0.0, jerk=inf), sensors=Sensors(gap_noise=0.0, speed_noise=0.0, delay=0.0, seed=165655430), behind=None), controller=ChangingIDM(first=IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5), changes=((5.847469597018181, IDM(accel=2.25, desired_speed=28.0, min_gap=0.8, time_headway=0.3, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)), (7.055997042621939, IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)))), variant='found 1'),
    'found 2': Draw(scenario=Scenario(leader=Leader(driver=IDM(accel=1.2, desired_speed=25.0, min_gap=1.0, time_headway=1.0, decel=2.5, exponent=4.0, lowest=-inf, highest=inf), brake_decel=3.9219829017843004, brake_speed=inf, brake_time=4.35870373915471, initial_speed=17.65954025559561, waves=(), cut_in=None), initial_gap=40.992819607071986, duration=12.0, dt=0.01, initial_speed=17.65954025559561, body=Body(lowest=-4.0, highest=2.5, delay=0.0, jerk=inf), sensors=Sensors(gap_noise=0.0, speed_noise=0.0, delay=0.0, seed=1229777395), behind=None), controller=ChangingIDM(first=IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5), changes=((6.237664164599517, IDM(accel=2.25, desired_speed=28.0, min_gap=0.8, time_headway=0.3, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)), (7.542825353873701, IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)))), variant='found 2'),
    'found 3': Draw(scenario=Scenario(leader=Leader(driver=IDM(accel=1.2, desired_speed=25.0, min_gap=1.0, time_headway=1.0, decel=2.5, exponent=4.0, lowest=-inf, highest=inf), brake_decel=4.125979905313386, brake_speed=inf, brake_time=2.9787008678316464, initial_speed=18.597646423436537, waves=(), cut_in=None), initial_gap=42.76675098174432, duration=12.0, dt=0.01, initial_speed=18.597646423436537, body=Body(lowest=-4.0, highest=2.5, delay=0.0, jerk=inf), sensors=Sensors(gap_noise=0.0, speed_noise=0.0, delay=0.0, seed=2502246551), behind=None), controller=ChangingIDM(first=IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5), changes=((4.952605569909637, IDM(accel=2.25, desired_speed=28.0, min_gap=0.8, time_headway=0.3, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)), (6.052848497582979, IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)))), variant='found 3'),
    'found 4': Draw(scenario=Scenario(leader=Leader(driver=IDM(accel=1.2, desired_speed=25.0, min_gap=1.0, time_headway=1.0, decel=2.5, exponent=4.0, lowest=-inf, highest=inf), brake_decel=4.048815848173011, brake_speed=inf, brake_time=3.5336666074767584, initial_speed=19.48023665971195, waves=(), cut_in=None), initial_gap=46.53966820544852, duration=12.0, dt=0.01, initial_speed=19.48023665971195, body=Body(lowest=-4.0, highest=2.5, delay=0.0, jerk=inf), sensors=Sensors(gap_noise=0.0, speed_noise=0.0, delay=0.0, seed=3354199175), behind=None), controller=ChangingIDM(first=IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5), changes=((5.950067896116326, IDM(accel=2.25, desired_speed=28.0, min_gap=0.8, time_headway=0.3, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)), (7.293946646259484, IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)))), variant='found 4'),
    'found 5': Draw(scenario=Scenario(leader=Leader(driver=IDM(accel=1.2, desired_speed=25.0, min_gap=1.0, time_headway=1.0, decel=2.5, exponent=4.0, lowest=-inf, highest=inf), brake_decel=4.077979124498016, brake_speed=inf, brake_time=2.672402373293754, initial_speed=19.38011421321155, waves=(), cut_in=None), initial_gap=49.4015143938268, duration=12.0, dt=0.01, initial_speed=19.38011421321155, body=Body(lowest=-4.0, highest=2.5, delay=0.0, jerk=inf), sensors=Sensors(gap_noise=0.0, speed_noise=0.0, delay=0.0, seed=2539772303), behind=None), controller=ChangingIDM(first=IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5), changes=((4.7426184764333925, IDM(accel=2.25, desired_speed=28.0, min_gap=0.8, time_headway=0.3, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)), (6.0306300009084, IDM(accel=1.25, desired_speed=25.0, min_gap=2.0, time_headway=1.5, decel=2.0, exponent=4.0, lowest=-4.0, highest=2.5)))), variant='found 5'),
}
family = Family(
    Path(__file__).stem,
    'Collisions of seldom that were found (judge: none) by: evofsm bench break toy,seldom --judge none --short',
    lambda numbers: [*cases.values()][numbers.variant][:2],
    low=-4.0,
    high=2.5,
    decel=4.0,
    leader_decel=4.2,
    interval=0.25,
    width=0.3,
    variants=tuple(cases),
    in_turn=True,
    fixed=True,
)
