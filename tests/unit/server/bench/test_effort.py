"""What a scene needs: chosen within the tolerance, said line by line, and held by what is drawn."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.display.balance import AS_USUAL, Seen
from hilstar.display.quantise import LevelCost
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.backend import level_cost
from hilstar.display.render.reference import linear_image
from hilstar.display.response import srgb_response
from hilstar.optics.psf import GaussianPsf
from hilstar.server.bench import effort_report
from hilstar.server.bench.bench_file import bench_file_of, read_bench_file
from hilstar.server.bench.build import (
    TIMED_EXACT_S,
    load,
    measured_cost,
    open_bench,
    timed_frame_ms,
)
from hilstar.server.bench.cameras import bench_camera
from hilstar.server.bench.code_errors import code_stars, worst_errors
from hilstar.server.bench.config import RenderSettings
from hilstar.server.bench.effort import (
    PATH_MS,
    Effort,
    FieldCost,
    Light,
    _combinations,
    _cut_to_mag,
    cut_px,
    exact_in_time,
    motion_candidates,
    plan_effort,
    side_candidates,
)
from hilstar.server.bench.effort_report import effort_keys, effort_lines
from hilstar.server.bench.least_psf import Choice
from hilstar.server.bench.scene import Display, scenes_of, turning_of
from hilstar.server.bench.would_do import Change, Remedy
from hilstar.tracker.centroiders import FAMILY
from tests.support.benches import SMALL_BENCH, bench_text
from tests.support.commands import run_hilstar_here, typed

SIGMA = (0.85, 0.85)
ORION = from_radec_roll_deg(84, -1, 0)
# float32 of the renderer against the float64 oracle, as tests/gpu/test_renderer.py has it.
FLOAT32 = 1e-5
# A tolerance that no key alone brings `round` to.
PAIRED = {"quantisation": "round", "tolerance_mag": 0.0002, "tolerance_px": 0.002}
WINGS_SHARE = 0.005  # of lit pixels: 6 of 2136 here with wings twice as high as those allowed


def render_settings(**keys) -> RenderSettings:
    return RenderSettings(**{"effort": "auto", "quantisation": "auto", **keys})


def light_range(bits: int, magnitudes: float) -> Light:
    """A white of 1e6 electrons/s, and stars from there down by so many magnitudes."""
    return Light(srgb_response(bits), 1e6, 5e6 * 10 ** (-0.4 * np.linspace(0, magnitudes, 50)))


def planned(asked: RenderSettings, of: Light) -> Effort:
    return plan_effort(asked, of)


def part(effort: Effort, name: str):
    return next(choice for choice in effort.choices if choice.part == name)


def test_round_is_chosen_where_it_does_and_exact_where_it_does_not():
    assert (
        planned(
            render_settings(tolerance_mag=0.1, tolerance_px=0.1), light_range(12, 6.0)
        ).quantisation
        == "round"
    )
    assert (
        planned(
            render_settings(tolerance_mag=0.05, tolerance_px=0.08), light_range(8, 6.0)
        ).quantisation
        == "exact"
    )
    over = planned(render_settings(tolerance_mag=1e-4), light_range(8, 6.0))
    assert over.quantisation == "exact" and not over.within and over.error_mag > 1e-4


def test_no_part_owns_a_share_of_the_tolerance():
    """Codes may take all of it but what the cheapest sprites need; half was theirs, a quarter
    each for edges and motion.
    """
    sky = light_range(10, 6.0)
    alone = planned(
        render_settings(quantisation="round", tolerance_mag=9, tolerance_px=9, effort="full"), sky
    )
    tight = {"tolerance_mag": 1.05 * alone.error_mag, "tolerance_px": 1.05 * alone.error_px}
    taken = planned(render_settings(**tight), sky)
    assert taken.quantisation == "round" and taken.within
    none = {"tolerance_mag": 0.95 * alone.error_mag, "tolerance_px": 1.05 * alone.error_px}
    assert planned(render_settings(**none), sky).quantisation == "exact"


def test_the_cheapest_of_all_combinations_within_is_taken():
    """By every combination of sprites and motions: none that is within takes less time than the
    one taken.
    """
    asked = render_settings(tolerance_mag=0.05, tolerance_px=0.08)
    moving = replace(light_range(12, 6.0), turning=2 / 3, sky_share=0.1)
    taken = planned(asked, moving)
    assert taken.within
    tried = 0
    for one in _combinations(asked, moving, ("round", "exact")):
        other = Effort(asked, moving, one)
        tried += 1
        assert not other.within or one.ms >= taken.taken.ms
    assert tried > 20


def test_codes_that_take_longer_than_exact_ones_save_nothing():
    sky = light_range(12, 6.0)
    for codes_ms, saves in (((2.0, 5.0), True), ((5.0, 2.0), False)):
        asked = render_settings(quantisation="round", codes_ms=codes_ms)
        assert part(planned(asked, sky), "codes").saved_ms == pytest.approx(3.0 if saves else 0.0)


def test_of_stars_at_rest_and_on_paths_the_worse_errors_count():
    """A path of 10 px has at most 1.9 / 10 of the brightest pixel of a star at rest: a star of
    which that is one and a half times half a step is seen on it, and one of half of that is not.
    """
    path_px = 10.0
    response = srgb_response(10)
    lit_share = response.half_step * path_px / 1.9
    for factor, seen in ((1.5, True), (0.75, False)):
        peak = np.array([factor * lit_share])
        stars = code_stars(GaussianPsf(SIGMA), AS_USUAL, 1, ("fit",), response, peak)
        still = worst_errors(stars, "round")
        both = worst_errors(replace(stars, path_px=path_px), "round")
        assert math.isfinite(both.flux_mag) == seen
        assert both.turns and both.place_px > still.place_px == both.still_px


@pytest.mark.parametrize(
    ("bits", "tolerance_px", "codes"), [(12, 0.02, "round"), (14, 0.01, "exact")]
)
def test_a_moving_scene_is_within_where_its_parts_together_can_be(bits, tolerance_px, codes):
    """Codes take six tenths of the tolerance or one, and paths most of the rest; the sprites are as
    the codes light pixels, whoever chose those.
    """
    moving = replace(light_range(bits, 6.0), turning=2 / 3, sky_share=0.1)
    limits = {"tolerance_mag": 0.05, "tolerance_px": tolerance_px}
    taken = planned(render_settings(**limits), moving)
    assert taken.within and taken.quantisation == codes
    assert taken.error_px > 0.7 * tolerance_px
    fixed = planned(render_settings(**limits, quantisation=codes), moving)
    assert fixed.taken.sprites == taken.taken.sprites


def test_a_scene_at_rest_asks_nothing_of_paths():
    """0.01 px were charged at rest, too."""
    asked, sky = render_settings(tolerance_mag=0.1, tolerance_px=0.1), light_range(12, 6.0)
    still, turning = planned(asked, sky), planned(asked, replace(sky, turning=0.5))
    assert part(still, "paths").error_px == 0.0 and "none" in part(still, "paths").choice
    assert part(turning, "paths").error_px == pytest.approx(0.5 * turning.motion_above_px)
    assert turning.motion_above_px >= asked.motion_above_px


def test_paths_cost_their_time_from_the_files_motion_on_and_save_it_beyond():
    """All stars in view have paths from there on; a larger motion has none in most frames."""
    asked = render_settings(tolerance_px=0.1)
    moving = replace(light_range(12, 6.0), turning=0.5, sky_share=0.1)
    asks, *larger = (motion.choice for motion in motion_candidates(asked, moving))
    assert (asks.ms, asks.saved_ms) == (pytest.approx(PATH_MS * 0.1 * 50), 0.0)
    assert larger
    for choice in larger:
        assert (choice.ms, choice.saved_ms) == (0.0, asks.ms)


@pytest.mark.parametrize(
    ("motion", "on_screen", "turns"),
    [("auto", False, False), ("auto", True, True), ("on", False, True), ("off", True, False)],
)
def test_paths_are_charged_where_frames_may_turn(motion, on_screen, turns, small_bench_file):
    """A frame without a path is where the middle of the middle row's light has it; the last row
    lights up half a scan-out later.
    """
    text = f'{SMALL_BENCH}[render]\nmotion = "{motion}"\nquantisation = "round"\n'
    config = bench_file_of(small_bench_file, text).config
    scan_s, hold_s = (config.monitor.panel_scanout_ms, config.monitor.panel_hold_ms)
    wanted = scan_s / (scan_s + 2 * hold_s) if turns else None
    assert turning_of(config, on_screen) == pytest.approx(wanted)


def test_a_screen_s_share_of_the_sky_is_its_solid_angle_over_the_sphere_s(tmp_path):
    """Of 320 x 240 pixels of 57.65 um behind 60 mm, about a pixel's own in the middle."""
    file = bench_file_of(
        tmp_path / "bench.toml", f"{SMALL_BENCH}[render]\nflux_at_white_e_per_s = 1e6\n"
    )
    camera = bench_camera(file.config, file.folder)
    display = Display(
        calibration=SimpleNamespace(response=None),
        camera=camera,
        context=None,
        drive=1.0,
        turning=None,
        path_px=0.0,
        darkest=0.5,
    )
    scene = next(scenes_of(file, SimpleNamespace(electrons_per_s=None), display))
    wanted = 320 * 240 * (0.05765 / 60) ** 2 / (4 * np.pi)
    assert scene.light.sky_share == pytest.approx(wanted, rel=1e-3)
    assert (scene.white_e_per_s, scene.light.white_e_per_s) == (1e6, 0.5e6)


