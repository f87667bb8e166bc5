"""Two skies compared star by star: right drivers pass, and each planted fault is named, and
nothing else.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

import hilstar
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.display.render.reference import linear_image
from hilstar.instruments.compare import MAX_LINES, assert_same_sky, compare
from hilstar.instruments.compare.compare_skies import (
    compare_skies,
    read_frame_fits,
    read_truth_csv,
)
from hilstar.instruments.compare.report import ChartPanel
from hilstar.instruments.compare.sky_comparison import CENTROID_PX, FLUX_MAG, Limits
from hilstar.instruments.compare.star_fit import star_psf
from hilstar.optics.layers.truth import TRUTH_DTYPE
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import pack_sprites
from hilstar.server.bench.frame_files import write_frame_fits, write_truth_csv
from tests.support.benches import SMALL_BENCH
from tests.support.refusals import assert_file_refused

ORION = from_radec_roll_deg(84.057, -1.2, 0.0)
FAULT_MAG, FAULT_PX = 0.01, 0.02  # the smallest that must be seen
# What the comparison itself is off by, of a fault that it measures: what is second order in the
# shift is under 1e-5, and the light of the GL image is float32, 2e-6 mag and px at the worst (the
# drivers' test below).
MEASURED_MAG = MEASURED_PX = 1e-4
# Two drivers: 2e-6 mag and 1.4e-6 px on all but stars cut by the edge or with a 100 times brighter
# neighbour. 20 times that.
DRIVER_MAG = DRIVER_PX = 4e-5
DRIVER_SHARE = 0.98  # of stars; the others within their own limits
EDGE_PX = 6.0


class Field:
    """A frame of a real bench whose stars can be changed one by one, drawn again by the same GL."""

    def __init__(self, bench, q=ORION):
        self.bench = bench
        self.golden = bench.frame(q)
        self.sprites = bench.sprites(self.golden.q_icrs_to_cam, bench.stars)
        self.hip = bench.stars.hip[self.sprites.star]
        self.x_px, self.y_px = self.sprites.x_px.copy(), self.sprites.y_px.copy()
        self.flux = self.sprites.data["electrons_per_s"].astype(float)

    def inside(self):
        """The stars away from the edge and from each other, faintest first."""
        x, y = self.x_px, self.y_px
        width, height = self.bench.camera.resolution_px
        kept = (np.minimum(x, y) > EDGE_PX) & (x < width - 1 - EDGE_PX) & (y < height - 1 - EDGE_PX)
        near = np.hypot(x[:, None] - x, y[:, None] - y) < 2 * EDGE_PX
        order = np.argsort(self.flux)
        return [k for k in order if kept[k] and near[k].sum() == 1]

    def frame(self):
        size_px = self.bench.camera.resolution_px
        sprites = pack_sprites(
            self.x_px, self.y_px, self.flux, self.sprites.star, size_px, self.sprites.footprint_px
        )
        self.bench.renderer.draw(sprites)
        return replace(self.golden, light=self.bench.renderer.linear()[np.newaxis].copy())

    def bad(self):
        return compare(self.frame(), self.golden).bad


SKIES = {
    "default": "",
    "faint stars": "[sky]\nfaintest_v_mag = 9.5\n",
    "wide": "[render]\nsprite_sigma_px = [1.6, 0.6]\n",
}


@pytest.fixture(scope="module")
def benches(tmp_path_factory):
    """The benches of SKIES, each loaded once: no test changes one, and a Field has frames of its
    own.
    """
    folder, opened = tmp_path_factory.mktemp("skies"), {}
    for name, more in SKIES.items():
        (folder / f"{name}.toml").write_text(SMALL_BENCH + more)
        opened[name] = hilstar.load(folder / f"{name}.toml")
    yield opened
    for bench in opened.values():
        assert bench.renderer.gl_error() == "GL_NO_ERROR"
        bench.close()


@pytest.fixture
def scene(benches):
    return Field(benches["default"])


def test_an_unchanged_frame_is_the_same_sky(scene):
    comparison = assert_same_sky(scene.frame(), scene.golden)
    summary = comparison.summary()
    assert summary["same"] and summary["missing"] == summary["extra"] == 0
    assert summary["flux_error_mag"]["max"] == summary["centroid_error_px"]["max"] == 0
    blended = sum(len(star.hip) - 1 for star in comparison.stars)
    assert summary["stars"] + blended + summary["unmeasured"] == len(scene.golden.truth)


PLACES = {
    "belt": (84.057, -1.2),
    "Sirius": (101.29, -16.7),
    "Milky Way": (266.0, -29.0),  # 680 faint stars in 320 x 240
}
DRAWN = [("default", "belt"), ("default", "Sirius")]
DRAWN += [("faint stars", "Milky Way"), ("wide", "Milky Way")]


@pytest.mark.parametrize(("sky", "place"), DRAWN)
def test_another_driver_s_rounding_passes(benches, sky, place):
    """GL's float32 against the oracle's float64."""
    bench = benches[sky]
    scene = Field(bench, from_radec_roll_deg(*PLACES[place], 0.0))
    oracle = linear_image(scene.sprites, bench.camera.resolution_px, bench.psf)
    for one, other in (
        (scene.golden, oracle),
        (oracle, scene.golden),
        (scene.golden.linear, oracle),
    ):
        stars = assert_same_sky(one, other).stars
        assert np.mean([abs(star.flux_error_mag) < DRIVER_MAG for star in stars]) > DRIVER_SHARE
        assert np.mean([star.centroid_error_px < DRIVER_PX for star in stars]) > DRIVER_SHARE
    assert min(FLUX_MAG, CENTROID_PX) > 20 * max(DRIVER_MAG, DRIVER_PX)
    assert FAULT_MAG >= 10 * FLUX_MAG and FAULT_PX >= 10 * CENTROID_PX


@pytest.mark.parametrize("which", [0, 1, -1], ids=["faintest", "second faintest", "brightest"])
def test_one_star_shifted_by_a_fiftieth_of_a_pixel_is_named(scene, which):
    k = scene.inside()[which]
    scene.x_px[k] += 0.6 * FAULT_PX
    scene.y_px[k] -= 0.8 * FAULT_PX
    (star,) = scene.bad()
    assert star.kind == "changed" and star.hip == (scene.hip[k],)
    assert (star.dx_px, star.dy_px) == pytest.approx(
        (0.6 * FAULT_PX, -0.8 * FAULT_PX), abs=MEASURED_PX
    )
    assert star.flux_error_mag == pytest.approx(0, abs=MEASURED_MAG)


@pytest.mark.parametrize("which", [0, -1], ids=["faintest", "brightest"])
def test_one_star_dimmed_by_a_hundredth_of_a_magnitude_is_named(scene, which):
    k = scene.inside()[which]
    scene.flux[k] *= 10 ** (-0.4 * FAULT_MAG)
    (star,) = scene.bad()
    assert star.kind == "changed" and star.hip == (scene.hip[k],)
    assert star.flux_error_mag == pytest.approx(FAULT_MAG, abs=MEASURED_MAG)
    assert star.centroid_error_px == pytest.approx(0, abs=MEASURED_PX)


def test_a_star_gone_a_star_too_many_and_a_star_moved_are_told_apart(scene):
    gone, moved, far = scene.inside()[:3]
    scene.flux[gone] = 0
    scene.x_px[moved] += 1.5
    scene.y_px[far] += 9
    frame = scene.frame()
    with pytest.raises(AssertionError) as failure:
        assert_same_sky(frame, scene.golden)
    lines = str(failure.value).splitlines()
    assert "Not the same sky" in lines[0] and "1 changed, 2 missing, 1 extra" in lines[0]
    assert len(lines) == 5
    for k in (gone, far):
        assert any(
            line.startswith(f"HIP {scene.hip[k]} at") and "missing" in line for line in lines[1:]
        )
    assert f"star at ({scene.x_px[far]:.1f}, {scene.y_px[far]:.1f}): extra" in str(failure.value)
    assert (
        f"HIP {scene.hip[moved]} at" in lines[4] and "1.5000 px (+1.5000, +0.0000) off" in lines[4]
    )


def test_the_frame_s_own_table_names_a_star_that_the_golden_frame_lacks(scene):
    k = scene.inside()[5]
    frame = scene.frame()
    scene.flux[k] = 0
    golden = scene.frame()
    (star,) = compare(frame, golden.linear).bad
    assert star.kind == "extra" and star.hip == (scene.hip[k],)
    assert star.flux_e_per_s == pytest.approx(
        frame.truth["electrons_per_s"][frame.truth["hip"] == scene.hip[k]][0], rel=1e-3
    )


def test_an_image_that_is_shifted_as_a_whole_is_said_to_be_and_only_who_differs_is_named(scene):
    """Also by more than any star is wide, where every star is missing from its place and extra
    in another.
    """
    odd = scene.inside()[-1]
    for right, down in ((-0.75, 0.0), (0.31, -0.02), (11.3, -4.6)):
        scene.x_px, scene.y_px = scene.x_px + right, scene.y_px + down
        scene.flux[odd] *= 0.9
        found = compare(scene.frame(), scene.golden)
        scene.x_px, scene.y_px = scene.x_px - right, scene.y_px - down
        scene.flux[odd] /= 0.9
        assert found.common is not None and not found.same
        assert found.common.shift_px == pytest.approx((right, down), abs=MEASURED_PX)
        assert (found.common.rotation_deg, found.common.scale_error, found.common.flux_mag) == (
            0,
            0,
            0,
        )
        (named,) = [star for star in found.differing if star.hip == (int(scene.hip[odd]),)]
        assert named.flux_error_mag == pytest.approx(2.5 * np.log10(1 / 0.9), abs=MEASURED_MAG)
        # Stars that share their light with a neighbour may be one star there and two here; in this
        # dense field a star that moves by many widths may come to lie on another one's old place,
        # too.
        assert len(found.differing) <= (0.05 if abs(right) < 1 else 0.3) * len(found.stars)
        assert found.common.line().startswith(f"all shifted by ({right:.2f}, {down:.2f}) px; ")


def test_a_turn_a_scale_and_a_dimming_of_all_are_told_apart(scene):
    width, height = scene.bench.camera.resolution_px
    x, y = scene.x_px - (width - 1) / 2, scene.y_px - (height - 1) / 2
    turn, scale = np.radians(0.05), 1.0005
    scene.x_px += scale * (x * np.cos(turn) - y * np.sin(turn)) - x
    scene.y_px += scale * (x * np.sin(turn) + y * np.cos(turn)) - y
    scene.flux *= 10 ** (-0.4 * 0.1)
    common = compare(scene.frame(), scene.golden).common
    assert common is not None
    assert common.shift_px == (0.0, 0.0)
    assert common.rotation_deg == pytest.approx(0.05, abs=1e-4)
    assert common.scale_error == pytest.approx(5e-4, abs=2e-6)
    assert common.flux_mag == pytest.approx(0.1, abs=MEASURED_MAG)
    assert "turned by +0.0500 deg" in common.line() and "dimmer by 0.10 mag" in common.line()


def test_the_legend_counts_what_the_terminal_counts(scene):
    # Shifted as a whole, stars leave the image and come into it: they are common, and missing or
    # extra all the same.
    scene.x_px += 3.0
    found = compare(scene.frame(), scene.golden)
    assert found.common is not None
    assert found.summary()["missing"] > 0
    panel = ChartPanel(found, "mag")
    for kind in ("missing", "extra"):
        drawn = len(panel.of(kind))
        assert panel.label(kind, drawn).startswith(f"{kind}: {found.summary()[kind]}")
    assert len(panel.of("missing")) < found.summary()["missing"]


def test_what_a_few_stars_do_is_not_common(scene):
    for k in scene.inside()[-3:]:
        scene.x_px[k] += 0.5
        scene.flux[k] *= 0.8
    found = compare(scene.frame(), scene.golden)
    assert found.common is None
    assert len(found.differing) == len(found.bad) == 3
    other = scene.bench.frame(from_radec_roll_deg(280, 35, 20))
    assert compare(other, scene.golden).common is None
    assert compare(scene.golden, scene.golden).common is None


def test_of_another_sky_twenty_stars_are_told_and_the_rest_counted(scene):
    other = scene.bench.frame(from_radec_roll_deg(280, 35, 20))
    with pytest.raises(AssertionError) as failure:
        assert_same_sky(other, scene.golden.linear)
    assert len(str(failure.value).splitlines()) == 1 + MAX_LINES + 1
    assert str(failure.value).splitlines()[-1].startswith("and ")


def grid(x_px, y_px, flux, sigma_px=(0.85, 0.85), size_px=(160, 120)):
    x_px, y_px, flux = (np.asarray(values, dtype=float) for values in (x_px, y_px, flux))
    sprites = pack_sprites(
        x_px, y_px, flux, np.arange(len(flux)), size_px, GaussianPsf(sigma_px).footprint_px
    )
    return linear_image(sprites, size_px, GaussianPsf(sigma_px)).astype(np.float32)


@pytest.mark.parametrize("apart_px", [2.6, 4.0])
@pytest.mark.parametrize("ratio", [1.0, 0.01])
def test_of_a_pair_only_the_star_that_changed_is_named(apart_px, ratio):
    """The other's light in its window is no fault of the neighbour, 100 times fainter as that
    one may be.
    """
    x, y = (
        np.array([60.2, 60.2 + apart_px, 120.4, 20.1, 130.3]),
        np.array([50.3, 50.1, 90.2, 99.7, 20.5]),
    )
    flux = np.array([1e6, 1e6 * ratio, 3e5, 3e5, 3e5])
    golden, truth = grid(x, y, flux), np.zeros(5, dtype=TRUTH_DTYPE)
    for name, values in zip(
        ("hip", "x_px", "y_px", "electrons_per_s"), (np.arange(1, 6), x, y, flux), strict=True
    ):
        truth[name] = values
    for k in (0, 1):
        changed = np.arange(5) == k
        for frame, error in (
            (grid(x + FAULT_PX * changed, y, flux), (0, FAULT_PX)),
            (grid(x, y, flux * 10 ** (-0.4 * FAULT_MAG * changed)), (FAULT_MAG, 0)),
        ):
            (star,) = compare(frame, golden, truth=truth).bad
            assert star.hip == (k + 1,)
            assert (star.flux_error_mag, star.dx_px) == pytest.approx(error, abs=MEASURED_PX)
            # Without a table a star that outshines its neighbour hides it; what that one does is
            # still seen, and where.
            bad = compare(frame, golden).bad
            assert bad and all(
                abs(star.x_px - x[k]) < 2 and abs(star.y_px - y[k]) < 2 for star in bad
            )


def test_names_are_of_the_image_s_own_table_and_those_of_a_blend_brightest_first():
    """A star of 3e5 e-/s goes and one of 4e5 comes; the brighter of two that are one stands below
    the other in the table.
    """
    kind = ("hip", "x_px", "y_px", "electrons_per_s")
    fainter, brighter = (7, 20.3, 30.2, 1e5), (8, 20.6, 30.4, 1e6)
    lost, brought = (9, 60.1, 50.0, 3e5), (11, 90.2, 20.1, 4e5)
    tables, images = [], []
    for stars in ((fainter, brighter, lost), (fainter, brighter, brought)):
        table = np.zeros(len(stars), dtype=TRUTH_DTYPE)
        for name, values in zip(kind, zip(*stars, strict=True), strict=True):
            table[name] = values
        tables.append(table)
        images.append(grid(table["x_px"], table["y_px"], table["electrons_per_s"]))
    (truth, frame_truth), (golden, frame) = tables, images
    found = compare_skies(frame, golden, Limits(), truth, frame_truth)
    names = {star.kind: star.hip for star in found.stars}
    assert names == {"same": (8, 7), "missing": (9,), "extra": (11,)}


def test_a_blend_is_one_star_with_both_names(scene):
    """Two stars within a pixel: the fault of one is the blend's, by its share of the light."""
    k, other = scene.inside()[:2]
    scene.x_px[other], scene.y_px[other] = scene.x_px[k] + 0.4, scene.y_px[k] - 0.3
    golden = scene.frame()
    golden.truth["x_px"][golden.truth["hip"] == scene.hip[other]] = scene.x_px[other]
    golden.truth["y_px"][golden.truth["hip"] == scene.hip[other]] = scene.y_px[other]
    share = scene.flux[k] / (scene.flux[k] + scene.flux[other])
    scene.flux[k] *= 10 ** (-0.4 * FAULT_MAG)
    (star,) = compare(scene.frame(), golden).bad
    assert set(star.hip) == {scene.hip[k], scene.hip[other]}
    assert star.flux_error_mag == pytest.approx(FAULT_MAG * share, rel=0.1)


