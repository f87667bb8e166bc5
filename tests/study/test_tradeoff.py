"""The study of trade-offs: exact methods are exact, worse ones worse, and each default stands on
the front or says why not.
"""

from __future__ import annotations

import itertools
import math
import re
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics import charts
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    angle_between_rad,
    from_rotation_vector,
    to_matrix,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.display.render.reference import linear_image
from hilstar.display.render.target import Target
from hilstar.display.render.variants import SplatVariant, VariantRenderer
from hilstar.instruments.study import sweep, trials
from hilstar.instruments.study.codes import star_field
from hilstar.instruments.study.predictors import ORION, predictors, slew_attitude, slew_sample
from hilstar.instruments.study.sweep import MAX_ROUNDS, MIN_ROUNDS, Load, in_turn
from hilstar.instruments.study.tradeoff import light, places
from hilstar.instruments.study.tradeoff import run as tradeoff
from hilstar.instruments.study.tradeoff.light import (
    gauss,
    sampled_flux,
    shared_knots,
    trapezoid,
)
from hilstar.instruments.study.tradeoff.places import (
    EVENLY,
    EXACT_NODES,
    GAUSS,
    SPRITE_PSF,
)
from hilstar.instruments.study.tradeoff.run import STEPS
from hilstar.instruments.study.trials import (
    Figure,
    Trial,
    Trials,
    draw_trials,
    judged,
    measured,
    ms_words,
    table_lines,
)
from hilstar.optics.camera import Camera
from hilstar.optics.psf import MAX_CUT
from hilstar.sky.electrons import TABLE_DEGREE
from hilstar.sky.spectrum import Curve
from hilstar.sky.stars import CELL_DEG
from tests.support.benches import ROOT
from tests.support.studies import times_are_watched
from tests.support.tables import csv_rows

NAMES = [
    "brightness",
    "spectrum",
    "depth",
    "culling",
    "projection",
    "prediction",
    "smear",
    "psf",
    "quantisation",
]
PX = 57.65e-3 / 350  # the tangent of a pixel of the demo's monitor
# A relative error in magnitudes: 2.5 / ln 10.
MAG_PER_SHARE = 1.0858
# Of the brightest star, in a pixel that holds 0.44 of it along each axis. The exp erf: two edges of
# 1.5e-7, halved, times 0.44, 0.7e-7. The table of 4096: (6 px / 4095)^2 / 8 times the profile's
# curvature of 0.55 / px^2, times 0.44, 0.7e-7. float32: 0.6e-7 of 1 at each edge, 0.3e-7, and as
# much of the sum.
PROFILE_SHARE = 2e-7


@pytest.fixture(scope="module")
def steps_measured():
    """Every step with one round; of those that draw at chance, fewer places than the page's."""
    with pytest.MonkeyPatch.context() as patch, times_are_watched():
        patch.setattr(tradeoff, "QUICK_BUDGET_S", 0.0)  # no claim here is of a time
        patch.setattr(sweep, "MIN_ROUNDS", 1)
        return tradeoff.measure(quick=True)


@pytest.fixture(scope="module")
def tradeoff_study(long_run, steps_measured):
    small = long_run(tradeoff.report, steps_measured)
    rows = small.rows("tradeoff")
    lines, _ = small.told
    steps = {name: {r["method"]: r for r in rows if r["step"] == name} for name in NAMES}
    return small.folder, lines, steps


def test_a_whole_study_draws_every_step(whole_study, steps_measured):
    charts_of = {f"tradeoff_{name}" for name in NAMES}
    # each step is told and drawn by the same functions
    part = steps_measured[:2]
    found = whole_study.reported("tradeoff", charts_of, steps_measured, part)
    assert {row["step"] for row in found.rows("tradeoff")} == set(NAMES)


@pytest.mark.parametrize("name", ["brightness", "spectrum", "depth", "psf", "quantisation"])
def test_the_errors_of_a_step_without_chance_are_those_recorded(tradeoff_study, name):
    """Of the whole study, to what drivers round otherwise: 2 %, or some of float32's steps."""
    then = {}
    for row in csv_rows(ROOT / "results" / "tradeoff.csv"):
        if row["step"] == name:
            then[row["method"]] = row
    now = tradeoff_study[2][name]
    assert set(now) == set(then)
    for method, row in now.items():
        # of mag or px; of light lost, %
        for error in ("error", "second"):
            wanted = float(then[method][error])
            assert float(row[error]) == pytest.approx(wanted, rel=0.02, abs=5e-7), (method, error)
        for same in ("error_unit", "second_unit", "error_is", "second_is", "default", "exact"):
            assert row[same] == then[method][same], (method, same)