def test_a_psf_in_place_of_a_glass_shares_the_tolerance():
    """Its error is taken from what is left for the codes."""
    sky, asked = light_range(12, 6.0), render_settings(tolerance_mag=0.05, tolerance_px=0.1)
    assert planned(asked, sky).quantisation == "round"
    near = replace(sky, psf_choice=Choice("PSF", "a Gaussian", 0.045, 0.01))
    effort = planned(asked, near)
    assert effort.quantisation == "exact" and part(effort, "PSF").error_mag == 0.045
    assert effort.error_mag == pytest.approx(effort.codes.flux_mag + 0.045, rel=0.2)


def test_the_worst_error_is_of_all_magnitudes_that_the_catalogue_has():
    """Of stars of half a step more than a whole number, and of none: `exact` leaves half a step
    of the first alone.
    """
    one_step = srgb_response(8).light[1]
    whole, half = (np.array([steps * one_step * 1e6]) for steps in (60.0, 60.5))
    errors = []
    for rates in (whole, half, np.concatenate([whole, half])):
        sky = Light(srgb_response(8), 1e6, rates)
        errors.append(planned(render_settings(quantisation="exact"), sky).error_mag)
    assert errors[0] < errors[1] / 2 and errors[2] == pytest.approx(errors[1], rel=0.3)
    assert errors[1] > 2.5 * math.log10(60.5 / 60.0)


