"""Cameras by GenICam: their formats, their bytes as DN, and what is said where one fails."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest

from hilstar.basics.errors import InputError, MachineError
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.genicam import camera as cameras
from hilstar.server.genicam.camera import (
    GenicamCamera,
    chosen_format,
    has_aravis,
    list_cameras,
)
from hilstar.server.genicam.pixels import unpacked
from tests.support.benches import TWIN, bench_text
from tests.support.commands import run_hilstar
from tests.support.gige_cameras import fake_camera, running_camera
from tests.support.gige_client import own_address

needs_aravis = pytest.mark.skipif(
    not has_aravis(), reason="Aravis is not installed (gir1.2-aravis-0.8, python3-gi)"
)


@pytest.mark.parametrize(
    ("formats", "bits", "form"),
    [
        (["Mono8", "Mono12", "Mono16"], 12, "Mono12"),
        (["Mono8", "Mono12Packed", "Mono12p"], 12, "Mono12Packed"),
        (["Mono8", "Mono16"], 12, "Mono16"),
        (["Mono8", "Mono10"], 12, "Mono10"),
        (["RGB8", "BayerRG8", "BayerRG12"], 12, "BayerRG12"),
    ],
)
def test_the_format_is_the_one_that_holds_the_detectors_bits(formats, bits, form):
    assert chosen_format(formats, bits) == form


def test_a_camera_of_colour_images_alone_is_refused():
    with pytest.raises(InputError, match="it has RGB8"):
        chosen_format(["RGB8"], 12)


def test_bits_in_a_row_are_pixels_lowest_bit_first():
    # PFNC's figure of Mono12p: three bytes, the middle one shared by its halves.
    data = bytes([0xBC, 0x3A, 0x12])
    np.testing.assert_array_equal(unpacked(data, "Mono12p", 2, 1), [[0xABC, 0x123]])
    data = bytes([0xFF, 0x03, 0x00, 0x00, 0x40])  # 1023, 0, 0, 256 in ten bits each
    np.testing.assert_array_equal(unpacked(data, "Mono10p", 4, 1), [[0x3FF, 0, 0, 0x100]])


@pytest.mark.parametrize("form", ["Mono8", "Mono12", "Mono12Packed", "Mono10p"])
def test_an_image_without_all_its_bytes_is_refused(form):
    with pytest.raises(InputError, match="came with 7 bytes"):
        unpacked(bytes(7), form, 8, 8)


def test_the_cameras_settings_change_no_hash_of_the_bench(tmp_path):
    plain, with_camera = tmp_path / "plain.toml", tmp_path / "camera.toml"
    plain.write_text(bench_text(TWIN, {}))
    table = "[tracker.camera]\ngain = 3.0\nfeatures = { BlackLevel = 10.0 }\n"
    with_camera.write_text(f"{bench_text(TWIN, {})}\n{table}")
    assert read_bench_file(plain).sha256 == read_bench_file(with_camera).sha256
    assert read_bench_file(with_camera).config.tracker.camera.settings() == {
        "BlackLevel": 10.0,
        "Gain": 3.0,
    }


def test_without_aravis_it_says_what_to_install(monkeypatch):
    monkeypatch.setattr(cameras, "has_aravis", lambda: False)
    with pytest.raises(MachineError, match=r"sudo apt-get install gir1\.2-aravis-0\.8"):
        GenicamCamera("")


@needs_aravis
def test_a_camera_is_listed_set_and_read_in_every_format_it_has():
    with running_camera() as address:
        listed = [camera for camera in list_cameras() if camera["address"] == address]
        assert [camera["vendor"] for camera in listed] == ["hilstar"]
        with GenicamCamera(address) as camera:
            newest = 0
            for form in camera.about["formats"]:
                camera.set({"PixelFormat": form})
                image = camera.grab(0.01).dn
                assert image.shape == (48, 64) and image.min() == image.max()
                if form != "Mono8":
                    assert image[0, 0] > newest
                    newest = int(image[0, 0])


@needs_aravis
def test_an_image_has_the_time_at_which_its_exposure_began():
    with running_camera() as address, GenicamCamera(address) as camera:
        before_ns = time.time_ns()
        image = camera.grab(0.25)
        after_ns = time.time_ns()
    assert image.exposure_s == 0.25 and image.incomplete == 0 and image.bayer == ""
    # The virtual camera of this test exposes nothing: its image comes at once.
    assert before_ns <= image.begun_utc_ns + 250_000_000 <= after_ns


# Aravis's fake camera has these beside RGB8.
FAKE_FORMATS = {
    "Mono8": "",
    "Mono16": "",
    "BayerRG8": "RGGB",
    "BayerGR8": "GRBG",
    "BayerGB8": "GBRG",
    "BayerBG8": "BGGR",
}


@needs_aravis
def test_a_fake_camera_of_others_gives_its_images_in_each_of_its_formats():
    with fake_camera() as address, GenicamCamera(address) as camera:
        assert set(camera.about["formats"]) == {*FAKE_FORMATS, "RGB8"}
        for form, mosaic in FAKE_FORMATS.items():
            camera.set({"PixelFormat": form})
            image = camera.grab(0.01)
            assert image.dn.shape == (512, 512) and image.bayer == mosaic
            if form.startswith("Mono"):
                # its grey test pattern is a ramp along the diagonal
                upper = (image.dn >> (8 if form == "Mono16" else 0)).astype(int)
                np.testing.assert_array_equal(upper[1:, :-1], upper[:-1, 1:])
                assert np.ptp(upper) > 200
        camera.set({"PixelFormat": "RGB8"})
        with pytest.raises(InputError, match="sends RGB8; write a pixel_format of grey"):
            camera.grab(0.01)


@needs_aravis
def test_what_a_camera_does_not_take_is_refused_with_its_name():
    with running_camera() as address, GenicamCamera(address) as camera:
        with pytest.raises(InputError, match=r"\[tracker.camera\].*Nonsense"):
            camera.set({"Nonsense": 3})
        with pytest.raises(InputError, match="it has Mono12"):
            camera.set({"PixelFormat": "RGB8"})
        with pytest.raises(MachineError, match="ExposureTime"):
            camera.grab(100.0)


@needs_aravis
def test_a_camera_that_is_not_there_ends_with_code_3_and_one_line(tmp_path):
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text(TWIN, {}))
    grab = f"genicam:{own_address()}"
    refused = run_hilstar("first-light", bench, "-o", tmp_path / "s", "--grab", grab)
    assert refused.returncode == 3
    assert len(refused.stderr.strip().splitlines()) == 1 and grab in refused.stderr


def test_the_child_imports_nothing_of_hilstar():
    text = cameras.CHILD.read_text()
    assert "import hilstar" not in text and "from hilstar" not in text


@needs_aravis
def test_doctor_lists_the_cameras():
    with running_camera() as address:
        found = run_hilstar("doctor", "--json")
    checks = {check["name"]: check for check in json.loads(found.stdout)["checks"]}
    assert address in checks["cameras"]["detail"]