def test_cells_that_are_smaller_are_tested_less_in_vain(tradeoff_study):
    """A scan tests all stars but those in view; cells those within their own radius, too."""
    step = tradeoff_study[2]["culling"]
    vain = {method: float(row["second"]) for method, row in step.items()}
    assert vain["scan, every star projected"] == vain["scan of angles"]
    cells = [vain[f"cells of {size} deg"] for size in (1, 2, 3, 4, 6, 10, 20)]
    assert cells == sorted(cells) and cells[-1] < 0.1 * vain["scan, every star projected"]
    missed = {method: float(row["error"]) for method, row in step.items()}
    assert missed["cells of 10 deg, by centres only"] > 100
    assert all(missed[method] == 0 for method in missed if "centres" not in method)
    # the sprites in view of 10 fields are of 17.9 x 10.2 degrees and 5 px on each side
    in_view = (116_812 - vain["scan of angles"]) / 116_812
    share = 4 * math.asin(math.sin(math.atan(963.5 * PX)) * math.sin(math.atan(543.5 * PX)))
    assert in_view == pytest.approx(share / (4 * math.pi), rel=0.25)


def test_a_place_is_known_to_the_steps_of_its_format(tradeoff_study):
    """Half a step of float32 at 1024 to 2048 px is 6.1e-5 px along each axis; of float64 a few of
    2.3e-13.
    """
    step = tradeoff_study[2]["projection"]
    worst = {method: float(row["error"]) for method, row in step.items()}
    rms = {method: float(row["second"]) for method, row in step.items()}
    assert 3e-5 < worst["float64, place in float32"] <= math.sqrt(2) * 6.2e-5
    # evenly in a step of each octave, mostly 512 to 1024 px and more
    assert rms["float64, place in float32"] == pytest.approx(3e-5, rel=0.5)
    assert worst["float32 throughout"] > 2 * worst["float64, place in float32"]
    assert worst["float32 throughout"] < 2e-3
    assert 1e-14 < worst["float64, place in float64"] < 5e-12
    assert 1e-8 < worst["float64, whole pixel + float32 fraction"] < 6e-8
    assert all(rms[method] <= worst[method] for method in rms)


def test_a_prediction_s_errors_are_those_of_its_samples():
    """Of a hold at 20 Hz: the turn since the newest sample, in frames at 60 Hz."""
    samples = [slew_sample(k * 50_000_000) for k in range(30)]
    hold, *_, blend = predictors()
    errors = places.prediction_errors(hold, samples)
    wanted = []
    for frame in range(9, 87):  # between the samples 3 and 29, the last one's frame not
        t_ns = round(frame * NS_PER_S / 60)
        newest_ns = frame // 3 * 50_000_000
        off_rad = angle_between_rad(slew_attitude(t_ns), slew_attitude(newest_ns))
        wanted.append(off_rad * ARCSEC_PER_RAD)
    np.testing.assert_allclose(errors, wanted, rtol=1e-6, atol=1e-9)
    # one that waits lies between two samples: the cubic of a swing of 20 s is 1e-3 of a hold
    assert max(places.prediction_errors(blend, samples)) < 0.2 * max(errors)


def test_predictions_are_told_by_their_worst_and_rms_and_timed_after_the_last_sample_but_one(
    tradeoff_study,
):
    samples = [slew_sample(k * 50_000_000) for k in range(200)]
    steps = tradeoff_study[2]["prediction"]
    for predictor in predictors()[:2]:
        errors = places.prediction_errors(predictor, samples)
        row = steps[predictor.name]
        assert float(row["error"]) == pytest.approx(max(errors))
        assert float(row["second"]) == pytest.approx(math.sqrt(np.mean(np.square(errors))))
    times_ns = places.moments_ns(samples)
    assert len(times_ns) == 60
    assert (times_ns[0], times_ns[-1]) == (samples[-2].t_ns, samples[-1].t_ns)


def test_each_field_s_stars_are_those_near_its_own_boresight(tradeoff_study):
    camera = places.ideal_monitor(places.demo_config())
    turns = places.random_turns(6, camera)
    radius_rad = camera.field_radius_rad(0.0)
    near = places.stars_near(places.stars_to(places.NO_LIMIT_V_MAG), turns, radius_rad)
    for vectors, turn in zip(near, turns, strict=True):
        cosines = vectors @ turn[2]
        # cells that reach into the field may end some degrees beyond it
        assert (cosines > math.cos(radius_rad)).sum() > 100
        assert cosines.min() > math.cos(radius_rad + math.radians(10))
    row = next(iter(tradeoff_study[2]["projection"].values()))
    assert row["work"].startswith(f"{len(near[0])} stars near the field to sprites")


