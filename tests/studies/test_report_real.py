"""The chapter on real data, made of a study that nobody measured."""

from dataclasses import replace

import numpy as np
import pytest
from studies.old.chapter import write_chapters
from studies.real.cases import HORIZONS
from studies.real.chapter import losses
from studies.real.measures import MEASURES, StateShare
from studies.real.moments import Kind, Moment, Warned
from studies.real.plan import Plan
from studies.real.study import WARNED_OF, Drives, RealStudy, Row
from studies.real.targets import TARGETS

from evofsm.driving.naming import name_state


def row(target, horizon, measure, area, enough):
    events = 30 if enough else 2
    few = float("nan")
    return Row(
        target.name,
        horizon,
        measure.name,
        *(area, area - 0.05, area + 0.02),
        *((0.2, 0.1, 0.3) if enough else (few, few, few)),
        *(area - 0.9, area - 0.95, area - 0.85),  # over time to collision
        *(0.001, 9, 8 if enough else 2, events, 5000, enough),
    )


def moment(kind):
    times = np.arange(-10.0, 4.2, 0.2)
    rows = np.column_stack([20.0 - times, np.full(len(times), 12.0), 12.0 - 0.1 * times])
    lead = float("nan") if kind is Kind.FALSE_ALARM else 2.0
    return Moment(kind, "made_1", "v1-v2", 7.0, lead, lead, times, rows, times / 9.0, -times)


def make(areas, enough=True):
    """``areas`` gives the AUROC of a measure by its name."""
    frequent = ("ttc-3", "braking-3") if enough else ()
    return RealStudy(
        Plan(),
        ("made_1", "made_2"),
        2,
        7,
        1.5,
        [
            row(target, horizon, measure, areas.get(measure.name, 0.7), target.name in frequent)
            for target in TARGETS
            for horizon in HORIZONS
            for measure in MEASURES
        ],
        [Warned(t, m.name, 30, 20, 1.2, (1.2,) * 30) for t in WARNED_OF for m in MEASURES],
        {"evofsm-states": (100, 120)},
        [
            StateShare((9.0, 4.0, 3.0), 12.0, 0.2),
            StateShare((9.1, 4.0, 3.0), 8.0, 0.1),
            StateShare((90.0, 4.0, 3.0), 1.0, 0.1),
        ],
        [moment(Kind.EARLIER), moment(Kind.LATER), moment(Kind.FALSE_ALARM)],
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("real")
    chapter = Plan().chapter(
        make({"ttc": 0.9, "evofsm-approach": 0.95}), folder, "python -m studies"
    )
    page = write_chapters(
        folder / "index.html", [chapter], title=chapter.title, about="", command="python -m studies"
    )
    return chapter, page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_page_has_its_figures_and_no_nan(written):
    chapter, page = written
    assert [figure.name for figure in chapter.figures] == ["real-areas", "real-moments"]
    assert all(path.stat().st_size > 0 for f in chapter.figures for path in f.paths.values())
    assert "nan" not in page.replace("nano", "").split("data:image")[0].lower()


def test_what_rests_on_few_events_says_so(written):
    chapter, _ = written
    table = next(
        t for t in chapter.tables if t.title.startswith("AUROC: time to collision below 2")
    )
    assert "Too few" in table.note
    assert any("Too few to compare anything" in sentence for sentence in chapter.answer)
    frequent = next(t for t in chapter.tables if t.title.startswith("AUROC: the follower"))
    assert "Too few" not in frequent.note


def test_rows_that_are_ours_are_set_off(written):
    chapter, _ = written
    table = chapter.tables[0]
    assert all(table.rows[place][0].startswith("evofsm") for place in table.ours)
    assert len(table.ours) == sum(m.name.startswith("evofsm") for m in MEASURES)


def test_states_that_were_hardly_visited_are_not_listed(written):
    chapter, _ = written
    (table,) = (one for one in chapter.tables if one.title.startswith("The states after which"))
    names = [line[0] for line in table.rows]
    assert names == [
        "9.0 m, 4.0 m/s behind 3.0 m/s",
        "9.1 m, 4.0 m/s behind 3.0 m/s",
    ]


def test_whoever_ranks_better_is_named_with_both_numbers():
    lost = losses(make({"ttc": 0.9, "mttc": 0.97, "evofsm-approach": 0.95}))
    assert any(
        text.startswith("mttc has the larger AUROC")
        and "braking-3 within 2 s 0.970 against 0.950" in text
        for text in lost
    )
    assert not any(text.startswith("ttc has") for text in lost)
    assert any(text.startswith("evofsm ranks worse than time to collision") for text in lost)


@pytest.mark.slow
def test_the_headline_counts_only_what_is_clear(tmp_path):
    clear = make({"ttc": 0.9, "evofsm-approach": 0.97})  # the difference is 0.02 to 0.12
    told = Plan().tell(clear)
    assert ("in 6 of 6 questions, worse in 0" in told.headline, told.mark) == (True, "✓")
    unclear = make({"ttc": 0.9, "evofsm-approach": 0.94})  # -0.01 to 0.09
    told = Plan().tell(unclear)
    assert ("in 0 of 6 questions, worse in 0" in told.headline, told.mark) == (True, "✗")


def test_without_enough_events_nothing_is_claimed(tmp_path):
    chapter = Plan().chapter(make({}, enough=False), tmp_path, "python -m studies")
    assert chapter.headline == "Too few events in these runs to compare anything."
    assert (chapter.losses, chapter.mark) == ((), "")
    assert [figure.name for figure in chapter.figures] == ["real-moments"]


@pytest.mark.slow
def test_it_says_who_taught_what_is_judged(tmp_path):
    folds = make({})
    assert "by what was learnt on the runs of the other 4 of 5 folds" in _said(folds, tmp_path)
    other = _said(replace(folds, taught_by=Drives(42, 16.1)), tmp_path)
    assert "All are judged by what 42 runs of another folder (16.1 h) taught;" in other
    assert "learnt on 42 runs of another folder, 16.1 h" in other
    assert "fold " not in other
    assert "folds" not in other


def _said(study, folder):
    chapter = Plan().chapter(study, folder, "python -m studies")
    plan = "; ".join(f"{one.name} {one.value}" for one in chapter.plan)
    return " ".join([chapter.about, plan, *(table.note for table in chapter.tables)])


# -- States in words ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("center", "name"),
    [
        ([9.2, 4.1, 3.0], "close (9 m), slow (4 m/s), closing at 1 m/s"),
        ([1.5, 0.2, 0.1], "nearly touching (2 m), standing (0 m/s), at equal speeds"),
        ([30.0, 15.0, 17.2], "at a distance (30 m), at medium speed (15 m/s), opening at 2 m/s"),
        ([80.0, 33.0, 20.0], "far (80 m), fast (33 m/s), closing at 13 m/s"),
    ],
)
def test_a_name_says_where_a_state_lies(center, name):
    assert name_state(center) == name


def test_a_centre_of_other_variables_has_no_name():
    with pytest.raises(ValueError, match="gap and both speeds"):
        name_state([1.0, 2.0])
