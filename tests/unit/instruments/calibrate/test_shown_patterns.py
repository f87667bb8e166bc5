"""Patterns, dots and patches on a panel that is recorded: what it shows, for how long, and which
keys end it. The window, its GL and the clock are those of the panel; all else is real.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.errors import InputError, MachineError
from hilstar.display.render import presenter as presenters
from hilstar.display.render.backend import ScreenView
from hilstar.display.window import window as windows
from hilstar.instruments.calibrate import plan as plans
from hilstar.instruments.calibrate import until_key
from hilstar.instruments.calibrate.first_light import image_sources
from hilstar.instruments.calibrate.first_light.image_sources import (
    GrabCamera,
    GrabCommand,
    Pattern,
    PatternDisplay,
    PatternFrames,
    Stopped,
)
from hilstar.instruments.calibrate.geometric.dots import DotPlan, dot_image, show_dots
from hilstar.instruments.calibrate.plan import Patch, show_patches
from hilstar.instruments.calibrate.until_key import stays_until_key
from hilstar.optics.scan import Orientation
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.genicam.camera import CameraImage
from tests.support.bench_files import filed_bench

SCREEN_PX = (320, 240)


class Panel:
    """A window whose panel is recorded: the codes (h, w) or (h, w, 3) that are presented, and when,
    by a clock that moves only when somebody sleeps.

    `meanwhile` is called with the number of the frame whenever events are looked at.
    """

    def __init__(self, size_px: tuple[int, int] = SCREEN_PX) -> None:
        self.size_px = size_px
        self.keys: deque[str] = deque()
        self.gone: str | None = None
        self.closing = False
        self.meanwhile: Callable[[int], None] = lambda frame: None
        self.now_s = 100.0
        self.shown: list[np.ndarray] = []
        self.shown_s: list[float] = []
        self.views: list[ScreenView] = []
        self.textures = 0
        self._presented: np.ndarray | None = None

    def __enter__(self) -> Panel:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def make_current(self) -> None:
        """There is no other."""

    def close(self) -> None:
        self.closing = True

    def present(self, codes: np.ndarray) -> None:
        self._presented = codes

    def swap(self) -> None:
        assert self._presented is not None
        self.shown.append(self._presented)
        self.shown_s.append(self.now_s)

    def look_at_events(self) -> None:
        assert len(self.shown) < 1000
        self.meanwhile(len(self.shown))

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(1e9 * self.now_s)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@dataclass
class PanelTexture:
    """Levels (h, w) in a panel's memory."""

    panel: Panel
    levels: np.ndarray

    def __post_init__(self) -> None:
        self.panel.textures += 1

    def release(self) -> None:
        self.panel.textures -= 1


@dataclass
class PanelPresenter:
    """Presents a texture's levels by the codes of its view."""

    texture: PanelTexture
    view: ScreenView
    triples: np.ndarray | None = field(init=False)

    def __post_init__(self) -> None:
        self.triples = self.view.triples
        self.texture.panel.views.append(self.view)

    def set_triples(self, triples: np.ndarray) -> None:
        self.triples = triples

    def present(self) -> None:
        levels = self.texture.levels
        self.texture.panel.present(levels if self.triples is None else self.triples[levels])


@pytest.fixture
def panel(monkeypatch) -> Panel:
    """The panel on which every window opens."""
    made = Panel()

    def opened(settings: windows.WindowSettings) -> Panel:
        made.settings = settings
        made.closing = False
        return made

    monkeypatch.setattr(windows, "Window", opened)
    for module in (presenters, image_sources, plans):
        monkeypatch.setattr(module, "window_context", lambda: made)
        monkeypatch.setattr(module, "level_texture", PanelTexture)
        monkeypatch.setattr(module, "Presenter", PanelPresenter)
    for module in (until_key, image_sources):
        monkeypatch.setattr(module, "time", made)
    return made


def bench(folder: Path, **monitor: object) -> BenchFile:
    return filed_bench(folder, {"monitor": {"resolution_px": list(SCREEN_PX)} | monitor})


def pattern_of(*levels: int) -> Pattern:
    """Frames of one code each, the first pixel of each is the frame's number."""
    frames = []
    for number, level in enumerate(levels):
        codes = np.full(SCREEN_PX[::-1], level, dtype=np.uint16)
        codes[0, 0] = number
        frames.append(codes)
    return Pattern("pattern", frames[0], tuple(frames[1:]))


