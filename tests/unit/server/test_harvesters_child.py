"""The child that holds a camera of a vendor's GenTL producer: what it asks of Harvesters, which
stands in here as the test's own (test_genicam_harvesters.py has the real one where it is
installed).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tests.unit.server.test_genicam_children import HEIGHT, IMAGE, WIDTH, child, module_of

FACTS = {
    "id_": "dev-7",
    "vendor": "A",
    "model": "M",
    "serial_number": "7",
    "display_name": "A M (7)",
    "tl_type": "U3V",
}
CAMERA = {
    "id": "dev-7",
    "vendor": "A",
    "model": "M",
    "serial": "7",
    "address": "A M (7)",
    "protocol": "U3V",
}
EXPOSURE_US, ARRIVED_NS = 1000.0, 123_456
PATIENCE_S = 20.002  # 20 s, and twice the exposure


class GenApiError(Exception):
    """A node map's."""


class GenTLError(Exception):
    """A producer's."""


class Buffer:
    """An image with room for more behind it; a figure that is None is not known."""

    def __init__(self, told: list[Any], number: int, padding: int | None, stamped: bool) -> None:
        self.width, self.height = WIDTH, HEIGHT
        self.raw_buffer, self.size_filled = IMAGE + b"old", len(IMAGE)
        self.parent = SimpleNamespace(queue_buffer=lambda buffer: told.append("queued"))
        self._padding, self._stamp_ns = padding, number if stamped else None

    @property
    def padding_x(self) -> int:
        return self._known(self._padding)

    @property
    def timestamp_ns(self) -> int:
        return self._known(self._stamp_ns)

    @staticmethod
    def _known(figure: int | None) -> int:
        if figure is None:
            raise GenTLError("not available")
        return figure


class Acquirer:
    """A camera whose images are `kinds` in turn: "whole", "torn" or "none", which takes as long as
    it may.
    """

    def __init__(self, features: Any, kinds: list[str], more: dict[str, Any]) -> None:
        self.remote_device = SimpleNamespace(node_map=features)
        self.told: list[Any] = []
        self.num_buffers = 3
        self.now_s = 0.0
        self._kinds = kinds
        self._more = {"padding": 0, "stamped": True} | more

    def try_fetch(self, *, timeout: float, is_raw: bool) -> Buffer | None:
        assert is_raw
        self.told.append(("fetch", round(timeout, 6)))
        kind = self._kinds.pop(0) if self._kinds else "none"
        self.now_s += timeout if kind == "none" else 1.0
        if kind != "whole":
            return None
        return Buffer(self.told, len(self.told), **self._more)

    def __getattr__(self, name: str) -> Callable[[], None]:
        return lambda: self.told.append(name)


