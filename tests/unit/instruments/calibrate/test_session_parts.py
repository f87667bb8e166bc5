"""What a session of first light takes a step's state, attempt and known figures by, and small
judgements of its images.
"""

from __future__ import annotations

import os
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.instruments.calibrate.first_light.context import (
    FittedFigure,
    StepContext,
    StepOutcome,
)
from hilstar.instruments.calibrate.first_light.image_sources import VirtualBench, complete_images
from hilstar.instruments.calibrate.first_light.photometer import _seen
from hilstar.instruments.calibrate.first_light.session import STEPS, FirstLightSession
from hilstar.server.bench.bench_file import BenchConfig
from tests.support.refusals import refusal


def state_of(folder, number: int, config: dict[str, dict[str, int]], monitor=None) -> str:
    """The state of a step by a bench file's tables, on a monitor."""
    session = SimpleNamespace(
        file=SimpleNamespace(config=config, folder=folder),
        source=SimpleNamespace(identity="a camera", monitor=monitor),
    )
    return FirstLightSession._state(session, number)


@pytest.mark.parametrize("number", range(len(STEPS)), ids=[step.name for step in STEPS])
def test_a_step_depends_on_its_tables_but_for_what_later_steps_set(tmp_path, number):
    tables = {name: {"kept": 1} for name in BenchConfig.__struct_fields__}
    for step in STEPS:
        for key in step.writes:
            table, name = key.split(".")
            tables[table][name] = 1
    before = state_of(tmp_path, number, tables)
    later = [key for step in STEPS[number + 1 :] for key in step.writes]
    for table, keys in tables.items():
        for name in keys:
            changed = tables | {table: keys | {name: 2}}
            is_read = table in STEPS[number].tables and f"{table}.{name}" not in later
            assert (state_of(tmp_path, number, changed) != before) == is_read
    monitor = SimpleNamespace(edid_sha256="ab12", name=lambda: "a monitor")
    is_shown = bool(STEPS[number].tables)
    assert (state_of(tmp_path, number, tables, monitor) != before) == is_shown


def test_an_attempt_with_another_number_of_patches_begins_anew():
    def attempt(state: str, patches: int) -> str:
        session = SimpleNamespace(_state=lambda number, tables: state, patches=patches)
        return FirstLightSession._attempt(session, 0)

    assert attempt("state", 5) == attempt("state", 5)
    assert len({attempt("state", 5), attempt("state", 6), attempt("other", 5)}) == 3


def test_figures_are_known_of_steps_that_are_done(tmp_path):
    records = {}
    for verdict in ("done", "failed", "skipped"):
        records[verdict] = SimpleNamespace(verdict=verdict, figures={"figure": 1.0})
    session = SimpleNamespace(
        folder=tmp_path,
        records=records,
        file=None,
        source=None,
        patches=0,
        _shows=None,
        _progress=SimpleNamespace(stage=None),
        _watched_s=0.0,
        _frames=1,
    )
    context = FirstLightSession._context(session, STEPS[0], goes_on=False)
    assert context.known == {"done.figure": 1.0}
    assert context.folder == tmp_path / "images" / f"{STEPS[0].name}-1"


def test_the_newest_image_may_be_incomplete(tmp_path):
    for number, name in enumerate(("second.png", "first.png", "last.png", "notes.txt")):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (1000 + number, 1000 + number))
    assert sorted(complete_images(tmp_path)) == ["first", "second"]
    (tmp_path / "last.png").unlink()
    assert sorted(complete_images(tmp_path)) == ["second"]


@pytest.mark.parametrize("verdict", ["done", "failed", "skipped"])
def test_only_what_was_done_fails_by_a_figure_at_an_end(verdict):
    at_end = FittedFigure("the width", 5.0, 0.0, 5.0)
    inside = FittedFigure("the height", 2.0, 0.0, 5.0)
    outcome = StepOutcome(verdict, "measured", fitted=(inside, at_end)).checked()
    if verdict == "done":
        assert outcome.verdict == "failed"
        words = "measured; but the width 5 is at an end of its model (0 to 5), so it was not"
        assert outcome.line.startswith(words)
        assert "the height" not in outcome.line
    else:
        assert (outcome.verdict, outcome.line) == (verdict, "measured")
    assert StepOutcome(verdict, "measured", fitted=(inside,)).checked().verdict == verdict


@pytest.mark.parametrize(("peak_dn", "is_bright"), [(810, True), (790, False)])
def test_an_image_is_too_bright_by_what_the_adc_reads(peak_dn, is_bright):
    """Over 0.8 of 1000 DN, of which 300 are dark."""
    looked = SimpleNamespace(raw_peak=peak_dn, floor_dn=300)
    assert StepContext.is_too_bright(SimpleNamespace(full_dn=1000), looked) == is_bright


def test_a_square_s_rows_and_columns_hold_its_margins():
    """A screen of which the tracker sees two pixels in one, 10 px right and 5 px down."""
    geometry = SimpleNamespace(
        to_tracker=lambda x, y: (x / 2 + 10, y / 2 + 5),
        tracker=SimpleNamespace(resolution_px=(44, 60)),
    )
    # columns 20 to 60 are seen at 20 to 40, rows 30 to 70 at 20 to 40
    rows, columns = _seen(geometry, (20, 30), 41, 3.0)
    assert (rows, columns) == (slice(17, 44), slice(17, 44))
    assert "not whole" in refusal(_seen, geometry, (20, 30), 41, 3.1)
    assert "not whole" in refusal(_seen, geometry, (-20, 30), 41, 3.0)


def test_each_primary_s_lit_pixels_are_drawn_in_its_own_light():
    class Masks(dict):
        """Images by key, scaled."""

        def keep(self, key, image):
            self[key] = image

        def image(self, key, brightest):
            return brightest * self[key]

    drawn = []

    def draw(light, primary):
        drawn.append(primary)
        return np.full((2, 2), primary)

    bench = SimpleNamespace(
        _primaries_seen=[3.0, 5.0],
        _masks=Masks(),
        _drawn=draw,
        _glow_e_per_s=np.zeros((2, 2)),
    )
    place = np.array([4, 7])
    for brightness in (1.0, 2.0):
        light = SimpleNamespace(e_per_s=np.full(2, brightness), place=place)
        for number, primary in enumerate((3.0, 5.0)):
            image = VirtualBench._primary_image(bench, light, number)
            assert image.tolist() == [[primary * brightness] * 2] * 2
    assert drawn == [3.0, 5.0]