def test_extended_precision_knows_places_between_those_of_float64():
    camera = places.ideal_monitor(places.demo_config())
    (turn,) = places.random_turns(1, camera)
    assert len(places.random_turns(5, camera)) == 5
    stars = places.stars_to(4.0)
    near = stars.vectors[stars.grid.near(turn[2], 0.1)]
    # a cell that is taken for its centre has no radius
    grid = places.in_cells(stars, 10.0, by_centres=True).grid
    assert (set(grid.cos_radius.tolist()), set(grid.sin_radius.tolist())) == ({1.0}, {0.0})
    exact = places.EXACT.places_px(near, turn, camera)
    assert np.isfinite(exact).all() and len(exact) > 5
    assert (exact != exact.astype(np.float64)).mean() > 0.9


def test_a_step_s_cells_are_its_own_and_have_no_front_on_a_busy_machine(small_run):
    """The study is as busy as its busiest step."""
    trial = Trial("a method", 0.5, 2.0, list, True, False, {"max_px_fit": 0.25})
    trial = replace(trial, time_ms=3.0, quartiles_ms=(2.0, 7.0), on_front=True, beaten="why")
    step = Trials("psf", "sums", Figure("error", "mag"), Figure("rms", "px"), "", [trial])
    cells = tradeoff.cells_of_trial(step, trial)
    assert {name: cells.pop(name) for name in tradeoff.MORE_COLUMNS if name != "max_px_fit"} == {
        name: "" for name in tradeoff.MORE_COLUMNS if name != "max_px_fit"
    }
    assert cells == {
        "step": "psf",
        "work": "sums",
        "method": "a method",
        "error": 0.5,
        "error_unit": "mag",
        "error_is": "error",
        "second": 2.0,
        "second_unit": "px",
        "second_is": "rms",
        "time_ms": 3.0,
        "quartile_1_ms": 2.0,
        "quartile_3_ms": 7.0,
        "default": True,
        "exact": False,
        "front": True,
        "beaten_by": "why",
        "max_px_fit": 0.25,
    }
    loads = {"first": Load(), "busy": Load(1e3), "last": Load(1e-3)}
    steps = [replace(step, name=name, load=load) for name, load in loads.items()]
    run = small_run(tradeoff.report, steps)
    fronts = {row["step"]: row["front"] for row in run.rows("tradeoff")}
    assert fronts == {"first": "True", "busy": "", "last": "True"}
    lines, right = run.told
    assert right is None and lines[-1] == Load(1e3).caution
    assert set(run.charts) == {f"tradeoff_{name}" for name in loads}


def test_codes_that_are_timed_are_those_of_one_frame_after_the_other(monkeypatch):
    drawn = []

    class Planted:
        footprint_px = 10

        def __init__(self, target):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *raised):
            pass

        def draw(self, field, number):
            drawn.append(number)

        def levels(self):
            return None

    errors = SimpleNamespace(flux_max_mag=0.1, max_px=lambda kind: 0.2)
    monkeypatch.setattr(light, "Renderer", Planted)
    monkeypatch.setattr(light, "code_errors", lambda *asked: [errors])
    with ExitStack() as stack:
        trial, *_ = light.quantisation(stack, True).trials
        for _ in range(3):
            trial.work()
    assert drawn == [0, 1, 2]


def test_the_smear_s_stars_are_even_over_the_detector_in_the_middle_of_the_exposure():
    bench = places.smear_bench()
    side = bench.side_px
    stars = bench.grid_stars(4)
    x_px, y_px = bench.places_px(stars, np.array([-0.5, 0.0, 0.5]))
    wanted = (np.arange(4) + 0.5) * side / 4 - 0.5
    # in cells of the sky, in no order of the detector's
    middles = {(round(x, 6), round(y, 6)) for x, y in zip(x_px[1], y_px[1], strict=True)}
    assert middles == set(itertools.product(wanted.tolist(), repeat=2))
    assert stars.electrons_per_s.tolist() == [1.0] * 16
    # over the exposure the middle moves across by a turn about y, up by one about x (0.7 deg/s)
    tracker = places.demo_config().tracker
    turn_px = math.radians(0.7) * tracker.exposure_s * bench.camera.focal_length_px
    across_px, down_px = x_px[2] - x_px[0], y_px[2] - y_px[0]
    assert abs(across_px.mean()) == pytest.approx(turn_px, rel=0.1)
    assert abs(down_px.mean()) == pytest.approx(turn_px, rel=0.1)
    lengths_px = np.hypot(across_px, down_px)
    assert places.path_words(bench, stars) == f"{lengths_px.min():.0f} to {lengths_px.max():.0f} px"
    # each sprite is of the star whose place it has
    at = np.array([-0.5, 0.5])
    sprites = bench.chain(at, np.array([0.25, 0.75]), stars)
    for instant in range(2):
        own = np.isclose(sprites.data["electrons_per_s"], (0.25, 0.75)[instant])
        assert sorted(sprites.star[own].tolist()) == list(range(16))
        np.testing.assert_allclose(
            sprites.x_px[own], x_px[2 * instant][sprites.star[own]], atol=1e-4
        )
        np.testing.assert_allclose(
            sprites.y_px[own], y_px[2 * instant][sprites.star[own]], atol=1e-4
        )
    # shares of light along the path, whole in all
    for sprites_of in places.smear_methods(bench).values():
        data = sprites_of(stars).data
        assert data["electrons_per_s"].sum() == pytest.approx(16.0, rel=1e-5)


