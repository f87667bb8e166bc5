"""A tracker of three channels against three trackers of one, and against quadrature that is not
the package's.
"""

import json
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from msgspec.structs import replace as replace_key
from scipy.integrate import trapezoid

from hilstar import load
from hilstar.basics.errors import InputError
from hilstar.basics.reading import warn_once
from hilstar.basics.rotation import direction_of, from_radec_roll_deg
from hilstar.display.render.backend import linear_light
from hilstar.instruments.compare import compare
from hilstar.optics.extended import GlowLight, LightMap
from hilstar.optics.sprites import AddedLight
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.frame_files import write_frame_fits
from hilstar.server.bench.star_light import bench_stars
from hilstar.server.bench.star_rates import bench_channels, bench_optics, star_flux, star_rates
from hilstar.sky.electrons import Photometry, reference_mean_w_m2_m, star_temperatures_k
from hilstar.sky.spectrum import load_curve
from tests.support.benches import ORION_Q, bench_text
from tests.support.claims import holds
from tests.support.commands import run_hilstar_here
from tests.support.spectra import bump, channel_keys, write_channels

# A Gaussian passband each, in percent at 25 nm from 350 to 1000 nm; the red one sees the near
# infrared, as silicon does.
NM = np.arange(350.0, 1001.0, 25.0)
PASSBANDS = {
    "r": 0.6 * bump(620, 50, NM) + 0.2 * (NM > 800),
    "g": 0.7 * bump(540, 55, NM),
    "b": 0.5 * bump(460, 45, NM),
}
# Products of two float32 factors and a sum of them in another order: a few steps of 6e-8, of the
# brightest pixel.
FLOAT32_STEPS = 1e-6
QUADRATURE = 1e-3  # asked for; the table of the Planck curve is within 1e-6


@pytest.fixture(scope="module")
def curves(tmp_path_factory):
    folder = tmp_path_factory.mktemp("curves")
    write_channels(folder, NM, PASSBANDS)
    return folder


def channels_bench(curves, channels, *changes):
    alone = {"quantum_efficiency": f"{channels}.csv"}
    keys = alone if len(channels) == 1 else channel_keys(channels)
    white = {"render": {"flux_at_white_e_per_s": 1e6, "quantisation": "round"}}
    path = curves / "bench.toml"
    path.write_text(bench_text({"tracker": keys}, white, *changes))
    return path


def bench_with(curves, channels, *changes):
    return load(channels_bench(curves, channels, *changes))


def light_of(curves, channels, *changes):
    with bench_with(curves, channels, *changes) as bench:
        return bench.frame(ORION_Q)


@pytest.mark.parametrize("spectrum", ["pickles", "blackbody"])
def test_a_zero_point_s_share_of_light_is_that_of_all_stars(tmp_path, spectrum):
    v_mag, bv_mag, vi_mag = np.array([0.0, 4.0]), np.array([0.1, 1.2]), np.array([0.1, 1.1])
    rates = []
    for zero in ("iau-bolometric", "vega"):
        path = tmp_path / "bench.toml"
        path.write_text(bench_text({"sky": {"spectrum": spectrum, "zero_point": zero}}))
        of_zero = star_rates(read_bench_file(path).config, tmp_path)
        rates.append(of_zero(v_mag, bv_mag, vi_mag))
    thesis, vega = (reference_mean_w_m2_m(Photometry(z)) for z in ("iau-bolometric", "vega"))
    assert abs(thesis / vega - 1) > 1e-3
    assert rates[0] / rates[1] == pytest.approx([thesis / vega] * 2, rel=1e-6)