def test_auto_leaves_exact_where_numpy_would_be_late():
    """Some 1000 stars in view at 60 Hz: 3 ms by shaders, 50 ms where OpenGL has none."""
    asked = render_settings(tolerance_mag=0.02, tolerance_px=0.04)
    bright = replace(
        light_range(8, 6.0),
        rates_e_per_s=np.repeat(light_range(8, 6.0).rates_e_per_s, 200),
        sky_share=0.1,
    )
    by_shader, by_numpy = (
        planned(
            asked,
            replace(bright, cost=partial(level_cost, gl_version=version)),
        )
        for version in (430, 330)
    )
    assert (by_shader.quantisation, by_numpy.quantisation) == ("exact", "round")
    assert (
        "in NumPy" in part(by_numpy, "codes").note and "OpenGL 4.3" in part(by_numpy, "codes").note
    )


def test_the_tracker_s_own_centroider_and_pixels_judge_codes():
    """12 bits, 6.5 magnitudes: a fit is served by `round`, the worst of six centroiders is not."""
    asked, sky = render_settings(tolerance_mag=0.05, tolerance_px=0.012), light_range(12, 6.5)
    of_fit, of_all = planned(asked, replace(sky, centroider="fit")), planned(asked, sky)
    assert (of_fit.quantisation, of_all.quantisation) == ("round", "exact")
    assert part(of_fit, "codes").note == "as `fit` finds stars"
    assert (
        f"as `{of_all.codes.centroider}` finds stars, the worst of 6 centroiders"
        in part(of_all, "codes").note
    )
    rounded = {}
    for kind in FAMILY:
        for pixel_px in (0.5, 1.0, 2.0):
            seen = Seen(0.55 * pixel_px, pixel_px)
            effort = planned(
                render_settings(quantisation="round"), replace(sky, centroider=kind, seen=seen)
            )
            rounded[kind, pixel_px] = effort.codes
    narrow, even, wide = (rounded["box3", pixel_px].place_px for pixel_px in (0.5, 1.0, 2.0))
    assert narrow < even / 2 < wide / 4
    assert len({round(rounded[kind, 1.0].place_px, 12) for kind in FAMILY}) == 6


@pytest.mark.parametrize(
    ("tolerance_mag", "tolerance_px"), [(9.0, 1e-3), (1e-3, 9.0), (0.05, 1e-3)]
)
def test_where_nothing_is_within_sprites_add_a_hundredth_of_the_tolerance(
    tolerance_mag, tolerance_px
):
    """Of the light's and of the place's, or are whole."""
    asked = render_settings(
        quantisation="round", tolerance_mag=tolerance_mag, tolerance_px=tolerance_px
    )
    effort = planned(asked, light_range(8, 6.0))
    sprites = effort.taken.sprites.choice
    assert not effort.within
    assert sprites.error_px <= 0.01 * tolerance_px
    assert sprites.error_mag <= max(0.01 * tolerance_mag, 1.09e-6)  # whole: 1e-6 of its light