def presses(panel: Panel, at: int, *keys: str) -> None:
    """Press keys at a frame."""

    def meanwhile(frame: int) -> None:
        if frame == at:
            panel.keys.extend(keys)

    panel.meanwhile = meanwhile


@pytest.mark.parametrize(
    ("keys", "stays", "frames"),
    [
        (("space",), True, 3),
        (("q",), False, 3),
        (("escape",), False, 3),
        (("x", "space", "q"), True, 3),
        # 0.1 s: a frame at once and one each 0.02 s
        (("x",), True, 5),
    ],
)
def test_a_pattern_stays_until_a_key_is_pressed_or_its_time_is_over(panel, keys, stays, frames):
    presenter = PanelPresenter(PanelTexture(panel, np.ones((2, 2))), ScreenView((2, 2), (2, 2), 8))
    presses(panel, 3, *keys)
    # less than 5 frames' 0.1 s by the rounding of the clock's sum
    assert stays_until_key(panel, presenter, 0.0999) == stays
    assert len(panel.shown) == frames
    np.testing.assert_allclose(np.diff(panel.shown_s), 0.02)


def test_a_pattern_without_an_end_stays_until_its_window_is_closed_or_gone(panel):
    presenter = PanelPresenter(PanelTexture(panel, np.ones((2, 2))), ScreenView((2, 2), (2, 2), 8))
    presses(panel, 700, "space")
    assert stays_until_key(panel, presenter, None)
    assert len(panel.shown) == 700
    panel.closing = True
    assert not stays_until_key(panel, presenter, None)
    panel.gone = "the X server went away"
    with pytest.raises(MachineError, match="the X server went away"):
        stays_until_key(panel, presenter, None)


def test_patches_light_a_square_in_their_own_channels_one_after_another(panel, caplog):
    planned = [Patch(200, "w"), Patch(7, "r"), Patch(30, "g"), Patch(255, "b")]
    with caplog.at_level(logging.WARNING):
        assert show_patches(planned, 8, ":7", 0.01) == 4
    wanted = [[200, 200, 200], [7, 0, 0], [0, 30, 0], [0, 0, 255]]
    for codes, triple in zip(panel.shown, wanted, strict=True):
        lit = codes.any(axis=-1)
        # a square in the middle of what is dark
        assert 0 < lit.sum() < 0.5 * lit.size and not lit[0, 0]
        assert codes[120, 160].tolist() == triple
        assert (codes[lit] == triple).all()
    assert (panel.settings.bits, panel.settings.display) == (8, ":7")
    assert caplog.messages[1] == "patch 2 of 4: code 7, channel r"
    presses(panel, 4 + 2, "q")
    assert show_patches(planned, 8, ":7", 0.01) == 1


@pytest.mark.parametrize(("windowed", "display"), [(False, ":3"), (True, None)])
def test_dots_are_white_on_the_screen_as_it_is_mounted(panel, tmp_path, caplog, windowed, display):
    config = bench(tmp_path, bits=10, rotate_deg=90, display=":3").config
    lit = np.array([[True, False], [True, True], [False, True]])
    plan = DotPlan(np.array([40.0, 80.0, 200.0]), np.array([30.0, 70.0, 20.0]), lit)
    with caplog.at_level(logging.WARNING):
        shown = show_dots(plan, config.monitor, 0.01, windowed=windowed)
    assert shown == plan.frames == len(panel.shown)
    for frame, codes in enumerate(panel.shown):
        lit = dot_image(plan, frame, SCREEN_PX, 1).astype(bool)
        np.testing.assert_array_equal(codes, 1023 * np.repeat(lit[:, :, None], 3, axis=2))
    assert panel.settings.resolution_px == (240, 320)
    assert panel.settings.display == display
    assert panel.views[0].orientation == Orientation(False, False, 1)
    assert panel.textures == 0
    assert caplog.messages[0] == f"frame 1 of {plan.frames} (frame_000)"
    presses(panel, shown + 2, "q")
    assert show_dots(plan, config.monitor, 0.01, windowed=windowed) == 1


