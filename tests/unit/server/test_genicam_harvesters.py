"""Cameras by Harvesters and a GenTL producer: one of C, compiled here, as no vendor's can be had."""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from hilstar.basics.errors import InputError, MachineError
from hilstar.instruments.calibrate.first_light.image_sources import GrabCamera
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.genicam import camera as cameras
from hilstar.server.genicam.camera import CameraError, GenicamCamera, list_cameras
from tests.support.benches import TWIN, bench_text
from tests.support.commands import run_hilstar_here
from tests.support.compilers import compiled

SOURCE = Path(__file__).parents[2] / "support" / "gentl_producer.c"
COMPILE = ["gcc", "-Wall", "-Werror", "-shared", "-fPIC", "-pthread", "-fvisibility=hidden"]
WIDTH, HEIGHT = 64, 48
needs_harvesters = pytest.mark.skipif(
    find_spec("harvesters") is None or shutil.which("gcc") is None,
    reason="Harvesters (hilstar[genicam]) and gcc are not installed",
)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder of the compiled producer."""
    folder = tmp_path_factory.mktemp("producer")
    compiled(folder / "test.cti", *COMPILE, SOURCE)
    return folder


@pytest.fixture
def producer(built, monkeypatch):
    """The producer, as a vendor's set-up names it."""
    monkeypatch.setenv("GENICAM_GENTL64_PATH", f"/nowhere:{built}")


def expected(number, bits=12):
    """The producer's image of a number, DN."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return (columns + 7 * rows + number) % 4096 >> (12 - bits)


@needs_harvesters
def test_a_producers_cameras_are_listed(producer):
    (camera,) = list_cameras()
    assert (camera["vendor"], camera["model"], camera["serial"]) == ("Test", "Synthetic", "S42")
    found = run_hilstar_here("doctor", "--json")
    checks = {check["name"]: check for check in json.loads(found.stdout)["checks"]}
    assert "Test-Synthetic, serial S42" in checks["cameras"]["detail"]


@needs_harvesters
@pytest.mark.parametrize("name", ["", "S42", "Test-Synthetic", "DEV-1"])
def test_a_camera_is_opened_by_each_of_its_names(producer, name):
    with GenicamCamera(name) as camera:
        assert camera.about["formats"] == ["Mono8", "Mono12", "Mono12Packed"]
        assert camera.about["exposure_us"] == [20.0, 1e6]


@needs_harvesters
def test_images_come_as_the_camera_has_them_in_every_format(producer):
    with GenicamCamera("") as camera:
        for form, bits in (("Mono12", 12), ("Mono12Packed", 12), ("Mono8", 8)):
            camera.set({"PixelFormat": form})
            image = camera.grab(0.005)
            numbers = [k for k in range(1, 200) if np.array_equal(image.dn, expected(k, bits))]
            assert numbers
            assert image.exposure_s == 0.005 and image.incomplete == 0


@needs_harvesters
def test_incomplete_images_are_taken_again(producer, monkeypatch):
    monkeypatch.setenv("GENTL_TEST_INCOMPLETE", "3")
    with GenicamCamera("") as camera:
        image = camera.grab(0.005)
        assert image.incomplete == 3
        np.testing.assert_array_equal(image.dn, expected(4))
    monkeypatch.setenv("GENTL_TEST_INCOMPLETE", "1000")
    with GenicamCamera("") as camera, pytest.raises(CameraError, match="8 images in a row"):
        camera.grab(0.005)


@needs_harvesters
def test_a_film_is_the_wanted_rows_of_images_in_their_order(producer):
    with GenicamCamera("") as camera:
        film = camera.film(0.005, 0.6, (10, 12))
        assert film.dn.shape[1:] == (2, WIDTH) and len(film.dn) > 5
        number = film.dn[:, 0, 0].astype(int) - 70
        assert (np.diff(number) >= 1).all()
        for k, rows in zip(number, film.dn, strict=True):
            np.testing.assert_array_equal(rows, expected(k)[10:12])
        assert (np.diff(film.stamp_ns) > 0).all() and (np.diff(film.arrived_utc_ns) > 0).all()


@needs_harvesters
@pytest.mark.parametrize(
    ("feature", "value", "says"),
    [
        ("Nonsense", 3, r"\[tracker.camera\].*no feature Nonsense"),
        ("PixelFormat", "RGB8", "it has Mono8, Mono12, Mono12Packed"),
        ("ExposureTime", 5e7, "ExposureTime"),
        ("ExposureTime", "long", "ExposureTime"),
    ],
)
def test_what_the_camera_does_not_take_is_refused_with_its_name(producer, feature, value, says):
    with GenicamCamera("") as camera, pytest.raises(InputError, match=says):
        camera.set({feature: value})


@needs_harvesters
def test_a_session_takes_its_images_so(producer, tmp_path, caplog):
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text(TWIN, {"tracker": {"resolution_px": [WIDTH, HEIGHT]}}))
    with closing(GrabCamera(read_bench_file(bench), "S42")) as source:
        path = source.photograph(tmp_path / "one", 0.005)
    assert "the tracker's images are Test Synthetic's, Mono12" in caplog.text
    image = fits.getdata(path)
    np.testing.assert_array_equal(image, expected(int(image[0, 0])))


@needs_harvesters
def test_a_camera_that_is_not_there_is_told_with_those_that_are(producer):
    with pytest.raises(MachineError, match=r"genicam:S43 fits 0 of the cameras here: DEV-1"):
        GenicamCamera("S43")


@needs_harvesters
def test_a_producer_that_cannot_be_loaded_is_told_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "broken.cti").write_text("no library")
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(tmp_path))
    with pytest.raises(MachineError) as refused:
        GenicamCamera("")
    assert "\n" not in str(refused.value)
    assert "broken.cti" in str(refused.value)


def test_a_path_without_a_producer_leaves_it_to_aravis(tmp_path, monkeypatch):
    monkeypatch.setenv("GENICAM_GENTL64_PATH", f"{tmp_path}:/nowhere:")
    assert not cameras.has_harvesters()
    monkeypatch.setattr(cameras, "has_aravis", lambda: True)
    assert cameras.child_command() == [str(cameras.SYSTEM_PYTHON), str(cameras.CHILD)]


def test_without_harvesters_a_producer_alone_opens_nothing(tmp_path, monkeypatch):
    (tmp_path / "some.cti").write_bytes(b"")
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(tmp_path))
    monkeypatch.setattr(cameras, "find_spec", lambda name: None)
    monkeypatch.setattr(cameras, "has_aravis", lambda: False)
    with pytest.raises(MachineError, match=r'pip install "hilstar\[genicam\]"'):
        GenicamCamera("")
