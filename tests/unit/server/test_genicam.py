"""Cameras by GenICam: their formats, their bytes as DN, and what is said where one fails."""

from __future__ import annotations

import json
import re
import sys
import time
from contextlib import closing
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.errors import InputError, MachineError
from hilstar.instruments.calibrate.first_light.image_sources import GrabCamera
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.genicam import camera as cameras
from hilstar.server.genicam.camera import (
    CameraError,
    CameraImage,
    GenicamCamera,
    chosen_format,
    has_aravis,
    list_cameras,
)
from hilstar.server.genicam.child_lines import chosen
from hilstar.server.genicam.pixels import mosaic_of, unpacked
from hilstar.server.gige.camera import GigECamera
from hilstar.server.gige.registers import CameraSettings
from tests.support.benches import TWIN, bench_text
from tests.support.commands import run_hilstar, run_hilstar_here
from tests.support.gige_cameras import fake_camera, running_camera
from tests.support.gige_client import own_address
from tests.support.refusals import refusal
from tests.support.waiting import wait_for

needs_aravis = pytest.mark.skipif(
    not has_aravis(), reason="Aravis is not installed (gir1.2-aravis-0.8, python3-gi)"
)


SEEN = [
    {"id": "A-1", "serial": "11", "address": "192.168.1.10", "vendor": "A", "model": "M"},
    {"id": "A-2", "serial": "22", "address": "192.168.1.11", "vendor": "A", "model": "M"},
    {"id": "B-3", "serial": "33", "address": "192.168.1.12", "vendor": "B", "model": "N"},
]


@pytest.mark.parametrize(
    ("name", "found"),
    [("A-2", "A-2"), ("22", "A-2"), ("192.168.1.11", "A-2"), ("B-N", "B-3"), ("33", "B-3")],
)
def test_a_camera_is_meant_by_its_identifier_serial_address_or_model(name, found):
    assert chosen(name, SEEN) == found
    assert chosen("", SEEN[:1]) == "A-1"


def test_a_name_of_no_camera_or_of_several_is_refused_with_what_is_there():
    for name, count in (("", 3), ("A-M", 2), ("C", 0)):
        with pytest.raises(LookupError, match=f"fits {count} of the cameras here: A-1 .*, B-3"):
            chosen(name, SEEN)
    with pytest.raises(LookupError, match="no camera is there"):
        chosen("A-1", [])


@pytest.mark.parametrize(
    ("asked_us", "off_us", "is_refused"),
    [
        (100_000.0, 999.0, False),
        (100_000.0, 1001.0, True),
        (100.0, 19.0, False),
        (100.0, 21.0, True),
    ],
)
def test_an_exposure_may_be_a_hundredth_or_a_step_off(asked_us, off_us, is_refused):
    camera = SimpleNamespace(about={"exposure_us": (10.0, 1e6)}, _said=lambda text: text)
    for exposure_us in (asked_us - off_us, asked_us + off_us):
        check = partial(GenicamCamera._check_exposure, camera, asked_us, exposure_us)
        if is_refused:
            assert "it can do 1e-05 to 1 s" in refusal(check)
        else:
            check()


@pytest.mark.parametrize(
    ("formats", "bits", "form"),
    [
        (["Mono8", "Mono12", "Mono16"], 12, "Mono12"),
        (["Mono8", "Mono12Packed", "Mono12p"], 12, "Mono12Packed"),
        (
            ["Mono12p", "Mono12Packed", "Mono12"],
            12,
            "Mono12",
        ),  # in whole bytes, whatever comes first
        (["Mono8", "Mono16"], 12, "Mono16"),
        (["Mono8", "Mono10"], 12, "Mono10"),
        (["RGB8", "BayerRG8", "BayerRG12"], 12, "BayerRG12"),
    ],
)
def test_the_format_is_the_one_that_holds_the_detectors_bits(formats, bits, form):
    assert chosen_format(formats, bits) == form


