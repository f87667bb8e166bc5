"""A map of PSF images and its table of points: what has no column or cell is not known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from hilstar.optics.glass.maps import glass_of_map

SIDE = 9


def images_of(folder: Path, count: int) -> Path:
    """Gaussians about the middle sample, each wider than the one before."""
    at = np.arange(SIDE) - SIDE // 2
    sigma = np.linspace(0.8, 1.4, count)[:, None]
    lines = np.exp(-((at / sigma) ** 2) / 2)
    fits.PrimaryHDU(lines[:, :, None] * lines[:, None, :]).writeto(folder / "stack.fits")
    return folder / "stack.fits"


@pytest.mark.parametrize("head", ["x_px,y_px", "y_px,focus_um,x_px", "x_px,outside_share,y_px"])
def test_what_a_map_does_not_say_is_unknown_and_none(tmp_path, head):
    """All light, one focus, as much light as on the axis, nothing outside, no lateral colour."""
    rows = {
        "x_px": ("10", "90"),
        "y_px": ("20", "30"),
        "focus_um": ("", "0"),
        "outside_share": "00",
    }
    names = head.split(",")
    lines = [",".join(rows[name][k] for name in names) for k in range(2)]
    (tmp_path / "points.csv").write_text("\n".join([head, *lines]) + "\n")
    glass = glass_of_map(images_of(tmp_path, 2), tmp_path / "points.csv", 3, False, 1e-3)
    assert glass.places_px.tolist() == [[10, 20], [90, 30]]
    assert glass.wavelengths_nm.shape == (1,)
    assert np.isnan(glass.wavelengths_nm).all()
    assert glass.focuses_um.tolist() == [0]
    assert (glass.illumination == 1).all()
    assert not glass.outside.any()
    assert not glass.lateral_px.any()


def test_each_column_of_a_map_is_its_own_by_name(tmp_path):
    """In any order, of four images: two wavelengths and two foci of a point."""
    head = "focus_um,lateral_y_px,wavelength_nm,y_px,relative_illumination,lateral_x_px,x_px"
    rows = []
    for focus_um in (-5, 5):
        for nm in (500, 600):
            rows.append(f"{focus_um},{nm / 1e3},{nm},20,{0.5 + focus_um / 100},{nm / 1e4},10")
    (tmp_path / "points.csv").write_text("\n".join([head, *rows]) + "\n")
    glass = glass_of_map(images_of(tmp_path, 4), tmp_path / "points.csv", 3, False, 1e-3)
    assert glass.places_px.tolist() == [[10, 20]]
    assert glass.wavelengths_nm.tolist() == [500, 600]
    assert glass.focuses_um.tolist() == [-5, 5]
    assert glass.illumination[0] == pytest.approx(np.array([[0.45, 0.55]] * 2))
    assert glass.lateral_px[0, :, 0] == pytest.approx(np.array([[0.05, 0.5], [0.06, 0.6]]))
