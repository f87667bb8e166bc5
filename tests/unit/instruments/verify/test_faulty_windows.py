"""A fault's window on the tracker's image, and what is taken of it: planted images, no bench."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.rotation import to_matrix
from hilstar.instruments.verify import faulty_fields
from hilstar.instruments.verify.faulty_fields import (
    FaultSeen,
    FaultyFields,
    _middle,
    _Shot,
    fault_lines,
)
from hilstar.optics.layers.fault_kinds import KINDS
from hilstar.optics.layers.fault_light import icrs_direction

SIZE_PX = (120, 80)
DRAWS = 200


def fields_of(place: tuple[float, float] | None) -> FaultyFields:
    """Faults at a place of a detector of 120 x 80 px, before a PSF that is wider along y."""
    made = object.__new__(FaultyFields)
    made._twin = SimpleNamespace(camera=SimpleNamespace(resolution_px=SIZE_PX))
    made._finder = SimpleNamespace(psf=SimpleNamespace(width_px=(0.8, 1.4)))
    made._place_px = lambda fault, frame: None if place is None else np.array(place)
    return made


def test_a_window_is_six_sigmas_about_its_place_and_whole_on_the_detector():
    """Six of 1.4 px, to whole pixels, and one more: 10 px."""
    fields = fields_of(None)
    rows, columns = fields._window(np.array([30.4, 50.6]))
    assert (rows.start, rows.stop, columns.start, columns.stop) == (41, 62, 20, 41)
    for place, is_whole in (
        ((10.0, 10.0), True),
        ((9.9, 40.0), False),
        ((40.0, 9.9), False),
        ((109.9, 69.9), True),
        ((110.0, 40.0), False),
        ((40.0, 70.0), False),
    ):
        assert fields._whole(np.array(place)) is is_whole


def shots(asked: np.ndarray, shown: np.ndarray) -> tuple[_Shot, _Shot]:
    """A field without a fault, and with one that adds these."""
    plain = np.full(SIZE_PX[::-1], 100.0)
    faulty = plain.copy(), plain.copy()
    faulty[0][:] += asked
    faulty[1][:] += shown
    return _Shot(plain, plain + 7.0, "plain"), _Shot(faulty[0], faulty[1] + 7.0, "faulty")


POINT = KINDS["false-star"](name="ghost", radec_deg=(1.0, 2.0), electrons=5.0)
GLOW = KINDS["glow"](name="sun", icrs=(0.0, 0.6, 0.8), electrons_per_s=8.0, scale_deg=4.0)


def test_a_point_of_light_is_what_it_adds_in_its_window():
    asked = np.zeros(SIZE_PX[::-1])
    shown = np.zeros(SIZE_PX[::-1])
    asked[50, 30], shown[50, 31] = 1000.0, 600.0
    shown[52, 31] = 200.0
    shown[5, 100] = 5e4  # another star's twinkle, far from it
    seen = fields_of((30.0, 50.0))._compared(POINT, *shots(asked, shown))
    assert (seen.asked_e, seen.seen_e) == pytest.approx((1000.0, 800.0))
    assert seen.flux_mag == pytest.approx(-2.5 * math.log10(0.8))
    # a quarter of its light stands two rows further down
    assert seen.off_px == pytest.approx(math.hypot(1.0, 0.5))
    beside = fields_of((5.0, 50.0))._compared(POINT, *shots(asked, shown))
    assert (
        beside.note
        == fields_of(None)._compared(POINT, *shots(asked, shown)).note
        == "not on the tracker's image"
    )


def test_a_glow_is_what_it_adds_to_the_whole_image():
    asked = np.linspace(0.0, 2.0, SIZE_PX[0]) * np.ones(SIZE_PX[::-1])
    seen = fields_of(None)._compared(GLOW, *shots(asked, 1.1 * asked))
    assert seen.asked_e == pytest.approx(asked.sum())
    assert seen.flux_mag == pytest.approx(-2.5 * math.log10(1.1))
    assert seen.off_px is None
    nothing = fields_of(None)._compared(GLOW, *shots(0 * asked, 0 * asked))
    assert (nothing.asked_e, nothing.note) == (0.0, "not on the tracker's image")
    dark = fields_of(None)._compared(GLOW, *shots(asked, 0 * asked))
    assert dark.flux_mag is None


def test_a_fault_is_shown_within_the_image_and_a_glow_beside_it(rng):
    """A point anywhere within two fifths of the field's radius, as often by area; a glow's middle
    a fifth beyond the field's edge.
    """
    made = object.__new__(FaultyFields)
    made._rng, made._view_rad = rng, 0.1
    angles_rad = {}
    for fault, toward in ((POINT, icrs_direction(POINT)), (GLOW, np.array(GLOW.icrs))):
        boresights = np.array([to_matrix(made._attitude(fault))[2] for _ in range(DRAWS)])
        angles_rad[fault.name] = np.arccos(boresights @ toward)
    np.testing.assert_allclose(angles_rad["sun"], 1.2 * 0.1, rtol=1e-6)
    areas = (angles_rad["ghost"] / (0.4 * 0.1)) ** 2
    assert areas.max() < 1 + 1e-6
    # the mean of so many uniform numbers, to four of its sigmas
    assert areas.mean() == pytest.approx(0.5, abs=4 / math.sqrt(12 * DRAWS))


def test_a_middle_is_x_then_y():
    light = np.zeros((5, 9))
    light[1, 6], light[3, 6] = 1.0, 3.0
    assert _middle(light).tolist() == [6.0, 2.5]


def test_each_fault_has_a_line_of_its_figures():
    lines = fault_lines(
        [
            FaultSeen("ghost", "false-star", 1000.0, 800.0, 0.2423, 0.5),
            FaultSeen("loss", "drop", note="of the run's frames"),
            FaultSeen("step", "attitude-step", off_px=0.0123),
            FaultSeen("none", "attitude-step"),
        ]
    )
    assert [" ".join(line.split()) for line in lines] == [
        "fault ghost (false-star): 1000 e- asked for, 800 seen, +0.2423 mag, 0.5000 px off",
        "fault loss (drop): of the run's frames",
        "fault step (attitude-step): 0.0123 px off",
        "fault none (attitude-step): nothing was found",
    ]


FLASH = KINDS["flash"](name="flare", radec_deg=(1.0, 2.0), electrons=5.0, for_s=3.0)


@pytest.mark.parametrize(("fault", "since_s"), [(FLASH, 1.5), (GLOW, 0.0)])
def test_a_fault_is_looked_at_half_way_through_or_at_its_beginning_where_it_never_ends(
    monkeypatch, fault, since_s
):
    fields = fields_of(None)
    fields._rng = np.random.default_rng(1)
    fields._view = None
    fields._attitude = lambda fault: "attitude"
    shown = []
    fields._shot = lambda q, first_frame, effects: shown.append((q, first_frame, effects))
    fields._compared = lambda fault, plain, faulty: "seen"
    monkeypatch.setattr(faulty_fields, "FaultLayer", lambda view, now: now)
    assert fields._one(fault) == "seen"
    (plain, faulty) = shown
    assert plain[2] is None and plain[:2] == faulty[:2]
    ((now),) = faulty[2]
    assert (now.fault, now.since_ns) == (fault, round(since_s * 1e9))


def test_stars_of_a_wrong_attitude_are_off_by_their_median_distance():
    """Three that are found, by 0.5, 1 and 1.3 px in several directions, and one that is not."""
    fields = fields_of(None)
    truth = np.zeros(4, dtype=[("x_px", "f8"), ("y_px", "f8")])
    truth["x_px"] = [10.0, 20.0, 30.0, 40.0]
    geometry = SimpleNamespace(to_tracker=lambda x, y: (2 * x, y + 5))
    fields._twin = SimpleNamespace(assumed_geometry=geometry)
    found = SimpleNamespace(x_px=np.array([60.5, 20.3, 39.0]), y_px=np.array([6.2, 5.4, 5.0]))
    index = np.array([1, 2, 0, -1])
    fields._finder = SimpleNamespace(
        match=lambda image, x, y: SimpleNamespace(found=found, index=index)
    )
    shot = SimpleNamespace(frame=SimpleNamespace(rows=truth), shown_e=None)
    assert fields._stars_off_px(shot) == pytest.approx(1.0)
    index[:] = -1
    assert fields._stars_off_px(shot) is None