# A child that opens a camera of a test's own: it films two images of 2 rows of 3 pixels, 16 bits.
FILMING = """
import json, struct, sys
print(json.dumps({"exposure_us": [10.0, 1e6]}), flush=True)
for line in sys.stdin:
    asked = json.loads(line)
    first, last = asked["rows"] or (0, 2)
    with open(asked["file"], "wb") as file:
        for image in range(2):
            for row in range(first, last):
                file.write(struct.pack("<3H", *(1000 * image + 256 * row + k for k in range(3))))
    answer = {"exposure_us": asked["exposure_us"], "format": "Mono16", "width": 3, "height": 2}
    print(json.dumps(answer | {"frames": [[70, 5], [80, 16]], "incomplete": 1}), flush=True)
"""


@pytest.mark.parametrize(
    ("rows", "codes"), [(None, [[0, 1, 2], [256, 257, 258]]), ((1, 2), [[256, 257, 258]])]
)
def test_a_film_of_two_bytes_a_pixel_is_the_rows_asked_for(monkeypatch, rows, codes):
    monkeypatch.setattr(cameras, "child_command", lambda: [sys.executable, "-S", "-c", FILMING])
    with GenicamCamera("") as camera:
        film = camera.film(0.01, 0.1, rows)
        images = np.array(film.dn)
    np.testing.assert_array_equal(images, [codes, np.add(codes, 1000)])
    assert (film.stamp_ns.tolist(), film.arrived_utc_ns.tolist()) == ([70, 80], [5, 16])
    assert (film.exposure_s, film.incomplete) == (0.01, 1)


def test_a_camera_of_colour_images_alone_is_refused():
    assert "it has RGB8" in refusal(chosen_format, ["RGB8"], 12)


# By hand from the figures of the GenICam PFNC, and for names in "Packed" from GigE Vision's: pixel
# 0's bits are written a, pixel 1's b, the lowest first.
VECTORS = {
    "Mono8": ("01 FF", [0x01, 0xFF]),
    "Mono10": ("FF 03 34 02", [0x3FF, 0x234]),
    "Mono12": ("BC 0A 23 01", [0xABC, 0x123]),
    "Mono14": ("FF 3F 01 20", [0x3FFF, 0x2001]),
    "Mono16": ("CD AB 34 12", [0xABCD, 0x1234]),
    # ten bits each without gaps, lowest first: 1023, 0, 0, 256
    "Mono10p": ("FF 03 00 00 40", [0x3FF, 0, 0, 0x100]),
    # byte 1 is shared: a's upper four bits below, b's lower four above
    "Mono12p": ("BC 3A 12", [0xABC, 0x123]),
    # upper eight bits of a, lower ones of both (a's in bits 0 and 1, b's in 4 and 5), upper of b
    "Mono10Packed": ("AA 31 48", [0xAA << 2 | 0b01, 0x48 << 2 | 0b11]),
    "Mono12Packed": ("AB 3C 12", [0xABC, 0x123]),
    "BayerRG8": ("01 FF", [0x01, 0xFF]),
    "BayerRG12": ("BC 0A 23 01", [0xABC, 0x123]),
    "BayerGB12p": ("BC 3A 12", [0xABC, 0x123]),
    "BayerBG12Packed": ("AB 3C 12", [0xABC, 0x123]),
    "BayerGR10p": ("FF 03 00 00 40", [0x3FF, 0, 0, 0x100]),
}


@pytest.mark.parametrize("form", VECTORS)
def test_bytes_are_pixels_as_the_standard_has_them(form):
    data, pixels = VECTORS[form]
    image = unpacked(bytes.fromhex(data), form, len(pixels), 1)
    np.testing.assert_array_equal(image, [pixels])


