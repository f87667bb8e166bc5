"""What readings do to a certificate's figures beside their own values: forms between two models,
edges that go together, light that a map leaves.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilstar.instruments.certify.bench_readings import BesideRatio, DotReadings
from hilstar.instruments.certify.estimates import Evenness, LightDeviation, Surface
from hilstar.instruments.certify.lens import LensFit, lens_fit
from hilstar.instruments.certify.model import Figures
from hilstar.instruments.certify.read_effects import (
    MapAtStars,
    Read,
    _of_delays,
    _of_evenness,
    _of_light,
    _of_uneven_light,
    of_readings,
)
from hilstar.instruments.certify.structure import Cells, Structure, in_time
from hilstar.server.bench.bench_file import BenchFile
from tests.support.planted_certify import reference_star, stated_bench

SIZE_PX = (1920, 1080)
NONE = Structure(np.ones(1), np.zeros(1), 1.0, math.inf)
STARS = 3
SQUARE_PX = (900, 500, 70)


def light_read(value: np.ndarray) -> LightDeviation:
    """Light by four codes, with noise of 1 % in each of them and 0.2 % of white in the dark."""
    count = len(value)
    return LightDeviation(
        log_light=np.log([0.01, 0.1, 0.4, 1.0]),
        value=value,
        factors=0.01 * np.eye(count),
        dof=30.0,
        noise=0.01,
        dark_factors=0.002 / np.array([[0.01], [0.1], [0.4], [1.0]]),
        dark_dof=5.0,
        dark=0.002,
        lasting_factors=np.zeros((count, 0)),
        lasting=NONE,
        square_px=SQUARE_PX,
        common_factors=np.zeros((count, 0)),
        beside=None,
    )


def figures() -> Figures:
    """Three stars, whose codes are those read and one between."""
    stars = []
    for light, x_px, y_px in ((0.1, 300.0, 200.0), (0.2, 960.0, 100.0), (1.0, 1500.0, 900.0)):
        stars.append(reference_star(log_light=np.log([light]), x_px=x_px, y_px=y_px))
    return Figures(stated_bench(), stars)


def even_read(structure: Structure = NONE) -> Evenness:
    """An even screen by 30 by 20 dots, whose fit takes nothing up."""
    x_px, y_px = (
        grid.ravel() for grid in np.meshgrid(np.arange(40, 1900, 64.0), np.arange(40, 1040, 50.0))
    )
    flat = Surface(2, SIZE_PX, np.zeros((6, 1)), 0.01 * np.eye(6), 40.0, 0.01)
    return Evenness(flat, Cells(x_px, y_px), np.zeros((6, len(x_px))), structure)


def by_name(effects: Any) -> dict[str, Any]:
    return {effect.input.name: effect for effect in effects}


def test_light_between_codes_is_a_triangle_half_way_to_straight_lines():
    """One that is half of the spline's bend wide to either side; at a code read there is none."""
    light = light_read(np.array([1.0, 1.05, 0.98, 1.01]))
    effects = by_name(_of_light(light, figures()))
    bent = light.bent(figures().log_light)
    form = effects["form of the response"]
    assert form.input.distribution == "triangular"
    assert form.levels == pytest.approx((bent / 2 / math.sqrt(6))[None])
    assert np.abs(bent[[0, 2]]).max() < 1e-12 < abs(bent[1])
    spread = np.sqrt((effects["response"].levels ** 2).sum(axis=0))
    assert spread[[0, 2]] == pytest.approx(0.01)
    dark = effects["dark readings"]
    assert dark.levels[0, [0, 2]] == pytest.approx([0.02, 0.002])
    assert (dark.input.dof, effects["response"].input.dof) == (5.0, 30.0)


def test_what_readings_share_and_what_lasts_move_the_codes_between_as_the_spline_does():
    """Of 4 % of one code's light in common, and of noise that is one for all codes; a lattice of lit
    pixels that is 5 sigma of its noise brighter than single ones.
    """
    light = replace(
        light_read(np.ones(4)),
        lasting_factors=np.full((4, 1), 0.03),
        lasting=Structure(np.array([5.0]), np.array([9.0]), 1.0, 7.0),
        common_factors=np.array([[0.0], [0.04], [0.0], [0.0]]),
        beside=BesideRatio(1 + 0.005 * math.sqrt(26), 0.005),
    )
    missing: list[str] = []
    read = replace(read_of([]), light=light)
    _, found = of_readings(stating(0.3), figures(), read, missing)
    effects = by_name(found)
    assert effects["noise that lasts"].levels == pytest.approx(np.full((1, 3), 0.03))
    assert effects["noise that lasts"].input.dof == 7.0
    shared = effects["what readings share"].levels[0]
    assert shared[[0, 2]] == pytest.approx([0.04, 0.0])
    assert 0 < shared[1] < 0.04
    assert effects["pixels beside lit ones"].even == pytest.approx(np.full((1, STARS), 0.025))
    assert missing == []


