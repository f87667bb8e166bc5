"""A row of each table in results/ that no study's test measures whole is what is measured now."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from hilstar.instruments.study import codes, colour, rigs
from hilstar.instruments.study.chain.choices import Parts, five_scenes
from hilstar.instruments.study.chain.measuring import (
    RSS,
    WHOLE,
    Rounds,
    SceneMeasurement,
    error_budget,
)
from hilstar.instruments.study.chain.tracker import StudyTracker
from hilstar.instruments.study.tradeoff.light import brightness
from tests.support.recorded import assert_row
from tools.measure_answers import bench_of

# As the whole studies have them: stars at so many places within a pixel, along each axis.
PHASES, PHASES_OVER_FRAMES = 32, 16
BITS, UNDER_WHITE_MAG = 8, 6.0


def test_the_errors_of_a_way_to_codes_are_those_recorded() -> None:
    way = next(way for way in codes.WAYS if way.name == "round")
    (errors,) = codes.code_errors(BITS, way, PHASES, [UNDER_WHITE_MAG])
    keys = {"bits": BITS, "method": way.name, "mag_under_white": UNDER_WHITE_MAG}
    assert_row("quantisation_time.csv", keys, asdict(codes.error_figures(errors)))


def test_the_errors_over_two_frames_are_those_recorded() -> None:
    panel = codes.frames_panels()[0]
    for row in codes.over_frames(panel, PHASES_OVER_FRAMES, (2,)):
        figures = asdict(row)
        keys = {name: figures.pop(name) for name in ("panel", "method", "frames")}
        assert_row("over_frames.csv", keys, figures)


def test_the_attitudes_that_pixels_give_a_published_rig_are_those_recorded() -> None:
    for row in rigs.naples_rows():
        keys = {"rig": row.rig, "figure": row.figure}
        assert_row("rigs.csv", keys, {"published": row.published, "predicted": row.predicted})


def test_the_errors_of_a_step_are_those_recorded() -> None:
    with ExitStack() as stack:
        step = brightness(stack, False)
    for trial in step.trials:
        if trial.error > step.error.floor:
            keys = {"step": step.name, "method": trial.method}
            assert_row("tradeoff.csv", keys, {"error": trial.error, "second": trial.second})


def test_the_errors_of_the_chosen_chain_are_those_recorded() -> None:
    with Parts(bench_of(BITS)) as parts, StudyTracker(parts.own) as tracker:
        scene = five_scenes(parts.own)[0]
        measurement = SceneMeasurement(parts, tracker, scene, Rounds())
        chosen = measurement.marks.auto
        error = measurement.error(chosen)
        budget = error_budget(measurement, chosen)
    keys = {"scene": scene.name, "bits": BITS, "chosen": "auto"}
    assert_row("chain.csv", keys, asdict(error))
    assert [part.step for part in budget][-2:] == [RSS, WHOLE]
    for part in budget:
        keys = {"bits": BITS, "scene": scene.name, "chosen": "auto", "step": part.step}
        figures = {"error_arcsec": part.error_arcsec, "error_mag": part.error_mag}
        assert_row("chain_budget.csv", keys, figures)


def test_the_errors_of_a_choice_of_colour_are_those_recorded(tmp_path: Path) -> None:
    colour.write_spectra(tmp_path)
    before = {"mono": colour.TRACKERS["mono"]}
    row = next(colour.study_choices(tmp_path, before, colour.FIELDS, 1))
    figures = asdict(row)
    keys = {name: figures.pop(name) for name in ("tracker", "colour", "method", "stars")}
    errors = {name: figures[name] for name in ("subtypes", "mag", "channel", "px")}
    assert_row("colour.csv", keys, errors)