class Watcher:
    """Takes every frame that is handed on."""

    def __init__(self) -> None:
        self.frames = []

    def look(self) -> bool:
        return True

    def put_frame(self, frame) -> None:
        self.frames.append(frame)


def test_a_pattern_is_shown_until_it_is_done_which_is_asked_once_the_panel_has_settled(
    panel, tmp_path
):
    asked_s = []

    def done() -> bool:
        asked_s.append(panel.now_s - panel.shown_s[0])
        return len(asked_s) > 50

    watcher = Watcher()
    pressed = []
    presses(panel, 3, "x", "space")
    panel.keys.append("q")  # of the pattern before
    with PatternDisplay() as shown:
        shown.frames = PatternFrames(watcher)
        shown.show_until(bench(tmp_path), pattern_of(9), done, pressed.append)
    assert pressed == ["x", "space"]
    # a quarter of a second for a panel that is slow, and then every 0.02 s
    assert 0.25 <= asked_s[0] < 0.25 + 0.021
    np.testing.assert_allclose(np.diff(asked_s), 0.02)
    assert panel.textures == 0
    # again every half a second, for a watcher that came late: of 1.26 s
    handed_on_s = [1e-9 * frame.head.lit_ns - panel.shown_s[0] for frame in watcher.frames]
    np.testing.assert_allclose(handed_on_s, [0.0, 0.52, 1.04], atol=0.021)
    assert [codes[5, 5] for codes in panel.shown] == [9] * len(panel.shown)


def test_frames_of_a_pattern_are_shown_and_handed_on_in_turn(panel, tmp_path):
    watcher = Watcher()
    with PatternDisplay() as shown:
        shown.frames = PatternFrames(watcher)
        file = bench(tmp_path, refresh_hz=50.0)
        shown.show_until(file, pattern_of(9, 8, 7), lambda: len(panel.shown) >= 40)
    numbers = [int(codes[0, 0]) for codes in panel.shown]
    assert numbers == [number % 3 for number in range(40)]
    # the swap waits for the refresh: the loop is back by half of it
    np.testing.assert_allclose(np.diff(panel.shown_s), 0.5 / 50)
    assert [frame.codes[-1] for frame in watcher.frames] == [9 - number for number in numbers]
    assert panel.textures == 0


@pytest.mark.parametrize("end", ["q", "escape", "closing", "gone"])
def test_whoever_closes_the_display_stops_a_session_and_frees_its_textures(panel, tmp_path, end):
    def meanwhile(frame: int) -> None:
        if frame < 4:
            return
        if end == "closing":
            panel.closing = True
        elif end == "gone":
            panel.gone = "the display went away"
        else:
            panel.keys.extend(["x", end])

    panel.meanwhile = meanwhile
    error, words = Stopped, "run the same command again to go on"
    if end == "gone":
        error, words = MachineError, "the display went away"
    with pytest.raises(error, match=words):
        PatternDisplay().show_until(bench(tmp_path), pattern_of(1, 2), lambda: False)
    assert (len(panel.shown), panel.textures) == (4, 0)


def test_a_colour_is_shown_in_its_own_codes(panel, tmp_path, rng):
    codes = rng.integers(0, 1024, (*SCREEN_PX[::-1], 3)).astype(np.uint16)
    codes[100:] = [1023, 0, 512]
    file = bench(tmp_path, bits=10, flip_x=True)
    PatternDisplay().show_until(file, Pattern("colour", codes), lambda: True)
    np.testing.assert_array_equal(panel.shown[0], codes)
    (view,) = panel.views
    assert (view.resolution_px, view.screen_px, view.bits) == (SCREEN_PX, SCREEN_PX, 10)
    assert view.orientation == Orientation(flip_x=True)


def test_a_session_holds_a_pattern_where_it_shows_it_itself(panel, tmp_path):
    dark = tmp_path / "dark.png"
    here = GrabCommand("grab {output}", dark)
    here.hold(bench(tmp_path), pattern_of(5), 3.0)
    assert panel.now_s - panel.shown_s[0] == pytest.approx(3.0, abs=0.03)
    assert here.unlit(tmp_path / "unlit") == dark
    assert here.diode(bench(tmp_path), 1.0) is None
    watcher = Watcher()
    here.hand_on(PatternFrames(watcher))
    here.hold(bench(tmp_path), pattern_of(5), 0.1)
    assert len(watcher.frames) == 1
    frames = len(panel.shown)
    elsewhere = GrabCommand("grab {output} {pattern}")
    before_s = panel.now_s
    elsewhere.hold(bench(tmp_path), pattern_of(5), 2.5)
    assert (len(panel.shown), panel.now_s) == (frames, before_s + 2.5)
    with pytest.raises(InputError, match="this session shows nothing here; leave --feed out"):
        elsewhere.hand_on(PatternFrames(watcher))
    assert math.isclose(before_s, panel.shown_s[-1], abs_tol=0.03)


