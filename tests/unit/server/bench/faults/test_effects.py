"""What each fault does to a frame of the display: light, places, names in the truth table."""

from __future__ import annotations

import io
import warnings
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

import hilstar
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import angle_between_rad, from_radec_roll_deg, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, LIGHT_KM_S
from hilstar.optics.camera import Camera, Lens
from hilstar.optics.layers.fault_kinds import Now, fault_of
from hilstar.optics.layers.fault_light import KEPT_BURSTS, FaultView
from hilstar.optics.layers.faults import FaultLayer
from hilstar.optics.layers.star_layer import no_light
from hilstar.optics.layers.view import View
from hilstar.server.bench.fault_views import display_view
from hilstar.server.bench.scenario import Scenario
from tests.support.benches import ORION_Q, SMALL_BENCH, bench_text
from tests.support.refusals import refusal

# The linear image is float32 and a footprint cuts 1e-6 of a star (scene.psf.MAX_CUT).
LIGHT_SHARE = 2e-6
EXPOSURE_S = 0.1  # the bench's default
PX = 1e-4  # footprints' whole pixels and float32 fractions


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    path = tmp_path_factory.mktemp("faults") / "bench.toml"
    path.write_text(SMALL_BENCH)
    with hilstar.load(path) as opened:
        yield opened


@pytest.fixture(scope="module")
def calm(faulty):
    return faulty.frame(ORION_Q)


def frame_with_faults(faulty, *tables, since_ns=0, share=1.0, folder=None, **more):
    """The frame with faults, and a table's own rows of the truth."""
    faults = [fault_of({"name": f"fault {k}", **table}) for k, table in enumerate(tables)]
    scenario = (
        Scenario(folder or ".", "", 7, tuple(faults), folder) if folder else Scenario(".", "", 7)
    )
    view = display_view(faulty, scenario)
    now = [Now(k, view.prepare(fault), since_ns, share) for k, fault in enumerate(faults, start=1)]
    frame = faulty.frame(ORION_Q, faults=FaultLayer(view, tuple(now)), **more)
    return frame, frame.truth[np.char.startswith(frame.truth["name"], "fault")]


def total_light(frame):
    return frame.linear.sum(dtype=np.float64)


def test_a_false_star_lies_where_a_real_star_of_its_place_would(faulty, calm):
    star = calm.truth[calm.truth["hip"] == 26727][0]
    place = calm.star[calm.truth["hip"] == 26727][0]
    frame, rows = frame_with_faults(
        faulty,
        {"kind": "false-star", "icrs": faulty.stars.vectors[place].tolist(), "electrons": 5e4},
    )
    assert [(row["hip"], row["name"]) for row in rows] == [(0, "fault 0")]
    assert abs(rows["x_px"][0] - star["x_px"]) < PX and abs(rows["y_px"][0] - star["y_px"]) < PX
    assert rows["electrons_per_s"][0] == 5e4 / EXPOSURE_S
    # of 47e6 in float32
    assert total_light(frame) - total_light(calm) == pytest.approx(5e4 / EXPOSURE_S, rel=2e-4)


def test_a_false_star_is_aberrated_as_the_stars_are(tmp_path):
    """A direction moves towards the velocity by v / c; what is second order is 1e-5 px here."""
    velocity_km_s = np.array([12.0, -20.0, 17.0])
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({"sky": {"observer_velocity_km_s": velocity_km_s.tolist()}}))
    direction = np.array([0.12, 0.985, -0.03])
    direction /= np.linalg.norm(direction)
    with hilstar.load(path) as bench:
        table = {"kind": "false-star", "icrs": direction.tolist(), "electrons": 5e4}
        _, rows = frame_with_faults(bench, table)
        moved = direction + velocity_km_s / LIGHT_KM_S
        axes = bench.camera.cam_to_image @ to_matrix(np.array(ORION_Q))
        x_px, y_px = bench.camera.project((axes @ moved)[None])
    assert abs(rows["x_px"][0] - x_px) < PX and abs(rows["y_px"][0] - y_px) < PX


@pytest.mark.parametrize("key", ["tracker_px", "screen_px"])
def test_a_place_to_which_the_lens_sends_no_light_is_refused_by_its_key(faulty, key):
    """Both lenses have no direction farther than 100 px from the middle."""
    lens = Lens(max_tangent=0.1)
    camera = Camera((400, 400), 1000.0, (200.0, 200.0), np.eye(3), lens)
    own = display_view(faulty, Scenario(".", "", 7)).by
    view = FaultView(replace(own, tracker=camera, monitor=camera))
    table = {"kind": "false-star", "name": "ghost", "electrons": 5e4}
    assert view.prepare(fault_of({**table, key: [250.0, 200.0]}))
    line = refusal(view.prepare, fault_of({**table, key: [350.0, 200.0]}))
    assert line.startswith(
        f"{key} = [350.0, 200.0]: the lens has no direction there; write a place"
    )


