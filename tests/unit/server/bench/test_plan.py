"""What a bench's light is planned with, part by part: its paths, its full scale, the first scene
within the tolerance, and what each choice adds to the worst errors of all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Orientation
from hilstar.server.bench import scene as scenes
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from hilstar.server.bench.cameras import bench_camera
from hilstar.server.bench.code_errors import CodeErrors
from hilstar.server.bench.config import RenderSettings
from hilstar.server.bench.effort import FieldCost, Motion, Sides, exact_in_time
from hilstar.server.bench.least_psf import WHOLE, Choice
from hilstar.server.bench.monitor import orientation_of, scan_of
from hilstar.server.bench.scene import (
    brightest_peak_e_per_s,
    path_of,
    plan_scene,
    turning_of,
    white_of,
)
from hilstar.sky.stars import Stars
from tests.support.benches import bench_text
from tests.support.stars import stars_at

PITCH_UM, COLLIMATOR_MM = 57.65, 60.0  # of the small bench


def bench_file(tmp_path, *changes: dict[str, dict[str, object]]) -> BenchFile:
    """The small bench with changes."""
    return bench_file_of(tmp_path / "bench.toml", bench_text(*changes))


SCANNED = {"monitor": {"refresh_hz": 50.0, "scanout_ms": 12.0, "hold_ms": 5.0}}


def test_a_star_s_path_is_that_of_a_turn_while_its_row_is_lit(tmp_path):
    """A degree a second for 5 ms, and 6 of 11 ms from the mean of its light where it has none."""
    file = bench_file(tmp_path, SCANNED, {"render": {"motion": "on"}})
    camera = bench_camera(file.config, tmp_path)
    px_per_rad = COLLIMATOR_MM / PITCH_UM * 1e3
    # at a corner of the image a pinhole's scale is larger by 1 + tan^2 of its angle
    corner = 1 + (160**2 + 120**2) / px_per_rad**2
    path_px = math.radians(1.0) * 0.005 * px_per_rad
    assert path_px <= path_of(file.config, camera, False) <= path_px * corner
    assert turning_of(file.config, False) == pytest.approx(6 / 11)
    still = bench_file(tmp_path, SCANNED, {"render": {"motion": "off"}})
    assert path_of(still.config, camera, True) == 0.0
    assert turning_of(still.config, True) is None
    # by itself a bench moves its stars on a screen alone
    usual = bench_file(tmp_path, SCANNED)
    assert turning_of(usual.config, False) is None
    assert turning_of(usual.config, True) == pytest.approx(6 / 11)


def test_a_monitor_s_rows_light_as_its_keys_say_or_for_a_refresh(tmp_path):
    scan = scan_of(bench_file(tmp_path, SCANNED).config.monitor)
    assert (scan.scanout_s, scan.hold_s) == (0.012, 0.005)
    usual = scan_of(bench_file(tmp_path, {"monitor": {"refresh_hz": 40.0}}).config.monitor)
    assert (usual.scanout_s, usual.hold_s) == (0.025, 0.025)
    turned = bench_file(tmp_path, {"monitor": {"flip_x": True, "rotate_deg": 270}})
    orientation = orientation_of(turned.config.monitor)
    assert orientation.screen_px((320, 240)) == (240, 320)
    assert orientation == Orientation(flip_x=True, flip_y=False, quarter_turns=3)
    upset = bench_file(tmp_path, {"monitor": {"flip_y": True, "rotate_deg": 90}})
    assert orientation_of(upset.config.monitor) == Orientation(False, True, 1)
    assert orientation_of(bench_file(tmp_path).config.monitor) == Orientation()


PSF = GaussianPsf((0.85, 0.85))


def lit(v_mag: list[float], rates: list[float]) -> Stars:
    """Stars of these magnitudes and rates, wherever they are."""
    stars = stars_at(np.tile([1.0, 0.0, 0.0], (len(rates), 1)), np.array(rates))
    return replace(stars, v_mag=np.array(v_mag, np.float32))


EVERY = lit([-1.4, 0.0, 0.5, 2.0], [900.0, 250.0, 160.0, 40.0])


@pytest.mark.parametrize(
    ("stars", "brightest_v_mag", "drive", "peak"),
    [
        (EVERY, 0.0, 1.0, 250.0),
        (EVERY, None, 1.0, 40.0),  # that of the bench file's page, V = 1.5
        (EVERY, 0.5, 1.0, 160.0),
        (EVERY, -2.0, 1.0, 900.0),
        # a red star asks for three times as much of white
        (EVERY, 0.5, np.array([1.0, 1.0, 1.0, 5.0]), 200.0),
        # a catalogue of brighter stars alone: none clips
        (lit([-1.4, -0.7], [900.0, 500.0]), None, 1.0, 900.0),
    ],
)
def test_full_scale_is_the_brightest_pixel_of_the_brightest_star_from_a_magnitude_on(
    stars, brightest_v_mag, drive, peak
):
    assert brightest_peak_e_per_s(stars, PSF, brightest_v_mag, drive) == peak * PSF.peak_share


def test_full_scale_that_the_file_gives_is_its_own():
    assert white_of(RenderSettings(flux_at_white_e_per_s=77.0), EVERY, PSF) == 77.0
    assert white_of(RenderSettings(), EVERY, PSF) == 40.0 * PSF.peak_share


@pytest.mark.parametrize(
    ("stars", "brightest_v_mag", "words"),
    [
        (EVERY, 2.5, r"\[render\] brightest_v_mag leaves no star; write a smaller"),
        (lit([], []), 0.0, r"\[sky\] faintest_v_mag leaves no star; write a larger"),
        (lit([1.0], [1e-9]), 0.0, r"the brightest star to show gives 1.97e-10 electrons"),
        (lit([1.0], [1e13]), 0.0, r"the brightest star to show gives 1.97e\+12 electrons"),
    ],
)
def test_a_full_scale_of_no_star_or_beyond_numbers_is_refused(stars, brightest_v_mag, words):
    with pytest.raises(InputError, match=words):
        brightest_peak_e_per_s(stars, PSF, brightest_v_mag)


@dataclass(frozen=True)
class Planned:
    """The plan of a scene."""

    within: bool
    number: int


TOLERANCE = RenderSettings(tolerance_mag=0.02, tolerance_px=0.03)


@pytest.mark.parametrize(
    ("candidates", "chosen"),
    [
        # name, errors of the PSF alone, and whether all together are within
        ([("a", 0.01, 0.01, True), (WHOLE, 0.0, 0.0, True)], 0),
        ([("a", 0.021, 0.01, True), ("b", 0.02, 0.03, True)], 1),
        ([("a", 0.01, 0.031, True), ("b", 0.02, 0.03, True)], 1),
        ([("a", 0.01, 0.01, False), ("b", 0.005, 0.01, True)], 1),
        # none is within with all together: the first whose PSF alone is
        ([("a", 0.5, 0.5, True), ("b", 0.01, 0.01, False), (WHOLE, 0.0, 0.0, False)], 1),
        ([("a", 0.5, 0.5, True), (WHOLE, 0.5, 0.5, False)], 1),
    ],
)
def test_the_scene_is_the_first_whose_plan_is_within_the_tolerance(monkeypatch, candidates, chosen):
    planned = []

    def plan(render, number):
        planned.append(number)
        return Planned(candidates[number][3], number)

    monkeypatch.setattr(scenes, "plan_effort", plan)
    made = []
    for number, (name, error_mag, error_px, _) in enumerate(candidates):
        choice = Choice("PSF", name, error_mag, error_px)
        made.append(SimpleNamespace(choice=choice, light=number))
    scene, effort = plan_scene(TOLERANCE, iter(made))
    assert (scene.light, effort.number) == (chosen, chosen)
    assert planned == list(range(max(planned) + 1))


def test_a_bench_s_own_psf_is_planned_once(monkeypatch):
    monkeypatch.setattr(scenes, "plan_effort", lambda render, light: Planned(False, light))
    own = SimpleNamespace(choice=None, light=5)
    assert plan_scene(TOLERANCE, iter([own]))[1].number == 5


# spans by their brighter ends, and the worst of flux and place in each
CODES = CodeErrors(
    flux_mag=0.3,
    place_px=0.5,
    centroider="window",
    by_span=((1.0, 0.02, 0.03), (3.0, 0.1, 0.05), (5.0, 0.3, 0.5)),
    still_px=0.2,
)


@pytest.mark.parametrize(
    ("cut_to_mag", "worst"),
    [
        (-1.0, (0.02, 0.03)),
        (1.0, (0.02, 0.03)),
        (2.0, (0.1, 0.05)),  # stars of the span that the magnitude is in, to its fainter end
        (4.0, (0.3, 0.5)),
        (math.inf, (0.3, 0.5)),
    ],
)
def test_the_errors_of_brighter_stars_are_those_of_their_spans(cut_to_mag, worst):
    assert CODES.brighter_than(cut_to_mag) == worst


@pytest.mark.parametrize(
    ("cut_to_mag", "added"),
    [
        # 0.02 + 0.29 is 0.01 over the worst of all, and 0.03 + 0.1 under it
        (1.0, (0.01, 0.0)),
        (math.inf, (0.29, 0.1)),
    ],
)
def test_a_smaller_sprite_adds_what_is_over_the_worst_of_the_codes(cut_to_mag, added):
    sides = Sides((), Choice("sprites", "9 px", 0.29, 0.1), cut_to_mag)
    found = sides.beside(CODES)
    assert (found.error_mag, found.error_px) == pytest.approx(added)
    assert (found.part, found.choice) == ("sprites", "9 px")


def test_a_star_without_its_path_adds_to_the_codes_of_a_star_at_rest():
    motion = Motion(0.4, Choice("paths", "from 0.4 px", 0.0, 0.35))
    assert motion.beside(CODES).error_px == pytest.approx(0.2 + 0.35 - 0.5)
    small = Motion(0.1, Choice("paths", "from 0.1 px", 0.0, 0.2))
    assert small.beside(CODES).error_px == 0.0
    # where nothing moves, or a star shows nothing, it is what it is
    at_rest = CodeErrors(0.3, 0.5, "window", CODES.by_span)
    dark = CodeErrors(math.inf, math.inf, None, CODES.by_span, still_px=0.2)
    for codes in (at_rest, dark):
        assert motion.beside(codes).error_px == 0.35


@pytest.mark.parametrize(
    ("table_ms", "measured_ms", "in_time"),
    [
        # (round, exact), of 8 ms that a frame may take
        ((1.0, 7.9), None, True),
        ((1.0, 8.1), None, False),
        ((8.1, 90.0), None, True),  # even `round` is late: nothing is lost
        # clearly in time by the machine's own clock, whatever the table has
        ((1.0, 90.0), (1.0, 6.3), True),
        ((1.0, 2.0), (1.0, 16.1), False),
        # between, the table decides
        ((1.0, 7.9), (1.0, 12.0), True),
        ((1.0, 8.1), (1.0, 7.0), False),
    ],
)
def test_exact_codes_are_in_time_by_the_machine_or_where_it_is_not_clear_by_the_table(
    table_ms, measured_ms, in_time
):
    table = FieldCost(*table_ms, "a table")
    measured = None if measured_ms is None else FieldCost(*measured_ms, "here")
    assert exact_in_time(table, measured, 8.0) is in_time


@pytest.mark.parametrize(
    ("changes", "frames"),
    [
        ({"tracker": {"exposure_s": 0.1}}, 6),
        ({"tracker": {"exposure_s": 0.001}}, 1),
        ({"tracker": {"exposure_s": 0.1}, "render": {"cycle_frames": 4}}, 4),
        ({"tracker": {"exposure_s": 0.1}, "monitor": {"refresh_hz": 120.0}}, 12),
    ],
)
def test_an_exposure_has_so_many_frames(tmp_path, changes, frames):
    assert bench_file(tmp_path, changes).config.exposure_frames == frames


@pytest.mark.parametrize(
    ("camera", "features"),
    [
        ({}, {}),
        ({"gain": 6.5, "features": {"BlackLevel": 10.0}}, {"BlackLevel": 10.0, "Gain": 6.5}),
        (
            {"trigger": "software"},
            {"TriggerSelector": "FrameStart", "TriggerSource": "Software", "TriggerMode": "On"},
        ),
    ],
)
def test_a_camera_is_set_as_its_table_says(tmp_path, camera, features):
    tracker = {"tracker.camera": camera} if "features" not in camera else {}
    text = bench_text(tracker)
    if not tracker:
        text += "[tracker.camera]\ngain = 6.5\nfeatures = { BlackLevel = 10.0 }\n"
    file = bench_file_of(tmp_path / "bench.toml", text)
    assert file.config.tracker.camera.settings() == features


@pytest.mark.parametrize(("key", "judge"), [("psf", "fit"), ("box3", "box3")])
def test_a_centroider_by_the_psf_is_a_fit_where_a_star_is_a_gaussian(tmp_path, key, judge):
    assert bench_file(tmp_path, {"verify": {"centroider": key}}).config.verify.judge == judge