def test_a_method_s_distance_is_of_both_axes_and_of_stars_that_are_seen():
    off_px = np.array([[3.0, 4.0], [np.nan, np.nan], [0.0, 1.0]], dtype=np.longdouble)
    assert places.worst_and_rms_px(off_px) == pytest.approx((5.0, math.sqrt(13)))


def test_a_narrow_star_s_samples_ripple_by_its_first_harmonic():
    phases_px = np.array([0.0, 0.25, 0.5])
    sums = sampled_flux(phases_px)
    first = 2 * math.exp(-2 * (math.pi * 0.4) ** 2)
    np.testing.assert_allclose(sums, 1 + first * np.cos(2 * math.pi * phases_px), atol=1e-5)


def method_error(step, method):
    return float(step[method]["error"])


def test_sampling_at_pixel_centres_spoils_a_middle_pixel_and_a_narrow_star_s_flux():
    """A wide star's by its height over its integral, a narrow one's by the first term of Poisson's
    sum.
    """
    (sigma_px,) = set(SPRITE_PSF.width_px)
    of_pixel = math.erf(0.5 / math.sqrt(2) / sigma_px) ** 2
    percent = 100 * (1 / (2 * math.pi * sigma_px**2) / of_pixel - 1)
    term = 2 * math.exp(-2 * math.pi**2 * 0.4**2)
    with ExitStack() as stack:
        step = light.psf(stack, True)
    found = re.search(r"is (\d+) % too bright, .* off by ([\d.]+) mag", step.remark)
    assert found is not None
    assert int(found[1]) == pytest.approx(percent, abs=0.51)
    assert float(found[2]) == pytest.approx(-5 * math.log10(1 - term), abs=0.006)


def test_every_step_has_a_chart_a_table_and_one_default(tradeoff_study):
    _, lines, steps = tradeoff_study
    for name in NAMES:
        assert any(line.startswith(f"{name}: ") for line in lines)
        assert sum(row["default"] == "True" for row in steps[name].values()) == 1
        assert sum(line.startswith((" >", "*>")) for line in lines) == len(NAMES)
        assert all(float(row["time_ms"]) > 0 for row in steps[name].values())


def test_a_default_is_on_the_front_or_says_what_beats_it(tradeoff_study):
    _, lines, steps = tradeoff_study
    for step in steps.values():
        default = next(row for row in step.values() if row["default"] == "True")
        assert (default["front"] == "True") == (default["beaten_by"] == "")
        if default["beaten_by"]:
            assert any(
                method in default["beaten_by"] for method in step if method != default["method"]
            )
            assert any(default["beaten_by"] in line for line in lines)


def test_the_defaults_are_the_code_s_own(tradeoff_study):
    steps = tradeoff_study[2]
    default = {
        name: next(m for m, row in step.items() if row["default"] == "True")
        for name, step in steps.items()
    }
    assert default["brightness"] == f"table over 1/T, degree {TABLE_DEGREE}"
    assert default["culling"] == f"cells of {CELL_DEG:g} deg"
    assert default["projection"].endswith("whole pixel + float32 fraction")
    assert (default["spectrum"], default["depth"], default["quantisation"]) == (
        "real spectra by V-I",
        "V to 7.5",
        "exact",
    )
    assert default["prediction"] == "linear, by the sample's rate"
    assert default["smear"].startswith("Gauss-Legendre by length")


