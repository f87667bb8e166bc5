"""Diffuse light against its own total: a disc of known flux, in any unit and projection, in
electrons of the tracker.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import direction_of, from_radec_roll_deg, to_matrix
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.optics.extended import LightMap
from hilstar.optics.layers.diffuse_layer import DiffuseLayer
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.star_rates import star_rates
from hilstar.sky.diffuse import read_diffuse_map
from tests.support.benches import SMALL_BENCH
from tests.support.claims import holds

RA_DEG, DEC_DEG, RADIUS_DEG, V_MAG_ARCSEC2 = 84.057, -1.2, 2.0, 18.0
ARCSEC2 = 1 / 206_264.806**2
# The limit; 0.1 % by an edge that is a pixel of the map wide, 0.03 % by the bilinear
# places.
FLUX = 0.005
# f_nu and f_lambda of V = 0 are tied at one wavelength, 545 nm.
UNITS = [
    "mag/arcsec2",
    "mag/deg2",
    "W/(m2 um sr)",
    "erg/(s cm2 AA arcsec2)",
    "MJy/sr",
    "ph/(s m2 nm sr)",
]


def light_of_disc() -> float:
    """Its stars of V = 0."""
    return 10 ** (-0.4 * V_MAG_ARCSEC2) / ARCSEC2 * 2 * np.pi * (1 - np.cos(np.radians(RADIUS_DEG)))


def write_disc(
    path: Path,
    unit: str = "mag/arcsec2",
    axes=("RA---TAN", "DEC--TAN"),
    centre=(RA_DEG, DEC_DEG),
    px_deg=0.02,
):
    """A disc about `centre`, in a WCS image 5 deg wide, or wide enough for an image of the whole
    sky.
    """
    n = 250 if px_deg < 0.5 else round(360 / px_deg)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.cdelt = axes, [-px_deg, px_deg]
    wcs.wcs.crval, wcs.wcs.crpix = centre, [(n + 1) / 2, (n + 1) / 2]
    y, x = np.mgrid[:n, :n]
    lon, lat = wcs.pixel_to_world_values(x.ravel(), y.ravel())
    seen = SkyCoord(np.nan_to_num(lon), np.nan_to_num(lat), unit="deg")
    inside = seen.separation(SkyCoord(*centre, unit="deg")).deg.reshape(n, n) < RADIUS_DEG
    kind = u.Unit(unit)
    if "mag" in unit:
        value = V_MAG_ARCSEC2 - (2.5 * np.log10(3600**2) if "deg" in unit else 0)
    else:
        density = 3.631e-2 * 10 ** (-0.4 * V_MAG_ARCSEC2) * u.W / u.m**3 / u.arcsec**2
        value = density.to(kind, u.spectral_density(545 * u.nm)).value
    image = np.where(inside, value, np.nan)
    header = wcs.to_header()
    header["BUNIT"] = unit
    fits.PrimaryHDU(image.astype(np.float32), header).writeto(path, overwrite=True)


def bench_in(folder: Path, keys: str = 'map = "map.fits"'):
    """A bench with few stars and a map."""
    (folder / "bench.toml").write_text(
        f"{SMALL_BENCH}[sky]\nfaintest_v_mag = 0.0\n[sky.diffuse]\n{keys}\n"
    )
    return read_bench_file(folder / "bench.toml")


def drawn_over_known(file, ra=RA_DEG, dec=DEC_DEG, roll=33.0) -> tuple[float, np.ndarray]:
    """Electrons that the tracker's image has over those of the disc, and the image."""
    v0_e_per_s = star_rates(file.config, file.folder)(
        *(np.array([part]) for part in (0.0, 0.65, np.nan))
    )[0]
    with Simulator(file) as tracker:
        view = tracker.view(from_radec_roll_deg(ra, dec, roll), np.zeros(3))
        image = tracker.expose(view, None).mean_e / tracker.config.tracker.exposure_s
    return float(image.sum() / (v0_e_per_s * light_of_disc())), image


