"""Machines trip as they are said to, and alarms are judged on what is held out."""

import numpy as np
import polars as pl
import pytest
from studies.machines import MACHINES, OURS, THRESHOLDS, judged, log_of, pooled_over_seeds


@pytest.mark.parametrize("name", MACHINES)
def test_a_log_has_trips_and_planned_stops_and_comes_again(name):
    runs = log_of(name, 20.0, 0)
    assert {run.tripped for run in runs} == {True, False}
    again = log_of(name, 20.0, 0)
    assert all(np.array_equal(a.values, b.values) for a, b in zip(runs, again, strict=True))


@pytest.mark.slow
def test_where_the_limit_depends_on_the_load_learnt_alarms_foresee_more():
    rows = pooled_over_seeds(pl.DataFrame(judged("compressor", 40.0, 0)))
    ours, thresholds = (
        rows.filter(pl.col("alarm") == alarm, stated=1.0).row(0, named=True)
        for alarm in (OURS, THRESHOLDS)
    )
    assert ours["failures"] == thresholds["failures"] > 10
    assert ours["foreseen"] > 0.8 > 0.3 > thresholds["foreseen"]
    assert thresholds["ours_at_same"] > thresholds["lead"]