class RecordedCamera:
    """A camera whose third answer is its image; what is asked of it is recorded."""

    def __init__(self, image: CameraImage) -> None:
        self.about = {"vendor": "Acme", "model": "Eye", "formats": ["Mono8", "Mono12", "Mono16"]}
        self.features: dict[str, object] = {}
        self.exposures_s: list[float] = []
        self.asked = 0
        self.is_open = True
        self._image = image

    def set(self, features: dict[str, object]) -> None:
        self.features |= features

    def begin(self, exposure_s: float) -> None:
        self.exposures_s.append(exposure_s)

    def image(self) -> CameraImage | None:
        self.asked += 1
        return self._image if self.asked == 3 else None

    def close(self) -> None:
        self.is_open = False


def test_a_camera_exposes_once_when_the_panel_shows_the_pattern(
    panel, tmp_path, caplog, monkeypatch, rng
):
    dn = rng.integers(0, 4095, (60, 80)).astype(np.uint16)
    dn[:4] = 4095
    camera = RecordedCamera(CameraImage(dn, 0.02, 0, "", 2))
    named = []

    def opened(name: str) -> RecordedCamera:
        named.append(name)
        return camera

    monkeypatch.setattr(image_sources, "GenicamCamera", opened)
    changes = {"tracker.detector": {"bits": 12}, "tracker.camera": {"gain": 3.0}}
    file = filed_bench(tmp_path, changes, {"monitor": {"resolution_px": list(SCREEN_PX)}})
    with caplog.at_level(logging.WARNING):
        source = GrabCamera(file, "S42")
        taken = source.look(file, pattern_of(200), tmp_path / "frame_003", 0.02)
    assert named == ["S42"]
    assert source.identity.endswith("S42") and source.sets_exposure
    assert camera.features["PixelFormat"] == "Mono12"
    assert camera.features["Gain"] == 3.0
    assert (camera.exposures_s, camera.asked) == ([0.02], 3)
    assert panel.now_s - panel.shown_s[0] == pytest.approx(0.25 + 3 * 0.02, abs=0.021)
    assert taken == tmp_path / "frame_003.png"
    np.testing.assert_array_equal(source.pixels(taken, (80, 60)), dn)
    assert caplog.messages == [
        "the tracker's images are Acme Eye's, Mono12",
        f"frame_003: {(dn == 4095).sum()} pixels are saturated at 4095",
        "frame_003: taken again after 2 incomplete images",
    ]
    source.close()
    assert not camera.is_open


def test_a_display_that_is_not_as_its_bench_says_may_be_forced_or_left_to_the_person(
    panel, tmp_path, monkeypatch
):
    """A session has no --force of its own: its refusal names the other way."""
    forced_as = []

    def gate(screen: object, force: bool) -> str:
        forced_as.append(force)
        if not force:
            raise MachineError("the display is scaled; set it to 100 %; or add --force")
        return "timed"

    monkeypatch.setattr(image_sources, "open_bench", lambda file, context: nullcontext())
    monkeypatch.setattr(
        image_sources, "Screen", lambda window, opened: SimpleNamespace(forced=["it is scaled"])
    )
    monkeypatch.setattr(image_sources, "pass_gate", gate)
    file = bench(tmp_path)
    with PatternDisplay() as shown:
        with pytest.raises(MachineError) as refused:
            shown.gate(file)
        assert str(refused.value) == (
            "the display is scaled; set it to 100 %; or show the patterns yourself: name {pattern}"
            " in --grab"
        )
        assert shown.forced == []
        shown.force = True
        assert shown.gate(file) == "timed"
        assert shown.forced == ["it is scaled"]
    assert forced_as == [False, True]
