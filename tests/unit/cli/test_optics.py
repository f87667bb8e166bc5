"""What `hilstar optics` hands to its engines and says of their glass: the engines are the test's."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilstar.optics.glass import maps, prescription, psf_file
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here

GLASS = SimpleNamespace(
    places_px=np.zeros((6, 2)),
    wavelengths_nm=np.array([450.0, 550.0]),
    focuses_um=np.array([-10.0, 0.0, 10.0]),
    basis=np.zeros((4, 3, 3)),
    residual=2.5e-4,
    outside=np.array([0.001, 0.03]),
    illumination=np.array([1.0, 0.5]),
)


@pytest.fixture
def written(monkeypatch) -> list[Any]:
    """The glass that was written, and where."""
    kept: list[Any] = []
    monkeypatch.setattr(psf_file, "write_glass", lambda *given: kept.append(given))
    return kept


def test_a_map_is_made_as_the_words_say_and_its_worst_shares_are_told(
    tmp_path, monkeypatch, written
):
    given = []

    def glass_of_map(*asked):
        given.append(asked)
        return GLASS

    monkeypatch.setattr(maps, "glass_of_map", glass_of_map)
    for name in ("s.fits", "p.csv"):
        (tmp_path / name).write_bytes(b"")
    words = ["optics", "map", "s.fits", "p.csv", "-o", "g.fits"]
    more = ["--oversampling", "4", "--pixel-integrated", "--tolerance", "0.01"]
    done = run_hilstar_here(*words, *more, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert run_hilstar_here(*words, cwd=tmp_path).stdout == (
        "6 field points, 2 wavelengths, 3 focus positions: 4 components, which put up to 2.5e-04 of"
        " a PSF's light elsewhere; wrote g.fits\n"
    )
    files = Path("s.fits"), Path("p.csv")
    assert given == [(*files, 4, True, 0.01), (*files, 1, False, 1e-3)]
    assert written == [(Path("g.fits"), GLASS)] * 2
    told = json.loads(done.stdout)
    assert (told["points"], told["components"]) == (6, 4)
    assert (told["outside_share"], told["relative_illumination"]) == (0.03, 0.5)


@pytest.mark.parametrize(
    ("words", "size_px", "pitch_um", "focuses_um"),
    [
        (["--bench", "bench.toml"], (96, 64), 7.5, (0.0,)),
        (["--bench", "bench.toml", "--pitch-um", "5"], (96, 64), 5.0, (0.0,)),
        (["--bench", "bench.toml", "--resolution", "30,20"], (30, 20), 7.5, (0.0,)),
        (
            ["--pitch-um", "5", "--resolution", "30,20", "--focuses-um", "-20,0,20"],
            (30, 20),
            5.0,
            (-20.0, 0.0, 20.0),
        ),
        (["--pitch-um", "5"], None, None, ()),
        (["--resolution", "30,20"], None, None, ()),
    ],
)
@pytest.mark.usefixtures("written")
def test_a_lens_is_traced_onto_the_pixels_that_are_given_or_else_the_bench_s(
    tmp_path, monkeypatch, words, size_px, pitch_um, focuses_um
):
    given = []
    traced = SimpleNamespace(focal_length_mm=70.5, f_number=2.35, notes=("a note",), glass=GLASS)

    def glass_of_prescription(*asked):
        given.append(asked)
        return traced

    monkeypatch.setattr(prescription, "glass_of_prescription", glass_of_prescription)
    tracker = {"resolution_px": [96, 64], "pixel_pitch_um": 7.5}
    (tmp_path / "bench.toml").write_text(bench_text({"tracker": tracker}))
    (tmp_path / "lens.zmx").write_bytes(b"")
    done = run_hilstar_here("optics", "lens", "lens.zmx", "-o", "g.fits", *words, cwd=tmp_path)
    if size_px is None:
        assert done.returncode == 2 and "need the tracker's pixels" in done.stderr
        assert given == []
        return
    assert done.returncode == 0, done.stderr
    ((path, plate, oversampling, tolerance),) = given
    assert (path, oversampling, tolerance) == (Path("lens.zmx"), None, 1e-3)
    assert plate == prescription.Plate(size_px, pitch_um, focuses_um, 8)
    assert "lens.zmx: a note" in done.stderr
    assert done.stdout.splitlines()[-1] == (
        "in the bench file, under [tracker]: focal_length_mm = 70.5  # F/2.35"
    )
    words = ("optics", "lens", "lens.zmx", "-o", "g.fits", *words, "--json")
    told = json.loads(run_hilstar_here(*words, cwd=tmp_path).stdout)
    assert (told["focal_length_mm"], told["f_number"], told["notes"]) == (70.5, 2.35, ["a note"])
