"""Whatever a tracker sends: nothing raises, nothing is kept, and what is made of it can be
handed over and explained.
"""

from __future__ import annotations

import json
import struct
import tracemalloc
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.server.answers.answer import Answer
from hilstar.server.answers.explain import lines_of
from hilstar.server.answers.formats import (
    MAX_KEPT_BYTES,
    MAX_MODE_CHARACTERS,
    AnswerDecoder,
    RefusedAnswer,
)
from hilstar.server.answers.reader import PIECE_BYTES, HandedOver, hand_over, handed_over
from tests.unit.server.answers.test_formats import (
    CCSDS_FIELDS,
    FRAMINGS,
    Q,
    answers,
    body_of,
    decoder_of,
    settings_of,
)

BODY_TO_CAM = (0.5, 0.5, -0.5, 0.5)


def handed(found: list[Answer | RefusedAnswer], decoder: AnswerDecoder) -> list[Answer]:
    """What the owner of the process gets; each is explained, too."""
    for each in found:
        assert all(line.isprintable() for line in lines_of(each, decoder, Q))
    return [handed_over(hand_over(HandedOver(each))).answer for each in answers(found)]


@pytest.mark.parametrize(
    "text",
    [
        f'{{"q":[1,0,0,0],"stars":{10**30}}}', '{"q":[1,0,0,0],"stars":-5}', '{"q":[1,0,0,0],"centroids":[[1,2,3,1e300]]}',
        f'{{"q":[1,0,0,0],"t_ns":{2**63}}}', '{"q":[1,0,0,0],"mode":%s}' % ("9" * 5000), '{"q":[1e200,1e200,0,0]}',
        '{"q":[1,0,0,0],"mode":"%s"}' % ("x" * 60_000), '{"q":[1,0,0,0],"mode":"\\u001b[2J\\n"}', "[" * 60_000, "\xff", "{}",
        '{"q":[1,0,0,0],"rate":[1e300,0,0]}', '{"q":["a"]}', '{"q":[1,0,0,0],"rms_arcsec":1e400}',
    ],
)  # fmt: skip
def test_whatever_json_says_can_be_handed_over(text):
    decoder = decoder_of(format="json", fields=[], messages=True)
    found = decoder.feed(0, text.encode("latin-1"))
    for each in handed(found, decoder):
        assert len(each.mode) <= MAX_MODE_CHARACTERS and each.mode.isprintable()
        assert each.star_count is None
        assert all(star.hip is None for star in each.centroids)
    for refused in found:
        if isinstance(refused, RefusedAnswer):
            assert refused.reason in {"format", "norm", "time", "nan"}


def test_whatever_numbers_a_frame_has_can_be_handed_over(rng):
    names = ("qw", "qx", "qy", "qz", "t_s", "t_sub", "valid", "mode", "stars", "wx", "wy", "wz")
    fields = [
        {"name": name, "at": 8 * k, "type": "f64be", "scale": 1e9} for k, name in enumerate(names)
    ]
    decoder = decoder_of(framing="fixed", length=8 * len(names), fields=fields, messages=True)
    odd = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-9, 0.0, 5e-324])
    given = [rng.choice(odd, len(names)) for _ in range(1000)]
    for numbers in given:
        numbers[:4] = 0.5e-9  # a unit quaternion, so that the others are looked at
        for each in handed(decoder.feed(0, struct.pack(f">{len(names)}d", *numbers)), decoder):
            assert each.t_ns is None or abs(each.t_ns) < 2**63


@pytest.mark.parametrize("name", [*FRAMINGS, "cobs without checksum", "json", "packet"])
def test_noise_is_refused_explained_and_not_kept(name, rng):
    keys = (
        {"framing": "cobs"}
        if "without" in name
        else {"format": name, "fields": []}
        if name not in FRAMINGS
        else FRAMINGS[name][0]
    )
    decoder = decoder_of(**keys)
    noise = rng.integers(0, 256, 12_000, dtype=np.uint8)
    noise[rng.random(len(noise)) < 0.1] = rng.choice(
        np.frombuffer(b"\0\1\xc0\xdb\n{\x1a\xcf\x08", np.uint8)
    )
    for k, chunk in enumerate(np.array_split(noise, 150)):
        handed(decoder.feed(k * 10**8 * (k % 7 == 0), chunk.tobytes()), decoder)


def test_an_empty_frame_is_refused_and_explained():
    for keys, empty in (({"framing": "cobs"}, b"\1\0"), ({"framing": "slip"}, b"\xdb\xdd\xc0")):
        decoder = decoder_of(**keys, checksum="crc32")
        decoder.feed(0, b"\0" if "cobs" in keys.values() else b"\xc0")
        (refused,) = decoder.feed(0, empty)
        assert isinstance(refused, RefusedAnswer)
        assert lines_of(refused, decoder, None)


