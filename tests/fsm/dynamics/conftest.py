import numpy as np
import pytest

from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.machine import EvolvingFSM


def _follow(dynamics, Z, U, *, failed=False):
    """An episode: T + 1 observations and T actions, of which nobody knows what they mean."""
    for t, z in enumerate(Z):
        dynamics.observe(np.asarray(z, np.float64))
        if t < len(U):
            dynamics.act(dynamics.encode(U[t]))
    dynamics.end(failed=failed)


def _drive(draw, steps=120, *, braking=None, start=(40.0, 15.0, 15.0), noise=0.01):
    """A gap [m] and two speeds [m/s] at 4 Hz; the leader brakes from a step on, and stands at 0."""
    gap, own, leader = start
    Z, U = [[gap, own, leader]], []
    for t in range(steps):
        a = float(np.clip(draw.normal(0.05 * (leader - own), 0.8), -2.5, 2.5))
        push = -3.0 if braking is not None and braking <= t < braking + 16 else 0.0
        own_next = max(0.0, own + 0.25 * a)
        leader_next = max(0.0, leader + 0.25 * push + noise * draw.normal())
        gap += 0.25 * (leader - own)
        own, leader = own_next, leader_next
        Z.append([gap, own, leader])
        U.append(a)
    return np.array(Z), np.array(U)


@pytest.fixture
def taught():
    """Dynamics of a car behind another one, after some episodes without a failure."""

    def make(episodes=4, seed=0, **settings):
        draw = np.random.default_rng(seed)
        dynamics = Dynamics(-2.5, 2.5, **settings)
        for episode in range(episodes):
            _follow(dynamics, *_drive(draw, braking=60 if episode % 2 else None))
        return dynamics

    return make


@pytest.fixture
def cart():
    """A machine that learns how a cart moves, and what it was told: rows, indices, pushes."""

    def make(rows=150, seed=0, box=True, start=0.0):
        draw = np.random.default_rng(seed)
        dynamics = Dynamics(-1.0, 1.0) if box else Dynamics(n_actions=3)
        machine = EvolvingFSM(3, radius=0.5, max_states=6, dynamics=dynamics)
        x, v, Z, I, U = start, 0.0, [], [], []
        for t in range(rows):
            a = float(draw.uniform(-1.0, 1.0))
            i = int(np.clip((a + 1.0) * 1.5, 0, 2))
            Z.append([x, v])
            I.append(i)
            U.append(a)
            gust = 0.6 if 100 <= t < 106 else 0.0
            push = a if box else i - 1.0
            x, v = x + 0.1 * v, v + 0.1 * (push - 0.2 * v + gust) + 0.001 * draw.normal()
        return machine, np.array(Z), np.array(I), np.array(U)

    return make


@pytest.fixture
def follow():
    """Have dynamics learn an episode."""
    return _follow


@pytest.fixture
def drive():
    """Drive behind a leader."""
    return _drive
