"""Alarms that state a rate of errors, adaptive and fixed, before and after a change."""