@pytest.mark.parametrize("unit", UNITS)
def test_a_disc_in_any_unit_has_its_flux(tmp_path, unit):
    write_disc(tmp_path / "map.fits", unit)
    share = drawn_over_known(bench_in(tmp_path))[0]
    holds("diffuse-disc", 100 * abs(share - 1))


def test_a_disc_lies_where_its_coordinates_are(tmp_path):
    write_disc(tmp_path / "map.fits")
    file = bench_in(tmp_path)
    share, image = drawn_over_known(file, RA_DEG + 2, DEC_DEG - 1, 70.0)
    assert share == pytest.approx(1, rel=FLUX)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    with Simulator(file) as tracker:
        seen = to_matrix(from_radec_roll_deg(RA_DEG + 2, DEC_DEG - 1, 70.0)) @ direction_of(
            RA_DEG, DEC_DEG
        )
        (x_px,), (y_px,) = tracker.camera.project((tracker.camera.cam_to_image @ seen)[None])
        # A round disc's light is symmetric about its centre to second order in its radius, 2 deg:
        # 0.06 % of 3 deg's 300 px.
        assert (image * x).sum() / image.sum() == pytest.approx(x_px, abs=0.3)
        assert (image * y).sum() / image.sum() == pytest.approx(y_px, abs=0.3)


def test_a_disc_smaller_than_a_pixel_has_its_flux_wherever_it_lies(tmp_path, rng):
    """22 arcsec wide, 0.6 px: the Gaussian of the PSF, of sigma 0.62 px, leaves ripples of 2 %;
    without it they are 50 %.
    """
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.cdelt = ("RA---TAN", "DEC--TAN"), [-0.0005, 0.0005]
    wcs.wcs.crval, wcs.wcs.crpix = (RA_DEG, DEC_DEG), [20.5, 20.5]
    y, x = np.mgrid[:40, :40] - 19.5
    image = np.where(np.hypot(x, y) < 6, V_MAG_ARCSEC2, np.nan).astype(np.float32)
    header = wcs.to_header()
    header["BUNIT"] = "mag/arcsec2"
    fits.PrimaryHDU(image, header).writeto(tmp_path / "map.fits")
    known = (
        np.isfinite(image).sum() * np.radians(0.0005) ** 2 * 10 ** (-0.4 * V_MAG_ARCSEC2) / ARCSEC2
    )
    file = bench_in(tmp_path)
    found = [
        drawn_over_known(file, RA_DEG + da, DEC_DEG + dd, da)[0]
        for da, dd in rng.uniform(-3, 3, (3, 2))
    ]
    assert np.array(found) * light_of_disc() == pytest.approx(known, rel=0.025)


def test_other_projections_and_frames_have_the_same_light(tmp_path):
    """Galactic coordinates, and an image of the whole sky, which becomes a cube: its coarse
    pixels have a coarser edge.
    """
    place = SkyCoord(RA_DEG, DEC_DEG, unit="deg").galactic
    write_disc(
        tmp_path / "map.fits", axes=("GLON-SIN", "GLAT-SIN"), centre=(place.l.deg, place.b.deg)
    )
    share = drawn_over_known(bench_in(tmp_path))[0]
    holds("diffuse-disc", 100 * abs(share - 1))