def test_stars_of_one_temperature_have_one_light_by_whichever_scale_their_colour_has_it(tmp_path):
    """A black body's light is by its temperature alone."""
    bv_mag = np.linspace(-0.2, 1.5, 18)
    wanted_k = star_temperatures_k(bv_mag, "wang2021")
    fine_mag = np.linspace(-0.35, 2.5, 100_001)
    fine_k = star_temperatures_k(fine_mag, "ballesteros2012")
    alike_mag = np.interp(-wanted_k, -fine_k, fine_mag)
    assert np.abs(alike_mag - bv_mag).max() > 0.05
    rates = []
    for scale, colours_mag in (("wang2021", bv_mag), ("ballesteros2012", alike_mag)):
        path = tmp_path / "bench.toml"
        path.write_text(bench_text({"sky": {"spectrum": "blackbody", "temperature": scale}}))
        of_scale = star_rates(read_bench_file(path).config, tmp_path)
        rates.append(of_scale(np.full(18, 3.0), colours_mag, np.full(18, np.nan)))
    np.testing.assert_allclose(rates[0], rates[1], rtol=1e-4)


@pytest.mark.parametrize(
    ("middles_nm", "blind"),
    # passbands of 50 nm to either side; V is from 470 to 700 nm
    [((850, 900, 400), True), ((850, 900, 515), False), ((760, 500, 400), False)],
)
def test_a_tracker_is_told_to_see_no_v_where_none_of_its_channels_does(
    tmp_path, caplog, middles_nm, blind
):
    warn_once.cache_clear()
    passbands = {}
    for name, middle_nm in zip("rgb", middles_nm, strict=True):
        passbands[name] = 0.5 * (np.abs(NM - middle_nm) <= 25)
    write_channels(tmp_path, NM, passbands)
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({"tracker": channel_keys("rgb")}))
    bench_channels(read_bench_file(path).config.tracker, tmp_path)
    told = [record.getMessage() for record in caplog.records]
    assert [("no light of V (470 to 700 nm)" in line) for line in told] == [True] * blind


@pytest.mark.gpu
@pytest.mark.parametrize("spectrum", ["pickles", "blackbody"])
def test_three_channels_are_three_trackers_of_one_channel_each(curves, spectrum):
    sky = {"sky": {"faintest_v_mag": 7.0, "spectrum": spectrum}}
    frame = light_of(curves, "rgb", sky)
    alone = np.concatenate([light_of(curves, name, sky).light for name in "rgb"])
    assert frame.light.shape == (3, 240, 320) and frame.light.dtype == np.float32
    np.testing.assert_allclose(frame.light, alone, rtol=0, atol=FLOAT32_STEPS * alone.max())
    np.testing.assert_allclose(
        frame.linear, alone.sum(axis=0), rtol=0, atol=FLOAT32_STEPS * alone.max()
    )
    blue_share = frame.light[2][frame.linear > 1e3] / frame.linear[frame.linear > 1e3]
    assert blue_share.max() > 1.5 * blue_share.min()  # stars differ in colour


@pytest.mark.gpu
def test_bodies_have_colours_of_their_own_as_points_and_as_discs(curves):
    tables = {
        "sky": {"epoch_utc": "2026-11-29T00:00:00Z", "faintest_v_mag": 5.0},
        "sky.bodies": {"moon": True, "planets": True},
    }
    with ExitStack() as stack:
        bench, *mono = (
            stack.enter_context(bench_with(curves, channels, tables))
            for channels in ("rgb", *"rgb")
        )
        for name in ("Moon", "Mars"):
            vector = bench.stars.vectors[
                len(bench.stars) - len(bench.stars.bodies) + bench.stars.bodies.index(name)
            ]
            ra_deg, dec_deg = np.degrees([np.arctan2(vector[1], vector[0]), np.arcsin(vector[2])])
            q = from_radec_roll_deg(ra_deg, dec_deg, 0.0)
            assert (name == "Moon") == bool(bench.light(bench.view(q)).discs)
            alone = np.concatenate([one.frame(q).light for one in mono])
            np.testing.assert_allclose(
                bench.frame(q).light, alone, rtol=0, atol=FLOAT32_STEPS * alone.max()
            )


