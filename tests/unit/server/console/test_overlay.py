"""What is drawn over a picture lies where the picture's own stars are, and lines of the grid are
where their labels say.
"""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.server.console.overlay import CameraMarks, catalogue_sky, overlay_of
from hilstar.sky.catalog import load_catalog
from tests.support.benches import ORION_Q

ROUNDED_PX = 0.006  # places are sent with two decimals
# Lines of the grid have one: a step of 0.05 px under the small bench's 200 arcsec/px.
LINE_DEG = 0.05 * 200 / 3600 * 1.5

pytestmark = pytest.mark.gpu


@pytest.fixture
def overlay_bench(bench_with):
    return bench_with()


def test_truth_has_the_stars_of_the_frame_at_their_places(overlay_bench):
    frame = overlay_bench.frame(ORION_Q)
    told = msgspec.to_builtins(overlay_of(overlay_bench).truth(0, np.array(ORION_Q), (26311,)))[
        "stars"
    ]
    drawn = frame.truth[frame.truth["drawn"]]
    places = {int(row["hip"]): (row["x_px"], row["y_px"]) for row in drawn}
    inside = {
        hip for hip, (x, y) in places.items() if abs(x - 159.5) < 159 and abs(y - 119.5) < 119
    }
    assert inside <= {star[3] for star in told} <= set(places)
    for x, y, v_mag, hip, label, clipped, _ in told:
        assert places[hip] == pytest.approx((x, y), abs=ROUNDED_PX)
        assert label == {26311: "ε Ori", 25930: "δ Ori", 26727: "ζ Ori"}.get(hip, label)
        assert clipped == (hip == 26311)
        assert v_mag >= told[0][2]
    assert told[0][4] == "ε Ori"


def test_the_tracker_s_field_is_as_wide_as_its_focal_length_makes_it(overlay_bench):
    """1024 pixels of 13 um at 70 mm, on a screen with 57.65 um at 60 mm: 1024 * 13 / 70 * 60 /
    57.65 px.
    """
    outline = np.array(overlay_of(overlay_bench).truth(0, np.array(ORION_Q)).tracker_px)
    wanted_px = 1024 * 13 / 70 * 60 / 57.65
    assert np.ptp(outline, axis=0) == pytest.approx([wanted_px, wanted_px], abs=2 * ROUNDED_PX)
    assert (outline.min(axis=0) + outline.max(axis=0)) / 2 == pytest.approx(
        [159.5, 119.5], abs=ROUNDED_PX
    )


@pytest.mark.parametrize(
    ("ra_deg", "dec_deg", "roll_deg"),
    [(84.057, -1.2, 0.0), (0.1, 60.0, 40.0), (200.0, 89.5, 10.0), (359.9, -90.0, 5.0)],
)
def test_each_line_of_the_grid_is_where_its_label_says(overlay_bench, ra_deg, dec_deg, roll_deg):
    q = from_radec_roll_deg(ra_deg, dec_deg, roll_deg)
    lines = msgspec.to_builtins(overlay_of(overlay_bench).truth(0, q))["grid"]
    kinds = {line["label"].split()[0] for line in lines}
    assert kinds == {"RA", "Dec"} and 6 <= len(lines) <= 80
    for line in lines:
        kind, text = line["label"].replace("\N{MINUS SIGN}", "-").rstrip("\N{DEGREE SIGN}").split()
        x, y, z = (overlay_bench.camera.rays(*np.array(line["px"]).T) @ to_matrix(q)).T
        if kind == "Dec":
            off_deg = np.degrees(np.arctan2(z, np.hypot(x, y))) - float(text)
        else:
            off_deg = (np.degrees(np.arctan2(y, x)) - float(text) + 180) % 360 - 180
            from_pole_deg = np.degrees(np.hypot(x, y) / np.sqrt(x * x + y * y + z * z))
            # At right angles to the meridian; on the pole itself every right ascension is right.
            off_deg = (
                np.where(np.abs(off_deg) < 90, np.sin(np.radians(off_deg)), 1.0) * from_pole_deg
            )
        assert np.abs(off_deg).max() < LINE_DEG
        assert "-" not in line["label"]  # a minus sign


@pytest.mark.parametrize(("f_mm", "digits"), [(100.0, 0), (1600.0, 1), (8000.0, 2)])
def test_a_grid_s_labels_have_as_many_digits_as_its_step(f_mm, digits):
    """A screen of 400 x 300 pixels of 50 um has steps of 2, 0.1 and 0.02 deg there."""
    q = np.array([1.0, 0.0, 0.0, 0.0])
    camera = monitor_camera((400, 300), 50.0, f_mm, q, None)
    q = from_radec_roll_deg(40.0, 20.0, 0.0)
    lines = CameraMarks(camera, camera).truth(0, [], q, grid=True).grid
    labels = [line.label.rstrip("\N{DEGREE SIGN}") for line in lines]
    assert {len(label.partition(".")[2]) for label in labels} == {digits}
    assert len(set(labels)) == len(labels)


@pytest.mark.parametrize("dec_deg", [-87.0, 87.0])
def test_a_grid_with_a_pole_in_it_has_right_ascensions_all_around(overlay_bench, dec_deg):
    lines = overlay_of(overlay_bench).truth(0, from_radec_roll_deg(40.0, dec_deg, 0.0)).grid
    every = "".join(line.label for line in lines)
    assert ("\N{MINUS SIGN}" in every) == (dec_deg < 0) and "-" not in every
    labels = {line.label for line in lines if line.label.startswith("RA")}
    assert labels == {f"RA {ra}\N{DEGREE SIGN}" for ra in range(0, 360, 30)}