@pytest.mark.parametrize("x_px", [-1.2, -0.5, 0.0, 0.4, 3.0, 158.9, 159.8])
def test_a_star_cut_by_the_edge_is_compared(x_px):
    places, flux = ([x_px, 80.3], [60.2, 40.4]), np.array([2e4, 1e6])
    golden = grid(*places, flux)
    (star,) = compare(grid([x_px + FAULT_PX, 80.3], places[1], flux), golden).bad
    assert star.dx_px == pytest.approx(FAULT_PX, rel=0.05) and star.x_px == pytest.approx(
        x_px, abs=0.01
    )
    (star,) = compare(grid(*places, flux * [10 ** (-0.4 * FAULT_MAG), 1]), golden).bad
    assert star.flux_error_mag == pytest.approx(FAULT_MAG, rel=0.05)


def test_a_wing_without_its_star_is_counted_and_its_light_still_looked_at():
    golden = grid([-4.0, 80.3], [60.2, 40.4], [1e6, 1e6])
    comparison = compare(golden, golden)
    assert comparison.same and len(comparison.stars) == 1 and comparison.unmeasured == 1
    (star,) = compare(grid([-4.0, 80.3], [60.2, 40.4], [1.3e6, 1e6]), golden).bad
    assert star.kind == "extra" and star.x_px < 1 and star.y_px == pytest.approx(60.2, abs=0.5)