def test_stars_too_faint_to_light_a_pixel_are_counted_with_their_light():
    cost = LevelCost(a_star_ms=0.004, why="")
    sky = replace(light_range(8, 12.0), sky_share=0.1, cost=lambda method, psf: cost)
    depth = part(planned(render_settings(quantisation="round"), sky), "depth")
    limit = float(depth.choice.removeprefix("from ").removesuffix(" electrons/s on"))
    rates = sky.rates_e_per_s
    dark = rates < limit
    share = rates[dark].sum() / rates.sum()
    assert 5 < dark.sum() < 45
    assert depth.note == f"{dark.sum()} of 50 stars light no pixel, {share:.2%} of all light"
    assert depth.saved_ms == pytest.approx(0.1 * dark.sum() * 0.004)


def test_what_the_file_asks_for_is_not_overruled():
    assert (
        planned(
            render_settings(quantisation="round", tolerance_mag=1e-6), light_range(8, 8.0)
        ).quantisation
        == "round"
    )


def test_sprites_are_as_small_as_the_tolerance_lets_them_be():
    wide = planned(
        render_settings(quantisation="exact", tolerance_mag=1e-6, tolerance_px=1e-6),
        light_range(8, 6.0),
    )
    narrow = planned(
        render_settings(quantisation="exact", tolerance_mag=0.2, tolerance_px=0.2),
        light_range(8, 6.0),
    )
    full = GaussianPsf(SIGMA).footprint_px
    assert (wide.sides[0].below_e_per_s, wide.sides[0].side_px) == (pytest.approx(3e38), full)
    assert narrow.sides[0].side_px < full and narrow.within


def test_small_sprites_save_the_pixels_that_the_catalogue_s_stars_do_not_need():
    """A star has the side of the last entry whose rate it is under."""
    sky = replace(light_range(8, 9.0), sky_share=0.1)
    asked = render_settings(quantisation="exact", tolerance_mag=0.2, tolerance_px=0.2)
    effort = planned(asked, sky)
    assert len(effort.sides) > 2
    area_px = []
    for rate in sky.rates_e_per_s:
        sides = [side.side_px for side in effort.sides if rate < side.below_e_per_s]
        area_px.append(sides[-1] ** 2)
    assert len(set(area_px)) > 2
    sprites = effort.taken.sprites.choice
    share = np.mean(area_px) / GaussianPsf(SIGMA).footprint_px ** 2
    assert sprites.ms / (sprites.ms + sprites.saved_ms) == pytest.approx(share)


@pytest.mark.parametrize("method", ["round", "exact"])
def test_the_sprites_of_codes_are_as_those_codes_light_pixels(method):
    """A star under full scale by so many magnitudes has its peak there, and beyond its sprite a
    quarter of what lights a pixel at most.
    """
    sky = replace(light_range(10, 6.0), turning=0.5, sky_share=0.1)
    asked = render_settings(tolerance_mag=0.05, tolerance_px=0.05)
    own = [sides.sides for sides in side_candidates(asked, sky, method)]
    of_method = [
        one.sprites.sides
        for one in _combinations(asked, sky, ("round", "exact"))
        if one.method == method
    ]
    assert set(of_method) == set(own)
    lit_e_per_s = QUANTISERS[method].lit_from_e_per_s(sky.panel)
    for size in (4, 6, 8):
        rate = 1e6 * 10 ** (-0.4 * _cut_to_mag(sky, method, size)) / sky.psf.peak_share
        assert rate * sky.psf.outside_share(size) == pytest.approx(lit_e_per_s / 4)


