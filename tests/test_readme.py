"""What README promises; its Python runs as a doctest, `make test` is what runs this."""

import json
import re
import statistics
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")
CLOSED_LOOP = (ROOT / "docs" / "closed-loop.md").read_text("utf-8")


# -- The closed loop -----------------------------------------------------------------------------

RESULTS = json.loads((ROOT / "docs" / "results" / "emergency.json").read_text())


def shown(rows, pick=lambda values: values[0]):
    """Collisions, mobility and jerk as the tables write them."""
    rate, mobility, jerk = (
        pick([row[name] for row in rows]) for name in ("collision_rate", "mobility", "jerk")
    )
    return [f"{100 * rate:.1f} %", f"{mobility:.3f}", f"{jerk:.2f}"]


def cells_of(page):
    text, *_ = (ROOT / page).read_text().split("\n## `shift`")  # other families have other tables
    lines = text.splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if "|" in line]


def test_the_closed_loop_table_is_what_the_study_printed():
    checked = 0
    for cells in cells_of("docs/closed-loop.md"):
        name = re.match(r"`([\w-]+)`", cells[0])
        rows = [row for row in RESULTS if name and row["policy"] == name[1]]
        if rows and len(cells) >= 5:
            numbers = shown(rows)
            assert all(number in cells for number in numbers), (name[1], numbers)
            checked += 1
    assert checked >= 7


def test_the_bold_row_is_rebuilt_in_ten_lines():
    from studies.closed_loop import OURS, ClosedLoop, _test_learner

    blocks = re.findall(r"```pycon\n(.*?)```", CLOSED_LOOP, re.DOTALL)
    (block,) = [block for block in blocks if "try_out(" in block]
    lines = [line[4:] for line in block.splitlines() if line.startswith(">>> ")]
    assert len(lines) <= 10
    few = "\n".join(lines).replace("episodes=20", "episodes=4")
    names = {}
    exec(few.replace("learning_seed=0", "learning_seed=1"), names)
    (row,) = _test_learner(ClosedLoop(train=4, test=4), OURS, 1)["rows"]
    ours = names["row"]
    assert ours.collisions == row["collisions"] == 0
    assert sum(drive.collided for drive in names["drives"]) == row["train_collisions"] == 0
    for name in ("mobility", "mobility_low", "intervention_rate", "mean_change", "jerk"):
        assert getattr(ours, name) == row[name]


def test_our_own_lines_and_the_evidence_are_the_median_and_the_worst_of_the_seeds():
    ours = [row for row in RESULTS if row["policy"] == "evofsm" and row["train_episodes"] == 100]
    assert len(ours) == 20
    worst = max(ours, key=lambda row: (row["collision_rate"], -row["mobility"]))
    median_line, worst_line = (
        cells for cells in cells_of("docs/closed-loop.md") if "100 episodes" in cells[0]
    )
    assert all(number in median_line for number in shown(ours, statistics.median))
    assert all(number in worst_line for number in shown([worst]))
    changed = statistics.median(row["intervention_rate"] for row in ours)
    names = ("unrevised", "rss-matched")
    alone, told = ([row for row in RESULTS if row["policy"] == name] for name in names)
    (line,) = [cells for cells in cells_of("README.md") if cells[0].startswith("weak brakes")]
    assert line[1].startswith("{}, mobility {}".format(*shown(alone)))
    assert f"changes {100 * told[0]['intervention_rate']:.0f} %" in line[2]
    for rows, cell in ((told, line[2]), ([worst], line[3])):
        assert all(number in cell for number in shown(rows)[:2])
    assert f"changes {100 * changed:.0f} %" in line[3]
    page = (ROOT / "docs" / "evidence.md").read_text()
    assert all(row["collision_rate"] == 0.0 for row in ours)
    assert f"each of {len(ours)} learning seeds" in page
    assert f"a mobility of {statistics.median(row['mobility'] for row in ours):.3f}" in page
    assert f"changes {100 * changed:.1f} % of the decisions" in page
    assert sum(row["train_collisions"] for row in RESULTS) == 0  # as the text says