@pytest.mark.gpu
def test_light_that_is_no_stars_has_the_colour_of_its_own_bv(curves):
    """False stars, stray and diffuse light; without a B-V the mean colour of the stars."""
    with bench_with(curves, "rgb", {"sky": {"faintest_v_mag": 5.0}}) as bench:
        sprites, file = bench.sprites(np.array(ORION_Q)), bench.file
        one = np.ones(1)
        red, sun = (
            star_flux(file.config, file.folder)(0 * one, bv * one, np.nan * one)[0]
            for bv in (1.5, 0.65)
        )
        glow = GlowLight(np.array([0.0, 0, 1]), 10.0, 0.1, 2.0, bench.camera, 0.65)
        spread = LightMap(np.ones((9, 9), np.float32), (20, 20), bv_mag=1.5)
        none, of_all = sprites.data[:0], bench.stars.electrons_per_s @ bench.stars.colours
        for lights, wanted in (
            ({"star": np.full(len(sprites), -1), "added": (AddedLight("", 2.0, 1.5, 1e4),)}, red),
            ({"data": none, "star": sprites.star[:0], "extended": (glow,)}, sun),
            ({"data": none, "star": sprites.star[:0], "extended": (spread,)}, red),
            (
                {
                    "data": none,
                    "star": sprites.star[:0],
                    "extended": (replace(spread, bv_mag=None),),
                },
                of_all,
            ),
        ):
            light = linear_light(bench.renderer, replace(sprites, **lights), bench.stars).sum(
                axis=(1, 2), dtype=np.float64
            )
            np.testing.assert_allclose(light / light.sum(), wanted / wanted.sum(), rtol=2e-4)


def test_a_stars_electrons_by_channel_are_those_of_a_quadrature(curves):
    """Planck's law from its formula by trapezia of 0.5 nm: stars from 3000 to 20 000 K."""
    sky = {"sky": {"spectrum": "blackbody", "brightness": "dgs", "faintest_v_mag": 4.0}}
    stars = bench_stars(read_bench_file(channels_bench(curves, "rgb", sky)).config, curves)
    assert (
        len(stars) > 400 and stars.temperature_k.min() < 3700 and stars.temperature_k.max() > 15_000
    )
    found = stars.electrons_per_s[:, None] * stars.colours
    wanted = np.array([integrals(t) for t in stars.temperature_k]) * 10 ** (
        -0.4 * stars.v_mag[:, None]
    )
    np.testing.assert_allclose(found, wanted, rtol=QUADRATURE)
    np.testing.assert_allclose(stars.colours.sum(axis=1), 1, rtol=1e-12)


def integrals(temperature_k):
    """Electrons per second in each channel of a star of V = 0: 3.631e-2 W/m2/m in the mean
    through V (Bessell 1998).
    """
    nm = np.arange(300.0, 1100.01, 0.5)
    power = nm**-5 / np.expm1(0.0143877688 / (nm * 1e-9 * temperature_k))
    glass, v = (load_curve(name, name)(nm) for name in ("n-bk7-10mm", "johnson-v"))
    w_m2_m = 3.631e-2 * power / (trapezoid(power * v, nm) / trapezoid(v, nm))
    photons = np.pi / 4 * 0.03**2 * w_m2_m * glass * nm * 1e-9 / 1.98644586e-25
    efficiencies = (
        np.interp(nm, NM, value.round(6), left=0, right=0) for value in PASSBANDS.values()
    )
    return [trapezoid(photons * one, nm * 1e-9) for one in efficiencies]


def test_all_channels_together_have_the_sum_of_their_curves_though_one_ends_above_zero(curves):
    file = read_bench_file(channels_bench(curves, "rgb"))
    tracker = replace_key(file.config.tracker, quantum_efficiency_g=0.25)
    nm = np.linspace(320.0, 1050.0, 7301)
    found = bench_optics(tracker, curves).quantum_efficiency(nm)
    wanted = sum(one.quantum_efficiency(nm) for one in bench_channels(tracker, curves))
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


@pytest.mark.gpu
def test_the_planes_of_a_cube_are_numbered_from_1_in_the_order_of_red_green_and_blue(
    curves, tmp_path
):
    with bench_with(curves, "rgb", {"sky": {"faintest_v_mag": 1.0}}) as bench:
        write_frame_fits(tmp_path / "cube.fits", bench, bench.frame(ORION_Q))
    header = fits.getheader(tmp_path / "cube.fits")
    numbered = {key: header[key] for key in header if key.startswith("CHANNEL")}
    assert numbered == {f"CHANNEL{k}": f"quantum_efficiency_{c}" for k, c in enumerate("rgb", 1)}