@pytest.mark.parametrize("name", FRAMINGS)
def test_memory_is_flat_under_babble(name, rng):
    keys, framed_as = FRAMINGS[name]
    decoder, good = decoder_of(**keys), framed_as(body_of())
    tracemalloc.start()
    base = tracemalloc.get_traced_memory()[0]
    for k in range(5):  # twice what may be kept
        decoder.feed(k, rng.bytes(PIECE_BYTES) + good)
    peak, grown = (
        tracemalloc.get_traced_memory()[1] - base,
        tracemalloc.get_traced_memory()[0] - base,
    )
    tracemalloc.stop()
    assert grown < 4 * MAX_KEPT_BYTES
    assert peak < 16 * MAX_KEPT_BYTES  # one chunk's refusals, each with its bytes


@pytest.mark.parametrize("scalar", ["first", "last"])
@pytest.mark.parametrize("direction", ["icrs_to_cam", "cam_to_icrs"])
@pytest.mark.parametrize("held", ["cam", "body"])
def test_attitude_and_rate_are_the_camera_s_under_each_convention(scalar, direction, held, rng):
    """By scipy, whose rotations act on vectors (v_cam = R v_icrs) and whose quaternions are
    scalar last.
    """
    mounting, rate_cam = Rotation.from_quat(np.roll(BODY_TO_CAM, -1)), np.array([0.1, -0.2, 0.3])
    icrs_to_cam = Rotation.random(random_state=int(rng.integers(99)))
    sent = mounting.inv() * icrs_to_cam if held == "body" else icrs_to_cam
    sent = sent.inv() if direction == "cam_to_icrs" else sent
    q = sent.as_quat() if scalar == "last" else np.roll(sent.as_quat(), 1)
    rate = mounting.inv().apply(rate_cam) if held == "body" else rate_cam
    convention = {"scalar": scalar, "direction": direction, "frame": held}
    decoder = AnswerDecoder(
        settings_of(format="json", fields=[], convention=convention), BODY_TO_CAM, True
    )
    (found,) = answers(
        decoder.feed(0, json.dumps({"q": q.tolist(), "rate": rate.tolist()}).encode())
    )
    off = Rotation.from_quat(np.roll(found.q_icrs_to_cam, -1)) * icrs_to_cam.inv()
    assert off.magnitude() < 1e-14
    assert np.abs(found.rate_cam_rad_s - rate_cam).max() < 1e-15


TYPES: dict[str, tuple[str, Any]] = {
    "u8": ("B", 200), "i8": ("b", -100), "u16le": ("<H", 65000), "u16be": (">H", 65000), "i16be": (">h", -30000),
    "u32le": ("<I", 2**32 - 1), "i32be": (">i", -(2**31)), "u64be": (">Q", 2**60), "i64le": ("<q", -(2**60)),
    "f32be": (">f", -0.15625), "f64le": ("<d", 1 / 3), "f32": ("<f", 1.5), "i16": ("<h", -2),
    "i24be": ("", -(2**23)), "i24le": ("", -0x1234), "u24be": ("", 2**24 - 1),
}  # fmt: skip


@pytest.mark.parametrize("kind", TYPES)
def test_a_number_of_each_type_is_what_struct_says(kind):
    form, value = TYPES[kind]
    order = "big" if kind.endswith("be") else "little"
    raw = struct.pack(form, value) if form else value.to_bytes(3, order, signed=kind[0] == "i")
    fields = [{"name": "t_s", "at": 3, "type": kind, "scale": 2.0, "add": -1.0}]
    fields += [{"name": name, "at": 12, "type": "f32be"} for name in ("qw", "qx", "qy", "qz")]
    decoder = decoder_of(framing="slip", fields=fields)
    number = decoder.frames.value(b"\xff" * 3 + raw, decoder.settings.fields[0])
    assert number == 2 * value - 1
    assert isinstance(number, float) == (kind[0] == "f")


@pytest.mark.parametrize("checksum", ["sum8", "xor8", "none"])
def test_a_weak_checksum_lets_through_what_the_page_says_that_it_does(checksum, rng):
    """docs/answers.md: one in 256 of frames whose bytes are noise, and without a checksum all of
    them.
    """
    frames = decoder_of(framing="cobs", checksum=checksum, fields=CCSDS_FIELDS).frames
    passed = sum(frames.fault(rng.bytes(40)) == "" for _ in range(8000))
    assert passed == 8000 if checksum == "none" else 10 < passed < 60  # 31 +- 6
