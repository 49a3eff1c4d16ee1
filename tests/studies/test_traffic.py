"""Guards in SUMO's traffic, beside the same traffic without them."""

import pytest
from studies import traffic
from studies.lib import frame_of
from studies.traffic import ALONE, OURS, Traffic, beside_alone, simulate


@pytest.mark.slow
def test_late_drivers_are_simulated_beside_themselves_without_guards():
    alone, guarded = (simulate("road", "late", one, 0, seconds=70.0) for one in (ALONE, OURS))
    few = simulate("road", "late", ALONE, 0, "10%", 70.0)
    assert few == {**alone, "share": "10%"}  # nobody who only looks changes anything
    assert alone["emergencies"] > guarded["emergencies"] == 0
    assert alone["hard"] > guarded["hard"]
    assert alone["limited"] is None
    assert guarded["limited"] > 0
    (beside,) = beside_alone(frame_of([guarded]), frame_of([alone])).to_dicts()
    assert beside["more"] == -alone["emergencies"]
    assert beside["hard_alone"] == pytest.approx(1000.0 * alone["hard"] / alone["kilometres"])
    assert beside["speed"] == pytest.approx(guarded["speed"] / alone["speed"])
    assert beside["bound"] == pytest.approx(3.69, abs=0.01)  # of none in one simulation


def test_networks_that_are_not_there_are_refused(monkeypatch):
    monkeypatch.setattr(traffic, "demos", lambda: None)
    with pytest.raises(ValueError, match="no network A10KW; there are drop, road, grid, and demos"):
        Traffic(worlds="drop,A10KW").run()
