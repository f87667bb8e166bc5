"""Settings of an output: which are right, which are refused, and what is said of them."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest

from hilstar.display.window.output_settings import (
    OutputState,
    findings,
    property_value,
    size_mm_of,
)
from hilstar.display.window.property_rules import NVIDIA

PLAIN = OutputState("DP-1", (1920, 1080), preferred_px=((1920, 1080),))
HALF = (0, 1, 0, 0, 0, 0, 0, 0, 0x80000000 - 2**32, 0, 0, 0, 0, 0, 0, 0, 0, 1)
UNITY = (0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1)


def edid(
    size_mm: tuple[int, int], size_cm: tuple[int, int] = (60, 34), wide_px: int = 1920
) -> bytes:
    """An EDID whose first detailed timing has that size."""
    (wide, high), block = size_mm, bytearray(128)
    block[21:23] = bytes(size_cm)
    timing = struct.pack(
        "<HBBBBBBBBBBBBBBBB", 14850, wide_px & 255, 24, wide_px >> 8 << 4, *[0] * 7, *[0] * 6
    )
    block[54:72] = timing
    block[66], block[67], block[68] = wide & 255, high & 255, wide >> 8 << 4 | high >> 8
    return bytes(block)


@pytest.mark.parametrize(
    ("name", "value", "refused"),
    [
        ("Broadcast RGB", "Full", None),
        ("Broadcast RGB", "Automatic", False),
        ("Broadcast RGB", "Limited 16:235", True),
        ("output_csc", "tvrgb", True),
        ("max bpc", 8, None),
        ("max bpc", 6, True),
        ("dithering mode", "off", None),
        ("dithering mode", "auto", True),
        ("dithering mode", "temporal", True),
        ("dither", "on", True),
        ("CTM", UNITY, None),
        ("CTM", (0,) * 18, None),
        ("CTM", HALF, True),
        ("CTM", (1, 2, 3), True),
        ("Colorspace", "Default", None),
        ("Colorspace", "BT2020_RGB", True),
        ("HDR_OUTPUT_METADATA", 0, None),
        ("HDR_OUTPUT_METADATA", (0, 2, 0), True),
        ("underscan", "off", None),
        ("underscan", "auto", False),
        ("underscan", "on", True),
        ("left margin", 12, True),
        ("left margin", 0, None),
        ("abm level", 3, True),
        ("abm level", 0, None),
        ("vibrant hue", 90, None),
        ("vibrant hue", 0, True),
        ("color vibrance", 150, None),
        ("color vibrance", 180, True),
        ("vrr_capable", 1, None),  # what it can is no fault; whether it does is measured
        ("VRR_ENABLED", 1, True),
        ("adaptive-sync", "on", True),
        ("TearFree", "auto", None),
        ("TearFree", "on", False),
        ("scaling mode", "Full", None),  # at the panel's own size it scales nothing
        (NVIDIA + "CurrentDithering", 0, None),
        (NVIDIA + "CurrentDithering", 1, True),
        (NVIDIA + "CurrentColorRange", 1, True),
        ("a name of a later driver", "whatever", None),
    ],
)
def test_a_property_is_right_doubtful_or_refused(name, value, refused):
    found = list(findings(replace(PLAIN, properties={name: value}), 8))
    assert [finding.refused for finding in found] == ([] if refused is None else [refused])
    for finding in found:
        command = "nvidia-settings -a" if name.startswith(NVIDIA) else "xrandr --output DP-1 --set"
        assert name in finding.text and command in finding.text and "\n" not in finding.text


def test_max_bpc_is_compared_with_the_bench_s_bits():
    state = replace(PLAIN, properties={"max bpc": 8})
    (finding,) = findings(state, 10)
    assert finding.refused and '--set "max bpc" "10"' in finding.text


@pytest.mark.parametrize(
    ("changes", "words", "refused"),
    [
        ({"mode_px": (1280, 720)}, "--mode 1920x1080", True),
        (
            {"mode_px": (1280, 720), "properties": {"scaling mode": "Full aspect"}},
            "(scaling mode Full aspect)",
            True,
        ),
        # of several preferred modes the first is named
        (
            {"mode_px": (1280, 720), "preferred_px": ((1920, 1200), (1024, 768))},
            "--mode 1920x1200",
            True,
        ),
        ({"transform": (1.25, 0, 0, 0, 1.25, 0, 0, 0, 1)}, "--transform none", True),
        # a smaller scale, and a shift to the left: both below the identity
        ({"transform": (0.8, 0, 0, 0, 0.8, 0, 0, 0, 1)}, "--transform none", True),
        ({"transform": (1, 0, -40, 0, 1, 0, 0, 0, 1)}, "--transform none", True),
        ({"rotated": True}, "--rotate normal", False),
        ({"providers": ("Intel", "NVIDIA-0")}, "2 GPUs (Intel, NVIDIA-0)", False),
    ],
)
def test_a_mode_transform_or_path_that_changes_frames_is_told_with_what_mends_it(
    changes, words, refused
):
    (finding,) = findings(replace(PLAIN, **changes), 8)
    assert words in finding.text and finding.refused == refused


def test_a_ledger_has_of_an_output_what_may_change_its_frames():
    state = replace(
        PLAIN,
        mode_px=(1280, 720),
        refresh_hz=59.95,
        transform=(0.8, 0, 0, 0, 0.8, 0, 0, 0, 1),
        rotated=True,
        properties={"TearFree": "on"},
        others=("HDMI-1",),
        providers=("Intel", "NVIDIA-0"),
    )
    known = state.fields()
    for name in {*known} - {"size_mm"}:
        assert known[name] == getattr(state, name)
    assert replace(PLAIN, properties=None).fields()["properties"] == {}


def test_a_plain_output_has_no_findings_nor_one_without_a_preferred_mode():
    assert not list(findings(PLAIN, 8, 277.0))
    assert not list(findings(replace(PLAIN, transform=(1, 0, 0, 0, 1, 0, 0, 0, 1)), 8))
    assert not list(findings(replace(PLAIN, preferred_px=(), providers=("one",)), 8))


@pytest.mark.parametrize(
    ("block", "pitch_um", "told"),
    [
        (edid((598, 336)), 311.5, False),
        (edid((598, 336)), 303.0, False),  # within 3 %
        (edid((598, 336)), 277.0, True),
        (edid((598, 336)), 320.0, False),
        (edid((598, 336)), 350.0, True),
        (edid((16, 9)), 312.0, False),  # an aspect ratio: centimetres are taken
        (edid((16, 9)), 306.0, False),
        (edid((16, 9)), 277.0, True),
        (edid((16, 9), (0, 0)), 277.0, False),  # no size at all
        (edid((598, 336), wide_px=3840), 155.7, False),
        (b"", 277.0, False),
        (b"\xff" * 40, 277.0, False),
        (b"\0" * 128, 277.0, False),
    ],
)
def test_the_size_by_the_edid_is_compared_with_the_bench_s_pitch(block, pitch_um, told):
    found = list(findings(replace(PLAIN, edid=block), 8, pitch_um))
    assert [finding.refused for finding in found] == [False] * told
    assert not told or "pixel_pitch_um" in found[0].text


def test_the_size_in_mm_is_that_of_the_first_detailed_timing():
    assert size_mm_of(edid((598, 336))) == (598, 336)
    assert size_mm_of(edid((21, 21))) == (21, 21)
    for aspect in ((16, 9), (21, 9), (9, 21), (20, 20)):
        assert size_mm_of(edid(aspect)) is None
    assert size_mm_of(b"") is None


def test_values_of_properties_are_words_integers_or_a_few_of_them():
    names = {7: "Full"}.__getitem__
    assert property_value("ATOM", 32, (7,), names) == "Full"
    assert property_value("INTEGER", 32, (8,), names) == 8
    # Xlib gives longs without a sign
    assert property_value("INTEGER", 32, (2**32 - 90,), names) == -90
    assert property_value("INTEGER", 32, UNITY, names) == UNITY
    assert property_value("INTEGER", 16, tuple(range(256)), names) is None  # a table
    assert property_value("ATOM", 32, (), names) is None


def test_an_output_s_line_and_fields_have_its_properties():
    state = replace(
        PLAIN, properties={"max bpc": 8, "Broadcast RGB": "Full"}, edid=edid((598, 336))
    )
    assert state.line() == "DP-1, 1920 x 1080; Broadcast RGB Full; max bpc 8"
    assert (
        state.fields()["size_mm"] == (598, 336) and state.fields()["properties"] == state.properties
    )
    assert PLAIN.line() == "DP-1, 1920 x 1080; no properties"
    assert PLAIN.fields()["refresh_hz"] is None
    known = replace(PLAIN, refresh_hz=59.951)
    assert known.line() == "DP-1, 1920 x 1080, 59.95 Hz; no properties"
    assert known.fields()["refresh_hz"] == 59.951