@pytest.mark.parametrize("size", [4, 6, 8, 5, 7])
def test_the_light_outside_a_sprite_is_no_more_than_said(size):
    """Every phase of a star in a sprite of that parity, pixel by pixel."""
    phases = np.linspace(0, 1, 41) - (0.5 if size % 2 else 0.0)
    first = -((size - 1) // 2)
    worst = moved = 0.0
    for x in phases:
        offsets = np.arange(-20, 21) - x
        shares = np.array(
            [
                0.5 * (math.erf((d + 0.5) / 1.2020815) - math.erf((d - 0.5) / 1.2020815))
                for d in offsets
            ]
        )
        inside = (np.arange(-20, 21) >= first) & (np.arange(-20, 21) < first + size)
        middle = math.erf(0.5 / 1.2020815)
        worst = max(worst, shares[~inside].max() * middle)
        moved = max(moved, abs((shares * offsets)[inside].sum() / shares[inside].sum()))
    assert worst <= GaussianPsf(SIGMA).outside_share(size) * (1 + 1e-6)
    assert cut_px(size, GaussianPsf(SIGMA)) == pytest.approx(math.hypot(moved, moved), rel=1e-3)


def test_small_sprites_give_the_codes_of_whole_ones_but_where_wings_meet(bench_with):
    """What is left out lights no pixel by itself; added to another star's it may make up a step,
    never two.
    """
    bench = bench_with('[render]\neffort = "auto"\nquantisation = "round"\n')
    assert min(side.side_px for side in bench.renderer.target.sides) < bench.psf.footprint_px
    small = bench.draw(ORION).levels.astype(int)
    whole = bench_with('[render]\nquantisation = "round"\n').draw(ORION).levels.astype(int)
    lit = (whole > 0).sum()
    assert lit > 1000
    assert np.abs(small - whole).max() <= 1
    assert (small != whole).sum() < WINGS_SHARE * lit


def test_the_linear_image_is_whole_all_the_same(bench_with):
    bench = bench_with('[render]\neffort = "auto"\ntolerance_mag = 0.5\ntolerance_px = 0.5\n')
    frame = bench.frame(ORION)
    sprites = bench.sprites(ORION, bench.stars)
    exact = linear_image(sprites, bench.camera.resolution_px, GaussianPsf(SIGMA))
    assert frame.linear.sum() == pytest.approx(exact.sum(), rel=FLOAT32)
    bench.draw(ORION)
    shown = linear_image(bench.sprites(ORION), bench.camera.resolution_px, GaussianPsf(SIGMA))
    assert bench.renderer.linear().sum() == pytest.approx(shown.sum(), rel=FLOAT32)


def test_the_parts_add_up():
    effort = planned(
        render_settings(tolerance_mag=0.1, tolerance_px=0.1),
        replace(light_range(12, 6.0), turning=0.5),
    )
    assert [choice.part for choice in effort.choices] == ["codes", "sprites", "paths", "depth"]
    assert effort.error_mag == pytest.approx(sum(choice.error_mag for choice in effort.choices))
    assert effort.error_px == pytest.approx(sum(choice.error_px for choice in effort.choices))
    assert effort.within


KEYS = (Change("[monitor] bits", 10), Change("[render] quantisation", "exact"))
TRIED = (
    Remedy(KEYS[:1], 0.0123, 0.0456, True),
    Remedy(KEYS, 0.0078, 0.0199, True),
    Remedy(KEYS[1:], 0.02, math.inf, False),
)


def test_a_table_says_what_was_chosen_and_what_would_do(bench_with, monkeypatch):
    bench = bench_with('[render]\neffort = "auto"\n[verify]\ncentroider = "box5"\n')
    lines = effort_lines(bench)
    assert lines[0].split() == ["part", "choice", "error", "of", "the", "tolerance", "saves"]
    assert [line.split()[0] for line in lines[1:6]] == [
        "codes",
        "sprites",
        "paths",
        "depth",
        "together",
    ]
    assert "within 0.05 mag, 0.1 px" in lines[5]
    assert any(line.startswith("codes: as `box5` finds stars") for line in lines)
    assert not any("would do" in line for line in lines)
    monkeypatch.setattr(effort_report, "would_do", lambda bench: TRIED)
    bits, exact = "[monitor] bits = 10", '[render] quantisation = "exact"'
    assert effort_lines(bench)[len(lines) :] == [
        f"would do: {bits} (0.0123 mag, 0.0456 px)",
        f"would do together: {bits} and {exact} (0.0078 mag, 0.0199 px)",
        f"would not do alone: {exact} (a star shows nothing)",
    ]
    told = effort_keys(bench)["would_do"]
    assert [remedy["value"] for remedy in told] == [10, [10, "exact"], "exact"]
    assert [remedy["key"] for remedy in told][1] == "[monitor] bits and [render] quantisation"
    assert [remedy["error_mag"] for remedy in told] == [0.0123, 0.0078, 0.02]
    assert [remedy["error_px"] for remedy in told] == [0.0456, 0.0199, None]
    assert [remedy["within"] for remedy in told] == [True, True, False]


def changed_by(tables, keys, values):
    """Tables of a bench with other values of "[table] key"."""
    changed = {name: dict(table) for name, table in tables.items()}
    for name, value in zip(keys, values, strict=True):
        table, key = name.removeprefix("[").split("] ")
        changed.setdefault(table, {})[key] = value
    return changed


def planned_with(path, tables) -> Effort:
    """What a bench file of `tables` would do."""
    path.write_text(bench_text(tables))
    with load(path) as bench:
        return bench.effort


def assert_does(effort: Effort, remedy) -> None:
    """The plan of a bench file is within, with the errors that were told."""
    assert effort.within is remedy["within"] is True
    assert effort.error_mag == pytest.approx(remedy["error_mag"], rel=1e-6)
    assert effort.error_px == pytest.approx(remedy["error_px"], rel=1e-6)


def test_what_would_do_does(tmp_path):
    """Each key that is told is written to the file, whose own plan then has the errors that were
    told.
    """
    limit = {"tolerance_mag": 0.01, "tolerance_px": 0.05}
    tables = {"monitor": {"bits": 8}, "render": limit}
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(tables))
    with load(path) as bench:
        told = effort_keys(bench)["would_do"]
    assert len(told) == 6
    for remedy in told:
        changed = changed_by(tables, [remedy["key"]], [remedy["value"]])
        assert_does(planned_with(path, changed), remedy)


