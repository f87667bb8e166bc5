"""Files that a bench file names: opened once by a command, and read anew when they change."""

from __future__ import annotations

import io
import shutil
import sys
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from hilstar.basics import reading
from hilstar.server.bench.bench_file import bench_file_of, read_bench_file
from hilstar.server.bench.build import open_bench
from tests.support.benches import ROOT, bench_text
from tests.support.commands import run_hilstar_here

DISPLAY_DATA = ROOT / "hilstar" / "display" / "data"
GLASS = ROOT / "configs" / "planar-1897.fits"

# Where opens are counted now: a hook of Python stays for ever.
_counters: list[Counter[str]] = []


def _count(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open":
        for counter in _counters:
            counter[str(arguments[0])] += 1


sys.addaudithook(_count)


@contextmanager
def opened_files():
    """How often each file is opened meanwhile."""
    _counters.append(Counter())
    try:
        yield _counters[-1]
    finally:
        _counters.pop()


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """A bench that names its glass, a curve, a calibration with two tables, and primaries."""
    monkeypatch.setattr(reading, "SETTLED_NS", 0)
    shutil.copy(GLASS, tmp_path / "psf.fits")
    for name in ("lcd-example.toml", "lcd-example.csv", "lcd-example-uniformity.csv"):
        shutil.copy(DISPLAY_DATA / name, tmp_path / name)
    shutil.copy(ROOT / "configs" / "primaries-lcd.csv", tmp_path / "primaries.csv")
    (tmp_path / "qe.csv").write_text("wavelength_nm,value\n400,0.5\n700,0.6\n")
    changes = {
        "tracker": {"quantum_efficiency": "qe.csv", "transmission": None},
        "tracker.optics": {"psf": "psf.fits"},
        "monitor": {"calibration": "lcd-example.toml"},
        "monitor.primaries": {"file": "primaries.csv"},
    }
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(changes))
    return path


def test_a_command_opens_each_file_of_a_bench_once(bench, tmp_path):
    with opened_files() as opened:
        done = run_hilstar_here("frame", bench, "--radec", "84,-1,0", "-o", tmp_path / "sky.fits")
    assert done.returncode == 0, done.stderr
    named = {path.name: opened[str(path)] for path in tmp_path.glob("*.[cft][sio]*")}
    del named["sky.fits"]
    assert named == dict.fromkeys(named, 1)
    assert len(named) == 7


def test_a_screen_s_darkest_place_is_that_of_its_uneven_light(tmp_path):
    for name in ("lcd-example.toml", "lcd-example.csv", "lcd-example-uniformity.csv"):
        shutil.copy(DISPLAY_DATA / name, tmp_path / name)
    changes = {"monitor": {"calibration": "lcd-example.toml"}, "render": {"quantisation": "round"}}
    with open_bench(bench_file_of(tmp_path / "bench.toml", bench_text(changes))) as bench:
        assert bench.darkest == bench.uniformity.min()
        assert bench.darkest < bench.uniformity.mean() < bench.uniformity.max() == 1.0


TABLE = "ra_deg,dec_deg,v_mag,bv_mag\n84.05,-1.2,1.7,-0.2\n83.0,-0.3,2.2,-0.2\n85.2,-1.9,1.8,-0.2\n"


def write_votable(path: Path) -> None:
    table = Table.read(io.BytesIO(TABLE.encode()), format="ascii.csv")
    table.write(path, format="votable")


def write_fits_table(path: Path) -> None:
    Table.read(io.BytesIO(TABLE.encode()), format="ascii.csv").write(path)


CATALOGUES = {
    "stars.csv": lambda path: path.write_text(TABLE),
    "stars.fits": write_fits_table,
    "stars.vot": write_votable,
}


def write_map(path: Path) -> None:
    """A map of diffuse light, 2 by 2 degrees about Orion's belt."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = [84.0, -1.0], [10.5, 10.5], [-0.1, 0.1]
    light = fits.PrimaryHDU(np.full((20, 20), 22.0), wcs.to_header())
    light.header["BUNIT"] = "mag/arcsec2"
    light.writeto(path)


@pytest.mark.parametrize("name", CATALOGUES)
def test_a_catalogue_and_a_map_are_opened_once_before_they_are_in_the_cache(
    tmp_path, monkeypatch, name
):
    monkeypatch.setattr(reading, "SETTLED_NS", 0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    catalogue, diffuse = tmp_path / name, tmp_path / "map.fits"
    CATALOGUES[name](catalogue)
    write_map(diffuse)
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text({"sky": {"catalogue": name}, "sky.diffuse": {"map": "map.fits"}}))
    words = ("frame", bench, "--radec", "84,-1,0", "-o", tmp_path / "sky.fits")
    for first in (True, False):
        with opened_files() as opened:
            done = run_hilstar_here(*words)
        assert done.returncode == 0, done.stderr
        assert any((tmp_path / "cache").rglob("*.npz"))
        most = int(first)  # the second command of this process still has them
        assert (opened[str(catalogue)], opened[str(diffuse)]) == (most, most)


def test_a_file_that_changed_is_read_anew(bench):
    first = read_bench_file(bench)
    curve = bench.with_name("qe.csv")
    curve.write_text(curve.read_text().replace("0.5", "0.4"))
    second = read_bench_file(bench)
    assert second.sha256 != first.sha256
    assert second.config == first.config


def test_a_file_that_changed_a_moment_ago_is_not_kept(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("a")
    assert reading.named_bytes(path, "write it", 10) == b"a"
    with opened_files() as opened:
        reading.named_bytes(path, "write it", 10)
    assert opened[str(path)] == 1


def test_a_kept_file_of_more_than_a_limit_is_refused_as_one_that_is_opened(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "SETTLED_NS", 0)
    path = tmp_path / "table.csv"
    path.write_text("12345")
    assert reading.named_bytes(path, "write it", 5) == b"12345"
    with pytest.raises(reading.InputError) as kept:
        reading.named_bytes(path, "write it", 4)
    with pytest.raises(reading.InputError) as opened:
        reading.read_bytes(path, "write it", 4)
    assert str(kept.value) == str(opened.value)


def test_what_is_kept_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "SETTLED_NS", 0)
    monkeypatch.setattr(reading, "MAX_KEPT_BYTES", 10)
    paths: list[Path] = []
    for name in "abc":
        paths.append(tmp_path / name)
        paths[-1].write_bytes(b"1234")
        reading.named_bytes(paths[-1], "", 10)
    with opened_files() as opened:
        for path in reversed(paths):
            reading.named_bytes(path, "", 10)
    assert [opened[str(path)] for path in paths] == [1, 0, 0]
