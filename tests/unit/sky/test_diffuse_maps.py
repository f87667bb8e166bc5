"""Maps of the sky's diffuse light: which way each frame and order of pixels looks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from numpy.typing import NDArray

from hilstar.sky import diffuse
from hilstar.sky.diffuse import TangentImage, block_means, read_diffuse_map

healpix = pytest.importorskip("astropy_healpix")

# Of a map of nside 16 between its pixels, 3.7 degrees apart: 3.4e-3 is the largest measured, beside the
# poles of its frame, and 3.9e-3 of a map that was reduced to it. A wrong frame is off by 0.1 and more.
SMOOTH = 6e-3
V0_W_M2_UM = 3.631e-8  # the light of V = 0 (Bessell 1998)
FRAMES = {"G": "galactic", "C": "icrs", "Q": "icrs", "E": "barycentricmeanecliptic"}


def dipole_map(path: Path, letter: str, ordering: str, nside: int = 16) -> NDArray[np.float64]:
    """A map of 1 + c/2 in a frame, c the cosine from a place of it; that place (3,), ICRS."""
    grid = healpix.HEALPix(nside, ordering)
    lon, lat = grid.healpix_to_lonlat(np.arange(grid.npix))
    place = np.array([0.48, -0.6, 0.64])
    x, y, z = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
    light = 1 + np.tensordot(place, np.array([x, y, z]), 1) / 2
    column = fits.Column("LIGHT", "E", "W/(m2 um sr)", array=light)
    table = fits.BinTableHDU.from_columns([column])
    table.header.update({"PIXTYPE": "HEALPIX", "ORDERING": ordering.upper(), "NSIDE": nside})
    table.header.update({"COORDSYS": letter, "INDXSCHM": "IMPLICIT"})
    table.writeto(path)
    x, y, z = place
    at = SkyCoord(x, y, z, representation_type="cartesian", frame=FRAMES[letter])
    return np.array(at.icrs.cartesian.xyz)


def assert_dipole(
    faces: tuple[TangentImage, ...], place: NDArray[np.float64], nside: int = 16
) -> None:
    """Each pixel within a face's edge has the light of its direction, and all six are there, as
    fine as the map at least.
    """
    assert len(faces) == 6
    px_rad = np.sqrt(4 * np.pi / (12 * nside**2))
    for face in faces:
        assert 1 / px_rad <= face.px_per_tangent < 2 / px_rad
        assert face.max_tangent == 1.0
        side = len(face.image)
        at = (np.arange(side) - (side - 1) / 2) / face.px_per_tangent
        v, u = np.meshgrid(at, at, indexing="ij")
        rays = np.stack([u, v, np.ones_like(u)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        wanted = 1 + rays @ face.axes @ place / 2
        inside = (np.abs(u) <= face.max_tangent) & (np.abs(v) <= face.max_tangent)
        found = face.image * V0_W_M2_UM
        assert found[inside] == pytest.approx(wanted[inside], abs=SMOOTH)


@pytest.mark.parametrize("ordering", ["nested", "ring"])
@pytest.mark.parametrize("letter", FRAMES)
def test_a_healpix_map_looks_where_its_frame_and_order_say(tmp_path, letter, ordering):
    place = dipole_map(tmp_path / "map.fits", letter, ordering)
    assert_dipole(read_diffuse_map(tmp_path / "map.fits"), place)


@pytest.mark.parametrize("ordering", ["nested", "ring"])
def test_a_finer_map_than_is_kept_has_the_means_of_its_pixels(tmp_path, monkeypatch, ordering):
    monkeypatch.setattr(diffuse, "MAX_NSIDE", 16)
    place = dipole_map(tmp_path / "map.fits", "G", ordering, nside=32)
    assert_dipole(read_diffuse_map(tmp_path / "map.fits"), place)


LIGHT_M_S, PLANCK_J_S = 299_792_458.0, 6.62607015e-34
V_M = 545e-9  # effective wavelength of V (Bessell 1998)
# what a surface of one star of V = 0 per square arcsecond is per steradian
ARCSEC2_PER_SR = (180 * 3600 / np.pi) ** 2


@pytest.mark.parametrize(
    ("unit", "value", "w_m2_m_sr"),
    [
        ("mag/arcsec2", 20.0, 10 ** (-0.4 * 20.0) * ARCSEC2_PER_SR * V0_W_M2_UM * 1e6),
        ("W/(m2 um sr)", 3.0, 3e6),
        ("MJy/sr", 5.0, 5e-20 * LIGHT_M_S / V_M**2),
        ("ph/(s m2 nm sr)", 7.0, 7e9 * PLANCK_J_S * LIGHT_M_S / V_M),
        ("erg/(s cm2 Angstrom sr)", 2.0, 2e-7 * 1e4 * 1e10),
    ],
)
def test_a_brightness_in_any_unit_is_that_of_so_many_stars_of_v_0(unit, value, w_m2_m_sr):
    """Densities by frequency and by photons are those at V's effective wavelength."""
    (found,) = diffuse.brightness(Path("map"), [value], unit)
    assert found * V0_W_M2_UM * 1e6 == pytest.approx(w_m2_m_sr, rel=1e-9)