def test_stars_that_show_nothing_are_null_in_json(bench_with):
    bench = bench_with(
        '[sky]\nfaintest_v_mag = 9\n[render]\nbrightest_v_mag = -2\nquantisation = "round"\n'
    )
    keys = effort_keys(bench)
    assert (
        keys["error_mag"] is None and keys["choices"][0]["error_px"] is None and not keys["within"]
    )
    assert any("a star shows nothing" in line for line in effort_lines(bench))
    json.dumps(keys, allow_nan=False)


def test_explain_has_the_effort_in_its_json(tmp_path, small_bench_file):
    small_bench_file.write_text(small_bench_file.read_text() + '[render]\neffort = "auto"\n')
    words = typed(f"frame {small_bench_file} --radec 84,-1,0 --truth {tmp_path}/t.csv --json")
    result = run_hilstar_here(*words, "--explain")
    assert result.returncode == 0, result.stderr
    assert "part " in result.stderr and "together" in result.stderr
    effort = json.loads(result.stdout)["effort"]
    assert set(effort) == {
        *(
            "within",
            "quantisation",
            "error_mag",
            "error_px",
            "tolerance_mag",
            "tolerance_px",
            "choices",
            "would_do",
        ),
    }
    assert all(
        set(choice) == {"part", "choice", "error_mag", "error_px", "ms"}
        for choice in effort["choices"]
    )
    assert "effort" not in json.loads(run_hilstar_here(*words).stdout)


