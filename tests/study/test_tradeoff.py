"""The study of trade-offs: exact methods are exact, worse ones worse, and each default stands on
the front or says why not.
"""

from __future__ import annotations

import itertools
import math
import re
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import angle_between_rad
from hilstar.display.render.reference import linear_image
from hilstar.display.render.target import Target
from hilstar.display.render.variants import SplatVariant, VariantRenderer
from hilstar.instruments.study import sweep
from hilstar.instruments.study.codes import star_field
from hilstar.instruments.study.predictors import slew_attitude
from hilstar.instruments.study.sweep import MAX_ROUNDS, MIN_ROUNDS, in_turn, pareto_front
from hilstar.instruments.study.tradeoff import run as tradeoff
from hilstar.instruments.study.tradeoff.light import LIMITS_V_MAG, gauss, shared_knots, trapezoid
from hilstar.instruments.study.tradeoff.places import (
    EVENLY,
    EXACT_NODES,
    GAUSS,
    SPRITE_PSF,
    smear_methods,
)
from hilstar.instruments.study.tradeoff.run import STEPS
from hilstar.instruments.study.trials import (
    Figure,
    Trial,
    Trials,
    draw_trials,
    measured,
    ms_words,
    table_lines,
)
from hilstar.optics.psf import MAX_CUT
from hilstar.sky.electrons import TABLE_DEGREE
from hilstar.sky.spectrum import Curve
from hilstar.sky.stars import CELL_DEG

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
# A relative error in magnitudes: 2.5 / ln 10.
MAG_PER_SHARE = 1.0858
# Of the brightest star, in a pixel that holds 0.44 of it along each axis. The exp erf: two edges of
# 1.5e-7, halved, times 0.44, 0.7e-7. The table of 4096: (6 px / 4095)^2 / 8 times the profile's
# curvature of 0.55 / px^2, times 0.44, 0.7e-7. float32: 0.6e-7 of 1 at each edge, 0.3e-7, and as
# much of the sum.
PROFILE_SHARE = 2e-7


@pytest.fixture(scope="module")
def tradeoff_study(whole_study):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tradeoff, "QUICK_BUDGET_S", 0.0)  # one round: no claim here is of a time
        patch.setattr(sweep, "MIN_ROUNDS", 1)
        charts = {f"tradeoff_{name}" for name in NAMES}
        found = whole_study("tradeoff", charts)
    rows = found.rows("tradeoff")
    return (
        found.folder,
        found.findings,
        {name: {r["method"]: r for r in rows if r["step"] == name} for name in NAMES},
    )


@pytest.fixture(scope="module")
def planned():
    """Each step by name, as it is before it is timed."""
    found = {}
    for plan in STEPS:
        with ExitStack() as stack:
            step = plan(stack, True)
        found[step.name] = step
    assert list(found) == NAMES
    return found


@pytest.fixture(scope="module")
def steps(planned):
    """The methods of each step by name."""
    return {name: {trial.method: trial for trial in step.trials} for name, step in planned.items()}


def test_sampling_at_pixel_centres_spoils_a_middle_pixel_and_a_narrow_star_s_flux(planned):
    """A wide star's by its height over its integral, a narrow one's by the first term of Poisson's
    sum.
    """
    (sigma_px,) = set(SPRITE_PSF.width_px)
    of_pixel = math.erf(0.5 / math.sqrt(2) / sigma_px) ** 2
    percent = 100 * (1 / (2 * math.pi * sigma_px**2) / of_pixel - 1)
    term = 2 * math.exp(-2 * math.pi**2 * 0.4**2)
    found = re.search(r"is (\d+) % too bright, .* off by ([\d.]+) mag", planned["psf"].remark)
    assert found is not None
    assert int(found[1]) == pytest.approx(percent, abs=0.51)
    assert float(found[2]) == pytest.approx(-5 * math.log10(1 - term), abs=0.006)


def default_of(step):
    (default,) = [trial for trial in step.values() if trial.is_default]
    return default


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


def test_the_defaults_are_the_code_s_own(steps):
    default = {name: default_of(step).method for name, step in steps.items()}
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


def test_what_is_exact_is_so_to_rounding(steps):
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
        (exact,) = [trial for trial in steps[name].values() if trial.is_exact]
        assert exact.error <= floor
    (exact,) = [trial for trial in steps["psf"].values() if trial.is_exact]
    assert exact.error <= 1e-7 and exact.second < 1e-12


