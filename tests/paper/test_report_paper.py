"""The paper's page holds everything, in one file that loads nothing."""

import base64
import subprocess
import sys
from dataclasses import replace

import pytest

import evofsm
from evofsm.driving.world import KinematicWorld
from evofsm.fsm.divergence import jensen_shannon
from evofsm.paper.chapter import context_tables, losses, paper_chapter
from evofsm.paper.claims import Claim, check_claims
from evofsm.paper.report.chapter import write_chapters
from evofsm.paper.report.drawing import Drawing
from evofsm.paper.runs import run_paper
from evofsm.paper.settings import Settings

SVG = b'<svg xmlns="http://www.w3.org/2000/svg"/>'


@pytest.fixture(scope="module")
def study():
    return run_paper(KinematicWorld(), "kinematic", Settings.load(), rounds=2)


@pytest.fixture(scope="module")
def claims(study):
    return check_claims(study)


@pytest.fixture
def figure(tmp_path):
    """The only figure, in place of the paper's, which take seconds to draw."""
    path = tmp_path / "a.svg"
    path.write_bytes(SVG)
    drawing = Drawing("a", "A title", "A caption.", 'What "it" shows.', {"svg": path})
    return drawing


@pytest.fixture
def page(tmp_path, figure, read_page):
    """Writes the page of a study and reads it."""

    def write(study, command="make paper", **others):
        made = paper_chapter(study, **others)
        chapter = replace(made, figures=(figure,), sketches=(), command=command)
        made = write_chapters(tmp_path / "new" / "index.html", [chapter], command=command)
        assert [path.name for path in made.parent.iterdir()] == ["index.html"]
        return read_page(made)

    return write


def test_the_page_is_sound_and_names_the_paper(page, study):
    read = page(study)
    read.is_sound()
    assert [link for link in read.links if not link.startswith("#")] == [
        "https://arxiv.org/abs/1908.10823"
    ]


def test_figures_are_inside(page, study, figure):
    read = page(study)
    assert base64.b64decode(read.loads[0].split(",")[1]) == SVG
    assert read.alts == [figure.alt]
    assert "Figure 1. A title" in read.text
    assert figure.caption in read.text


def test_every_claim_and_table_is_there(page, study, claims):
    text = page(study).text
    for claim in claims:
        for part in (claim.claim, claim.paper, claim.measured):
            assert part in text
    for table in context_tables(study):
        assert table.title in text
        assert table.note in text
        for row in (table.header, *table.rows):
            assert all(value.replace(" -", " −") in text for value in row)


def test_settings_versions_command_and_paper_are_there(page, study):
    text = page(study).text
    for part in (
        "9 m/s² on reaching 24.2 m/s",
        "learning rate φ 0.01",
        "17 intervals of 0.3 m/s² from −2.5 to 2.5 m/s²",
        "case 3 from 15 s",
        "−4 to 2.5",
        f"evofsm {evofsm.__version__}",
        "numba",
        "make paper",
        "arXiv:1908.10823",
        "8 runs of four cases in the kinematic world",
        "8, and 2 extra ones",
    ):
        assert part in text
    assert "libsumo" not in text


def test_all_holds_is_said_on_top_and_a_failing_claim_cannot_be_missed(page, study, claims):
    good = [replace(claim, holds=True) for claim in claims]
    read = page(study, claims=good)
    assert (
        f"{len(good)} of {len(good)} claims of the paper hold in the kinematic world" in read.text
    )
    assert "fails" not in read.text
    assert 'class="verdict holds"' in read.verdict

    bad = [replace(good[0], holds=False, measured="quite the contrary"), *good[1:]]
    read = page(study, claims=bad)
    assert f"{len(bad) - 1} of {len(bad)} claims of the paper hold" in read.verdict
    assert 'class="verdict fails"' in read.verdict
    assert "quite the contrary" in read.verdict
    assert read.text.count("✗ ") == 1
    assert read.html.count('<tr class="fails">') == 1
    assert "quite the contrary" not in "".join(losses(study))


def test_whoever_forecasts_better_is_where_it_loses(page, study):
    lost = list(losses(study))
    assert lost[0].startswith("Persistence is the better forecast")
    mine = max(run.surprise[1:].max() for run in study.last_round[:1])
    assert f"in case 1 {_still(study.last_round[0]):.1e} against {mine:.1e} bit" in lost[0]
    text = page(study).text
    assert all(loss in text for loss in lost)
    assert f"{len(lost)} rows go against us" in text

    # Where the machine foresees everything nobody is better.
    runs = tuple(replace(run, surprise=0.0 * run.surprise) for run in study.runs)
    assert list(losses(replace(study, runs=runs))) == []


def _still(run):
    """Largest divergence of a belief from the one before it."""
    return jensen_shannon(run.belief[:-1], run.belief[1:]).max()


def test_what_is_told_is_text_and_never_markup(page, study):
    evil = '<script>alert("1 & 2")</script>'
    claims = [Claim("x", evil, evil, evil, holds=False)]
    read = page(replace(study, world=evil), command=f"do {evil}", claims=claims)
    read.is_sound()
    assert evil not in read.html
    assert read.text.count(evil) >= 10


def test_sumo_is_named_with_its_version(page, study):
    assert "SUMO (libsumo)" in page(replace(study, world="sumo")).text


@pytest.mark.parametrize("settings", ["", "[leader]\nbrake_decel = 2.0\n"])
def test_one_round_with_or_without_a_collision(settings, page, tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text(settings)
    study = run_paper(KinematicWorld(), "kinematic", Settings.load(path), rounds=1)
    assert (study.dead_end == -1) == bool(settings)
    assert "4 runs of four cases" in page(study).text


def test_a_missing_jinja2_is_named():
    code = """
import sys
sys.modules["jinja2"] = None
try:
    import evofsm.paper.report.chapter
except ModuleNotFoundError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install '.[plot]'" in done.stdout