def test_magnitude_and_electrons_are_one_light(faulty):
    _, rows = frame_with_faults(
        faulty, {"kind": "false-star", "screen_px": [50, 60], "v_mag": 3.0, "bv_mag": 1.1}
    )
    _, again = frame_with_faults(
        faulty,
        {
            "kind": "false-star",
            "screen_px": [50, 60],
            "electrons_per_s": float(rows["electrons_per_s"][0]),
            "bv_mag": 1.1,
        },
    )
    assert again["v_mag"][0] == pytest.approx(3.0, abs=1e-9)
    assert (rows["x_px"][0], rows["y_px"][0]) == (50, 60)


def test_a_false_star_of_the_detector_moves_at_its_rate(faulty):
    table = {
        "kind": "false-star",
        "tracker_px": [500, 520],
        "rate_px_s": [40, -20],
        "electrons": 1e4,
    }
    places = [
        frame_with_faults(faulty, table, since_ns=since_ns)[1][0] for since_ns in (0, 1_000_000_000)
    ]
    # 13 um behind 70 mm against 57.65 um behind 60 mm
    scale = (60 / 0.05765) / (70 / 0.013)
    assert places[1]["x_px"] - places[0]["x_px"] == pytest.approx(40 * scale, abs=1e-3)
    assert places[1]["y_px"] - places[0]["y_px"] == pytest.approx(-20 * scale, abs=1e-3)
    assert (places[0]["x_px"] - 159.5, places[0]["y_px"] - 119.5) == (
        pytest.approx((500 - 511.5) * scale, abs=1e-3),
        pytest.approx((520 - 511.5) * scale, abs=1e-3),
    )


def test_a_star_that_is_gone_is_in_neither_image_nor_truth(faulty, calm):
    row = calm.truth[calm.truth["hip"] == 26727][0]
    frame, _ = frame_with_faults(faulty, {"kind": "star-gone", "star": "Alnitak"})
    assert 26727 not in frame.truth["hip"] and len(frame.truth) == len(calm.truth) - 1
    assert total_light(calm) - total_light(frame) == pytest.approx(row["electrons_per_s"], rel=1e-5)
    half, _ = frame_with_faults(faulty, {"kind": "star-gone", "hip": 26727}, share=0.5)
    assert total_light(calm) - total_light(half) == pytest.approx(
        row["electrons_per_s"] / 2, rel=1e-5
    )


def test_a_flash_at_a_star_adds_to_its_light_at_its_place(faulty, calm):
    row = calm.truth[calm.truth["hip"] == 26727][0]
    _, rows = frame_with_faults(
        faulty, {"kind": "flash", "hip": 26727, "electrons": 1e5, "for_s": 0.2}
    )
    assert abs(rows["x_px"][0] - row["x_px"]) < PX and abs(rows["y_px"][0] - row["y_px"]) < PX


def test_tracks_have_their_electrons_in_each_exposure_and_are_the_seed_s(faulty, calm):
    table = {"kind": "cosmic-rays", "number": 12, "electrons": 4000, "length_px": 9}
    frame, rows = frame_with_faults(faulty, table)
    inside = (rows["x_px"] > 8) & (rows["x_px"] < 311) & (rows["y_px"] > 8) & (rows["y_px"] < 231)
    assert 0 < len(rows) <= 12 and inside.any()
    assert total_light(frame) - total_light(calm) <= 12 * 4000 / EXPOSURE_S * (1 + 1e-3)
    again, _ = frame_with_faults(faulty, table)
    later, other = frame_with_faults(faulty, table, since_ns=150_000_000)
    assert np.array_equal(frame.levels, again.levels)
    assert not np.array_equal(frame.linear, later.linear) and len(other)


def test_tracks_of_long_runs_take_so_much_memory(faulty):
    """A burst for hours is another one in each exposure."""
    view = display_view(faulty, Scenario(".", "", 7))
    table = {"kind": "cosmic-rays", "name": "rays", "number": 2, "electrons": 4000, "for_s": 1e6}
    fault = view.prepare(fault_of(table))
    for exposure in range(3 * KEPT_BURSTS):
        since_ns = round(exposure * EXPOSURE_S * 1e9)
        (chain,), lights = view.camera_points([Now(1, fault, since_ns)], None)
        assert (chain.lines, len(lights)) == (2, 2)
        assert len(view._tracks) <= KEPT_BURSTS


