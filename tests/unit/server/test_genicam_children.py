"""The children that hold a camera: their lines, and what they ask of Aravis and Harvesters, which
stand in here as the test's own.
"""

from __future__ import annotations

import importlib.util
import io
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from hilstar.server.genicam import child_lines

HERE = Path(child_lines.__file__).parent
WIDTH, HEIGHT = 4, 3
IMAGE = bytes(range(WIDTH * HEIGHT))
LISTED = [
    {"id": "A-7", "vendor": "A", "model": "M", "serial": "7", "address": "h", "protocol": "p"}
]


def child(name: str, monkeypatch: pytest.MonkeyPatch, **modules: ModuleType) -> ModuleType:
    """A child's module, with others in place of what is not installed."""
    for each, module in modules.items():
        monkeypatch.setitem(sys.modules, each.replace("_dot_", "."), module)
    monkeypatch.setitem(sys.modules, "child_lines", child_lines)
    spec = importlib.util.spec_from_file_location(name, HERE / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def module_of(name: str, **contents: Any) -> ModuleType:
    module = ModuleType(name)
    vars(module).update(contents)
    return module


class FakeCamera:
    """A camera whose images are `kinds` in turn: "whole", "torn", "none" or "padded"."""

    def __init__(self, *kinds: str, mode: str | None = "Off") -> None:
        self.kinds, self.mode = list(kinds), mode
        self.told: list[tuple[Any, ...]] = []
        self.queued = 0

    def __getattr__(self, name: str) -> Any:
        if name.startswith("is_"):
            return lambda: True
        return lambda *given: self.told.append((name, *given))

    def times(self, name: str) -> int:
        """How often a method was called."""
        return sum(call[0] == name for call in self.told)

    def get_device(self) -> FakeCamera:
        return self

    def get_string_feature_value(self, name: str) -> str:
        assert name == "TriggerMode"
        if self.mode is None:
            raise GError("no such feature")
        return self.mode

    def get_payload(self) -> int:
        return len(IMAGE)

    def dup_available_pixel_formats_as_strings(self) -> list[str]:
        return ["Mono8", "Mono12"]

    def get_pixel_format_as_string(self) -> str:
        return "Mono8"

    def get_exposure_time(self) -> float:
        return 999.5

    def create_stream(self, *_: object) -> FakeCamera:
        return self

    def push_buffer(self, buffer: Any) -> None:
        self.queued += 1

    def timeout_pop_buffer(self, patience_us: int) -> Any:
        self.told.append(("patience", patience_us))
        kind = self.kinds.pop(0) if self.kinds else "none"
        if kind == "none":
            return None
        number = self.times("patience")
        self.queued -= 1
        return SimpleNamespace(
            get_status=lambda: "torn" if kind == "torn" else "success",
            get_image_padding=lambda: (2 if kind == "padded" else 0, 0),
            get_image_data=lambda: IMAGE,
            get_image_width=lambda: WIDTH,
            get_image_height=lambda: HEIGHT,
            get_timestamp=lambda: number,
            get_system_timestamp=lambda: 100 + number,
        )


class GError(Exception):
    """GLib's error, as it is raised: its words are in `message`."""

    def __init__(self, message: str) -> None:
        super().__init__("domain", 4)
        self.message = message


@pytest.fixture
def aravis(monkeypatch):
    """Opens a fake camera by Aravis's child."""

    def opened(camera: FakeCamera, name: str = "192.168.1.10") -> Any:
        fake = SimpleNamespace(
            Camera=SimpleNamespace(new=lambda which: camera.told.append(("new", which)) or camera),
            Auto=SimpleNamespace(OFF="off"),
            Buffer=SimpleNamespace(new_allocate=lambda size: size),
            BufferStatus=SimpleNamespace(SUCCESS="success"),
            update_device_list=lambda: None,
            get_n_devices=lambda: 1,
        )
        for key, value in LISTED[0].items():
            name_of = "serial_nbr" if key == "serial" else key
            setattr(fake, f"get_device_{name_of}", lambda k, value=value: value)
        module = child(
            "aravis_child",
            monkeypatch,
            gi=module_of("gi", require_version=lambda *_: None),
            gi_dot_repository=module_of("r", Aravis=fake, GLib=SimpleNamespace(Error=GError)),
        )
        return module.AravisCamera(name)

    return opened


@pytest.mark.parametrize(("name", "opened"), [("192.168.1.10", "192.168.1.10"), ("7", "A-7")])
def test_a_camera_is_opened_by_its_address_or_as_it_is_listed_without_automatic_light(
    aravis, name, opened
):
    camera = FakeCamera()
    aravis(camera, name)
    assert camera.told == [
        ("new", opened),
        ("set_exposure_time_auto", "off"),
        ("set_gain_auto", "off"),
    ]


def test_features_are_set_by_their_kind_and_a_format_that_is_none_is_refused(aravis):
    camera = FakeCamera()
    held = aravis(camera)
    camera.told.clear()
    held.adjust({"A": True, "B": 1, "C": 1.0, "D": "On", "PixelFormat": "Mono12"})
    kinds = ("boolean", "integer", "float", "string", "string")
    assert [call[0] for call in camera.told] == [f"set_{kind}_feature_value" for kind in kinds]
    assert [call[1:] for call in camera.told][:2] == [("A", True), ("B", 1)]
    with pytest.raises(LookupError, match="no PixelFormat Mono16; it has Mono8, Mono12"):
        held.adjust({"PixelFormat": "Mono16"})


@pytest.mark.parametrize(("mode", "triggers"), [("Off", 0), ("On", 3), (None, 0)])
def test_an_image_is_the_first_whole_one_and_each_is_triggered_where_that_is_on(
    aravis, tmp_path, mode, triggers
):
    camera = FakeCamera("torn", "torn", "whole", mode=mode)
    facts = aravis(camera).take(1000.0, tmp_path / "image")
    assert facts == {
        "format": "Mono8",
        "width": WIDTH,
        "height": HEIGHT,
        "exposure_us": 999.5,
        "arrived_utc_ns": 103,
        "incomplete": 2,
    }
    assert (tmp_path / "image").read_bytes() == IMAGE
    assert camera.times("software_trigger") == triggers
    assert ("set_exposure_time", 1000.0) in camera.told
    assert ("patience", 20_002_000) in camera.told
    assert camera.times("stop_acquisition") == 1


@pytest.mark.parametrize(
    ("kinds", "words"),
    [
        (["none"], "no image came"),
        (["torn"] * 8 + ["whole"], "8 images in a row came incomplete"),
        (["padded"], "2 bytes of padding"),
    ],
)
def test_an_image_that_does_not_come_whole_is_refused_and_the_camera_stopped(
    aravis, tmp_path, kinds, words
):
    camera = FakeCamera(*kinds)
    held = aravis(camera)
    with pytest.raises(LookupError, match=words):
        held.take(1000.0, tmp_path / "image")
    assert camera.times("stop_acquisition") == 1
    assert not (tmp_path / "image").exists()


def test_a_film_has_the_rows_asked_for_of_each_whole_image(aravis, tmp_path, monkeypatch):
    for rows, part in ((None, IMAGE), ([1, 2], IMAGE[WIDTH : 2 * WIDTH])):
        camera = FakeCamera("whole", "torn", "whole", "whole")
        held = aravis(camera)
        clock = iter(range(100))
        ticking = SimpleNamespace(monotonic=lambda clock=clock: float(next(clock)))
        monkeypatch.setitem(type(held).film.__globals__, "time", ticking)
        told = held.film(50.0, tmp_path / "film", 4.5, rows)
        assert (told["frames"], told["incomplete"]) == ([(1, 101), (3, 103), (4, 104)], 1)
        assert (told["width"], told["height"]) == (WIDTH, HEIGHT)
        assert (tmp_path / "film").read_bytes() == 3 * part
        assert camera.queued == 40 and camera.times("stop_acquisition") == 1


class AskedCamera:
    """A camera as a child holds it, which tells what it was asked; the lid is on for "bad"."""

    def __init__(self, name: str) -> None:
        self.asked: list[Any] = []
        if name == "none":
            raise LookupError("no such camera")
        cameras_of.append(self)

    def about(self) -> dict[str, Any]:
        return {"model": "M"}

    def adjust(self, features: dict[str, Any]) -> None:
        self.asked.append(features)
        if "bad" in features:
            raise GError("the lid is on")

    def take(self, exposure_us: float, path: Path) -> dict[str, Any]:
        self.asked.append((exposure_us, path))
        return {"taken": 1}

    def film(self, exposure_us: float, path: Path, seconds: float, rows: Any) -> dict[str, Any]:
        self.asked.append((exposure_us, path, seconds, rows))
        return {"filmed": 1}

    def close(self) -> None:
        self.asked.append("closed")


cameras_of: list[AskedCamera] = []


def told_by(monkeypatch, capsys, words: list[str], lines: list[dict[str, Any]]) -> list[Any]:
    """What a child says of its command line and the lines it reads."""
    cameras_of.clear()
    monkeypatch.setattr(sys, "argv", ["child", *words])
    monkeypatch.setattr(
        sys, "stdin", io.StringIO("".join(json.dumps(each) + "\n" for each in lines))
    )
    child_lines.main(lambda: LISTED, AskedCamera, (LookupError, GError))
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def test_a_child_answers_each_line_and_lets_the_camera_go_at_the_end(monkeypatch, capsys):
    lines = [
        {"set": {"Gain": 2.0}},
        {"set": {"bad": 1}},
        {"exposure_us": 50.0, "file": "a"},
        {"film": 2.5, "exposure_us": 60.0, "file": "b", "rows": [1, 9]},
    ]
    assert told_by(monkeypatch, capsys, ["grab", "7"], lines) == [
        {"model": "M"},
        {},
        {"error": "the lid is on"},
        {"taken": 1},
        {"filmed": 1},
    ]
    (camera,) = cameras_of
    assert camera.asked == [
        {"Gain": 2.0},
        {"bad": 1},
        (50.0, Path("a")),
        (60.0, Path("b"), 2.5, [1, 9]),
        "closed",
    ]


def test_a_child_lists_cameras_and_says_why_one_cannot_be_opened(monkeypatch, capsys):
    assert told_by(monkeypatch, capsys, ["list"], []) == [LISTED]
    assert told_by(monkeypatch, capsys, ["grab", "none"], []) == [{"error": "no such camera"}]