def test_what_is_exact_is_so_to_rounding(tradeoff_study):
    """Figures from each step's `floor`: float64 integrals, float32 sprites, extended precision."""
    floors = {
        "brightness": 5e-12,
        "spectrum": 5e-12,
        "depth": 0.0,
        "culling": 0.0,
        "projection": 1e-12,
        "smear": 1e-7,
    }
    for name, floor in floors.items():
        exact = [row for row in tradeoff_study[2][name].values() if row["exact"] == "True"]
        assert len(exact) == 1 and float(exact[0]["error"]) <= floor
    (exact,) = [row for row in tradeoff_study[2]["psf"].values() if row["exact"] == "True"]
    assert float(exact["error"]) <= 1e-7 and float(exact["second"]) < 1e-12


def test_the_defaults_keep_their_modules_promises(tradeoff_study):
    steps = tradeoff_study[2]
    own = {
        name: next(row for row in step.values() if row["default"] == "True")
        for name, step in steps.items()
    }
    assert float(own["psf"]["error"]) <= MAX_CUT * MAG_PER_SHARE
    assert float(own["smear"]["error"]) <= 1e-6  # scene/exposure_motion.py
    assert float(own["culling"]["error"]) == 0
    assert float(own["projection"]["error"]) < 6e-8  # half a step of float32 under 1, on both axes


def test_less_is_worse(tradeoff_study):
    """Of steps that draw at chance; the others' errors are those recorded."""
    steps = tradeoff_study[2]

    def falls(step, *methods):
        errors = [method_error(steps[step], method) for method in methods]
        assert all(worse > better for worse, better in itertools.pairwise(errors)), (
            methods,
            errors,
        )

    falls("culling", "cells of 10 deg, by centres only", "cells of 10 deg")
    falls(
        "projection",
        "float32 throughout",
        "float64, place in float32",
        "float64, whole pixel + float32 fraction",
    )
    falls(
        "prediction",
        "hold",
        "linear, by the last two samples",
        "linear, by the sample's rate",
        "C2 blend, a sample later",
    )
    falls("smear", *(f"evenly in time, {n}" for n in (4, 8, 16, 32, 64)), "Gauss-Legendre, 24")


@pytest.fixture
def clock(monkeypatch):
    """Time that passes only where a work says so, ms."""
    now = [0.0]
    monkeypatch.setattr(sweep.time, "perf_counter", lambda: now[0])

    def work(took_ms, calls=None):
        def run_it():
            now[0] += took_ms * 1e-3
            if calls is not None:
                calls.append(took_ms)

        return run_it

    return work


def three_methods(clock, own_ms, floor=0.0):
    """Three methods, of which the slowest is as wrong as the fastest."""
    trials = [
        Trial("fast and rough", 0.1, 0.0, clock(1.0)),
        Trial("own", 1e-3, 0.0, clock(own_ms), is_default=True),
        Trial("slow and rough", 0.1, 0.0, clock(100.0)),
    ]
    return Trials(
        "planted", "sums", Figure("error", "px", floor), Figure("rms", "px"), "it is tidy", trials
    )


def test_a_planted_worse_method_is_off_the_front_and_a_beaten_default_says_why(clock):
    step = measured(three_methods(clock, 4.0), 0.02)
    assert [row.method for row in step.trials if not row.on_front] == ["slow and rough"]
    assert step.default.beaten == "" and step.default.time_ms == pytest.approx(4.0)
    # all errors count as none: the fastest is best
    beaten = measured(three_methods(clock, 4.0, floor=1.0), 0.02)
    assert not beaten.default.on_front
    assert (
        beaten.default.beaten == "'fast and rough' is no worse and takes 75 % less time; it is tidy"
    )
    assert any(beaten.default.beaten in line for line in table_lines(beaten))


def test_what_beats_a_default_is_the_fastest_that_does_and_on_a_busy_machine_nothing(clock):
    step = three_methods(clock, 4.0, floor=1.0)
    step = replace(step, trials=[*step.trials, Trial("rough", 0.2, 0.0, clock(2.0))])
    beaten = measured(step, 0.02)
    assert [trial.method for trial in beaten.trials] == [
        "fast and rough",
        "rough",
        "own",
        "slow and rough",
    ]
    assert beaten.default.beaten.startswith("'fast and rough' is no worse")
    busy = judged(replace(beaten, load=Load(1e3)))
    assert not any(trial.on_front or trial.beaten for trial in busy.trials)
    assert f"   {sweep.NOT_JUDGED}" in table_lines(busy)