def test_a_run_has_the_effort_once(tmp_path, small_bench_file):
    log = tmp_path / "log.csv"
    log.write_text("t_s,qw,qx,qy,qz\n0,0.5,0.5,-0.5,0.5\n0.1,0.5,0.5,-0.5,0.5\n")
    result = run_hilstar_here(
        "replay", small_bench_file, log, "--headless", "--speed", "max", "--json"
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["effort"]["quantisation"] == "exact"
    assert result.stdout.count('"effort"') == 1


def test_a_fixed_bench_keeps_its_hash_and_one_left_to_the_default_does_not(
    tmp_path, small_bench_file
):
    """The default of the tolerance was 0.02 mag and 0.02 px; no frame of a fixed bench changed
    with it.
    """
    text = small_bench_file.read_text()

    def hashed(render: str) -> str:
        return bench_file_of(small_bench_file, f"{text}[render]\n{render}").sha256

    stated = "tolerance_mag = 0.02\ntolerance_px = 0.02\n"
    assert hashed('quantisation = "exact"\n') == hashed(f'quantisation = "exact"\n{stated}')
    assert hashed("") != hashed(stated)
    assert hashed('quantisation = "exact"\neffort = "auto"\n') != hashed(
        f'quantisation = "exact"\neffort = "auto"\n{stated}'
    )


def test_auto_codes_become_the_bench_s_own(tmp_path, small_bench_file):
    small_bench_file.write_text(
        small_bench_file.read_text() + '[render]\nquantisation = "auto"\ntolerance_mag = 0.001\n'
    )
    with load(small_bench_file) as bench:
        assert bench.config.render.quantisation == bench.renderer.target.quantisation == "exact"
        assert bench.renderer.target.sides == ()


def test_a_file_that_says_nothing_gets_the_codes_that_its_tolerance_needs(small_bench_file):
    with load(small_bench_file) as bench:
        assert bench.config.render.quantisation == "exact"
    small_bench_file.write_text(
        small_bench_file.read_text().replace("[monitor]", "[monitor]\nbits = 16")
    )
    with load(small_bench_file) as bench:
        assert bench.config.render.quantisation == "round"


def test_fields_of_so_many_stars_that_exact_would_be_late_stay_with_round_and_say_so():
    """3000 stars on a screen that has the whole sky, at two refresh rates; 70 as wide as only
    NumPy takes them.
    """
    crowded = replace(light_range(8, 6.0), sky_share=1.0, rates_e_per_s=np.full(3000, 1e4))
    chosen = planned(render_settings(), crowded)
    assert chosen.quantisation == "round"
    assert "exact takes 9 ms of 16.7 (round 6)" in part(chosen, "codes").note
    assert planned(render_settings(), replace(crowded, refresh_hz=30.0)).quantisation == "exact"
    # `round` would be late, too
    assert planned(render_settings(), replace(crowded, refresh_hz=90.0)).quantisation == "exact"
    assert planned(render_settings(quantisation="exact"), crowded).quantisation == "exact"
    slow = planned(render_settings(quantisation="exact", codes_ms=(99.4, 150.4)), crowded)
    assert "exact takes 150 ms of 16.7 (round 99)" in part(slow, "codes").note
    assert (
        "9 ms of 16.7"
        in part(planned(render_settings(quantisation="exact"), crowded), "codes").note
    )
    few = replace(crowded, rates_e_per_s=np.full(70, 1e3))
    wide = replace(few, psf=GaussianPsf((2.5, 2.5)))
    assert (
        planned(render_settings(), few).quantisation,
        planned(render_settings(), wide).quantisation,
    ) == (
        "exact",
        "round",
    )


def cost(cheap_ms: float, best_ms: float) -> FieldCost:
    """Made up."""
    return FieldCost(cheap_ms, best_ms, "here")


IN_TIME, LATE = cost(1.0, 2.0), cost(1.0, 20.0)  # by the table, of a limit of 8 ms


@pytest.mark.parametrize(
    ("measured", "of_table_in_time", "of_table_late"),
    [
        (None, True, False),
        (cost(1.0, 6.3), True, True),
        (cost(1.0, 6.5), True, False),  # from here the table's choice stays
        (cost(1.0, 15.9), True, False),
        (cost(1.0, 16.1), False, False),
        (cost(7.0, 15.0), True, False),  # `round` may be late, too
        (cost(15.9, 40.0), True, False),
        (cost(16.1, 40.0), True, True),
    ],
)
def test_a_measured_cost_overrules_the_table_only_where_it_is_clear_of_the_limit(
    measured, of_table_in_time, of_table_late
):
    assert exact_in_time(IN_TIME, measured, 8.0) is of_table_in_time
    assert exact_in_time(LATE, measured, 8.0) is of_table_late


def test_a_machine_that_holds_exact_takes_it_where_the_table_would_not():
    """3000 stars in view at 60 Hz: 9 ms on two cores without a GPU; and 70 on a slow machine."""
    crowded = replace(light_range(8, 6.0), sky_share=1.0, rates_e_per_s=np.full(3000, 1e4))
    by_gpu = planned(render_settings(), replace(crowded, measured=cost(0.2, 0.4)))
    assert (by_gpu.quantisation, by_gpu.by_cost) == ("exact", True)
    assert "exact takes 0.4 ms of 16.7 (round 0.2)" in part(by_gpu, "codes").note
    few = replace(crowded, rates_e_per_s=np.full(70, 1e3))
    slow = planned(render_settings(), replace(few, measured=cost(2.0, 25.0)))
    assert slow.quantisation == "round"
    assert (
        "takes 25 ms of 16.7 (round 2) for an average field at 1 deg/s here"
        in part(slow, "codes").note
    )
    assert planned(render_settings(codes_ms=(2.0, 25.0)), few).quantisation == "round"
    assert (
        "by [render] codes_ms"
        in part(planned(render_settings(codes_ms=(0.2, 0.4)), crowded), "codes").note
    )
    # `round` is within the tolerance, whatever it costs
    assert not planned(render_settings(), light_range(16, 6.0)).by_cost
    assert not planned(render_settings(quantisation="exact"), few).by_cost


def test_round_is_timed_only_where_exact_may_be_late():
    timed = []

    def frame_ms(method: str, for_s: float) -> float:
        timed.append((method, for_s))
        return {"round": 4.5678, "exact": 9.12345}[method]

    fast = measured_cost(frame_ms, cost(2.0, 3.0), 16.0)
    assert (fast.cheap_ms, fast.best_ms) == (6.08, 9.12) and timed == [("exact", TIMED_EXACT_S)]
    slow = measured_cost(frame_ms, cost(2.0, 3.0), 8.0)
    assert (slow.cheap_ms, slow.best_ms) == (4.57, 9.12) and [
        method for method, _ in timed[1:]
    ] == ["exact", "round"]
    assert "[render] codes_ms = [4.57, 9.12]" in slow.where
    assert measured_cost(frame_ms, cost(2.0, 3.0), 10.0).cheap_ms == 4.57  # in time, not surely


def test_frames_are_timed_for_no_longer_than_asked(small_bench_file):
    """By a clock of which each look takes 30 ms: a frame is 30 ms, and there is time for two of
    them.
    """
    looks = []

    def now_ns() -> int:
        looks.append(1)
        return len(looks) * 30_000_000

    with load(small_bench_file) as bench:
        assert timed_frame_ms(bench, 0.1, now_ns) == 30.0
    assert len(looks) == 6  # the begin, two frames, and the look that ends it


class TimedBench:
    """Draws each of the six fields in so many ms, by the round; notes what it is asked for."""

    def __init__(self, *rounds_ms: list[float]) -> None:
        self.asked: list[str] = []
        self.fields: list[np.ndarray] = []
        self.ns = 0
        self.renderer = SimpleNamespace(
            finish=self._finish, begin_anew=lambda: self.asked.append("anew")
        )
        self._costs_ms = [ms for round_ms in rounds_ms for ms in round_ms]

    def warm_up(self) -> None:
        self.asked.append("warm-up")
        self.ns += 10**12

    def draw(self, q_icrs_to_cam, number, rate_cam_rad_s) -> None:
        assert np.linalg.norm(rate_cam_rad_s) == pytest.approx(math.radians(1))
        self.asked.append("draw")
        self.fields.append(q_icrs_to_cam)

    def _finish(self) -> None:
        self.ns += round(self._costs_ms[len(self.fields) - 1] * 1e6)


def test_a_frame_s_time_is_the_mean_of_its_fields_fastest_ones():
    """Of six fields all over the sky, before a run whose first frame is drawn anew."""
    cold, warm, hot = ([base + k for k in range(6)] for base in (20.0, 10.0, 30.0))
    bench = TimedBench(cold, warm, hot)
    for_s = sum(cold + warm + hot[:5]) * 1e-3 - 1e-6
    assert timed_frame_ms(bench, for_s, lambda: bench.ns) == pytest.approx(12.5)
    assert bench.asked == ["warm-up", *["draw"] * 17, "anew"]
    boresights = np.array([to_matrix(q)[2] for q in bench.fields[:6]])
    # every two are 90 or 180 deg apart
    assert (
        np.abs(boresights @ boresights.T).round(9).tolist()
        == np.kron(np.eye(3), np.ones((2, 2)))[np.ix_(*[[0, 2, 1, 3, 4, 5]] * 2)].tolist()
    )


def test_a_timed_bench_has_measured_codes_and_any_other_has_not(small_bench_file):
    file = read_bench_file(small_bench_file)
    with open_bench(file, timed=True) as timed, open_bench(file) as untimed:
        cheap_ms, best_ms = timed.config.render.codes_ms
        assert min(cheap_ms, best_ms) > 0
        measured = f"measured here ([render] codes_ms = [{cheap_ms:g}, {best_ms:g}] fixes it)"
        assert measured in part(timed.effort, "codes").note
        assert (
            untimed.config.render.codes_ms is None
            and "without a GPU" in part(untimed.effort, "codes").note
        )
        assert timed.file.sha256 == untimed.file.sha256
    small_bench_file.write_text(small_bench_file.read_text() + "[render]\ncodes_ms = [2, 500]\n")
    with open_bench(read_bench_file(small_bench_file), timed=True) as fixed:
        assert (
            fixed.config.render.codes_ms == (2, 500)
            and fixed.renderer.target.quantisation == "round"
        )


def test_a_timed_bench_takes_the_codes_that_its_machine_holds(small_bench_file, monkeypatch):
    """Whatever the table says: the bench is drawn anew with the others."""
    small_bench_file.write_text(small_bench_file.read_text() + '[render]\neffort = "auto"\n')
    monkeypatch.setattr(
        "hilstar.server.bench.build.timed_frame_ms",
        lambda bench, for_s: 500.0 if "exact" in bench.quantiser.shader else 1.0,
    )
    with open_bench(read_bench_file(small_bench_file), timed=True) as bench:
        assert (
            bench.config.render.quantisation
            == bench.renderer.target.quantisation
            == bench.effort.quantisation
            == "round"
        )
        assert bench.config.render.codes_ms == (1.0, 500.0)
        assert bench.draw(ORION).levels.any()


def test_where_no_key_does_alone_pairs_do(tmp_path):
    """16 bits, the deepest that a key asks for, leave 0.0017 mag; each pair is written to the file,
    whose own plan then is within, and neither key of it does alone.
    """
    tables = {"monitor": {"bits": 8}, "render": PAIRED}
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(tables))
    with load(path) as bench:
        told = effort_keys(bench)["would_do"]
        lines = effort_lines(bench)
    assert len(told) == 3
    assert sum(line.startswith("would do together: ") for line in lines) == len(told)
    for remedy in told:
        names, values = remedy["key"].split(" and "), remedy["value"]
        assert len(names) == len(values) == 2
        assert_does(planned_with(path, changed_by(tables, names, values)), remedy)
        for name, value in zip(names, values, strict=True):
            assert not planned_with(path, changed_by(tables, [name], [value])).within