def test_what_is_no_light_is_dark():
    """Below zero, as noise about a dark sky has it, and what is no number, at any end."""
    values = [2.0, -3.0, np.nan, np.inf, -np.inf, 0.0]
    found = diffuse.brightness(Path("map"), values, "W/(m2 um sr)") * V0_W_M2_UM
    assert found == pytest.approx([2.0, 0, 0, 0, 0, 0], abs=1e-12)


def test_blocks_are_means_with_the_dark_beyond_the_last_row_and_column():
    image = np.arange(15.0).reshape(3, 5) + 1
    assert block_means(image, 2).tolist() == [
        [(1 + 2 + 6 + 7) / 4, (3 + 4 + 8 + 9) / 4, (5 + 10) / 4],
        [(11 + 12) / 4, (13 + 14) / 4, 15 / 4],
    ]
    assert block_means(image, 1).tolist() == image.tolist()


@pytest.mark.parametrize(("pixels", "count"), [(0.7, 1), (1.99, 1), (2.0, 2), (3.9, 3), (4.0, 4)])
def test_a_map_is_seen_in_pixels_no_larger_than_the_camera_s_about_the_same_middle(pixels, count):
    """And keeps its light: sums times the area of a pixel; what is in its middle stays there."""
    image = np.zeros((26, 26), dtype=np.float32)
    image[4:22, 9:17] = 3.0
    whole = TangentImage(image, np.eye(3), 1000.0, bv_mag=None)
    seen = whole.seen_by(pixels / 1000.0, 0.1)
    assert seen.px_per_tangent == pytest.approx(1000.0 / count)
    assert len(seen.image) % 2 == 0
    # rounding of float32 sums
    assert seen.image.sum() * count**2 == pytest.approx(image.sum(), rel=1e-6)
    assert middle_of(seen) == pytest.approx([0.0, 0.0], abs=1e-9)


def middle_of(seen: TangentImage) -> list[float]:
    """The middle of an image's light on its tangent plane, from its middle."""
    rows, columns = np.indices(seen.image.shape) - (len(seen.image) - 1) / 2
    weights = seen.image / seen.image.sum()
    return [float((at * weights).sum()) / seen.px_per_tangent for at in (columns, rows)]


@pytest.mark.parametrize(("sigma_px", "px"), [(1.5, 1.0), (0.7, 2.0), (0.15, 1.9), (0.1, 1.9)])
def test_a_map_is_spread_by_the_psf_in_its_own_pixels_unless_that_is_narrow(sigma_px, px):
    """A sigma of the camera's pixels, each of `px` of the map's, which may have been binned."""
    image = np.zeros((42, 42), dtype=np.float32)
    image[20:22, 20:22] = 1.0
    whole = TangentImage(image, np.eye(3), 1000.0)
    seen = whole.seen_by(px / 1000.0, sigma_px)
    sigma = sigma_px * px / int(px)
    before = whole.seen_by(px / 1000.0, 0.0)
    grown = spread_px2(seen) - spread_px2(before)
    if sigma < 0.2:
        assert np.array_equal(seen.image, before.image)
    else:
        at = np.arange(-5, 6)
        sampled = np.exp(-(at**2) / (2 * sigma**2))
        assert grown == pytest.approx(np.average(at**2, weights=sampled), rel=3e-3)
    assert seen.image.sum() == pytest.approx(before.image.sum(), rel=1e-4)