def test_a_map_s_form_is_a_rectangle_from_the_smooth_one_to_the_linear():
    form = np.array([0.02, -0.01, 0.0])
    terms = np.zeros((STARS, 6))
    terms[:, 1] = [1.0, 2.0, -1.0]
    effects = by_name(_of_evenness(even_read(), MapAtStars(terms, np.zeros(STARS), form)))
    shape = effects["form of the light map"]
    assert shape.input.distribution == "rectangular"
    assert shape.even == pytest.approx((np.abs(form) / 2 / math.sqrt(3))[None])
    assert np.sqrt((effects["evenness"].even ** 2).sum(axis=0)) == pytest.approx([0.01, 0.02, 0.01])


@pytest.mark.parametrize(("length_px", "left"), [(1e6, 0.0), (1.0, 1.0)])
def test_light_that_a_map_leaves_counts_relative_to_where_light_was_read(length_px, left):
    """What changes over a million pixels is in both; what changes over one is each star's own, as
    the square has the mean of 49 places.
    """
    structure = Structure(np.array([length_px]), np.array([4e-4]), 1.0, 9.0)
    effect = _of_uneven_light(figures(), even_read(structure), SQUARE_PX)
    variance = (effect.even**2).sum(axis=0)
    assert variance == pytest.approx(left * 4e-4 * (1 + 1 / 49), abs=1e-8)
    assert effect.input.dof == 9.0


@functools.cache
def fitted_lens() -> LensFit:
    """Of 12 by 9 dots with noise of 0.1 arcsec; no figure here goes by it."""
    x_px, y_px = (
        at.ravel() for at in np.meshgrid(np.arange(300, 1620, 110), np.arange(99, 981, 98))
    )
    dots = DotReadings(x_px, y_px, x_px, y_px, np.ones(len(x_px)))
    noise_arcsec = 0.1 * np.random.default_rng(1).standard_normal((len(x_px), 2))
    return lens_fit(stated_bench(), dots, noise_arcsec)


def read_of(delays_ms: list[float]) -> Read:
    """A bench's readings with these edges."""
    return Read(light_read(np.ones(4)), even_read(), fitted_lens(), np.array(delays_ms))


def stating(panel_delay_u_ms: float | None) -> BenchFile:
    """A bench file that states a delay of 8 ms, and how well it is known."""
    if panel_delay_u_ms is None:
        return stated_bench()
    return stated_bench(f"[certify]\npanel_delay_u_ms = {panel_delay_u_ms}\n")


@pytest.mark.parametrize(
    ("edges_ms", "delay_ms"), [([], 8.0), ([9.0], 8.0), ([9.0, 9.4], 9.2), ([9.0, 9.4, 8.9], 9.1)]
)
def test_a_delay_is_the_mean_of_two_edges_or_more_and_else_as_stated(edges_ms, delay_ms):
    missing: list[str] = []
    value, effects = of_readings(stating(0.3), figures(), read_of(edges_ms), missing)
    assert value.delay_ms == pytest.approx([delay_ms])
    delay = by_name(effects)["delay"]
    if len(edges_ms) < 2:
        assert delay.delay == [0.3]
    else:
        assert delay.input.dof == len(edges_ms) - 1
        assert 0.0 < delay.delay[0] < 0.3
    assert value.levels == pytest.approx(np.ones((1, 3)))
    assert len(missing) == 1  # neighbours were not read
    missing = []
    of_readings(stating(None), figures(), read_of(edges_ms), missing)
    assert any("latency" in line for line in missing) == (len(edges_ms) < 2)


def test_edges_that_go_together_tell_their_mean_worse(rng):
    """A delay that wanders from edge to edge: the mean's variance is the mean of all covariances."""
    count = 80
    late_ms = 8 + 0.05 * rng.standard_normal(count)
    for k in range(1, count):
        late_ms[k] += 0.9 * (late_ms[k - 1] - 8)
    order = np.arange(count, dtype=float)
    structure = in_time(order, late_ms - late_ms.mean(), np.ones((count, 1)))
    assert structure.total > 0
    effects = by_name(_of_delays(late_ms))
    apart = np.abs(order[:, None] - order)
    of_mean = 0.0
    for length, variance in structure.parts():
        of_mean += variance * float(np.exp(-apart / length).mean())
    lasting = effects["delay that lasts"]
    assert lasting.delay == pytest.approx([math.sqrt(of_mean)])
    assert lasting.input.dof == structure.dof
    assert effects["delay"].delay == pytest.approx([math.sqrt(structure.noise_variance / count)])