@pytest.mark.parametrize("sigma_px", [(0.4, 0.4), (0.55, 0.85), (3.0, 1.0), (10.0, 10.0)])
def test_the_sigma_is_that_of_the_stars(sigma_px, rng):
    """To what the light of neighbours a footprint away, 1e-6 of theirs, may do where one is 1000
    times brighter.
    """
    x, y = (60 + 130 * axis.ravel() + rng.uniform(-5, 5, 9) for axis in np.mgrid[:3, :3])
    image = grid(x, y, 10 ** rng.uniform(3, 6, 9), sigma_px, (400, 400))
    assert star_psf(image.astype(float)).sigma_px == pytest.approx(sigma_px, rel=1e-3)


def test_files_arrays_and_frames_are_one_sky(scene, tmp_path):
    write_frame_fits(tmp_path / "golden.fits", scene.bench, scene.golden)
    write_truth_csv(tmp_path / "truth.csv", scene.golden)
    k = scene.inside()[0]
    scene.x_px[k] += FAULT_PX
    frame = scene.frame()
    for golden, truth in (
        (str(tmp_path / "golden.fits"), tmp_path / "truth.csv"),
        (tmp_path / "golden.fits", None),
    ):
        (star,) = compare(frame.linear if truth else frame, golden, truth=truth).bad
        assert star.hip == (scene.hip[k],)
    (star,) = compare(frame.linear, scene.golden.linear).bad
    assert star.hip == () and star.name == f"star at ({star.x_px:.1f}, {star.y_px:.1f})"
    assert_same_sky(frame, scene.golden, centroid_px=1.5 * FAULT_PX)


