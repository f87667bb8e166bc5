"""A lens's prescription against rays that optiland traces here, and against diffraction's own peak; needs optiland."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from hilstar.bench.bench_file import read_bench_file
from hilstar.optics.psf_file import Glass, read_glass
from hilstar.resources import resource_path
from tests.support.commands import assert_refused, run_hilstar_here

SIZE, PITCH_UM = "101,81", 20.0
# Measured: 0.002 px and 0.7 %; diffraction's wings beyond the stamp are what is left.
CENTROID_PX, SECOND = 0.01, 0.03


def made(folder: Path, *options: object):
    lens = folder / "lens.json"
    if not lens.exists():
        lens.write_text("{}")
    return run_hilstar_here("optics", "lens", lens, "-o", folder / "psf.fits", *options)


def test_it_says_what_it_lacks(tmp_path, monkeypatch):
    assert_refused(made(tmp_path), 2, "--bench BENCH.toml, or --pitch-um and --resolution")
    assert_refused(made(tmp_path, "--pitch-um", 5, "--resolution", "0,5"), 2, "--resolution 0,5")
    monkeypatch.setitem(sys.modules, "optiland", None)
    assert_refused(made(tmp_path, "--pitch-um", 5, "--resolution", "50,50"), 3, "hilstar[lens]")


def test_a_file_that_is_no_lens_is_one_line(tmp_path):
    pytest.importorskip("optiland", reason="hilstar[lens] is 0.8 GB: no test environment has it")
    assert_refused(made(tmp_path, "--pitch-um", 5, "--resolution", "50,50"), 2, "lens.json")


def test_a_triplet_is_what_its_rays_are(tmp_path):
    pytest.importorskip("optiland", reason="hilstar[lens] is 0.8 GB: no test environment has it")
    from optiland.fileio import save_optiland_file
    from optiland.samples.objectives import CookeTriplet

    lens = CookeTriplet()
    save_optiland_file(lens, str(tmp_path / "lens.json"))
    result = made(tmp_path, "--pitch-um", PITCH_UM, "--resolution", SIZE, "--half-px", 5, "--oversampling", 8)
    assert result.returncode == 0, result.stderr
    assert "focal_length_mm = 49.79" in result.stdout  # of its chief rays: its image plane is not the paraxial one
    glass = read_glass(tmp_path / "psf.fits")
    assert isinstance(glass, Glass)
    at = (np.arange(glass.basis.shape[1]) - glass.basis.shape[1] // 2) / glass.per_px
    grid = np.array(np.meshgrid(*[np.linspace(-1, 1, 101)] * 2)).reshape(2, -1)
    x, y = grid[:, (grid**2).sum(axis=0) <= 1]
    for point in (0, 12):
        for number, um in enumerate((0.48, 0.55, 0.65)):
            place = (glass.places_px[point] - [50, 40]) * PITCH_UM * 1e-3
            field = np.rad2deg(np.arctan(place / 50)) / 20  # over so small a field angles are tangents
            rays = lens.trace_generic(np.full(len(x), field[0]), np.full(len(x), field[1]), x, y, um)
            chief = lens.trace_generic(field[0], field[1], 0.0, 0.0, um)
            image = glass.images[point, number, 0]
            for axis, got, middle in ((0, rays.x, chief.x[0]), (1, rays.y, chief.y[0])):
                off = (got - middle) / (PITCH_UM * 1e-3)
                line = image.sum(axis=axis)
                assert line @ at == pytest.approx(off.mean(), abs=CENTROID_PX)
                assert line @ at**2 - (line @ at) ** 2 >= off.var() * (1 - SECOND)


def test_the_ready_lens_is_a_bench_s_glass():
    file = read_bench_file(resource_path("configs", "planar-1897.toml"))
    path = resource_path("configs", file.config.tracker.optics.psf)
    glass = read_glass(path)
    assert isinstance(glass, Glass)
    assert path.stat().st_size < 400_000
    assert "583336" in glass.history[0]
    assert glass.lens is not None
    focal_mm = float(" ".join(glass.history).split("focal length ")[1].split()[0])
    assert file.config.tracker.focal_length_mm == pytest.approx(focal_mm, rel=1e-3)