def opened(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    kinds: list[str],
    trigger: str | None = None,
    exposure: str | None = "ExposureTime",
    **more: Any,
) -> tuple[ModuleType, Acquirer, list[Any], Any]:
    """The child's module, its camera's acquirer, the files that Harvesters was given, and the
    camera's features.
    """
    mono = SimpleNamespace(value="Mono8", symbolics=("Mono8", "Mono12"))
    features = SimpleNamespace(PixelFormat=mono, GainAuto=SimpleNamespace(value="Continuous"))
    if exposure:
        setattr(features, exposure, SimpleNamespace(value=5.0, min=10, max=60e6))
    acquirer = Acquirer(features, kinds, more)
    if trigger is not None:
        features.TriggerMode = SimpleNamespace(value=trigger)
        fire = SimpleNamespace(execute=lambda: acquirer.told.append("trigger"))
        features.TriggerSoftware = fire
    files: list[Any] = []

    class Reader:
        device_info_list = (SimpleNamespace(property_dict=FACTS),)

        def add_file(self, name: str, *, check_validity: bool) -> None:
            if "bad" in name:
                raise OSError("wrong ELF class")
            files.append((Path(name).name, check_validity))

        def update(self) -> None:
            files.append("update")

        def create(self, which: dict[str, str]) -> Acquirer:
            assert which == {"id_": "dev-7"}
            return acquirer

        def reset(self) -> None:
            files.append("reset")

    for name in ("one/b.cti", "one/a.cti", "two/c.cti", "two/readme.txt"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    monkeypatch.setenv("GENICAM_GENTL64_PATH", f"{folder / 'two'}::{folder / 'one'}")
    module = child(
        "harvesters_child",
        monkeypatch,
        genicam_dot_genapi=module_of("genapi", GenericException=GenApiError),
        genicam_dot_gentl=module_of("gentl", GenericException=GenTLError),
        harvesters_dot_core=module_of("core", Harvester=Reader),
    )
    clock = SimpleNamespace(monotonic=lambda: acquirer.now_s, time_ns=lambda: ARRIVED_NS)
    monkeypatch.setattr(module, "time", clock)
    return module, acquirer, files, features


def test_cameras_are_those_of_every_producer_and_one_is_opened_without_automatic_light(
    monkeypatch, tmp_path
):
    module, acquirer, files, features = opened(monkeypatch, tmp_path, [])
    loaded = [(f"{name}.cti", True) for name in "cab"]
    assert module.cameras() == [CAMERA]
    assert files == [*loaded, "update", "reset"]
    files.clear()
    camera = module.HarvestersCamera("A-M")
    assert files == [*loaded, "update"]
    assert camera.about() == {
        "vendor": "A",
        "model": "M",
        "formats": ["Mono8", "Mono12"],
        "exposure_us": [10, 60e6],
    }
    assert features.GainAuto.value == "Off"
    camera.adjust({"PixelFormat": "Mono12"})
    assert features.PixelFormat.value == "Mono12"
    for wrong, words in (({"PixelFormat": "Mono16"}, "no PixelFormat Mono16"), ({"Lid": 1}, "Lid")):
        with pytest.raises(LookupError, match=words):
            camera.adjust(wrong)
    camera.close()
    assert acquirer.told == ["destroy"] and files[-1] == "reset"
    (tmp_path / "one" / "bad.cti").touch()
    with pytest.raises(LookupError, match=r"bad\.cti cannot be loaded: wrong ELF class"):
        module.cameras()


@pytest.mark.parametrize(
    ("trigger", "exposure"),
    [(None, "ExposureTime"), ("Off", "ExposureTimeAbs"), ("On", "ExposureTime")],
)
def test_an_image_is_the_first_whole_one_and_each_is_triggered_where_that_is_on(
    monkeypatch, tmp_path, trigger, exposure
):
    kinds = ["torn", "torn", "whole"]
    module, acquirer, _, features = opened(monkeypatch, tmp_path, kinds, trigger, exposure)
    facts = module.HarvestersCamera("7").take(EXPOSURE_US, tmp_path / "image")
    assert facts == {
        "format": "Mono8",
        "width": WIDTH,
        "height": HEIGHT,
        "exposure_us": EXPOSURE_US,
        "arrived_utc_ns": ARRIVED_NS,
        "incomplete": 2,
    }
    assert getattr(features, exposure).value == EXPOSURE_US
    assert (tmp_path / "image").read_bytes() == IMAGE
    fetch = ["trigger"] * (trigger == "On") + [("fetch", PATIENCE_S)]
    assert acquirer.told == ["start", *fetch * 3, "queued", "stop"]


@pytest.mark.parametrize(
    ("kinds", "more", "words"),
    [
        (["none"], {}, "no image came"),
        (["torn"] * 8 + ["whole"], {}, "8 images in a row came incomplete"),
        (["whole"], {"padding": 2}, "2 bytes of padding"),
    ],
)
def test_an_image_that_does_not_come_whole_is_refused_and_the_camera_stopped(
    monkeypatch, tmp_path, kinds, more, words
):
    module, acquirer, *_ = opened(monkeypatch, tmp_path, kinds, **more)
    camera = module.HarvestersCamera("")
    with pytest.raises(LookupError, match=words):
        camera.take(EXPOSURE_US, tmp_path / "image")
    assert acquirer.told[-1] == "stop" and not (tmp_path / "image").exists()


@pytest.mark.parametrize(("rows", "part"), [(None, IMAGE), ([1, 2], IMAGE[WIDTH : 2 * WIDTH])])
@pytest.mark.parametrize("stamped", [True, False])
def test_a_film_has_the_rows_asked_for_of_each_whole_image_until_its_time_is_over(
    monkeypatch, tmp_path, rows, part, stamped
):
    """Each image takes a second; a producer that knows of no padding or stamps has none."""
    kinds = ["whole", "torn", "whole", "whole", "whole"]
    more = {} if stamped else {"padding": None, "stamped": False}
    module, acquirer, *_ = opened(monkeypatch, tmp_path, kinds, **more)
    told = module.HarvestersCamera("").film(EXPOSURE_US, tmp_path / "film", 3.5, rows)
    stamps = [2, 5, 7] if stamped else [0, 0, 0]
    assert told["frames"] == [(stamp, ARRIVED_NS) for stamp in stamps]
    assert (told["incomplete"], told["width"], told["height"]) == (1, WIDTH, HEIGHT)
    assert (tmp_path / "film").read_bytes() == 3 * part
    assert acquirer.num_buffers == 40 and acquirer.told[-1] == "stop"
    assert acquirer.told.count("queued") == 3


def test_a_camera_without_an_exposure_time_is_refused(monkeypatch, tmp_path):
    module, *_ = opened(monkeypatch, tmp_path, [], exposure=None)
    with pytest.raises(LookupError, match="has no ExposureTime"):
        module.HarvestersCamera("dev-7")