def test_what_is_no_sky_is_refused(scene):
    golden = scene.golden
    nothing = np.zeros_like(golden.linear)
    broken = golden.linear.copy()
    broken[3, 3] = np.nan
    for frame, wanted, words in (
        (golden.linear[:, 1:], golden, "319 x 240 px against 320 x 240 px"),
        (golden.codes, golden, "not its codes"),
        (broken, golden, "NaN"),
        (golden.linear[0], golden, "shape"),
        (golden, nothing, "no star"),
    ):
        with pytest.raises(InputError, match=words):
            assert_same_sky(frame, wanted)
    with pytest.raises(InputError, match="flux_mag"):
        assert_same_sky(golden, golden, flux_mag=0)
    with pytest.raises(InputError, match="centroid_px"):
        assert_same_sky(golden, golden, centroid_px=float("nan"))
    with pytest.raises(InputError, match="truth table"):
        assert_same_sky(
            golden, golden, truth=scene.bench.frame(from_radec_roll_deg(280, 35, 20)).truth
        )
    with pytest.raises(AssertionError, match="missing"):
        assert_same_sky(nothing, golden)


@pytest.mark.parametrize(
    ("unit", "value", "words"),
    [
        ("electron/s", -1e29, ""),
        ("adu", 1.0, "not a linear image in electron/s (BUNIT is 'adu')"),
        (None, 1.0, "(BUNIT is None)"),
        ("electron/s", 2e30, "a pixel has more than 1e+30 electron/s"),
        ("electron/s", -2e30, "a pixel has more than 1e+30 electron/s"),
    ],
)
def test_a_frame_is_electrons_per_second_of_a_size_that_can_be_squared(
    tmp_path, unit, value, words
):
    image = np.zeros((3, 4), dtype=np.float32)
    image[1, 2] = value
    hdu = fits.PrimaryHDU(image)
    if unit is not None:
        hdu.header["BUNIT"] = unit
    path = tmp_path / "frame.fits"
    hdu.writeto(path)
    if words:
        assert_file_refused(read_frame_fits, path, words)
    else:
        np.testing.assert_array_equal(read_frame_fits(path), image)