def spread_px2(seen: TangentImage) -> float:
    """The variance of an image's light along rows, of its own pixels."""
    columns = np.indices(seen.image.shape)[1] - (len(seen.image) - 1) / 2
    weights = seen.image / seen.image.sum()
    return float((columns**2 * weights).sum() - (columns * weights).sum() ** 2)


@pytest.mark.parametrize(("shape", "most_px"), [((30, 50), 4096), ((30, 50), 25)])
def test_a_picture_s_image_has_room_for_its_corners_and_is_as_fine_as_what_is_kept(
    tmp_path, monkeypatch, shape, most_px
):
    """Two degrees wide, all of it lit: its flux stays, and nothing is cut at a side. Of more pixels
    than are kept two become one.
    """
    monkeypatch.setattr(diffuse, "MAX_SIDE_PX", most_px)
    step_deg = 0.04
    header = fits.Header()
    header.update({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 40.0, "CRVAL2": 20.0})
    header.update({"CRPIX1": 25.5, "CRPIX2": 15.5, "CDELT1": -step_deg, "CDELT2": step_deg})
    header.update({"CUNIT1": "deg", "CUNIT2": "deg", "BUNIT": "W/(m2 um sr)"})
    path = tmp_path / "map.fits"
    fits.PrimaryHDU(np.full(shape, 2.0), header).writeto(path)
    (image,) = read_diffuse_map(path)
    kept_rad = np.radians(step_deg) * (2 if most_px == 25 else 1)
    reach_rad = np.arctan(np.hypot(*shape) / 2 * np.radians(step_deg))
    side = len(image.image)
    assert image.px_per_tangent == pytest.approx(1 / kept_rad, rel=0.05)
    # Between the outermost pixels of the image and the corner's there is always a neighbour.
    assert side / 2 / image.px_per_tangent >= np.tan(reach_rad) + 0.99 * kept_rad
    flux = image.image.sum() * V0_W_M2_UM / image.px_per_tangent**2
    assert flux == pytest.approx(2.0 * np.prod(shape) * np.radians(step_deg) ** 2, rel=0.01)
    edges = np.concatenate([image.image[[0, -1]].ravel(), image.image[:, [0, -1]].ravel()])
    assert edges.max() < 1.1 / V0_W_M2_UM  # a half at most, where the picture's own edge lies
    assert image.max_tangent == np.inf


def test_each_picture_of_a_file_is_a_map_at_its_own_place(tmp_path):
    hdus = fits.HDUList([fits.PrimaryHDU()])
    places_deg = ((40.0, 20.0), (75.0, -30.0))
    for ra_deg, dec_deg in places_deg:
        header = fits.Header()
        header.update({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "BUNIT": "W/(m2 um sr)"})
        header.update({"CRVAL1": ra_deg, "CRVAL2": dec_deg, "CRPIX1": 3.5, "CRPIX2": 2.5})
        header.update({"CDELT1": -0.1, "CDELT2": 0.1})
        hdus.append(fits.ImageHDU(np.ones((4, 6)), header))
    hdus.writeto(tmp_path / "maps.fits")
    middles = [image.axes[2] for image in read_diffuse_map(tmp_path / "maps.fits")]
    ra, dec = np.radians(places_deg).T
    wanted = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    assert np.array(middles) == pytest.approx(wanted, abs=1e-4)


def test_a_picture_with_a_part_off_the_sky_is_of_a_cube(tmp_path):
    """A tile at the rim of a whole sky in Aitoff's projection, whose ellipse is 162 by 81 degrees
    about its middle: of its corners some show no direction. Only the face opposite has its light.
    """
    header = fits.Header()
    header.update({"CTYPE1": "RA---AIT", "CTYPE2": "DEC--AIT", "CRVAL1": 0.0, "CRVAL2": 0.0})
    header.update({"CRPIX1": -75.0, "CRPIX2": 5.5, "CDELT1": -2.0, "CDELT2": 2.0})
    header.update({"CUNIT1": "deg", "CUNIT2": "deg", "BUNIT": "W/(m2 um sr)"})
    path = tmp_path / "rim.fits"
    fits.PrimaryHDU(np.ones((10, 8)), header).writeto(path)
    (face,) = read_diffuse_map(path)
    assert face.max_tangent == 1.0
    np.testing.assert_allclose(face.axes[2], [-1.0, 0.0, 0.0], atol=1e-12)
    assert (face.image > 0).any()