def test_a_line_of_light_is_one_of_several_sprites_and_so_is_each_of_another_fault(faulty):
    """Twelve tracks, a fifth of a detector long, and three more: a frame knows how many sprites
    one has, by which it counts its stars.
    """
    view = display_view(faulty, Scenario(".", "", 7))
    now = []
    for k, number in enumerate((12, 3)):
        table = {"kind": "cosmic-rays", "name": f"{k}", "number": number, "electrons": 4000}
        fault = view.prepare(fault_of(table | {"length_px": 200, "for_s": 1.0}))
        now.append(Now(k + 1, fault, 0))
    empty = no_light(faulty.canvas.psf.footprint_px)
    light = FaultLayer(view, tuple(now)).add(empty, faulty.stars, View(np.array(ORION_Q)))
    stars, counts = np.unique(light.star, return_counts=True)
    assert light.per_star == counts.max() > 5
    assert light.star_count == len(stars)
    names = {-1 - star: light.added[-1 - star].name for star in stars.tolist()}
    assert {k: name for k, name in names.items() if k < 12} == dict.fromkeys(
        [k for k in names if k < 12], "0"
    )
    assert {name for k, name in names.items() if k >= 12} == {"1"}


def test_a_star_is_looked_for_among_the_stars_that_are_shown(faulty):
    """Each time where a bench's arrays are others, though they lie at the same place in memory."""
    view = display_view(faulty, Scenario(".", "", 7))
    gone = [Now(1, fault_of({"kind": "star-gone", "name": "gone", "hip": 26727}), 0)]
    for k in range(20):
        others = replace(faulty.stars, hip=np.roll(faulty.stars.hip, k))
        wanted = int(np.flatnonzero(others.hip == 26727)[0])
        assert view.gone(gone, others) == [(wanted, 0.0)]
        del others


def test_a_gradient_has_its_light_in_a_tracker_pixel_at_the_bright_edge(faulty, calm):
    frame, _ = frame_with_faults(faulty, {"kind": "gradient", "electrons_per_s": 100.0})
    added = (frame.linear - calm.linear)[0]  # the first row has few stars
    # A monitor pixel collects the light of as many tracker pixels as it covers.
    covered = (0.05765 / 60 / (0.013 / 70)) ** 2
    x_tracker = 511.5 + (np.arange(320) - 159.5) * np.sqrt(covered)
    expected = 100 * np.maximum(0.5 + (x_tracker - 511.5) / 1024, 0) * covered
    assert np.median(np.abs(added - expected)) < 1e-3 * expected.max()


def test_a_glow_off_the_field_falls_off_with_the_angle_from_it(faulty, calm):
    frame, _ = frame_with_faults(
        faulty,
        {"kind": "glow", "tracker_px": [-700, 511.5], "electrons_per_s": 1000, "scale_deg": 2},
    )
    row = (frame.linear - calm.linear)[119]
    angle = np.arctan((511.5 + 700) * 0.013 / 70) - np.arctan(
        (159.5 - np.array([20, 300])) * 0.05765 / 60
    )
    covered = (0.05765 / 60 / (0.013 / 70)) ** 2
    expected = 1000 * covered / (1 + (np.degrees(angle) / 2) ** 2)
    assert row[[20, 300]] == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("ending", ["npy", "fits", "png"])
def test_a_measured_map_covers_the_detector(faulty, calm, tmp_path, ending):
    image = np.zeros((64, 64))
    image[20:40, 10:50] = 200
    path = tmp_path / f"stray.{ending}"
    write_image(path, image)
    frame, _ = frame_with_faults(
        faulty, {"kind": "light-map", "file": path.name, "electrons_per_s": 50}, folder=tmp_path
    )
    covered = (0.05765 / 60 / (0.013 / 70)) ** 2
    added = frame.linear - calm.linear
    # Tracker pixel (x, y) is 16 times the map's; rows 20 to 40 of 64 are tracker rows 320 to 640.
    assert np.median(added[110:125, 150:170]) == pytest.approx(50 * covered, rel=1e-3)
    assert np.median(added[:60]) == 0


def write_image(path, image):
    from astropy.io import fits
    from PIL import Image

    if path.suffix == ".npy":
        np.save(path, image)
    elif path.suffix == ".fits":
        fits.PrimaryHDU(image.astype(np.float32)).writeto(path)
    else:
        Image.fromarray(image.astype(np.uint8)).save(path)