def test_cubes_are_compared_by_their_sum_and_each_channel_by_itself():
    """A star that red has lost and blue has won is the same star in their sum."""
    x, y = np.array([20.2, 60.4, 100.7, 50.1]), np.array([30.3, 80.1, 40.8, 20.6])
    shares = np.array([[1.0, 2.0, 3.0, 1.5], [3.0, 1.0, 0.5, 2.0], [2.0, 2.5, 1.0, 1.0]])
    golden = np.stack([grid(x, y, 1e5 * flux) for flux in shares])
    moved = shares.copy()
    moved[0, 1] -= 0.5
    moved[2, 1] += 0.5
    frame = np.stack([grid(x, y, 1e5 * flux) for flux in moved])
    found = compare(frame, golden)
    assert found.bad == [] and not found.same
    light = sorted(star.flux_e_per_s for star in found.stars)
    assert light == pytest.approx(sorted(1e5 * shares.sum(axis=0)), rel=1e-4)
    errors_mag = {name: -2.5 * np.log10(1 + off) for name, off in (("r", -0.25), ("b", 0.2))}
    for name, channel in found.channels.items():
        off = [star.flux_error_mag for star in channel.bad]
        assert off == pytest.approx([errors_mag[name]] if name in errors_mag else [], abs=1e-4)


def test_a_table_s_bodies_are_known_by_their_names_and_its_stars_by_their_numbers(tmp_path):
    """One of stars alone may have no names."""
    path = tmp_path / "truth.csv"
    path.write_text("name,hip,x_px,y_px,electrons_per_s\nMars,0,1.5,2.25,300\n,71,3,4,5.5\n")
    truth = read_truth_csv(path)
    columns = ["name", "hip", "x_px", "y_px", "electrons_per_s"]
    assert truth[columns].tolist() == [("Mars", 0, 1.5, 2.25, 300.0), ("", 71, 3.0, 4.0, 5.5)]
    path.write_text("hip,x_px,y_px,electrons_per_s\n71,3,4,5.5\n")
    assert read_truth_csv(path)["name"].tolist() == [""]