def test_the_sky_has_the_brightest_star_first_and_the_screen_s_corners(overlay_bench):
    told = msgspec.to_builtins(overlay_of(overlay_bench).sky())
    assert told["stars"][0][2:] == [-1.44, "α CMa"]  # Hipparcos' V of Sirius
    assert len(told["stars"]) == np.sum(load_catalog().v_mag < 5.5) > 2500
    assert [star[2] for star in told["stars"]] == sorted(star[2] for star in told["stars"])
    labels = [star[3] for star in told["stars"]]
    assert "" in labels and not any(label.startswith("HIP") for label in labels)
    corners = np.array(told["screen_cam"])
    half = np.arctan(np.hypot(160, 120) * 57.65e-6 / 60e-3)
    assert np.arccos(corners[:, 2]) == pytest.approx(half, abs=1e-5)
    # without a bench the map is the same but for proper motions since 1991.25, and has no screen
    bare = msgspec.to_builtins(catalogue_sky())
    assert [star[2] for star in bare["stars"]] == [star[2] for star in told["stars"]]
    assert bare["stars"][0][3] == "α CMa" and {star[3] for star in bare["stars"]} <= set(labels)


def test_bodies_are_on_the_map_apart_from_stars(bench_with):
    """Sun, Moon and planets, each by its name; none of them is a star of it."""
    keys = '[sky]\nepoch_utc = "2026-11-29T00:00:00Z"\n[sky.bodies]\nmoon = true\nplanets = true\n'
    told = overlay_of(bench_with(keys)).sky()
    names = [place.label for place in told.moving]
    assert {"Moon", "Venus", "Mars", "Jupiter", "Saturn"} <= set(names)
    assert names[:2] == ["Moon", "Venus"]  # the brightest first
    assert not {place.label for place in told.stars} & set(names)


def test_a_frame_s_marks_are_its_brightest_stars_and_bodies_are_clipped_by_name(
    bench_with, monkeypatch
):
    keys = '[sky]\nepoch_utc = "2026-11-29T00:00:00Z"\n[sky.bodies]\nplanets = true\n'
    overlay = overlay_of(bench_with(keys))
    venus = next(place for place in overlay.sky().moving if place.label == "Venus")
    q = from_radec_roll_deg(venus.ra_deg, venus.dec_deg, 0.0)
    all_marks = overlay.truth(0, q, ("Venus",)).stars
    assert [mark.label for mark in all_marks if mark.clipped] == ["Venus"]
    monkeypatch.setattr("hilstar.server.console.overlay.MAX_STARS", 7)
    assert overlay.truth(0, q, ("Venus",)).stars == all_marks[:7] != all_marks
    assert [mark.v_mag for mark in all_marks] == sorted(mark.v_mag for mark in all_marks)


def test_a_place_is_on_the_screen_up_to_its_pixels_edges_and_a_share_of_its_size():
    """Of 400 x 300 px: -0.5 to 399.5 and -0.5 to 299.5; a tenth beyond that is 40 and 30 px."""
    camera = monitor_camera((400, 300), 50.0, 100.0, np.array([1.0, 0.0, 0.0, 0.0]), None)
    marks = CameraMarks(camera, camera)
    for beyond, left, right, top, bottom in (
        (0.0, -0.5, 399.5, -0.5, 299.5),
        (0.1, -40.5, 439.5, -30.5, 329.5),
    ):
        for out_px, wanted in ((-0.01, True), (0.01, False)):
            x_px = np.array([left - out_px, right + out_px, 200.0, 200.0, 200.0])
            y_px = np.array([100.0, 100.0, top - out_px, bottom + out_px, 100.0])
            on_screen = marks.on_screen(x_px, y_px, beyond)
            assert on_screen.tolist() == [wanted] * 4 + [True]
    nowhere = np.array([np.nan])
    assert not marks.on_screen(nowhere, np.zeros(1), 9.0)[0]


def test_a_grid_has_every_meridian_of_the_image_and_its_lines_cross_the_edges():
    """At 60 deg of declination meridians are twice as close: 14 deg of sky span 30 of them."""
    camera = monitor_camera((400, 300), 50.0, 100.0, np.array([1.0, 0.0, 0.0, 0.0]), None)
    q = from_radec_roll_deg(40.0, 60.0, 0.0)
    lines = CameraMarks(camera, camera).truth(0, [], q, grid=True).grid
    along = np.linspace(-0.5, 399.5, 50)
    x, y, _ = (camera.rays(along, np.full(50, -0.5)) @ to_matrix(q)).T
    ra_deg = np.degrees(np.arctan2(y, x)) % 360
    shown = [line for line in lines if line.label.startswith("RA")]
    labels = sorted(int(line.label[3:].rstrip("\N{DEGREE SIGN}")) for line in shown)
    step_deg = labels[1] - labels[0]
    inside = range(0, 360, step_deg)
    assert {ra for ra in inside if ra_deg.min() < ra < ra_deg.max()} <= set(labels)
    for line in shown:
        ends_px = np.array([line.px[0], line.px[-1]])
        assert not CameraMarks(camera, camera).on_screen(*ends_px.T, 0.1).any()