def test_a_blank_field_has_no_light_and_a_step_turns_the_attitude(faulty):
    frame, _ = frame_with_faults(
        faulty, {"kind": "blank"}, {"kind": "false-star", "screen_px": [5, 5], "electrons": 1e5}
    )
    assert not frame.linear.any() and not frame.levels.any() and not len(frame.truth)
    stepped, _ = frame_with_faults(faulty, {"kind": "attitude-step", "turn_arcsec": [0, 90, 0]})
    turned = angle_between_rad(np.array(ORION_Q), stepped.q_icrs_to_cam) * ARCSEC_PER_RAD
    assert turned == pytest.approx(90, abs=1e-3)


def test_dropped_frames_are_the_seed_s(faulty):
    view = display_view(faulty, Scenario(".", "", 3))
    effects = FaultLayer(
        view, (Now(1, fault_of({"kind": "drop", "name": "loss", "share": 0.3}), 0),)
    )
    lost = [effects.drops(frame) for frame in range(500)]
    assert 0.22 < np.mean(lost) < 0.38  # 0.3, and 4 sigma of 500 draws
    assert lost == [
        FaultLayer(display_view(faulty, Scenario(".", "", 3)), effects.now).drops(frame)
        for frame in range(500)
    ]


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"kind": "star-gone", "hip": 999_999}, "hip = 999999: not among the"),
        ({"kind": "star-gone", "star": "Nibiru"}, 'star = "Nibiru": not among the'),
        ({"kind": "flash", "hip": 999_999, "v_mag": 1.0, "for_s": 0.2}, "hip = 999999: not among"),
        ({"kind": "light-map", "file": "nothing.fits"}, "a message names no files"),
    ],
)
def test_what_this_bench_cannot_draw_is_refused(faulty, table, said):
    with pytest.raises(InputError, match=said):
        frame_with_faults(faulty, table)


def cut_fits():
    whole = io.BytesIO()
    fits.PrimaryHDU(np.ones((40, 40), dtype=np.float32)).writeto(whole)
    return whole.getvalue()[:4000]  # of 11 520 bytes


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"not an image", "neither FITS, PNG nor npy"),
        (b"\x89PNG\r\n\x1a\nbroken", "cannot be read"),
        (b"\x93NUMPY\x01", "cannot be read"),
        (cut_fits(), "cannot be read"),
    ],
)
def test_a_map_that_is_no_image_is_refused(faulty, tmp_path, content, said):
    (tmp_path / "stray.fits").write_bytes(content)
    with warnings.catch_warnings(record=True) as told, pytest.raises(InputError, match=said):
        warnings.simplefilter("always")
        frame_with_faults(faulty, {"kind": "light-map", "file": "stray.fits"}, folder=tmp_path)
    assert not told  # of a cut file one line is printed, not Astropy's besides


def test_a_body_that_is_gone_has_neither_disc_nor_row(tmp_path):
    path = tmp_path / "moon.toml"
    path.write_text(
        bench_text({"sky": {"epoch_utc": "2026-11-21T00:00:00Z"}, "sky.bodies": {"moon": True}})
    )
    with hilstar.load(path) as faulty:
        x, y, z = faulty.seen(faulty.stars, faulty.view(ORION_Q, None, 0)).vectors[-1]
        q = from_radec_roll_deg(np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z)), 0.0)
        there = faulty.frame(q, t_ns=0)
        view = display_view(faulty)
        fault = view.prepare(fault_of({"kind": "star-gone", "name": "no Moon", "star": "Moon"}))
        gone = faulty.frame(q, t_ns=0, faults=FaultLayer(view, (Now(1, fault, 0),)))
    assert "Moon" in there.truth["name"] and "Moon" not in gone.truth["name"]
    assert gone.linear.max() < 1e-3 * there.linear.max()


def test_a_false_star_over_white_is_named_with_its_loss(faulty):
    view = display_view(faulty)
    fault = view.prepare(
        fault_of(
            {"kind": "false-star", "name": "nova", "screen_px": [40, 50], "electrons_per_s": 1e8}
        )
    )
    effects = FaultLayer(view, (Now(1, fault, 0),))
    frame = faulty.frame(ORION_Q, faults=effects)
    losses = faulty.losses_mag(frame, effects)
    # A hundred million electrons a second against white, in each pixel of its own.
    assert frame.truth["clipped"][frame.truth["name"] == "nova"].all()
    assert 0.5 < losses["nova"] < 10