def test_the_defaults_keep_their_modules_promises(steps):
    error = {name: default_of(step).error for name, step in steps.items()}
    assert error["psf"] <= MAX_CUT * MAG_PER_SHARE
    assert error["smear"] <= 1e-6  # scene/exposure_motion.py
    assert error["culling"] == 0
    assert error["projection"] < 6e-8  # half a step of float32 under 1, on both axes


def test_less_is_worse(steps):
    def falls(step, *methods):
        errors = [steps[step][method].error for method in methods]
        assert all(worse > better for worse, better in itertools.pairwise(errors)), (
            methods,
            errors,
        )

    falls(
        "psf",
        "GL polynomial, R32F, 6 px",
        "GL polynomial, R32F, 8 px",
        "GL polynomial, R32F, 10 px",
    )
    falls(
        "psf", "GL polynomial, R16F, 10 px", "GL table of 512, 10 px", "GL polynomial, R32F, 10 px"
    )
    falls(
        "brightness",
        "AGS",
        "trapezoid, 10 nm",
        "trapezoid, 5 nm",
        "trapezoid, 1 nm",
        "Gauss-Legendre, 3 per knot",
    )
    falls("brightness", *(f"table over 1/T, degree {n}" for n in (5, 10, 20, 40)))
    falls("spectrum", "AGS, one average", "black body, ballesteros2012", "real spectra by V-I")
    falls("depth", *(f"V to {limit:g}" for limit in LIMITS_V_MAG), "all of Hipparcos")
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
    falls("quantisation", "round", "exact", "exact, bit stealing")


def test_what_is_wrong_is_wrong_by_as_much_as_it_should_be(steps):
    """Second figures, and errors that physics gives."""
    culling = steps["culling"]
    # every star is tested, of 116 812
    scan = culling["scan, every star projected"]
    assert scan.second == culling["scan of angles"].second
    assert 0.98 < scan.second / 116_812 < 1
    tested = [culling[f"cells of {deg:g} deg"].second for deg in (2, 4, 10, 20)]
    assert tested == sorted(tested) and tested[-1] < 0.1 * scan.second
    # places up to 2000 px: float32's step there is 1.2e-4, whose half is the worst along an axis
    worst = steps["projection"]["float64, place in float32"].error
    assert worst == pytest.approx(math.hypot(2**-14, 2**-15), rel=0.3)
    # held from one sample to the next, 50 ms later, whose turn in between is the most of the slew's
    hold = steps["prediction"]["hold"]
    samples = [slew_attitude(k * 50_000_000) for k in range(201)]
    turned = [angle_between_rad(a, b) for a, b in itertools.pairwise(samples)]
    # frames are at most two thirds of that after a sample
    assert hold.error == pytest.approx(max(turned) * 206264.806 * 2 / 3, rel=0.02)
    assert 0.5 * hold.error < hold.second < 0.7 * hold.error
    # so many impulses on a path: the centre is right whatever their number
    smear = steps["smear"]
    for name in ("evenly in time, 16", "Gauss-Legendre, 32"):
        assert smear[name].second < 0.02


def test_the_front_is_what_nothing_beats():
    errors, times = [3.0, 2.0, 2.0, 1.0, 5.0], [1.0, 2.0, 3.0, 9.0, 1.0]
    assert pareto_front(errors, times).tolist() == [True, True, False, True, False]
    assert pareto_front([1.0, 1.0], [2.0, 2.0]).tolist() == [True, True]


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
    drawn = []
    bench = SimpleNamespace(chain=lambda at, share, stars: drawn.append((at, share)))
    methods = smear_methods(bench)
    for method in methods.values():
        method(None)
    counts = [len(at) for at, _ in drawn]
    assert sorted(counts) == sorted((*GAUSS, EXACT_NODES, *EVENLY))
    for at, share in drawn:
        assert share.sum() == pytest.approx(1.0)
        assert share @ at == pytest.approx(0.0, abs=1e-12)
        # of a path from -1/2 to 1/2, all but what so many sprites leave out
        spread = share @ at**2
        even = (1 - 1 / len(at) ** 2) / 12
        assert spread == pytest.approx(even if np.ptp(share) == 0 else 1 / 12, rel=1e-9)
