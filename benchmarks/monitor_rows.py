"""What monitors are fed with: rows, scenes, junk."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np


def line(message: Mapping[str, Any]) -> bytes:
    """A message as it is sent, without the end of the line."""
    return json.dumps(message).encode()


def closing_in(count: int, dt: float = 0.1, seed: int = 0) -> Iterator[dict[str, float]]:
    """Closing in on a slower car: no alarm at first, one at the end."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        yield {
            "time": round(k * dt, 9),
            "gap": max(1.0, 45.0 - 5.0 * k * dt + rng.normal(0.0, 0.1)),
            "v_follower": 20.0 + rng.normal(0.0, 0.1),
            "v_leader": 15.0,
            "proposal": 0.5,
        }


def traffic(count: int, dt: float = 0.1, seed: int = 0) -> Iterator[dict[str, float]]:
    """Hours of following: waves, now and then closer than is good, and noise."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0.0, 0.1, (count, 3))
    for k in range(count):
        t = k * dt
        wave = math.sin(t / 7.0)
        gap = 15.0 + 11.0 * math.sin(t / 41.0) + 6.0 * math.sin(t / 97.0)
        yield {
            "time": round(t, 9),
            "gap": max(0.5, gap + noise[k, 0]),
            "v_follower": 18.0 + 3.0 * wave + noise[k, 1],
            "v_leader": max(0.0, 18.0 + 4.0 * math.sin(t / 7.0 + 0.6) + noise[k, 2]),
            "proposal": round(1.5 * math.cos(t / 7.0), 3),
        }


def scenes(count: int, dt: float = 0.01, objects: int = 50, seed: int = 0) -> Iterator[bytes]:
    """The same as `closing_in`, among other cars on three lanes; already written."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-150.0, 150.0, objects - 1)
    for k in range(count):
        gap = max(2.0, 60.0 - 3.0 * k * dt)
        others = [
            {
                **{"id": f"vehicle {n:03}", "x": round(float(place) + 0.5 * k * dt, 3)},
                **{"lane": 1 + n % 2, "vx": 20.5, "vy": 0.0, "length": 4.6, "width": 1.9},
            }
            for n, place in enumerate(places)
        ]
        ahead = {"id": "ahead", "x": gap + 4.6, "lane": 0, "vx": 17.0, "length": 4.6}
        ego = {"x": 0.0, "lane": 0, "vx": 20.0, "length": 4.6}
        yield line(
            {"time": round(k * dt, 6), "ego": ego, "objects": [*others, ahead], "proposal": 0.0}
        )


#: What is no message, and must change nothing.
JUNK = (
    b"",
    b"junk",
    b"\xff\xfe\x00\x01",
    b'{"time": 1',
    b"[1, 2, 3]",
    b"null",
    b'{"time": NaN, "gap": 1, "v_follower": 1, "v_leader": 1, "proposal": 0}',
    b'{"time": 1, "gap": 1, "v_follower": 1, "v_leader": 1, "proposal": 0, "colour": "red"}',
    b'{"schema": 2, "time": 1, "gap": 1, "v_follower": 1, "v_leader": 1, "proposal": 0}',
    b'{"time": 1, "gap": "near", "v_follower": 1, "v_leader": 1, "proposal": 0}',
    b'{"time": 1, "gap": 1e999, "v_follower": 1, "v_leader": 1, "proposal": 0}',
    b'{"a":' * 20_000,
    b"x" * 70_000,
)
