"""What the keys of tracker, monitor and trigger mean by themselves: layouts, features of a camera,
and limits from both sides.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from hilstar.server.bench.config import AttitudeSettings, parse_config
from hilstar.server.bench.config.hardware import (
    Monitor,
    PrimariesSettings,
    SyncSettings,
    TrackerCamera,
    TrackerOptics,
    check_channels,
    check_primaries,
    check_sync,
)
from tests.support.benches import SMALL_BENCH
from tests.support.refusals import refusal

SERIAL = AttitudeSettings(source="serial", port="/dev/ttyUSB1")
TRACKER = replace(parse_config(Path("bench.toml"), SMALL_BENCH).tracker, exposure_s=0.1)


@pytest.mark.parametrize(
    ("layout", "red", "blue"),
    [
        ("white", (0.0, 0.0), (0.0, 0.0)),
        ("rgb-stripe", (-1 / 3, 0.0), (1 / 3, 0.0)),
        ("bgr-stripe", (1 / 3, 0.0), (-1 / 3, 0.0)),
        ("vertical", (0.0, -1 / 3), (0.0, 1 / 3)),
    ],
)
def test_a_layout_has_its_primaries_from_left_to_right_or_from_the_top_down(layout, red, blue):
    primaries = PrimariesSettings(layout=layout)
    check_primaries(primaries)
    assert primaries.places_px == (red, (0.0, 0.0), blue)


def test_offsets_stand_for_a_layout_and_not_beside_one():
    places_px = ((0.1, 0.2), (0.3, -0.4), (-0.5, 0.0))
    primaries = PrimariesSettings(offsets_px=places_px)
    check_primaries(primaries)
    assert primaries.places_px == places_px
    both = PrimariesSettings(offsets_px=places_px, layout="vertical")
    assert "layout and offsets_px" in refusal(check_primaries, both)


def test_a_camera_is_triggered_by_software_where_that_is_asked_for():
    assert TrackerCamera().settings() == {}
    camera = TrackerCamera(gain=2.5, trigger="software", features={"BlackLevel": 7})
    assert camera.settings() == {
        "BlackLevel": 7,
        "Gain": 2.5,
        "TriggerSelector": "FrameStart",
        "TriggerSource": "Software",
        "TriggerMode": "On",
    }


def test_a_lens_is_warmer_by_what_its_temperature_is_above_its_reference():
    assert TrackerOptics(temperature_k=300.0, reference_temperature_k=280.0).warmer_k == 20.0


@pytest.mark.parametrize(
    ("frame_hz", "is_refused"), [(10.0, False), (10.000009, False), (10.0001, True)]
)
def test_exposures_may_follow_one_another_but_not_overlap(frame_hz, is_refused):
    tracker = replace(TRACKER, frame_hz=frame_hz)
    monitor = Monitor(resolution_px=(320, 240), pixel_pitch_um=50.0)
    if is_refused:
        said = refusal(check_sync, SyncSettings(), tracker, monitor, SERIAL)
        assert "exposures of 0.1 s overlap; write 10 or less" in said
    else:
        check_sync(SyncSettings(), tracker, monitor, SERIAL)


@pytest.mark.parametrize(
    ("pulse_ms", "every", "words"),
    [
        (19.9, 1, None),
        (20.0, 1, "the next pulse is due after 20 ms"),
        (59.0, 3, None),
        (60.0, 3, "the next pulse is due after 60 ms"),
    ],
)
def test_a_pulse_ends_before_the_next(pulse_ms, every, words):
    monitor = Monitor(resolution_px=(320, 240), pixel_pitch_um=50.0, refresh_hz=50.0)
    sync = SyncSettings(port="/dev/ttyUSB0", pulse_ms=pulse_ms, every_frames=every)
    if words is None:
        check_sync(sync, TRACKER, monitor, SERIAL)
    else:
        assert words in refusal(check_sync, sync, TRACKER, monitor, SERIAL)


@pytest.mark.parametrize(
    ("given", "bayer", "words"),
    [
        ("_r _g _b", None, None),
        ("_r _g _b", "rggb", None),
        ("_r _b", None, "the key quantum_efficiency_g is missing"),
        ("", None, "the key quantum_efficiency is missing"),
    ],
)
def test_a_tracker_has_one_efficiency_or_all_three(given, bayer, words):
    efficiencies = {f"quantum_efficiency{end}": 0.5 for end in given.split()}
    detector = replace(TRACKER.detector, bayer=bayer)
    tracker = replace(TRACKER, detector=detector, **({"quantum_efficiency": None} | efficiencies))
    if words is None:
        check_channels(tracker)
    else:
        assert words in refusal(check_channels, tracker)


def test_one_efficiency_and_one_of_a_colour_are_refused():
    tracker = replace(TRACKER, quantum_efficiency=0.5, quantum_efficiency_g=0.5)
    assert "quantum_efficiency and quantum_efficiency_g" in refusal(check_channels, tracker)
