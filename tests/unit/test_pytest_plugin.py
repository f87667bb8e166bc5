"""The pytest plugin, in a pytest of its own: what passes, what fails with which line, and what is
written.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hilstar
from hilstar import pytest_plugin
from hilstar.rotation import from_radec_roll_deg
from tests.support.benches import bench_text
from tests.support.commands import run_started

TEST = """
from hilstar.rotation import from_radec_roll_deg


def test_belt(hilstar_bench, assert_same_sky):
    assert_same_sky(hilstar_bench.frame(from_radec_roll_deg(84.057, {dec_deg}, 0.0)))


def test_named(hilstar_bench, assert_same_sky):
    assert_same_sky(hilstar_bench.frame(from_radec_roll_deg(10.0, 20.0, 0.0)), "andromeda")
"""
# A test that was written anew within a second has the time of the old one's compiled module.
PYTEST = """
import sys
import pytest
sys.dont_write_bytecode = True
sys.exit(pytest.main(sys.argv[2:]))
"""
SHIFT_DEG = 0.01  # 0.3 px of this bench, 300 times the limit


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "bench.toml").write_text(bench_text())
    write_test(tmp_path, -1.2)
    return tmp_path


def write_test(folder: Path, dec_deg: float) -> None:
    (folder / "test_sky.py").write_text(TEST.format(dec_deg=dec_deg))


def pytest_in(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    plugins = ("-p", "hilstar.pytest_plugin", "-p", "no:cacheprovider", "-p", "no:xdist")
    # the fork server has what this word names (`LATER`)
    command = [sys.executable, "-c", PYTEST, "pytest", "-q", *plugins, *options]
    return run_started(command, folder)


@pytest.mark.e2e
def test_golden_frames_are_written_compared_and_updated_where_they_differ(project):
    missing = pytest_in(project)
    assert missing.returncode == 1
    assert "test_belt.fits: there is no golden frame; write it with" in missing.stdout
    assert not (project / "golden").exists()

    written = pytest_in(project, "--update-golden")
    assert written.returncode == 0, written.stdout
    golden = project / "golden"
    names = {path.name for path in golden.iterdir()}
    assert names == {"test_belt.fits", "test_belt.csv", "andromeda.fits", "andromeda.csv"}
    assert written.stdout.count("wrote ") == 2

    write_test(project, -1.2 + SHIFT_DEG)
    before = (golden / "andromeda.fits").stat().st_mtime_ns
    moved = pytest_in(project)
    assert moved.returncode == 1
    assert "test_belt" in moved.stdout and "1 passed" in moved.stdout
    updated = pytest_in(project, "--update-golden")
    assert updated.returncode == 0
    assert updated.stdout.count("wrote ") == 1
    assert (golden / "andromeda.fits").stat().st_mtime_ns == before
    # frames like the golden ones pass; the bench file is the root's, from wherever pytest is called
    assert pytest_in(golden, f"--rootdir={project}", str(project)).returncode == 0


@pytest.mark.e2e
def test_a_missing_bench_is_one_line(project):
    (project / "pytest.ini").write_text("[pytest]\nhilstar_bench = nowhere.toml\n")
    failed = pytest_in(project)
    assert failed.returncode == 1
    assert "nowhere.toml: cannot be read" in failed.stdout
    assert "Traceback" not in failed.stdout


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("'belt', hilstar_bench.frame([1, 0, 0, 0])", "write the golden frame's name, after"),
        ("hilstar_bench.frame([1, 0, 0, 0]).linear", "golden frames are written of what"),
    ],
)
def test_a_wrong_golden_frame_is_one_line(project, arguments, said):
    text = f"def test_it(hilstar_bench, assert_same_sky):\n    assert_same_sky({arguments})\n"
    (project / "test_sky.py").write_text(text)
    failed = pytest_in(project, "--update-golden")
    assert failed.returncode == 1
    assert said in failed.stdout
    assert "Error" not in failed.stdout
    assert not (project / "golden").exists()


def test_a_golden_frame_is_written_where_it_differs_by_more_than_its_limits(
    request, tmp_path, monkeypatch
):
    """By default a thousandth of a magnitude, and of a pixel of 198 arcsec."""
    monkeypatch.setattr(pytest_plugin, "GOLDEN_FOLDER", str(tmp_path))
    few = {"render": {"quantisation": "round"}, "monitor": {"resolution_px": [160, 120]}}
    (tmp_path / "bench.toml").write_text(bench_text(few))
    with hilstar.load(tmp_path / "bench.toml") as bench:
        frame, moved = (bench.frame(from_radec_roll_deg(84.057, dec, 0.0)) for dec in (0.0, 1e-4))
    brighter = replace(frame, light=frame.light * np.float32(1.002))
    check, update = (pytest_plugin.GoldenFrames(request.node, update=on) for on in (False, True))
    written = request.node.user_properties
    known = len(written)
    golden = tmp_path / "Orion_1.fits"

    update(frame, "_Orion [1]")
    assert written[known:] == [(pytest_plugin.WRITTEN, str(golden))]
    assert golden.is_file() and golden.with_suffix(".csv").is_file()
    for other, wider in ((moved, {"centroid_px": 0.01}), (brighter, {"flux_mag": 0.01})):
        with pytest.raises(AssertionError):
            check(other, "Orion_1")
        check(other, "Orion_1", **wider)
        update(other, "Orion_1", **wider)
        assert len(written) == known + 1
    golden.with_suffix(".csv").unlink()
    update(frame, "Orion_1.fits")
    assert golden.with_suffix(".csv").is_file() and len(written) == known + 2
    update(brighter, "Orion_1")
    check(brighter, "Orion_1")
    assert len(written) == known + 3
    del written[known:]


def test_the_plugin_imports_nothing_of_hilstar_but_its_version():
    """A pytest of any project in the environment pays for the import."""
    code = "import sys, hilstar.pytest_plugin; print(*sorted(m for m in sys.modules if 'hil' in m))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= {
        "hilstar",
        "hilstar.basics",
        "hilstar.basics.version",
        "hilstar.pytest_plugin",
    }