def test_a_step_s_works_share_its_budget_and_its_floor_is_drawn_where_one_is_below(
    clock, monkeypatch, small_run
):
    asked = []
    turns = trials.in_turn

    def in_turn(works, rounds, share_s):
        asked.append((list(works), rounds, share_s))
        return turns(works, 1, share_s)

    monkeypatch.setattr(trials, "in_turn", in_turn)
    step = measured(three_methods(clock, 4.0), 0.6)
    assert asked == [(["fast and rough", "own", "slow and rough"], MAX_ROUNDS, pytest.approx(0.2))]
    for floor, is_drawn in ((5e-3, True), (1e-3, False)):
        floored = replace(step, error=Figure("error", "px", floor))
        run = small_run(lambda folder, step=floored: draw_trials(folder / "t", step, "here"))
        levels = [y for _, x, y in run.lines("t", 0) if x == [0.0, 1.0]]
        assert levels == ([[floor, floor]] if is_drawn else [])
        assert run.title("t") == charts.capital(trials.finding(floored))


def test_a_time_s_quartiles_are_of_the_wall_and_say_where_methods_overlap():
    taken = [sweep.Spent(wall, 1e3) for wall in (9.0, 1.0, 3.0, 5.0, 7.0)]
    assert trials.quartiles_ms(taken) == (3.0, 5.0, 7.0)
    default = Trial("own", 0.1, 0.0, list, time_ms=10.0, quartiles_ms=(8.0, 13.0))
    for third_ms, end in ((7.9, "takes 40 % less time"), (8.0, "quartiles of both overlap")):
        best = Trial("best", 0.1, 0.0, list, time_ms=6.0, quartiles_ms=(5.0, third_ms))
        words = trials.beaten_words(default, best)
        assert words.startswith("'best' is no worse and takes 40 % less time")
        assert words.endswith(end)


def planted_trials(floor: float = 0.01, unit: str = "mag", **changes: object) -> Trials:
    """Three methods on the front but for the second, which is the default."""
    methods = [
        Trial("fast", 0.5, 2.0, list, time_ms=1.0, quartiles_ms=(0.9, 1.3), on_front=True),
        Trial("own", 0.5, 3.0, list, is_default=True, time_ms=20.0, quartiles_ms=(19.0, 22.0)),
        Trial("the sum", 0.001, 0.0, list, is_exact=True, time_ms=1500.0, on_front=True),
    ]
    methods[1] = replace(methods[1], **changes)
    step = Trials(
        "psf", "the sum of it", Figure("error", unit, floor), Figure("rms", "px"), "", methods
    )
    return replace(step, remark="a caution")


def test_a_step_s_table_title_and_note_are_whole():
    step = planted_trials(beaten="'fast' is no worse")
    assert table_lines(step) == [
        "",
        "psf: the sum of it",
        "   method   error [mag]   rms [px]   ms",
        "*  fast             0.5          2  1",
        " > own              0.5          3  20",
        "*  the sum        0.001          0  1.5e+03",
        "   the default: 'fast' is no worse",
        "   a caution",
    ]
    title = "PSF: 'own' is off by 0.5 mag in 20 ms; 'the sum' takes 1500 ms"
    assert trials.finding(step) == title
    at_floor = planted_trials(error=0.01, on_front=True)
    assert trials.finding(at_floor).startswith("PSF: 'own' has no error in 20 ms")
    above = planted_trials(error=0.0101, unit="1")
    assert trials.finding(above).startswith("PSF: 'own' is off by 0.01 in 20 ms")
    busy = replace(step, load=Load(1e3))
    assert trials.finding(busy) == f"PSF: 'own' is off by 0.5 mag; {sweep.NOT_JUDGED}"
    assert trials.trials_note(step, "A machine") == (
        "The sum of it. Blue: the front, which nothing else is as right and as fast as. Ring:"
        " hilstar's default. Bars: quartiles. Dotted: 0.01 mag, no error below it. A machine."
    )
    assert "Dotted" not in trials.trials_note(planted_trials(floor=0.0), "A machine")
    assert "front" not in trials.trials_note(busy, "A machine")


def test_a_step_s_points_are_ringed_by_default_and_blue_on_the_front():
    points = trials.front_points(planted_trials())
    drawn = [(point.place, point.colour, point.on_front, point.rings) for point in points]
    assert drawn == [
        ((1.0, 0.5), charts.BLUE, True, ()),
        ((20.0, 0.5), charts.MUTED, False, (charts.RED,)),
        # an error below the floor is drawn there
        ((1500.0, 0.01), charts.BLUE, True, ()),
    ]
    assert points[1].ends_ms == (19.0, 22.0)
    # the largest error first, the faster of two alike before the other
    names = [(name, colour) for name, _, colour in trials.side_names(planted_trials())]
    assert names == [("fast", charts.BLUE), ("own", charts.RED), ("the sum", charts.BLUE)]
    # a default alone on the front has the colour of its name
    alone = planted_trials(on_front=True)
    alone = replace(
        alone, trials=[replace(trial, on_front=trial.is_default) for trial in alone.trials]
    )
    assert [point.colour for point in trials.front_points(alone)] == [
        charts.MUTED,
        charts.RED,
        charts.MUTED,
    ]


