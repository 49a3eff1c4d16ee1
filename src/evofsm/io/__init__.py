"""Readers of traces: logs in CSV and Parquet, and the FCD output of SUMO."""

from evofsm.io.conditions import Condition
from evofsm.io.fcd import VehicleLengths
from evofsm.io.traces import Chunk, LogColumns, Noted, read_traces

__all__ = ["Chunk", "Condition", "LogColumns", "Noted", "VehicleLengths", "read_traces"]
