"""What the system says of displays, in values of GLFW's own types: which is meant, which modes it
has, which refresh is asked for, and which keys are pressed. No window system is asked.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from hilstar.display.identity import MonitorIdentity
from hilstar.display.window import this_monitor
from hilstar.display.window.displays import Display, display_of
from hilstar.display.window.library import glfw
from hilstar.display.window.output_settings import OutputState
from hilstar.display.window.this_monitor import identity_of
from hilstar.display.window.visibility import is_dark
from hilstar.display.window.window import change_of, pressed_key
from tests.unit.server.test_machine_row import edid

HD = (1920, 1080)


def mode(
    size: tuple[int, int] = HD, refresh_hz: int = 60, bits: tuple[int, int, int] = (8, 8, 8)
) -> Any:
    """A video mode as GLFW describes it."""
    described = glfw._GLFWvidmode()
    described.width, described.height = size
    described.red_bits, described.green_bits, described.blue_bits = bits
    described.refresh_rate = refresh_hz
    return described.unwrap()


def display(name: str = "DP-1", **changes: Any) -> Display:
    made = display_of(0, name.encode(), mode(), (0, 0), size_mm=(520, 290), scale=1.0)
    return replace(made, **changes)


@pytest.mark.parametrize(
    ("bits", "fewest"), [((8, 8, 8), 8), ((10, 10, 10), 10), ((5, 6, 5), 5), ((8, 8, 2), 2)]
)
def test_a_mode_has_the_bits_of_its_coarsest_colour(bits, fewest):
    made = display_of(2, b"DP-2", mode((2560, 1440), 144, bits), (1920, -80), (600, 340), 1.5)
    assert made == Display(2, "DP-2", (2560, 1440), 144, (1920, -80), (600, 340), 1.5, fewest)


@pytest.mark.parametrize(
    ("wanted", "is_meant"),
    [("DUMMY0", True), ("dummy0", True), ("mmy", True), ("DUMMY1", False), (3, True), (0, False)],
)
def test_a_display_is_meant_by_its_index_or_by_a_part_of_its_name_in_any_case(wanted, is_meant):
    assert display("DUMMY0", index=3).is_named(wanted) is is_meant


def test_the_modes_of_a_display_are_those_of_both_its_sides_with_a_known_refresh():
    modes = [
        *(mode(HD, hz) for hz in (144, 60, 0, 60, 50)),
        *(mode((1920, 1200), 75), mode((1280, 1080), 85), mode((1080, 1920), 90)),
    ]
    assert display().rates_hz(modes) == (50, 60, 144)
    assert display(resolution_px=(1920, 1200)).rates_hz(modes) == (75,)
    assert display().rates_hz([mode(HD, 0)]) == ()


@pytest.mark.parametrize(
    ("wanted_hz", "now_hz", "asked_hz"),
    [
        (None, 60, 60),  # left to itself, GLFW would take the highest
        (144.0, 60, 144),
        (59.94, 144, 60),  # the mode of television's 60 Hz
        (59.6, 144, 60),
        (59.4, 144, 144),
        (100.0, 60, 60),  # no such mode
        (None, 0, 0),
    ],
)
def test_the_refresh_that_is_asked_for_is_the_nearest_mode_or_the_present_one(
    wanted_hz, now_hz, asked_hz
):
    shown = display(refresh_hz=now_hz)
    assert shown.refresh_for(wanted_hz, (50, 60, 144)) == asked_hz


def test_a_display_is_mirrored_by_another_one_at_its_own_place_alone():
    here = display("DP-1", position_px=(1920, 0))
    beside = display("DP-2", position_px=(0, 0))
    over_it = display("HDMI-1", position_px=(1920, 0))
    assert here.mirrored_by([here, beside]) is None
    assert here.mirrored_by([here, beside, over_it]) == "HDMI-1"
    assert here.mirrored_by([]) is None


@pytest.mark.parametrize(
    ("key", "name"),
    [
        (glfw.KEY_ESCAPE, "escape"),
        (glfw.KEY_SPACE, "space"),
        (glfw.KEY_F1, "f1"),
        (glfw.KEY_G, "g"),
        (glfw.KEY_7, "7"),
        (glfw.KEY_F2, ""),
        (glfw.KEY_UNKNOWN, ""),
    ],
)
def test_a_key_counts_once_when_it_goes_down_however_long_it_is_held(key, name):
    assert pressed_key(key, glfw.PRESS) == name
    assert pressed_key(key, glfw.REPEAT) == pressed_key(key, glfw.RELEASE) == ""


@pytest.mark.parametrize(
    ("is_there", "was_lost", "on_it", "change"),
    [
        (True, False, True, ""),
        (True, False, False, "back"),  # a window that was put elsewhere meanwhile
        (True, True, False, "back"),
        (True, True, True, "back"),
        (False, False, False, "gone"),
        (False, False, True, "gone"),
        (False, True, False, ""),  # it is told once
    ],
)
def test_a_window_goes_back_to_its_display_wherever_it_was_put(is_there, was_lost, on_it, change):
    assert change_of(is_there, was_lost, on_it) == change


# dpmsconst.h: on, standby, suspend, off
@pytest.mark.parametrize(("level", "is_so"), [(0, False), (1, True), (2, True), (3, True)])
def test_a_display_is_dark_at_every_level_of_dpms_but_on(level, is_so):
    assert is_dark(True, level) is is_so
    assert not is_dark(False, level)


def test_a_monitor_s_identity_has_what_x_says_and_the_kernel_s_edid_where_x_hides_it(tmp_path):
    (tmp_path / "card0-DP-1").mkdir()
    (tmp_path / "card0-DP-1" / "edid").write_bytes(edid("DELL U2412M"))
    hidden = OutputState("DP-1", HD, refresh_hz=59.934)
    shown = replace(hidden, edid=edid("DELL P2423D"), transform=(0.5, *hidden.transform[1:]))
    names = {}
    for output in (None, hidden, shown):
        adds = {"XWayland": False, "a compositing manager": True}
        now = identity_of(display(refresh_hz=60), output, b"", adds, tmp_path)
        names[output] = now.model
        assert (now.connector, now.bits, now.gamma_ramp) == ("DP-1", 8, "")
        assert now.mode == f"1920x1080@{'60.00' if output is None else '59.93'}"
        added = ("a compositing manager", "a transform")
        assert now.window_system == (added if output is shown else added[:1])
    assert names == {None: "DELL U2412M", hidden: "DELL U2412M", shown: "DELL P2423D"}
    assert identity_of(display("VGA-1"), None, b"", {}, tmp_path).model == ""


def test_a_monitor_is_asked_by_its_edids_first_block(tmp_path, monkeypatch):
    """ddcutil takes 128 bytes of it, in hexadecimal; half a block names no monitor."""
    program = tmp_path / "ddcutil"
    program.write_text('#!/bin/sh\necho "VCP 10 C ${#8} 999"\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    block = edid()
    brightness = []
    for given in (block, block + bytes(128), block[:64]):
        output = OutputState("DP-1", HD, edid=given)
        brightness.append(identity_of(display(), output, b"", {}, tmp_path).brightness)
    unasked = MonitorIdentity().brightness
    assert brightness == [256, 256, unasked]


def test_a_monitor_that_does_not_answer_is_not_waited_for(tmp_path, monkeypatch):
    program = tmp_path / "ddcutil"
    program.write_text("#!/bin/sh\nexec sleep 600\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    monkeypatch.setattr(this_monitor, "DDC_S", 0.05)
    output = OutputState("DP-1", HD, edid=edid())
    now = identity_of(display(), output, b"", {}, tmp_path)
    assert (now.model, now.brightness) == ("DELL U2412M", None)


def test_a_display_s_line_has_its_number_its_name_its_mode_and_its_size():
    """A server that does not say its refresh, as Xvfb, has none of 0 Hz."""
    plain = display(resolution_px=(1920, 1200), refresh_hz=60, size_mm=(518, 324))
    assert plain.line() == f"{plain.index}: DP-1, 1920 x 1200, 60 Hz, 518 x 324 mm"
    unknown = display(resolution_px=(640, 480), refresh_hz=0, size_mm=(163, 122))
    assert unknown.line() == f"{plain.index}: DP-1, 640 x 480, refresh not known, 163 x 122 mm"
