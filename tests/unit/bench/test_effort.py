"""What a scene needs: chosen within the tolerance, said line by line, and held by what is drawn."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.bench.bench_file import read_bench_file
from hilstar.bench.build import TIMED_EXACT_S, load, measured_cost, open_bench, timed_frame_ms
from hilstar.bench.config import RenderSettings
from hilstar.bench.effort import FieldCost, Light, choose_codes, choose_sides, cut_px, exact_in_time, explain, plan_effort
from hilstar.monitor.balance import Seen
from hilstar.monitor.response import srgb_response
from hilstar.render.backend import level_cost
from hilstar.render.reference import linear_image
from hilstar.rotation import from_radec_roll_deg
from hilstar.scene.psf import GaussianPsf
from hilstar.tracker.centroiders import FAMILY
from tests.support.commands import run_hilstar_here

SIGMA = (0.85, 0.85)
ORION = from_radec_roll_deg(84, -1, 0)
# float32 of the renderer against the float64 oracle, as tests/gpu/test_renderer.py has it.
FLOAT32 = 1e-5
WINGS_SHARE = 0.005  # of lit pixels: 6 of 2136 here with wings twice as high as those allowed


def settings(**keys) -> RenderSettings:
    return RenderSettings(**{"effort": "auto", "quantisation": "auto", **keys})


def light(bits: int, magnitudes: float) -> Light:
    """A white of 1e6 electrons/s, and stars from there down by so many magnitudes."""
    return Light(srgb_response(bits), 1e6, 5e6 * 10 ** (-0.4 * np.linspace(0, magnitudes, 50)))


def test_round_is_chosen_where_it_does_and_exact_where_it_does_not():
    assert choose_codes(settings(tolerance_mag=0.1, tolerance_px=0.1), light(12, 6.0)).method == "round"
    assert choose_codes(settings(tolerance_mag=0.02, tolerance_px=0.04), light(8, 6.0)).method == "exact"
    codes = choose_codes(settings(tolerance_mag=1e-4), light(8, 6.0))
    assert codes.method == "exact" and "over 5e-05 mag" in codes.choice.error and codes.errors.flux_mag > 1e-4


def test_auto_leaves_exact_where_numpy_would_be_late():
    """Some 1000 stars in view at 60 Hz: 3 ms by shaders, 50 ms where OpenGL has none."""
    asked = settings(tolerance_mag=0.02, tolerance_px=0.04)
    bright = replace(light(8, 6.0), rates_e_per_s=np.repeat(light(8, 6.0).rates_e_per_s, 200), sky_share=0.1)
    by_shader, by_numpy = (
        choose_codes(asked, replace(bright, cost=partial(level_cost, context=SimpleNamespace(version_code=version))))
        for version in (430, 330)
    )
    assert (by_shader.method, by_numpy.method) == ("exact", "round")
    assert "in NumPy" in by_numpy.choice.error and "OpenGL 4.3" in by_numpy.choice.error


def test_the_tracker_s_own_centroider_and_pixels_judge_codes():
    """12 bits, 6.5 magnitudes, 0.02 px: a fit is served by `round`, a plain moment is not."""
    asked, sky = settings(tolerance_mag=0.05, tolerance_px=0.02), light(12, 6.5)
    of_fit, of_all = choose_codes(asked, replace(sky, centroider="fit")), choose_codes(asked, sky)
    assert (of_fit.method, of_all.method) == ("round", "exact")
    assert of_fit.errors.centroider == "fit" and "as `fit` finds stars, from white" in of_fit.choice.error
    assert f"as `{of_all.errors.centroider}` finds stars, the worst of 6 centroiders" in of_all.choice.error
    rounded = {
        (kind, pixel_px): choose_codes(
            settings(quantisation="round"), replace(sky, centroider=kind, seen=Seen(0.55 * pixel_px, pixel_px))
        ).errors
        for kind in FAMILY
        for pixel_px in (0.5, 1.0, 2.0)
    }
    assert len({errors.flux_mag for errors in rounded.values()}) == 1
    narrow, even, wide = (rounded["box3", pixel_px].place_px for pixel_px in (0.5, 1.0, 2.0))
    assert narrow < even / 2 < wide / 4
    assert len({round(rounded["moment", pixel_px].place_px, 12) for pixel_px in (0.5, 1.0, 2.0)}) == 1
    assert len({round(rounded[kind, 1.0].place_px, 12) for kind in FAMILY}) == 6


def test_what_the_file_asks_for_is_not_overruled():
    assert choose_codes(settings(quantisation="round", tolerance_mag=1e-6), light(8, 8.0)).method == "round"


def test_sprites_are_as_small_as_the_tolerance_lets_them_be():
    wide = choose_sides(settings(tolerance_mag=1e-6, tolerance_px=1e-6), light(8, 6.0), "exact")
    narrow = choose_sides(settings(tolerance_mag=0.2, tolerance_px=0.2), light(8, 6.0), "exact")
    full = GaussianPsf(SIGMA).footprint_px
    assert (wide.sides[0].below_e_per_s, wide.sides[0].side_px) == (pytest.approx(3e38), full)
    assert narrow.sides[0].side_px < full
    assert narrow.cut_mag <= 0.05 and narrow.moved_px <= 0.05


@pytest.mark.parametrize("size", [4, 6, 8, 5, 7])
def test_the_light_outside_a_sprite_is_no_more_than_said(size):
    """Every phase of a star in a sprite of that parity, pixel by pixel."""
    phases = np.linspace(0, 1, 41) - (0.5 if size % 2 else 0.0)
    first = -((size - 1) // 2)
    worst = moved = 0.0
    for x in phases:
        offsets = np.arange(-20, 21) - x
        shares = np.array([0.5 * (math.erf((d + 0.5) / 1.2020815) - math.erf((d - 0.5) / 1.2020815)) for d in offsets])
        inside = (np.arange(-20, 21) >= first) & (np.arange(-20, 21) < first + size)
        middle = math.erf(0.5 / 1.2020815)
        worst = max(worst, shares[~inside].max() * middle)
        moved = max(moved, abs((shares * offsets)[inside].sum() / shares[inside].sum()))
    assert worst <= GaussianPsf(SIGMA).outside_share(size) * (1 + 1e-6)
    assert cut_px(size, GaussianPsf(SIGMA)) == pytest.approx(math.hypot(moved, moved), rel=1e-3)


def test_small_sprites_give_the_codes_of_whole_ones_but_where_wings_meet(bench_with):
    """What is left out lights no pixel by itself; added to another star's it may make up a step, never two."""
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