def test_a_front_of_two_points_is_a_step_and_every_ring_is_drawn():
    points = trials.front_points(planted_trials())
    with charts.panels_of("A finding") as (axes,):
        trials.draw_front(axes, points, trials.TRIALS_LOOK)
        lines = axes.get_lines()
        steps = [line for line in lines if line.get_drawstyle() == "steps-post"]
        rings = [line for line in lines if line.get_markerfacecolor() == "none"]
        scales = axes.get_xscale(), axes.get_yscale()
        alone = len(axes.get_lines())
        trials.draw_front(axes, points[:2], trials.TRIALS_LOOK)
        added = axes.get_lines()[alone:]
    assert scales == ("log", "log")
    (front,) = steps
    assert front.get_xydata().tolist() == [[1.0, 0.5], [1500.0, 0.01]]
    (ring,) = rings
    assert (ring.get_xydata().tolist(), ring.get_markeredgecolor()) == ([[20.0, 0.5]], charts.RED)
    assert not [line for line in added if line.get_drawstyle() == "steps-post"]


def test_every_round_has_every_work_and_slow_works_drop_out(clock):
    calls = []
    slow, fast = clock(50.0, calls), clock(1.5, calls)
    works = {"slow": lambda _: slow(), "fast": lambda _: fast()}
    times = in_turn(works, MAX_ROUNDS, 0.01)
    rounds = [sorted(calls[k : k + 2]) for k in range(0, 2 * (MIN_ROUNDS + 1), 2)]
    assert rounds == [[1.5, 50.0]] * (MIN_ROUNDS + 1)
    # The slow one has had its 10 ms after one round; the fast one is over its own after the
    # seventh.
    assert {name: len(taken) for name, taken in times.items()} == {"slow": MIN_ROUNDS, "fast": 7}


def test_the_variants_that_change_nothing_or_only_the_profile_draw_the_same_stars():
    field = star_field((160, 120), 10)
    wanted = linear_image(field, (160, 120), SPRITE_PSF)
    brightest = float(field.data["electrons_per_s"].max())
    drawn = {}
    for variant in (
        SplatVariant(),
        SplatVariant("exp erf"),
        SplatVariant("table", table_size=4096),
        SplatVariant("centre"),
    ):
        with VariantRenderer(Target((160, 120), SPRITE_PSF), variant) as renderer:
            renderer.draw_and_wait(field)
            drawn[variant.profile] = np.abs(renderer.linear() - wanted).max()
            assert renderer.gl_error() == "GL_NO_ERROR" and renderer.texel == "R32F"
    for profile in ("renderer", "exp erf", "table"):
        assert drawn[profile] < PROFILE_SHARE * brightest, profile
    assert drawn["centre"] > 100 * PROFILE_SHARE * brightest


def test_half_floats_are_told_apart_and_smaller_sprites_are_smaller():
    with VariantRenderer(
        Target((64, 64), SPRITE_PSF), SplatVariant(half_float=True, footprint_px=6)
    ) as renderer:
        assert (renderer.texel, renderer.footprint_px) == ("R16F", 6)


def test_a_trapezoid_integrates_a_straight_line(rng):
    line = Curve(np.array([400.0, 500.0]), rng.uniform(size=2))
    nodes, weight = trapezoid(7.0, line)
    assert np.diff(nodes).max() <= 7.0
    assert line(nodes) @ weight == pytest.approx(line.value.mean() * 100e-9, rel=1e-12)


def test_every_step_is_known_and_a_chart_that_cannot_be_written_is_refused(tmp_path, clock):
    assert len(STEPS) == len(NAMES)
    with pytest.raises(InputError, match="cannot be written"):
        draw_trials(
            tmp_path / "no" / "chart.png", measured(three_methods(clock, 4.0), 0.01), "here"
        )


def test_a_title_says_a_time_as_it_is_drawn():
    """1196 ms were told as 1200 ms, beside a point that is drawn at 1196."""
    said = [ms_words(ms) for ms in (0.4567, 22.44, 999.4, 999.6, 1196.4)]
    assert said == ["0.457 ms", "22.4 ms", "999 ms", "1000 ms", "1196 ms"]


