"""The Python API: what `hilstar.load` opens, and what a caller may give it."""

from __future__ import annotations

import pickle
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from scipy.spatial.transform import Rotation

import hilstar
from hilstar.api import OpenBench, _unit_of, _unit_quaternion
from hilstar.instruments.assess import assessment
from hilstar.rotation import from_radec_roll_deg
from hilstar.server.bench.frame import Bench
from hilstar.testing import compare
from tests.support.benches import bench_text
from tests.support.refusals import refusal

BELT = from_radec_roll_deg(84.057, -1.2, 30.0)
# Float64 angles and places in both: Astropy's own transformations agree to some 1e-10 rad.
SAME_Q = 1e-9
SAME_DEG = 1e-9
# Behind no lens a star is where the tangent plane has it, but for the rounding of the header.
SAME_PX = 1e-6
BAD_ATTITUDES = {
    "a string": "84,-1.2,0",
    "three angles": [84.0, -1.2, 0.0],
    "nothing": None,
    "a matrix": np.eye(4),
    "degrees": [1, 0, 0, 0] * u.deg,
    "two rotations": Rotation.from_quat(np.eye(4)[:2]),
    "two places": SkyCoord([1, 2], [3, 4], unit="deg"),
    "no observer": SkyCoord(alt=1, az=2, unit="deg", frame="altaz"),
    "a text within": [1, 0, 0, "a"],
    "no unit norm": [1, 1, 0, 0],
    "not a number": [np.nan, 0, 0, 0],
}
BAD_RATES = {
    "an angle": [0, 0, 1] * u.deg,
    "one number": 0.1,
    "a list of quantities": [1 * u.deg / u.s] * 3,
    "not finite": [0, 0, np.inf],
    "a string": "0,0,1",
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    path = tmp_path_factory.mktemp("api") / "bench.toml"
    path.write_text(bench_text())
    with hilstar.load(path) as opened:
        yield opened


def test_the_public_names_are_listed_and_there():
    listed = [name for name in dir(hilstar) if not name.startswith("_")]
    assert sorted(listed) == sorted(hilstar.__all__)
    for name in listed:
        assert getattr(hilstar, name).__doc__


def test_the_names_of_rotation_are_listed():
    assert sorted(dir(hilstar.rotation)) == sorted(hilstar.rotation.__all__)
    for name in dir(hilstar.rotation):
        assert callable(getattr(hilstar.rotation, name))


def test_an_attitude_is_a_quaternion_a_rotation_or_a_place_with_a_roll(bench):
    place = SkyCoord(84.057, -1.2, unit="deg")
    same = (
        bench.frame(BELT),
        bench.frame(Rotation.from_quat(np.roll(BELT, -1))),
        bench.frame(place, roll_deg=30),
        bench.frame(place.galactic, roll_deg=np.radians(30) * u.rad),
    )
    for frame in same[1:]:
        assert np.abs(frame.q_icrs_to_cam - same[0].q_icrs_to_cam).max() < SAME_Q


def test_a_rotation_turns_icrs_components_into_the_cameras(bench):
    rotation = Rotation.from_quat(np.roll(BELT, -1))
    boresight = rotation.apply(SkyCoord(84.057, -1.2, unit="deg").cartesian.xyz.value)
    assert boresight == pytest.approx([0, 0, 1], abs=SAME_Q)


@pytest.mark.parametrize("attitude", BAD_ATTITUDES.values(), ids=BAD_ATTITUDES)
def test_a_wrong_attitude_is_one_line(bench, attitude):
    for what in (bench.frame, bench.simulate):
        with pytest.raises(hilstar.InputError) as refused:
            what(attitude)
        assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize("rate", BAD_RATES.values(), ids=BAD_RATES)
def test_a_wrong_rate_is_one_line(bench, rate):
    with pytest.raises(hilstar.InputError, match="rate_cam_rad_s") as refused:
        bench.draw(BELT, 0, rate)
    assert len(str(refused.value).splitlines()) == 1


def test_a_roll_beside_a_quaternion_is_refused(bench):
    with pytest.raises(hilstar.InputError, match="roll_deg"):
        bench.frame(BELT, roll_deg=3.0)
    for roll_deg in (3.0, 0.0):
        with pytest.raises(hilstar.InputError, match="roll_deg"):
            bench.draw(None, roll_deg=roll_deg)


def test_quantities_are_numbers_in_their_units(bench):
    as_numbers = bench.simulate(BELT, [0, 0, np.radians(2.0)], noise="none")
    as_quantities = bench.simulate(BELT, [0, 0, 120] * u.arcmin / u.s, noise="none")
    assert (as_numbers.dn == as_quantities.dn).all()
    assert bench.frame(BELT, t_ns=2 * u.ms).t_ns == 2_000_000
    for wrong in (1.5, 2 * u.m, "0", True):
        with pytest.raises(hilstar.InputError, match="t_ns"):
            bench.frame(BELT, t_ns=wrong)


def test_the_same_seed_is_the_same_noise(bench):
    first, again, other = (bench.simulate(BELT, seed=seed).dn for seed in (1, 1, 2))
    assert (first == again).all()
    assert (first != other).any()


def test_tables_and_a_configuration_open_the_bench_of_their_file(bench):
    tables = tomllib.loads(bench.file.text)
    tables["tracker"]["resolution_px"] = np.array(tables["tracker"]["resolution_px"])
    with hilstar.load(tables) as of_tables, hilstar.load(bench.file.config) as of_config:
        assert of_tables.file.sha256 == bench.file.sha256
        assert of_config.file.config == bench.file.config
        assert compare(of_tables.frame(BELT), bench.frame(BELT)).same


def test_what_is_no_bench_is_one_line():
    for wrong in (5, None, ["bench.toml"], {"monitor": {"pixel_pitch_um": 57 * u.um}}, {}):
        with pytest.raises(hilstar.InputError) as refused:
            hilstar.load(wrong)
        assert len(str(refused.value).splitlines()) == 1


def test_what_a_bench_returns_is_one_line(bench):
    frame = bench.frame(BELT)
    dimmed = hilstar.compare(frame, frame.linear * 1.1)
    results = (bench.simulate(BELT), bench.verify(1), bench.budget(), dimmed)
    for found in (*results, hilstar.compare(frame, frame)):
        assert repr(found).startswith("<hilstar ")
        assert repr(found).endswith(">")
        assert len(repr(found)) < 120
        assert "\n" not in repr(found)
    assert "NOT the same sky" in repr(dimmed)


def test_a_frame_and_a_bench_are_one_line_and_a_picture(bench):
    frame = bench.frame(BELT)
    for shown, figures in ((frame, 5), (bench, 5)):
        assert len(repr(shown).splitlines()) == 1
        assert len(repr(shown)) < 160
        assert shown._repr_html_().count("<tr>") == figures
    assert str(len(frame.truth)) in repr(frame)
    assert "data:image/png;base64," in frame._repr_html_()
    # the outlines of both fields lie about the middle
    outlines = re.findall(
        r'<rect x="(\S+)" y="(\S+)" width="(\S+)" height="(\S+)"', bench._repr_html_()
    )
    assert len(outlines) == 2
    for outline in outlines:
        x, y, width, height = map(float, outline)
        assert (-2 * x, -2 * y) == pytest.approx((width, height), rel=1e-5)


def test_an_assessment_s_latency_is_in_seconds_or_any_unit_of_time(monkeypatch):
    asked = []
    monkeypatch.setattr(assessment, "assess_files", lambda *given: asked.append(given))
    for latency_s in (-0.0025, -2.5 * u.ms):
        hilstar.assess("run.mcap", stamp="end", latency_s=latency_s, display_attitudes=3)
    (first, again) = asked
    assert first == (Path("run.mcap"), None, assessment.AssessSettings("end", -0.0025, 3))
    assert again[2].latency_s == pytest.approx(-0.0025)


def test_a_frame_is_its_linear_image(bench):
    frame = bench.frame(BELT)
    assert np.shares_memory(np.asarray(frame), frame.linear)
    assert np.asarray(frame, dtype=np.float64).dtype == np.float64
    assert np.shares_memory(frame.__array__(copy=False), frame.linear)
    assert not np.shares_memory(np.array(frame), frame.linear)
    with pytest.raises(ValueError, match="a float32 image as float64 is a copy"):
        frame.__array__(np.float64, copy=False)
    copied = np.array(frame)
    copied[:] = 0
    assert frame.linear.any()


def test_a_table_has_units_and_places_that_the_image_has(bench):
    frame = bench.frame(BELT)
    table = frame.to_table()
    assert len(table) == len(frame.truth)
    assert table["electrons_per_s"].unit == u.electron / u.s
    assert table["sigma_pos_mas"].unit == u.mas
    x_px, y_px = frame.wcs.world_to_pixel(SkyCoord(table["ra_deg"], table["dec_deg"]))
    assert x_px == pytest.approx(frame.truth["x_px"], abs=SAME_PX)
    assert y_px == pytest.approx(frame.truth["y_px"], abs=SAME_PX)
    height, width = frame.linear.shape
    assert frame.wcs.pixel_shape == (width, height) and width != height


def test_an_angle_that_rounds_to_a_whole_turn_is_said_as_none(bench):
    frame = bench.frame(from_radec_roll_deg(359.9998, 12.0, 359.9997))
    assert "at RA 0.000, Dec 12.000, roll 0.000 deg" in repr(frame)


def test_an_exposures_stars_have_their_places_too(bench):
    frame, exposure = bench.frame(BELT), bench.simulate(BELT)
    places = {row["hip"]: (row["ra_deg"], row["dec_deg"]) for row in frame.truth}
    shared = [row for row in exposure.truth if row["hip"] in places]
    assert shared
    for row in shared:
        assert (row["ra_deg"], row["dec_deg"]) == pytest.approx(places[row["hip"]], abs=SAME_DEG)


def test_a_frame_is_saved_by_the_ending(bench, tmp_path):
    frame = bench.frame(BELT)
    paths = [frame.save(tmp_path / name) for name in ("a.fits", "a.fits.gz", "a.csv", "a.png")]
    with fits.open(paths[0]) as image:
        assert (image[0].data == frame.linear).all()
    assert compare(frame, paths[1], truth=paths[2]).same
    assert paths[3].read_bytes().startswith(b"\x89PNG")
    with pytest.raises(hilstar.InputError, match=r"\.fits"):
        frame.save(tmp_path / "a.jpg")


def test_a_sender_takes_what_a_bench_takes():
    with hilstar.Sender("udp://127.0.0.1:5569") as sender:
        sender.send(Rotation.identity(), [0, 0, 1] * u.deg / u.s, t_ns=1 * u.s)
        for wrong in ({"q_icrs_to_cam": [84, -1.2, 0]}, {"q_icrs_to_cam": BELT, "t_ns": 1.5}):
            with pytest.raises(hilstar.InputError):
                sender.send(**wrong)


def test_a_drawn_frame_is_one_line_and_can_be_pickled(bench):
    drawn = bench.draw(BELT)
    moving = bench.draw(BELT, rate_cam_rad_s=np.radians([0.0, 2.0, 0.0]))
    assert repr(moving).endswith("clipped, drawn along a turn of 2 deg/s>")
    assert repr(bench.draw(None)) == "<hilstar drawn frame: blank>"
    drawn = bench.draw(BELT)
    again = pickle.loads(pickle.dumps(drawn))
    assert repr(again) == repr(drawn)
    assert repr(drawn) == f"<hilstar drawn frame: {drawn.star_count} stars, 2 clipped>"
    assert len(drawn.clipped_hip) == 2
    levels = drawn.levels.copy()
    bench.draw(None)
    assert np.array_equal(again.levels, levels) and levels.any()
    assert again.clipped_hip == drawn.clipped_hip


def test_a_frame_can_be_pickled_without_its_bench(bench):
    frame = bench.frame(BELT)
    again = pickle.loads(pickle.dumps(frame))
    assert np.array_equal(again.codes, frame.codes)
    assert again.truth.tobytes() == frame.truth.tobytes()
    assert repr(again) == repr(frame)
    with pytest.raises(hilstar.InputError, match="was pickled"):
        again.to_table()


@pytest.mark.parametrize(
    ("column", "unit"),
    [
        ("electrons_r_per_s", "electron / s"),
        ("shift_arcsec", "arcsec"),
        ("v_mag", "mag"),
        ("parallax_mas", "mas"),
        ("ra_deg", "deg"),
        ("x_px", "pix"),
        ("period_d", "day"),
        ("temperature_k", "K"),
        ("hip", None),
    ],
)
def test_a_column_s_unit_is_that_of_its_longest_end(column, unit):
    assert _unit_of(column) == unit


@pytest.mark.parametrize(("off", "is_kept"), [(0.0, True), (9e-7, True), (2e-6, False)])
def test_a_quaternion_of_seven_digits_is_drawn_as_it_was_written(off, is_kept):
    q = np.array([1.0 + off, 0.0, 0.0, 0.0])
    drawn = _unit_quaternion(q)
    assert (drawn is q) is is_kept
    assert abs(np.linalg.norm(drawn) - 1) <= (1e-6 if is_kept else 1e-15)


def test_a_closed_bench_draws_no_more(monkeypatch):
    bench = object.__new__(OpenBench)
    monkeypatch.setattr(Bench, "close", lambda self: None)
    bench._refuse_closed("frame")
    bench.close()
    for what in ("frame", "draw", "simulate", "budget"):
        assert "closed" in refusal(bench._refuse_closed, what)
