"""Readers of traces: logs in CSV and Parquet, and the FCD output of SUMO."""

from evofsm.io.fcd import VehicleLengths
from evofsm.io.traces import Chunk, LogColumns, read_traces

__all__ = ["Chunk", "LogColumns", "VehicleLengths", "read_traces"]
