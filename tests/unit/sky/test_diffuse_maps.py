"""Maps of the sky's diffuse light: which way each frame and order of pixels looks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from numpy.typing import NDArray

from hilstar.sky import diffuse
from hilstar.sky.diffuse import TangentImage, read_diffuse_map

healpix = pytest.importorskip("astropy_healpix")

# Of a map of nside 16 between its pixels, 3.7 degrees apart: 3.4e-3 is the largest measured, beside the
# poles of its frame, and 3.9e-3 of a map that was reduced to it. A wrong frame is off by 0.1 and more.
SMOOTH = 6e-3
V0_W_M2_UM = 3.631e-8  # the light of V = 0 (Bessell 1998)
FRAMES = {"G": "galactic", "C": "icrs", "E": "barycentricmeanecliptic"}


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
