"""What a session of first light takes a step's state, attempt and known figures by, and small
judgements of its images.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

from hilstar.display.identity import MonitorIdentity
from hilstar.instruments.calibrate.first_light import session
from hilstar.instruments.calibrate.first_light.context import (
    DarkSubtracted,
    FittedFigure,
    KeyChange,
    StepContext,
    StepOutcome,
    StepRecord,
)
from hilstar.instruments.calibrate.first_light.image_sources import Pattern, black, complete_images
from hilstar.instruments.calibrate.first_light.photometer import _seen
from hilstar.instruments.calibrate.first_light.session import (
    FIRST_LIGHT,
    FirstLightSession,
    SessionPlan,
    origin_of,
    state_sha256,
)
from hilstar.instruments.calibrate.first_light.steps import STEPS, SessionStep
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchConfig
from tests.support.benches import Tables
from tests.support.closed_camera import DETECTOR_PX, FULL_DN, ClosedCamera, closed_context
from tests.support.refusals import refusal


def session_of(folder, patches: int = 5, *changes: Tables) -> FirstLightSession:
    """A session on the closed bench."""
    context = closed_context(folder, ClosedCamera(), *changes)
    return FirstLightSession(folder / "s", context.file, context.source, patches)


def record(name: str, verdict: str, state: str = "", **figures: float) -> StepRecord:
    """A step that has ended so."""
    return StepRecord(
        name=name,
        verdict=verdict,
        line="",
        exit_code=0,
        state_sha256=state,
        figures=figures,
        files={},
        pictures=[],
        changes=[],
        ended="",
        seconds=0.0,
    )


def test_later_keys_are_those_of_the_steps_after_one():
    steps = (
        SessionStep("", "", "", name="first", writes=("monitor.flip_x",)),
        SessionStep("", "", "", name="second", writes=("monitor.bits", "render.bits")),
    )
    plan = SessionPlan(steps, {})
    assert plan.names == ("first", "second")
    assert plan.later_keys(0) == {"monitor.bits", "render.bits"}
    assert plan.later_keys(1) == frozenset()


def test_a_camera_is_told_with_the_monitor_that_it_sees():
    camera = ClosedCamera()
    assert origin_of(camera) == "closed camera"
    camera.monitor = MonitorIdentity(maker="DEL", connector="HDMI-1")
    assert origin_of(camera) == "closed camera"
    camera.monitor = MonitorIdentity(maker="DEL", connector="HDMI-1", edid_sha256="ab12")
    assert origin_of(camera) == f"closed camera on {camera.monitor.name()}"


@pytest.mark.parametrize("number", range(len(STEPS)), ids=[step.name for step in STEPS])
def test_a_step_depends_on_its_tables_but_for_what_later_steps_set(tmp_path, number):
    tables = {name: {"kept": 1} for name in BenchConfig.__struct_fields__}
    for step in STEPS:
        for key in step.writes:
            table, name = key.split(".")
            tables[table][name] = 1
    later = FIRST_LIGHT.later_keys(number)
    before = state_sha256(STEPS[number], later, tables, tmp_path, "a camera")
    for table, keys in tables.items():
        for name in keys:
            changed = tables | {table: keys | {name: 2}}
            is_read = table in STEPS[number].tables and f"{table}.{name}" not in later
            after = state_sha256(STEPS[number], later, changed, tmp_path, "a camera")
            assert (after != before) == is_read
    by_another = state_sha256(STEPS[number], later, tables, tmp_path, "another")
    assert (by_another != before) == bool(STEPS[number].tables)


def test_a_step_depends_on_what_its_files_hold_and_on_hilstar_s_version(tmp_path, monkeypatch):
    (step,) = (step for step in STEPS if step.name == "photometry")
    tables = {name: {} for name in BenchConfig.__struct_fields__}
    tables["monitor"] = {"calibration": "light.toml"}

    def state() -> str:
        return state_sha256(step, frozenset(), tables, tmp_path, "a camera")

    (tmp_path / "light.toml").write_text("one")
    before = state()
    (tmp_path / "light.toml").write_text("two")
    assert state() != before
    (tmp_path / "light.toml").write_text("one")
    assert state() == before
    monkeypatch.setattr(session, "__version__", "99")
    assert state() != before


def test_an_attempt_on_another_bench_or_with_another_number_of_patches_begins_anew(tmp_path):
    longer = {"collimator": {"focal_length_mm": 41}}
    attempts = []
    for patches, changes in ((5, {}), (5, {}), (6, {}), (5, longer)):
        attempts.append(session_of(tmp_path, patches, changes)._attempt(0))
    first, again, *others = attempts
    assert first == again
    assert len({first, *others}) == 3


@pytest.mark.parametrize("step", STEPS, ids=[step.name for step in STEPS])
def test_a_step_that_was_skipped_runs_again_where_what_it_lacked_may_be_there(tmp_path, step):
    number = STEPS.index(step)
    session = session_of(tmp_path)
    session.records = {name: record(name, "done") for name in step.needs}
    state = session._state(number)
    for verdict, is_done in (("done", True), ("skipped", not step.needs), ("failed", False)):
        session.records[step.name] = record(step.name, verdict, state)
        assert session._is_done(number) == is_done
        session.records[step.name] = record(step.name, verdict, "other")
        assert not session._is_done(number)
    session.records[step.name] = record(step.name, "done", state)
    # it was begun again, and killed
    session.unfinished[step.name] = session._attempt(number)
    assert not session._is_done(number)


def test_figures_are_known_of_steps_that_are_done(tmp_path):
    session = session_of(tmp_path)
    for verdict in ("done", "failed", "skipped"):
        session.records[verdict] = record(verdict, verdict, figure=1.0)
    context = session._context(STEPS[0], goes_on=False)
    assert context.known == {"done.figure": 1.0}
    assert context.folder == tmp_path / "s" / "images" / f"{STEPS[0].name}-1"


def test_a_step_is_given_what_its_session_was_asked_for(tmp_path):
    """The readings of the response, the watch over white and the frames of a field; whoever
    watches sees each pattern.
    """
    steps = (SessionStep("", "", "", name="only"),)
    contexts, watched = [], []

    def asked(context: StepContext) -> StepOutcome:
        contexts.append(context)
        context.watch(pattern)
        return StepOutcome("done", "it was asked", {"figure": 1.5})

    closed = closed_context(tmp_path, ClosedCamera())
    pattern = Pattern("dots", black(closed.resolution_px))
    session = FirstLightSession(
        tmp_path / "s",
        closed.file,
        closed.source,
        7,
        watched.append,
        watched_s=600.0,
        frames=3,
        plan=SessionPlan(steps, {"only": asked}),
    )
    said = []
    (tmp_path / "s").mkdir()
    assert session.run(frozenset(), said.append) == 0
    (context,) = contexts
    assert (context.patches, context.watched_s, context.frames) == (7, 600.0, 3)
    assert context.file is closed.file and context.source is closed.source
    assert watched == [pattern]
    assert said[-1].split() == ["only", "done:", "it", "was", "asked"]
    # what is done is not asked again
    session.run(frozenset(), said.append)
    assert len(contexts) == 1 and "done before" in said[-1]
    session.run(frozenset({"only"}), said.append)
    assert [context.folder.name for context in contexts] == ["only-1", "only-1"]


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


@pytest.mark.parametrize(
    ("verdict", "line"),
    [
        ("done", "measured"),
        ("failed", "measured; set all the same: [render] flux_at_white_e_per_s"),
    ],
)
def test_a_failed_step_names_the_keys_that_it_set(verdict, line):
    change = KeyChange(table="render", key="flux_at_white_e_per_s", before=1.0, after=2.0)
    outcome = StepOutcome(verdict, "measured", changes=(change,)).checked()
    assert (outcome.verdict, outcome.line, outcome.changes) == (verdict, line, (change,))


@pytest.mark.parametrize(("peak", "is_bright"), [(0.81, True), (0.79, False)])
def test_an_image_is_too_bright_by_what_the_adc_reads(tmp_path, peak, is_bright):
    """Over 0.8 of its range, of which 0.3 are dark."""
    context = closed_context(tmp_path, ClosedCamera())
    image = np.zeros(DETECTOR_PX[::-1])
    looked = DarkSubtracted(tmp_path / "a.png", image, peak * FULL_DN, 0.3 * FULL_DN)
    assert context.is_too_bright(looked) == is_bright


def test_a_square_s_rows_and_columns_hold_its_margins():
    """A screen of which the tracker sees two pixels in one, 10 px right and 5 px down."""
    monitor = Camera((100, 100), 1600.0, (0.0, 0.0), np.eye(3))
    geometry = BenchGeometry(monitor, Camera((44, 60), 800.0, (10.0, 5.0), np.eye(3)))
    # columns 20 to 60 are seen at 20 to 40, rows 30 to 70 at 20 to 40
    rows, columns = _seen(geometry, (20, 30), 41, 3.0)
    assert (rows, columns) == (slice(17, 44), slice(17, 44))
    assert "not whole" in refusal(_seen, geometry, (20, 30), 41, 3.1)
    assert "not whole" in refusal(_seen, geometry, (-20, 30), 41, 3.0)
