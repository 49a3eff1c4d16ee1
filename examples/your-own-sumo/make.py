"""Make the simulation: a grid of streets, 600 cars, one in ten with a hasty driver.

    python make.py            # grid.rou.xml and grid.sumocfg
    python make.py --network  # grid.net.xml.gz anew, by netgenerate (pip install eclipse-sumo)

The hasty ones keep a fifth of a second behind the car ahead, and look up once a second: SUMO's own
car-following model then runs into others. Nothing here knows of evofsm.
"""

from __future__ import annotations

import argparse
import gzip
import random
import subprocess
from pathlib import Path

HERE = Path(__file__).parent
STREETS, LENGTH = 4, 200  # in each direction, and from crossing to crossing [m]
CARS, DURATION = 600, 300.0  # inserted evenly over so long [s]
TYPES = """    <vType id="normal" sigma="0.5"/>
    <vType id="hasty" tau="0.2" minGap="0.5" accel="3.5" speedFactor="1.3" sigma="0.5"
           actionStepLength="1.0" color="red"/>
"""
CONFIGURATION = """<configuration>
    <net-file value="{net}"/>
    <route-files value="grid.rou.xml"/>
    <step-length value="0.1"/>
    <collision.action value="warn"/>
    <collision.mingap-factor value="0"/>
    <time-to-teleport value="120"/>
    <no-step-log value="true"/>
    <no-warnings value="true"/>
    <end value="400"/>
</configuration>
"""


def make_network(file: Path) -> None:
    """Have netgenerate make the grid: two lanes each way, traffic lights."""
    plain = file.with_suffix("")
    words = ["netgenerate", "--grid", "--grid.number", str(STREETS), "--grid.length", str(LENGTH)]
    words += ["--grid.attach-length", str(LENGTH), "--default.lanenumber", "2"]
    words += ["--default-junction-type", "traffic_light", "--no-turnarounds", "true"]
    subprocess.run([*words, "--output-file", str(plain)], check=True)
    file.write_bytes(gzip.compress(plain.read_bytes(), mtime=0))
    plain.unlink()


def ends() -> tuple[list[str], list[str]]:
    """Streets on which cars come in, and on which they leave, as netgenerate names them."""
    last = STREETS - 1
    letters = "ABCDEFGHIJ"[:STREETS]
    outside = [(f"left{k}", f"A{k}") for k in range(STREETS)]
    outside += [(f"right{k}", f"{letters[last]}{k}") for k in range(STREETS)]
    outside += [(f"bottom{k}", f"{letters[k]}0") for k in range(STREETS)]
    outside += [(f"top{k}", f"{letters[k]}{last}") for k in range(STREETS)]
    return [out + near for out, near in outside], [near + out for out, near in outside]


def write_cars(folder: Path, seed: int) -> Path:
    """Write who drives from where to where; returns the configuration of the simulation."""
    draw = random.Random(seed)
    sources, sinks = ends()
    lines = []
    for k in range(CARS):
        begin = draw.randrange(len(sources))
        end = draw.choice([each for each in range(len(sinks)) if each != begin])
        kind = "hasty" if draw.random() < 0.1 else "normal"
        lines.append(
            f'    <trip id="{k}" type="{kind}" depart="{k * DURATION / CARS:.1f}" '
            f'from="{sources[begin]}" to="{sinks[end]}" departLane="best" departSpeed="max"/>\n'
        )
    (folder / "grid.rou.xml").write_text(f"<routes>\n{TYPES}{''.join(lines)}</routes>\n")
    configuration = folder / "grid.sumocfg"
    configuration.write_text(CONFIGURATION.format(net=(HERE / "grid.net.xml.gz").resolve()))
    return configuration


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", action="store_true", help="make the network anew")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    if asked.network:
        make_network(HERE / "grid.net.xml.gz")
    print(write_cars(Path.cwd(), asked.seed))
