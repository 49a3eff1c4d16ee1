"""A SUMO script of one's own, with four lines more: import, attach, print and detach."""

import libsumo

from evofsm.driving import attach

libsumo.start(["sumo", "-c", "grid.sumocfg"])
guards = attach(libsumo, "type:hasty")
while libsumo.simulation.getTime() < 400.0:
    libsumo.simulationStep()
print(f"{len(guards.collisions)} collisions")
guards.detach()
libsumo.close()