def write_even_sky(path: Path) -> None:
    """The whole sky of one brightness, 1 degree to a pixel."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.cdelt, wcs.wcs.crval, wcs.wcs.crpix = (
        ("RA---CAR", "DEC--CAR"),
        [-1, 1],
        [180, 0],
        [180.5, 91],
    )
    header = wcs.to_header()
    header["BUNIT"] = "mag/arcsec2"
    fits.PrimaryHDU(np.full((181, 360), V_MAG_ARCSEC2, dtype=np.float32), header).writeto(path)


@pytest.mark.parametrize(
    "place", [(0.0, 0.0), (45.0, 0.0), (45.0, 35.264), (10.0, 89.0), (179.5, -45.0)]
)
def test_a_sky_of_one_brightness_has_no_seams(tmp_path, place):
    """At a face's middle, on its edge, on the cube's corner, at a pole, and where the image's
    own edge lies.
    """
    write_even_sky(tmp_path / "map.fits")
    file = bench_in(tmp_path)
    share, image = drawn_over_known(file, *place)
    with Simulator(file) as tracker:
        y, x = np.mgrid[: image.shape[0], : image.shape[1]]
        sr = tracker.camera.pixel_sr(x.ravel().astype(float), y.ravel().astype(float)).reshape(
            image.shape
        )
    even = image / sr * sr.sum() / image.sum()
    assert np.abs(even - 1).max() < FLUX
    known = light_of_disc() / (2 * np.pi * (1 - np.cos(np.radians(RADIUS_DEG)))) * sr.sum()
    assert share * light_of_disc() == pytest.approx(known, rel=FLUX)


def test_a_healpix_map_has_its_flux(tmp_path):
    """In galactic coordinates, nested; a disc of nside 256's pixels, 14 arcmin wide, that the
    tracker's field holds.
    """
    healpix = pytest.importorskip("astropy_healpix")
    grid = healpix.HEALPix(256, "nested", frame="galactic")
    centre = SkyCoord(RA_DEG, DEC_DEG, unit="deg").galactic
    off = grid.healpix_to_skycoord(np.arange(grid.npix)).separation(centre).deg
    light = np.where(off < RADIUS_DEG, 1.0, 0.0)
    table = fits.BinTableHDU.from_columns(
        [fits.Column("LIGHT", "1024E", "W/(m2 um sr)", array=light.reshape(-1, 1024))]
    )
    table.header.update(
        {
            "PIXTYPE": "HEALPIX",
            "ORDERING": "NESTED",
            "NSIDE": 256,
            "COORDSYS": "G",
            "INDXSCHM": "IMPLICIT",
        }
    )
    table.writeto(tmp_path / "map.fits")
    file = bench_in(tmp_path)
    known = light.sum() * 4 * np.pi / grid.npix * 1e6 / 3.631e-2
    assert drawn_over_known(file)[0] * light_of_disc() == pytest.approx(known, rel=FLUX)
    del table.header["COORDSYS"]
    table.writeto(tmp_path / "map.fits", overwrite=True)
    with pytest.raises(InputError, match=r"COORDSYS = None; write G \(galactic\)"):
        read_diffuse_map(tmp_path / "map.fits")


def test_the_monitor_draws_what_passes_its_first_step_and_says_where_nothing_does(tmp_path):
    write_disc(tmp_path / "map.fits")
    q = from_radec_roll_deg(RA_DEG, DEC_DEG, 0.0)
    with open_bench(bench_in(tmp_path)) as bench:
        layer = next(layer for layer in bench.layers if isinstance(layer, DiffuseLayer))
        assert layer.line().endswith("it is drawn where it passes one")
        first = bench.light(bench.view(q)).extended
        again = bench.light(bench.view(from_radec_roll_deg(RA_DEG + 1e-6, DEC_DEG, 0.0))).extended
        turned = bench.light(bench.view(from_radec_roll_deg(RA_DEG + 0.1, DEC_DEG, 0.0))).extended
        back = bench.light(bench.view(q)).extended
        # whatever was drawn between: a replay has the same codes
        assert (first[0].image == back[0].image).all()
        assert len(first) == len(turned) == 1
        assert first[0] is again[0]  # the renderer has it already
        assert first[0] is not turned[0]
        assert isinstance(first[0], LightMap)
        lit = bench.frame(q).levels > 0  # a disc of 36 px, and 2 px of the PSF's wings around it
        assert (
            0.95
            < lit.sum()
            * bench.camera.scales_px_rad()[0] ** -2
            / np.radians(RADIUS_DEG) ** 2
            / np.pi
            < 1.15
        )
    write_faint = (tmp_path / "map.fits").read_bytes().replace(b"'mag/arcsec2'", b"'mag/deg2'   ")
    (tmp_path / "map.fits").write_bytes(write_faint)
    with open_bench(bench_in(tmp_path)) as bench:
        layer = next(layer for layer in bench.layers if isinstance(layer, DiffuseLayer))
        assert "is not drawn; the virtual tracker has it" in layer.line()
        assert not bench.light(bench.view(q)).extended
    with open_bench(bench_in(tmp_path, "bv_mag = 1.0")) as bench:
        assert not any(isinstance(layer, DiffuseLayer) for layer in bench.layers)


def test_a_map_leaves_the_screen_over_any_edge(tmp_path):
    """Step by step of a third of a cell: also where one row of cells' corners alone is near its
    light.
    """
    write_disc(tmp_path / "map.fits")
    with open_bench(bench_in(tmp_path)) as bench:
        cell_deg = np.degrees(16 / min(bench.camera.scales_px_rad()))
        for roll in (0.0, 90.0, 180.0, 270.0):
            drawn = [
                bool(
                    bench.light(
                        bench.view(from_radec_roll_deg(RA_DEG, DEC_DEG + off, roll))
                    ).extended
                )
                for off in np.arange(4.0, 14.0, cell_deg / 3)
            ]
            assert drawn[0] and not drawn[-1]
            assert drawn == sorted(drawn, reverse=True)


@pytest.mark.parametrize("content", [b"", b"no FITS", b"SIMPLE  =                    T"])
def test_a_file_that_is_no_map_is_refused_in_one_line(tmp_path, content):
    (tmp_path / "map.fits").write_bytes(content)
    with pytest.raises(InputError, match=r"map\.fits.*give a FITS image with a WCS"):
        read_diffuse_map(tmp_path / "map.fits")


def test_the_map_of_a_catalogue_has_each_objects_magnitude_and_axes(tmp_path):
    """Two rows in OpenNGC's form: a disc that lies at 35 deg from north to east, and a nebula; a
    cluster is left out.
    """
    (tmp_path / "NGC.csv").write_text(
        "Name;Type;RA;Dec;MajAx;MinAx;PosAng;B-Mag;V-Mag;Hubble\n"
        "NGC0224;G;00:42:44.35;+41:16:08.6;177.83;69.66;35;4.29;3.44;Sb\n"
        "NGC9999;HII;05:36:13.68;-01:12:00.0;60.00;40.00;;4.70;;\n"
        "NGC0129;OCl;00:29:58.19;+60:12:40.2;5.40;;;7.33;6.50;\n"
    )
    tool = Path(__file__).parents[2] / "tools" / "make_deep_sky.py"
    subprocess.run(
        [sys.executable, tool, tmp_path / "NGC.csv", "-o", tmp_path / "map.fits"],
        check=True,
        capture_output=True,
    )
    andromeda, nebula = read_diffuse_map(tmp_path / "map.fits")
    for face, v_mag in ((andromeda, 3.44), (nebula, 4.0)):
        at = (np.arange(len(face.image)) - (len(face.image) - 1) / 2) / face.px_per_tangent
        v, w = np.meshgrid(at, at, indexing="ij")
        light = face.image * (1 + v * v + w * w) ** -1.5 / face.px_per_tangent**2
        assert light.sum() == pytest.approx(10 ** (-0.4 * v_mag), rel=FLUX)
        rays = np.stack([w, v, np.ones_like(v)], axis=-1) @ face.axes
        middle = (light[..., None] * rays).sum(axis=(0, 1)) / light.sum()
        if face is andromeda:
            north, east = np.array([0, 0, 1.0]), np.cross([0, 0, 1.0], middle)
            off = (rays - middle)[light > 0]
            places = np.stack([off @ (north - middle * (middle @ north)), off @ east])
            along = np.linalg.eigh(np.cov(places, aweights=light[light > 0]))[1][:, 1]
            assert np.degrees(np.arctan(along[1] / along[0])) == pytest.approx(35, abs=0.5)
        else:
            assert drawn_over_known(bench_in(tmp_path))[0] * light_of_disc() == pytest.approx(
                10 ** (-0.4 * 4.0), rel=FLUX
            )