def test_a_rule_reaches_over_all_that_curves_share():
    """From the later first knot to the earlier last one, both included: a power of the wavelength
    has its closed integral there.
    """
    curves = (
        Curve(np.array([300.0, 400.0, 700.0]), np.ones(3)),
        Curve(np.array([350.0, 500.0, 900.0]), np.ones(3)),
    )
    assert shared_knots(*curves).tolist() == [350.0, 400.0, 500.0, 700.0]
    for power in (0, 1, 3):
        closed = (700.0 ** (power + 1) - 350.0 ** (power + 1)) / (power + 1)
        nm, weight_m = gauss(2, *curves)  # exact up to the third power
        assert (nm**power) @ weight_m == pytest.approx(closed * 1e-9, rel=1e-12)
        nm, weight_m = trapezoid(1.0, *curves)
        assert (nm**power) @ weight_m == pytest.approx(closed * 1e-9, rel=1e-5)


def test_sprites_of_a_path_stand_about_its_middle_and_share_its_light():
    placed = places.path_nodes()
    assert list(placed) == list(places.smear_methods(places.smear_bench()))
    counts = [len(at) for at, _ in placed.values()]
    assert sorted(counts) == sorted((*GAUSS, EXACT_NODES, *EVENLY))
    for at, share in placed.values():
        assert share.sum() == pytest.approx(1.0)
        assert share @ at == pytest.approx(0.0, abs=1e-12)
        # of a path from -1/2 to 1/2, all but what so many sprites leave out
        spread = share @ at**2
        even = (1 - 1 / len(at) ** 2) / 12
        assert spread == pytest.approx(even if np.ptp(share) == 0 else 1 / 12, rel=1e-9)


def seen_camera(turn_rad: float = 0.0) -> Camera:
    """A display of 100 x 60 px, turned about the boresight."""
    to_image = to_matrix(from_rotation_vector(np.array([0.0, 0.0, turn_rad])))
    return Camera((100, 60), 1000.0, (49.5, 29.5), to_image)


def test_a_turn_is_into_the_camera_first_and_then_into_its_image():
    """A star beside the boresight is in the image where the camera that is turned has it."""
    camera = seen_camera(0.4)
    first, second, _ = places.random_turns(3, camera)
    ra, dec = math.radians(84.057), math.radians(-1.2)
    boresight = np.array(
        [math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]
    )
    np.testing.assert_allclose(first @ boresight, [0, 0, 1], atol=1e-12)
    assert abs(second @ boresight - [0, 0, 1]).max() > 0.01
    beside_cam = np.array([1e-2, 0.0, 1.0])
    beside = to_matrix(ORION).T @ beside_cam
    x_px, y_px = camera.project((first @ beside)[None])
    assert abs(x_px[0] - 49.5) == pytest.approx(10 * math.cos(0.4))
    assert abs(y_px[0] - 29.5) == pytest.approx(10 * math.sin(0.4))


@pytest.mark.parametrize("name", places.ROADS)
def test_a_road_s_sprites_are_those_that_reach_into_the_image(name):
    """Half of 10 px beyond the outermost pixels, in columns and rows of its own."""
    camera = seen_camera()
    wanted_px = np.array([[10.0, 40.0], [103.0, 20.0], [107.0, 20.0], [30.0, 63.0], [30.0, 67.0]])
    slopes = (wanted_px - [49.5, 29.5]) / 1000.0
    vectors = np.column_stack([slopes, np.ones(len(slopes))])
    found_px = places.ROADS[name].places_px(vectors, np.eye(3), camera).astype(np.float64)
    wanted_px[[2, 4]] = np.nan
    np.testing.assert_allclose(found_px, wanted_px, atol=1e-3)


def test_stars_that_are_tested_are_all_of_a_scan_and_those_of_near_cells():
    camera = places.ideal_monitor(places.demo_config())
    (turn,) = places.random_turns(1, camera)
    stars = places.stars_to(6.0)
    every, near = places.scan(stars, turn, camera), places.by_cells(stars, turn, camera)
    assert every.tested == len(stars) == places.by_angle(stars, turn, camera).tested
    assert sorted(near.star.tolist()) == sorted(every.star.tolist())
    # cells reach beyond the field, and are a small part of the sky
    assert 1.2 * len(near.star) < near.tested < 0.1 * len(stars)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_path_s_length_is_along_the_axis_that_it_takes(axis):
    """Through the lens of the demo's tracker, a turn about one axis moves the other's pixels."""
    bench = places.smear_bench()
    rate_rad_s = np.zeros(3)
    rate_rad_s[axis] = math.radians(1.0)
    motion = replace(bench.motion, rate_cam_rad_s=rate_rad_s)
    bench = replace(bench, motion=motion)
    stars = bench.grid_stars(1)
    path_px = math.radians(1.0) * motion.exposure_s * bench.camera.focal_length_px
    assert path_px > 1
    assert places.path_words(bench, stars) == f"{path_px:.0f} to {path_px:.0f} px"
