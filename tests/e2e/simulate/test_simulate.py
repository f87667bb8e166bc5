"""`hilstar simulate`, as a user types it."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

import hilstar
from tests.support.benches import ROOT, SMALL_BENCH, bench_text
from tests.support.commands import assert_refused, run_hilstar, run_hilstar_here, typed
from tests.support.psfs import coma, sampled

LYRA = ROOT / "configs" / "thesis-lyra.toml"
POINTING = ("--radec", "283.021,35.349,0")


def simulate(path, *options, bench=LYRA, pointing=POINTING):
    result = run_hilstar_here("simulate", bench, *pointing, "-o", path, *options)
    assert result.returncode == 0, result.stderr
    with fits.open(path) as hdus:
        return hdus[0].data.copy(), hdus[0].header.copy(), hdus[1].data.copy()


def test_the_fits_has_dn_header_and_truth(tmp_path):
    dn, header, truth = simulate(tmp_path / "a.fits", "--seed", "7", "--png", tmp_path / "a.png")
    assert dn.dtype == np.uint16
    assert dn.shape == (1024, 1024)
    wanted = {
        "BUNIT": "adu",
        "EXPTIME": 5.0,
        "SEED": 7,
        "DEVSEED": 0,
        "NOISE": "full",
        "GAIN": 24.0,
        "EPOCHJYR": 2000.0,
    }
    assert {key: header[key] for key in wanted} == wanted
    assert len(header["BENCHSHA"]) == 64
    assert header["CREATOR"] == f"hilstar {hilstar.__version__}"
    assert header["RA_PNT"] == pytest.approx(283.021, abs=1e-9)
    first = [
        "hip",
        "x_px",
        "y_px",
        "v_mag",
        "bv",
        "temperature_k",
        "electrons_per_s",
        "drawn",
        "clipped",
    ]
    last = [
        "variable",
        "range_mag",
        "period_d",
        "double",
        "separation_arcsec",
        "name",
        "sigma_pos_mas",
        "sigma_mag",
        "ra_deg",
        "dec_deg",
    ]
    optics = ["x_centroid_px", "y_centroid_px", "relative_illumination"]
    assert list(truth.names) == [*first, *last, *optics]
    assert (truth["x_centroid_px"] == truth["x_px"]).all()
    assert (truth["relative_illumination"] == 1).all()
    # Background and dark: 3000 e- and 203 e-/s for 5 s, at 24 e-/DN.
    assert np.median(dn) == pytest.approx((3000 + 203 * 5) / 24, abs=1.0)
    vega = truth[truth["hip"] == 91262][0]
    assert vega["clipped"]
    assert dn[round(vega["y_px"]), round(vega["x_px"])] == 2917  # 70 000 e- / 24
    assert np.array(Image.open(tmp_path / "a.png")).std() > 5


def test_the_belt_of_orion_stands_out_of_hundreds_of_full_stars(tmp_path):
    bench, pointing = ROOT / "configs" / "thesis-orion.toml", ("--radec", "84.057,-1.2,0")
    *_, truth = simulate(
        tmp_path / "a.fits", "--png", tmp_path / "a.png", bench=bench, pointing=pointing
    )
    picture = np.array(Image.open(tmp_path / "a.png")).astype(float)
    assert truth["clipped"].sum() > 200
    assert (picture == 255).sum() < 500  # of the hundreds of full stars, few are white
    light = []
    for row in truth:
        x, y = round(row["x_px"]), round(row["y_px"])
        light.append(picture[max(y - 8, 0) : y + 9, max(x - 8, 0) : x + 9].sum())
    brightest = truth["hip"][np.argsort(light)[::-1]].tolist()
    belt = [brightest.index(hip) for hip in (25930, 26311, 26727)]
    assert max(belt) < 40, belt


def test_the_dn_come_as_a_picture_of_16_bits_too(tmp_path):
    (tmp_path / "bench.toml").write_text(
        SMALL_BENCH + "[tracker.detector]\ngain_e_per_dn = 1\nbits = 16\noffset_dn = 300\n"
    )
    options = {"bench": tmp_path / "bench.toml", "pointing": ("--radec", "84.057,-1.2,0")}
    for name in ("dn.png", "dn.tif"):
        dn, *_ = simulate(tmp_path / "a.fits", "--dn-png", tmp_path / name, **options)
        with Image.open(tmp_path / name) as picture:
            assert picture.mode == "I;16"
            assert np.array_equal(np.array(picture), dn)
    assert dn.max() > 4095


def test_seeds_make_the_image_and_nothing_else_does(tmp_path):
    first, *_ = simulate(tmp_path / "a.fits", "--seed", "1")
    again, *_ = simulate(tmp_path / "b.fits", "--seed", "1")
    other, *_ = simulate(tmp_path / "c.fits", "--seed", "2")
    clean, header, _ = simulate(tmp_path / "d.fits", "--noise", "none")
    assert np.array_equal(first, again)
    assert (first != other).mean() > 0.5
    assert header["NOISE"] == "none"
    # Without noise the sky is one level; with it, the mean of many pixels is that level.
    quiet = clean == np.median(clean)
    assert quiet.mean() > 0.95
    # half a DN of rounding, and 1e-3 of noise
    assert first[quiet].mean() == pytest.approx(np.median(clean), abs=0.6)


def test_a_turn_smears_stars_and_keeps_their_flux(tmp_path):
    (tmp_path / "bench.toml").write_text(
        SMALL_BENCH + "[tracker.detector]\ngain_e_per_dn = 1\nfull_well_e = 1e9\nbits = 16\n"
    )
    options = {"bench": tmp_path / "bench.toml", "pointing": ("--radec", "84.057,-1.2,0")}
    still, _, truth = simulate(tmp_path / "a.fits", "--noise", "none", **options)
    turned, header, moved = simulate(
        tmp_path / "b.fits", "--noise", "none", "--slew", "0,0.3,0", **options
    )
    assert header["RATEY"] == pytest.approx(0.3)
    assert (turned > 0).sum() > 1.3 * (still > 0).sum()
    bright = truth[
        (truth["v_mag"] > 3.3)
        & (truth["v_mag"] < 5)
        & (truth["x_px"] > 20)
        & (truth["x_px"] < 1000)
    ]
    assert len(bright) >= 3
    for row in bright:
        x, y = round(row["x_px"]), round(row["y_px"])
        if abs(y - 512) > 490:
            continue
        boxes = [
            image[y - 8 : y + 9, x - 12 : x + 13].astype(float).sum() for image in (still, turned)
        ]
        same = moved[moved["hip"] == row["hip"]][0]
        assert np.hypot(same["x_px"] - row["x_px"], same["y_px"] - row["y_px"]) < 1e-6
        # 16 bits clip nothing here but what rounding takes from faint wings: half a DN in 425
        # pixels.
        assert boxes[1] == pytest.approx(boxes[0], rel=0.01)


def test_a_log_is_simulated_over_all_cores(tmp_path):
    rows = ["t_s,qw,qx,qy,qz", "0,1,0,0,0", "1,0.99999,0.004,0,0.002"]
    (tmp_path / "log.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "bench.toml").write_text(SMALL_BENCH.replace("[1024, 1024]", "[128, 96]"))
    command = typed(f"simulate {tmp_path}/bench.toml --log {tmp_path}/log.csv --frames 6 --seed 3")
    for folder in ("one", "two"):
        result = run_hilstar(*command, "-o", tmp_path / folder)
        assert result.returncode == 0, result.stderr
    files = sorted((tmp_path / "one").glob("exposure_*.fits"))
    assert len(files) == 6
    frames = [fits.getdata(path) for path in files]
    assert all(
        np.array_equal(a, fits.getdata(tmp_path / "two" / p.name))
        for a, p in zip(frames, files, strict=True)
    )
    rates = [fits.getheader(path)["RATEX"] for path in files]
    assert rates == pytest.approx([rates[0]] * 6, rel=1e-6)
    assert abs(rates[0]) == pytest.approx(np.degrees(0.008), rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--radec", "1,2,3"], ["-o OUT.fits"]),
        (["-o", "x.fits"], ["--radec", "--quaternion"]),
        (["--radec", "1,2,3", "-o", "x.fits", "--slew", "1"], ["--slew 1", "X,Y,Z"]),
        (["--radec", "1,2,3", "-o", "x.fits", "--noise", "some"], ["some"]),
        (["--radec", "1,2,3", "-o", "x.fits", "--seed", "-1"], ["seed"]),
        (["--log", "none.csv", "-o", "d"], ["none.csv"]),
        (["--log", "none.csv"], ["-o DIR"]),
        (["--radec", "1,2,3", "-o", "none/x.fits"], ["cannot be written"]),
        (["--radec", "1,2,3", "-o", "x.png"], ["-o x.png", "FITS", "x.fits"]),
        (["--radec", "1,2,3", "--png", "x.jpg"], ["--png x.jpg", "x.png"]),
        (["--radec", "1,2,3", "--dn-png", "x.fits"], ["--dn-png x.fits", "PNG or TIFF", "x.png"]),
        (["--log", "none.csv", "-o", "d.fits"], ["-o d.fits", "directory"]),
    ],
)
def test_a_wrong_simulation_gets_one_line(tmp_path, arguments, words):
    (tmp_path / "bench.toml").write_text(SMALL_BENCH.replace("[1024, 1024]", "[64, 64]"))
    assert_refused(run_hilstar_here("simulate", "bench.toml", *arguments, cwd=tmp_path), 2, *words)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("bits = 17", "bits = 17"),
        ("column_noise_e = 3", "cmos"),
        ("temperature_k = 5000", "temperature_k"),
        ('dark_law = "cold"', "dark_law"),
    ],
)
def test_a_wrong_detector_gets_one_line(tmp_path, keys, words):
    (tmp_path / "bench.toml").write_text(SMALL_BENCH + f"[tracker.detector]\n{keys}\n")
    result = run_hilstar_here(
        "simulate", "bench.toml", "--radec", "1,2,3", "-o", "x.fits", cwd=tmp_path
    )
    assert_refused(result, 2, "[tracker.detector]", words)


def test_the_tracker_s_psf_may_be_an_image(tmp_path):
    """A coma, whose light lies right of and below the stars' places: as bright, and the bench
    has another hash.
    """
    fits.writeto(tmp_path / "coma.fits", sampled(coma(), 5, 7), fits.Header({"OVERSAMP": 5}))
    detector = {"gain_e_per_dn": 0.5, "bits": 16}
    images, hashes = [], []
    for name, optics in (("plain", {}), ("coma", {"psf": "coma.fits"})):
        tables = {
            "tracker": {"resolution_px": [128, 128]},
            "tracker.detector": detector,
            "tracker.optics": optics,
        }
        (tmp_path / "bench.toml").write_text(bench_text(tables))
        dn, header, truth = simulate(
            tmp_path / f"{name}-dn.fits", "--noise", "none", bench=tmp_path / "bench.toml"
        )
        images.append(dn - np.median(dn).astype(float))
        hashes.append(header["BENCHSHA"])
    on = truth[
        (np.abs(truth["x_px"] - 63.5) < 50)
        & (np.abs(truth["y_px"] - 63.5) < 50)
        & ~truth["clipped"]
    ]
    star = on[np.argmax(on["electrons_per_s"])]
    x, y = round(star["x_px"]), round(star["y_px"])
    at = np.arange(-9, 10)
    light, moved = [], []
    for image in images:
        stamp = image[y - 9 : y + 10, x - 9 : x + 10]
        light.append(stamp.sum())
        moved.append([(stamp.sum(axis=0) * at).sum(), (stamp.sum(axis=1) * at).sum()] / stamp.sum())
    assert light[1] == pytest.approx(light[0], rel=0.01)
    # The profile's own first moment; the stamp's neighbours and the DN's rounding are in both
    # images.
    assert moved[1] - moved[0] == pytest.approx(
        0.45 * (0.28 * np.array([1.2, 0.5]) + 0.12 * np.array([3.0, 1.3])), abs=0.02
    )
    assert hashes[0] != hashes[1]


@pytest.mark.parametrize(
    ("image", "header", "advice"),
    [
        (None, {}, "give a FITS file"),
        (np.ones((3, 5, 5)), {}, "holds 3 images"),
        (np.ones((4, 5)), {}, "odd width and height"),
        (np.ones((5, 5)), {"OVERSAMP": 2.5}, "write a whole number, and T or F"),
        (np.ones((5, 5)), {"PIXINT": 1}, "write a whole number, and T or F"),
        (sampled(coma(), 5, 7) - 1e-3, {"OVERSAMP": 5}, "subtract its background"),
        (b"SIMPLE  = nothing", {}, "not a FITS image"),
    ],
)
def test_a_file_that_is_no_psf_is_one_line(tmp_path, image, header, advice):
    path, bench = tmp_path / "psf.fits", tmp_path / "bench.toml"
    if isinstance(image, bytes):
        path.write_bytes(image)
    elif image is not None:
        fits.writeto(path, image, fits.Header(header))
    bench.write_text(SMALL_BENCH + '[tracker.optics]\npsf = "psf.fits"\n')
    assert_refused(
        run_hilstar_here("simulate", bench, *POINTING, "-o", tmp_path / "a.fits"),
        2,
        "psf.fits",
        advice,
    )


def test_a_sigma_that_a_psf_s_file_replaces_is_said(tmp_path):
    fits.writeto(tmp_path / "psf.fits", sampled(coma(), 5, 7), fits.Header({"OVERSAMP": 5}))
    optics = {
        "tracker": {"psf_sigma_px": [0.7, 0.7], "resolution_px": [64, 64]},
        "tracker.optics": {"psf": "psf.fits"},
    }
    (tmp_path / "bench.toml").write_text(bench_text(optics))
    result = run_hilstar_here(
        "simulate", tmp_path / "bench.toml", *POINTING, "-o", tmp_path / "a.fits"
    )
    assert result.returncode == 0
    assert "psf_sigma_px is not used: [tracker.optics] psf is psf.fits" in result.stderr