@pytest.mark.parametrize("form", ["Mono12Packed", "Mono12p", "Mono10p", "Mono10Packed"])
def test_a_packed_image_of_an_odd_count_ends_within_a_byte_or_a_triple(form):
    # three pixels, the last one full: its bits are in its own bytes, with or without the pair's
    bits = int(form[4:6])
    full = (1 << bits) - 1
    count = 3 * bits
    if form.endswith("p"):
        data = (full << 2 * bits).to_bytes(-(-count // 8), "little")
    else:
        data = bytes([0, 0, 0, 0xFF, full & (1 << (bits - 8)) - 1])
    np.testing.assert_array_equal(unpacked(data, form, 3, 1), [[0, 0, full]])
    np.testing.assert_array_equal(unpacked(data + b"\0", form, 3, 1), [[0, 0, full]])


@pytest.mark.parametrize(
    ("form", "pattern"),
    [
        ("BayerRG8", "RGGB"),
        ("BayerGR12p", "GRBG"),
        ("BayerGB10Packed", "GBRG"),
        ("BayerBG16", "BGGR"),
        ("Mono12", ""),
    ],
)
def test_a_mosaic_is_told_by_its_formats_name(form, pattern):
    assert mosaic_of(form) == pattern


@pytest.mark.parametrize("form", ["Mono8", "Mono12", "Mono12Packed", "Mono10p"])
def test_an_image_without_all_its_bytes_is_refused(form):
    assert "came with 7 bytes" in refusal(unpacked, bytes(7), form, 8, 8)


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
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    with pytest.raises(MachineError, match=r"sudo apt-get install gir1\.2-aravis-0\.8") as refused:
        GenicamCamera("")
    assert 'in GENICAM_GENTL64_PATH, and pip install "hilstar[genicam]"' in str(refused.value)


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
def test_a_camera_that_is_let_go_can_be_set_by_the_next_at_once():
    with running_camera() as address:
        for gain_db in (1.0, 2.0, 3.0):
            with GenicamCamera(address) as camera:
                camera.set({"Gain": gain_db})
                camera.grab(0.01)


@needs_aravis
def test_a_camera_in_the_middle_of_an_exposure_is_left_soon():
    with running_camera() as address:
        camera = GenicamCamera(address)
        camera.set({"TriggerMode": "On"})  # nobody takes its trigger: no image comes
        camera.begin(30.0)
        begun_s = time.monotonic()
        camera.close()
        camera.close()
        # far below the exposure's 60 s
        assert time.monotonic() - begun_s < 30.0


@needs_aravis
def test_an_image_has_the_time_at_which_its_exposure_began():
    with running_camera() as address, GenicamCamera(address) as camera:
        before_ns = time.time_ns()
        image = camera.grab(0.25)
        after_ns = time.time_ns()
    assert image.exposure_s == 0.25 and image.bayer == ""
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


def whole_image(camera: GenicamCamera, exposure_s: float) -> CameraImage:
    """The first whole image: the fake camera sends each at once, of which a socket of a busy
    machine may lose a part.
    """
    images = []

    def is_whole() -> bool:
        try:
            images.append(camera.grab(exposure_s))
        except CameraError as error:
            if "incomplete" not in str(error):
                raise
        return bool(images)

    wait_for(is_whole, "a whole image")
    return images[0]


@needs_aravis
def test_a_fake_camera_of_others_gives_its_images_in_each_of_its_formats():
    with fake_camera() as address, GenicamCamera(address) as camera:
        assert set(camera.about["formats"]) == {*FAKE_FORMATS, "RGB8"}
        for form, mosaic in FAKE_FORMATS.items():
            camera.set({"PixelFormat": form})
            image = whole_image(camera, 0.01)
            assert image.dn.shape == (512, 512) and image.bayer == mosaic
            if form.startswith("Mono"):
                # its grey test pattern is a ramp along the diagonal
                upper = (image.dn >> (8 if form == "Mono16" else 0)).astype(int)
                np.testing.assert_array_equal(upper[1:, :-1], upper[:-1, 1:])
                assert np.ptp(upper) > 200
        camera.set({"PixelFormat": "RGB8"})
        assert "sends RGB8; write a pixel_format of grey" in refusal(whole_image, camera, 0.01)


@needs_aravis
def test_what_a_camera_does_not_take_is_refused_with_its_name():
    with running_camera() as address, GenicamCamera(address) as camera:
        with pytest.raises(InputError, match=r"\[tracker.camera\].*Nonsense"):
            camera.set({"Nonsense": 3})
        assert "it has Mono12" in refusal(camera.set, {"PixelFormat": "RGB8"})
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
    for script in (cameras.CHILD, cameras.CHILD.with_name("child_lines.py")):
        text = script.read_text()
        assert "import hilstar" not in text and "from hilstar" not in text


@needs_aravis
def test_doctor_lists_the_cameras():
    with running_camera() as address:
        found = run_hilstar("doctor", "--json")
    checks = {check["name"]: check for check in json.loads(found.stdout)["checks"]}
    assert f"at {address} (GigEVision)" in checks["cameras"]["detail"]


USB = {
    "id": "Maker-M1-777",
    "vendor": "Maker",
    "model": "M1",
    "serial": "777",
    "address": "USB3",
    "protocol": "USB3Vision",
}


def test_a_usb3_camera_is_listed_as_aravis_lists_it(tmp_path, monkeypatch):
    """Without one here: what Aravis would print of it."""
    child = tmp_path / "child.py"
    child.write_text(f"print({json.dumps([USB])!r})\n")
    monkeypatch.setattr(cameras, "CHILD", child)
    monkeypatch.setattr(cameras, "has_aravis", lambda: True)
    found = run_hilstar_here("doctor", "--json")
    checks = {check["name"]: check for check in json.loads(found.stdout)["checks"]}
    assert checks["cameras"]["detail"] == "Maker-M1, serial 777, at USB3 (USB3Vision)"


class LossyCamera(GigECamera):
    """A camera that loses a packet of each of its first images for good."""

    lossy = 2

    def _send_block(self, block):
        if block.number > self.lossy:
            super()._send_block(block)
            return
        self._blocks.remove(block)  # none is sent again
        for number, packet in enumerate(block.packets()):
            if number != 2:
                self._stream_socket.sendmsg(packet, (), 0, self.channel.destination)


class BrokenCamera(LossyCamera):
    """A camera that loses a packet of every image."""

    lossy = 1 << 16


class CoarseSettings(CameraSettings):
    """Of a camera that exposes for 20 ms at least, whatever it is told."""

    def __setattr__(self, name, value):
        super().__setattr__(name, max(value, 0.02) if name == "exposure_s" else value)


@needs_aravis
def test_an_incomplete_image_is_refused_and_taken_again():
    with running_camera(kind=LossyCamera) as address, GenicamCamera(address) as camera:
        image = camera.grab(0.01)
        # a busy machine may lose another one
        assert image.incomplete >= LossyCamera.lossy
        # The camera's images are one number everywhere: nothing is of another or missing.
        assert image.dn.min() == image.dn.max() > LossyCamera.lossy
        again = camera.grab(0.01)
        assert again.dn.min() == again.dn.max() > image.dn.max()


@needs_aravis
def test_images_that_never_come_whole_are_told():
    with (
        running_camera(kind=BrokenCamera) as address,
        GenicamCamera(address) as camera,
        pytest.raises(CameraError, match="8 images in a row came incomplete"),
    ):
        camera.grab(0.01)


@needs_aravis
def test_an_exposure_that_the_camera_did_not_set_is_told_with_both_figures():
    settings = CoarseSettings(64, 48, 12, 0.05, 20.0)
    with running_camera(settings) as address, GenicamCamera(address) as camera:
        assert camera.grab(0.03).exposure_s == pytest.approx(0.03)
        with pytest.raises(InputError, match=r"exposes for 0\.02 s where 0\.005 s were asked for"):
            camera.grab(0.005)


@needs_aravis
@pytest.mark.parametrize(
    ("dn", "told"),
    [(0, "every pixel is 0; look at the lens cap"), (4095, "3072 pixels are saturated at 4095")],
)
def test_black_and_saturated_images_are_told_once(tmp_path, caplog, dn, told):
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text(TWIN, {"tracker": {"resolution_px": [64, 48]}}))
    settings = CameraSettings(64, 48, 12, 0.01, 50.0)
    image = np.full((48, 64), dn, np.uint16)
    with (
        running_camera(settings, lambda k: image) as address,
        closing(GrabCamera(read_bench_file(bench), address)) as source,
    ):
        path = source.photograph(tmp_path / "one", 0.01)
        assert [told in record.getMessage() for record in caplog.records].count(True) == 1
    np.testing.assert_array_equal(source.pixels(path, (64, 48)), image)


@needs_aravis
def test_incomplete_images_are_told_by_their_number(tmp_path, caplog):
    bench = tmp_path / "bench.toml"
    bench.write_text(bench_text(TWIN, {"tracker": {"resolution_px": [64, 48]}}))
    with (
        running_camera(kind=LossyCamera) as address,
        closing(GrabCamera(read_bench_file(bench), address)) as source,
    ):
        source.photograph(tmp_path / "one", 0.01)
    assert re.search(r"one: taken again after [2-7] incomplete images", caplog.text)