def test_the_plan_adds_up_and_says_when_it_cannot():
    within = plan_effort(settings(tolerance_mag=0.1, tolerance_px=0.1), light(12, 6.0))
    assert within.error_mag <= 0.1 and within.error_px <= 0.1
    lines = explain(within, settings(tolerance_mag=0.1, tolerance_px=0.1))
    names = [line.split(":")[0] for line in lines]
    assert names == ["stars", "codes", "sprites", "encoding", "paths", "projection", "together, worst case"]
    assert "OVER" not in lines[-1]
    tight = settings(tolerance_mag=1e-4, tolerance_px=1e-4)
    assert "OVER" in explain(plan_effort(tight, light(8, 6.0)), tight)[-1]
    assert "full" in explain(None, RenderSettings())[0]


def test_a_bench_s_centroider_stands_in_what_it_explains(small_bench_file):
    small_bench_file.write_text(small_bench_file.read_text() + '[verify]\ncentroider = "box5"\n')
    with load(small_bench_file) as bench:
        assert "as `box5` finds stars, from white" in explain(bench.effort, bench.config.render)[0]


def test_explain_is_said_beside_the_json(tmp_path, small_bench_file):
    small_bench_file.write_text(small_bench_file.read_text() + '[render]\neffort = "auto"\n')
    result = run_hilstar_here(
        "frame", small_bench_file, "--radec", "84,-1,0", "--truth", tmp_path / "t.csv", "--explain", "--json"
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("{")
    assert "sprites:" in result.stderr and "together, worst case" in result.stderr


def test_auto_codes_become_the_bench_s_own(tmp_path, small_bench_file):
    small_bench_file.write_text(small_bench_file.read_text() + '[render]\nquantisation = "auto"\ntolerance_mag = 0.001\n')
    with load(small_bench_file) as bench:
        assert bench.config.render.quantisation == bench.renderer.target.quantisation == "exact"
        assert bench.renderer.target.sides == ()


def test_a_file_that_says_nothing_gets_the_codes_that_its_tolerance_needs(small_bench_file):
    with load(small_bench_file) as bench:
        assert bench.config.render.quantisation == "exact"
    small_bench_file.write_text(small_bench_file.read_text().replace("[monitor]", "[monitor]\nbits = 16"))
    with load(small_bench_file) as bench:
        assert bench.config.render.quantisation == "round"


def test_fields_of_so_many_stars_that_exact_would_be_late_stay_with_round_and_say_so():
    """3000 stars on a screen that has the whole sky, at two refresh rates; 70 as wide as only NumPy takes them."""
    crowded = replace(light(8, 6.0), sky_share=1.0, rates_e_per_s=np.full(3000, 1e4))
    chosen = choose_codes(settings(), crowded)
    assert chosen.method == "round"
    assert 'quantisation = "exact" is nearer and takes 9 ms of 17' in chosen.choice.error
    assert choose_codes(settings(), replace(crowded, refresh_hz=30.0)).method == "exact"
    assert choose_codes(settings(), replace(crowded, refresh_hz=90.0)).method == "exact"  # `round` would be late, too
    assert choose_codes(settings(quantisation="exact"), crowded).method == "exact"
    assert "9 ms of 16.7" in choose_codes(settings(quantisation="exact"), crowded).choice.saving
    few = replace(crowded, rates_e_per_s=np.full(70, 1e3))
    wide = replace(few, psf=GaussianPsf((2.5, 2.5)))
    assert (choose_codes(settings(), few).method, choose_codes(settings(), wide).method) == ("exact", "round")


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
def test_a_measured_cost_overrules_the_table_only_where_it_is_clear_of_the_limit(measured, of_table_in_time, of_table_late):
    assert exact_in_time(IN_TIME, measured, 8.0) is of_table_in_time
    assert exact_in_time(LATE, measured, 8.0) is of_table_late


def test_a_machine_that_holds_exact_takes_it_where_the_table_would_not():
    """3000 stars in view at 60 Hz: 9 ms on two cores without a GPU; and 70 on a slow machine."""
    crowded = replace(light(8, 6.0), sky_share=1.0, rates_e_per_s=np.full(3000, 1e4))
    by_gpu = choose_codes(settings(), replace(crowded, measured=cost(0.2, 0.4)))
    assert (by_gpu.method, by_gpu.by_cost) == ("exact", True) and "takes 0.4 ms of 16.7 here" in by_gpu.choice.saving
    few = replace(crowded, rates_e_per_s=np.full(70, 1e3))
    slow = choose_codes(settings(), replace(few, measured=cost(2.0, 25.0)))
    assert slow.method == "round" and "takes 25 ms of 17 (round 2) for an average field at 1 deg/s here" in slow.choice.error
    assert choose_codes(settings(codes_ms=(2.0, 25.0)), few).method == "round"
    assert "by [render] codes_ms" in choose_codes(settings(codes_ms=(0.2, 0.4)), crowded).choice.saving
    assert not choose_codes(settings(), light(16, 6.0)).by_cost  # `round` is within the tolerance, whatever it costs
    assert not choose_codes(settings(quantisation="exact"), few).by_cost


def test_round_is_timed_only_where_exact_may_be_late():
    timed = []

    def frame_ms(method: str, for_s: float) -> float:
        timed.append((method, for_s))
        return {"round": 4.5678, "exact": 9.12345}[method]

    fast = measured_cost(frame_ms, cost(2.0, 3.0), 16.0)
    assert (fast.cheap_ms, fast.best_ms) == (6.08, 9.12) and timed == [("exact", TIMED_EXACT_S)]
    slow = measured_cost(frame_ms, cost(2.0, 3.0), 8.0)
    assert (slow.cheap_ms, slow.best_ms) == (4.57, 9.12) and [method for method, _ in timed[1:]] == ["exact", "round"]
    assert "[render] codes_ms = [4.57, 9.12]" in slow.where


def test_frames_are_timed_for_no_longer_than_asked(small_bench_file):
    """By a clock of which each look takes 30 ms: a frame is 30 ms, and there is time for two of them."""
    looks = []

    def now_ns() -> int:
        looks.append(1)
        return len(looks) * 30_000_000

    with load(small_bench_file) as bench:
        assert timed_frame_ms(bench, 0.1, now_ns) == 30.0
    assert len(looks) == 6  # the begin, two frames, and the look that ends it


def test_a_timed_bench_has_measured_codes_and_any_other_has_not(small_bench_file):
    file = read_bench_file(small_bench_file)
    with open_bench(file, timed=True) as timed, open_bench(file) as planned:
        cheap_ms, best_ms = timed.config.render.codes_ms
        assert min(cheap_ms, best_ms) > 0
        assert (
            f"measured here ([render] codes_ms = [{cheap_ms:g}, {best_ms:g}] fixes it)"
            in explain(timed.effort, timed.config.render)[0]
        )
        assert planned.config.render.codes_ms is None and "without a GPU" in explain(planned.effort, planned.config.render)[0]
        assert timed.file.sha256 == planned.file.sha256
    small_bench_file.write_text(small_bench_file.read_text() + "[render]\ncodes_ms = [2, 500]\n")
    with open_bench(read_bench_file(small_bench_file), timed=True) as fixed:
        assert fixed.config.render.codes_ms == (2, 500) and fixed.renderer.target.quantisation == "round"


def test_a_timed_bench_takes_the_codes_that_its_machine_holds(small_bench_file, monkeypatch):
    """Whatever the table says: the bench is drawn anew with the others."""
    small_bench_file.write_text(small_bench_file.read_text() + '[render]\neffort = "auto"\n')
    monkeypatch.setattr(
        "hilstar.bench.build.timed_frame_ms", lambda bench, for_s: 500.0 if "exact" in bench.quantiser.shader else 1.0
    )
    with open_bench(read_bench_file(small_bench_file), timed=True) as bench:
        assert bench.config.render.quantisation == bench.renderer.target.quantisation == bench.effort.quantisation == "round"
        assert bench.config.render.codes_ms == (1.0, 500.0)
        assert bench.draw(ORION).levels.any()