@pytest.mark.gpu
def test_the_fits_of_three_channels_is_a_cube_with_the_skys_own_axes(curves, tmp_path):
    with bench_with(curves, "rgb") as bench:
        frame = bench.frame(ORION_Q)
        write_frame_fits(tmp_path / "cube.fits", bench, frame)
    with fits.open(tmp_path / "cube.fits") as (hdu,):
        assert np.array_equal(hdu.data, frame.light)
        assert (
            hdu.header["CTYPE3"] == "CHANNEL" and hdu.header["CHANNEL2"] == "quantum_efficiency_g"
        )
        cube = WCS(hdu.header)
    first = frame.truth[0]
    ra_deg, dec_deg, channel = cube.all_pix2world(first["x_px"], first["y_px"], 1, 0)
    np.testing.assert_allclose(
        direction_of(ra_deg, dec_deg), bench.stars.vectors[frame.star[0]], atol=1e-7
    )
    assert channel == 2
    # `compare` sees what the sum of the channels does not have: red light that has become blue.
    both = [tmp_path / "cube.fits", tmp_path / "bluer.fits"]
    bluer = frame.light * np.array([0.9, 1.0, 1.0], np.float32)[:, None, None]
    bluer[2] += 0.1 * frame.light[0]
    with fits.open(both[0]) as (hdu,):
        fits.PrimaryHDU(bluer, hdu.header).writeto(both[1])
    told = json.loads(run_hilstar_here("compare", both[1], both[0], "--json").stdout)
    assert not told["same"] and told["flux_error_mag"]["max"] < 1e-3
    red, green = (told["channels"][name] for name in "rg")
    assert green["same"] and green["flux_error_mag"]["rms"] == pytest.approx(0, abs=1e-6)
    assert not red["same"] and red["flux_error_mag"]["rms"] == pytest.approx(0.1144, abs=1e-3)
    said = run_hilstar_here("compare", both[1], both[0])
    assert said.returncode == 1
    assert "flux error, r       0.11" in said.stdout and "star at" in said.stdout
    same = compare(frame, both[0])
    assert same.same and same.channels["b"].star_count > 10


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (
            {"quantum_efficiency_r": 0.5},
            "has quantum_efficiency and quantum_efficiency_r; write one for all light",
        ),
        (
            {"quantum_efficiency": None, "quantum_efficiency_r": 0.5},
            "the key quantum_efficiency_g is missing; add it",
        ),
    ],
)
def test_a_tracker_has_one_quantum_efficiency_or_three(tmp_path, keys, words):
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({"tracker": keys}))
    with pytest.raises(InputError, match=words):
        read_bench_file(path)


def test_light_without_a_colour_of_its_own_has_that_of_the_stars(curves):
    """Of black bodies: the mean of a bench's stars beside that of one B-V, by the same trapezia."""
    sky = {"sky": {"spectrum": "blackbody", "brightness": "dgs", "faintest_v_mag": 7.5}}
    stars = bench_stars(read_bench_file(channels_bench(curves, "rgb", sky)).config, curves)
    mean = stars.electrons_per_s @ stars.colours
    for name, bv_mag in (("sun", 0.65), ("vega", 0.0), ("red", 1.5)):
        own = np.array(integrals(ballesteros_k(bv_mag)))
        off = mean / mean.sum() / (own / own.sum()) - 1
        if name == "red":
            holds("fault-blue", 1 + off[2])
        else:
            holds(f"fault-colour-{name}", 100 * np.abs(off).max())


def ballesteros_k(bv_mag):
    """Ballesteros 2012 (EPL 97, 34008), equation 14."""
    return 4600 * (1 / (0.92 * bv_mag + 1.7) + 1 / (0.92 * bv_mag + 0.62))
