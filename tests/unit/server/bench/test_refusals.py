"""Bench files that are refused: what is written, and the words of the one line that says so."""

from __future__ import annotations

import re

import pytest

from hilstar.server.bench.config import read_config
from tests.support.benches import SMALL_BENCH
from tests.support.refusals import refusal


def line(text: str) -> str:
    """The small bench with another line for the first key of that name."""
    key = text.partition(" =")[0]
    return re.sub(rf"(?m)^{key} = .*$", text, SMALL_BENCH, count=1)


def other_text(old: str, new: str) -> str:
    assert old in SMALL_BENCH
    return SMALL_BENCH.replace(old, new)


def without(key: str) -> str:
    return re.sub(rf"(?m)^{key} .*\n", "", SMALL_BENCH, count=1)


def more(text: str) -> str:
    return f"{SMALL_BENCH}{text}\n"


NEEDED = (
    "aperture_mm",
    "focal_length_mm",
    "pixel_pitch_um",
    "resolution_px",
    "quantum_efficiency",
)
DATED = '[sky]\nepoch_utc = "2026-11-21T00:00:00Z"\n'
SITE = DATED + "[site]\nlatitude_deg = 48.0\nlongitude_deg = 11.0\nheight_m = 500\n"
VIZARD = DATED + '[attitude]\nsource = "vizard"\n'


def aligned(covariance: list[list[float]]) -> str:
    """An alignment with a covariance, arcsec squared."""
    return f"[alignment]\nq_mon_to_reference = [1, 0, 0, 0]\ncovariance_arcsec2 = {covariance}"


def answers(**keys: str) -> str:
    """A tracker's answers as packets over UDP, but for some keys."""
    known = {"source": '"udp"', "format": '"packet"'} | keys
    return "\n".join(["[answers]", *(f"{key} = {value}" for key, value in known.items())])


QUATERNION = """{name = "qw", at = 4, type = "f32be"}, {name = "qx", at = 8, type = "f32be"},
 {name = "qy", at = 12, type = "f32be"}, {name = "qz", at = 16, type = "f32be"}"""


def frames(*fields: str, **keys: str) -> str:
    """Answers in frames of 32 bytes, with fields beside the quaternion's."""
    numbers = ", ".join([QUATERNION, *(f"{{{field}}}" for field in fields)])
    known = {"format": '"frame"', "framing": '"fixed"', "length": "32", "fields": f"[{numbers}]"}
    return more(answers(**(known | keys)))


def number(name: str, at: int, kind: str, rest: str = "") -> str:
    """A field of a frame."""
    return f'name = "{name}", at = {at}, type = "{kind}"{rest}'


REFUSED = [
    *((without(key), f"[tracker] the key {key} is missing") for key in NEEDED),
    (
        other_text("aperture_mm = 30", "aperture = 30"),
        "[tracker] unknown key aperture; did you mean aperture_mm?",
    ),
    (line("aperture_mm = -30"), "[tracker] aperture_mm = -30; number >= 1e-06 is wanted"),
    (line('aperture_mm = "30"'), '[tracker] aperture_mm = "30"; number is wanted'),
    (
        line("aperture_mm = 1e200"),
        "[tracker] aperture_mm = 1e200; number <= 1000000000000.0 is wanted",
    ),
    (line("aperture_mm = true"), "[tracker] aperture_mm = true; number is wanted"),
    (line("aperture_mm = nan"), "tracker.aperture_mm = nan; a finite number is wanted"),
    (
        other_text("[320, 240]", "[320]"),
        "[monitor] resolution_px = [320]; array of length 2 is wanted",
    ),
    (
        other_text("[320, 240]", "[320, 240.5]"),
        "[monitor] resolution_px = [320,240.5]; whole number is wanted",
    ),
    (
        other_text("[320, 240]", "[320, inf]"),
        "monitor.resolution_px = inf; a finite number is wanted",
    ),
    (other_text("[collimator]", "[colimator]"), "unknown key colimator; did you mean collimator?"),
    (other_text("[tracker]", "x = 1\n[tracker]"), "unknown key x; known are tracker, monitor"),
    (other_text("[tracker]", "[tracker"), "not TOML"),
    (more("q_cam_to_mon = [1,1,0,0]"), "q_cam_to_mon: its norm is 1.41421"),
    (more("q_cam_to_mon = [0.5,0.5,0,0]"), "q_cam_to_mon: its norm is 0.707107"),
    (
        more('[sky]\ntemperature = "hot"'),
        '[sky] temperature = "hot"; "ballesteros2012" or "wang2021" is wanted',
    ),
    (more("[sky]\nobserver_velocity_km_s = [3e5, 0, 0]"), "not slower than light"),
    (
        # a spacecraft of 10 000 km/s besides
        more('[attitude]\nsource = "vizard"\n[sky]\nobserver_velocity_km_s = [0, 2.9e5, 0]'),
        "not slower than light",
    ),
    (
        more("[background]\nelectrons_per_px = 1\nzodiacal_v_mag_arcsec2 = 22"),
        "write one of them",
    ),
    (
        more('[verify]\ncentroider = "centre"'),
        '[verify] centroider = "centre"; "window" or "wide" or "moment" or "fit" or',
    ),
    (more("[verify]\ncentroider = 3"), '[verify] centroider = 3; "window" or "wide"'),
    (more('[render]\nquantisation = "exactly"'), '"exact" or "auto" is wanted'),
    (more("[render]\ncycle_frames = 0"), "cycle_frames"),
    (more("[render]\ncycle_frames = 6.5"), "cycle_frames"),
    (more("[render]\ncycle_frames = 257"), "cycle_frames"),
    (more("[render]\nsprite_sigma_px = [0, 1]"), "sprite_sigma_px = [0,1]"),
    (more("[monitor.x]"), "[monitor] unknown key x"),
    # what keys mean together: each is right by itself
    (
        more("[render]\nflux_at_white_e_per_s = 1e4\nbrightest_v_mag = 2.0"),
        "[render] has flux_at_white_e_per_s and brightest_v_mag",
    ),
    (
        more('[verify]\ntrue_geometry = "g.toml"\ntrue_pixel_pitch_um = 60'),
        "[verify] true_geometry takes the place of true_pixel_pitch_um",
    ),
    (
        more(
            '[attitude]\nendpoint = "tcp://127.0.0.1:7001"\n'
            '[faults]\nendpoint = "tcp://127.0.0.1:7001"'
        ),
        "the attitude comes from there",
    ),
    (
        more('[render]\nbit_stealing = true\ncolour = "white"'),
        "the codes of r, g and b serve one",
    ),
    (more('[render]\ncolour = "star"'), '"star" needs the light of the primaries'),
    (
        more('[attitude]\nconvention = { frame = "body" }'),
        '[attitude] convention = { frame = "body" } needs [tracker] q_body_to_cam',
    ),
    (
        more('[answers]\nsource = "udp"\nformat = "packet"\nconvention = { frame = "body" }'),
        '[answers] convention = { frame = "body" } needs [tracker] q_body_to_cam',
    ),
    (
        more('[sky]\nepoch_utc = "2026-11-21T00:00:00Z"\nepoch_jyear = 2026.0'),
        "[sky] has epoch_utc and epoch_jyear",
    ),
    (
        more('[sky.bodies]\nsatellite_magnitudes = "m.csv"'),
        "satellite_magnitudes is of no satellites",
    ),
    (more("[sky.bodies]\nmoon = true"), "[sky.bodies] and [spacecraft] need a date"),
    (more('[sky]\nvariables = "phase"'), '[sky] variables = "phase" needs a date'),
    (more("[background]\nzodiacal = 1.0"), "[background] zodiacal"),
    (
        more(
            '[sky]\nepoch_utc = "2026-11-21T00:00:00Z"\nobserver_velocity_km_s = [1, 0, 0]\n'
            "[sky.bodies]\nmoon = true"
        ),
        "the velocity follows from the ephemeris",
    ),
    (more(SITE + '[spacecraft]\norbit = "o.tle"'), "[site] is a place on the ground, and [space"),
    (more(SITE + "[sky.bodies]\nearth = true"), "[site] is a place on the ground, and [sky.b"),
    (
        more(DATED + "[sky.bodies]\nearth = true"),
        "from its centre no Earth is seen",
    ),
    (
        more(DATED + '[spacecraft]\norbit = "source"'),
        'only "vizard" (Basilisk) sends the spacecraft\'s place',
    ),
    (
        more(VIZARD + 'use_velocity = false\n[spacecraft]\norbit = "source"'),
        "takes the source's place and velocity",
    ),
    (
        more(VIZARD + 'use_velocity = true\n[spacecraft]\norbit = "o.tle"'),
        "adds Basilisk's velocity to that of [spacecraft] orbit",
    ),
    (more(SITE + "[attitude]\n" + 'source = "vizard"'), "sends a spacecraft's velocity"),
    # the alignment's covariance
    (more(aligned([[4, 1, 0], [2, 2, 0], [0, 0, 9]])), "is no covariance"),
    (more(aligned([[4, 0, 0], [0, 2, 0], [7, 0, 9]])), "is no covariance"),
    (more(aligned([[4, 3, 0], [3, 2, 0], [0, 0, 9]])), "is no covariance"),
    (more(aligned([[4, -3, 0], [-3, 2, 0], [0, 0, 9]])), "is no covariance"),
    (more(aligned([[4, 0, 0], [0, -2, 0], [0, 0, 9]])), "a variance is below 0"),
    (more("[alignment]\nq_mon_to_reference = [1, 1, 0, 0]"), "its norm is 1.41421"),
    (more("[alignment]\nq_mon_to_reference = [0.5, 0.5, 0, 0]"), "its norm is 0.707107"),
    # SCPI's attitudes, and who may send
    (more('[attitude]\nsource = "scpi"\nport = 5560'), 'port: source = "scpi" has none'),
    (
        more('[attitude]\nsource = "scpi"\nendpoint = "tcp://127.0.0.1:5"'),
        'endpoint: source = "scpi" has none',
    ),
    (more('[attitude]\nsource = "scpi"\nclock = "shared"'), "are stamped by this machine"),
    (more('[attitude]\nsource = "udp"\nbind = "0.0.0.0:5560"'), "allow does not say which"),
    (more('[attitude]\nsource = "serial"'), 'source = "serial" needs port; write port = "/dev'),
    (more('[attitude]\nsource = "serial"\nport = 5560'), 'source = "serial" needs port; write'),
    (
        more('[attitude]\nsource = "udp"\nlockstep = true'),
        'lockstep = true is for source = "zmq", "vizard" or "42"',
    ),
    (
        more('[attitude]\nsource = "zmq"\nbind = "127.0.0.1:5560"'),
        'bind = "127.0.0.1:5560" is for source = "udp"; write true or false',
    ),
    (
        more('[attitude]\nsource = "42"\nallow = ["192.0.2.1"]'),
        'allow is for source = "udp", and for "42" with bind = true; remove it (source = "42")',
    ),
    (
        more('[attitude]\nsource = "serial"\nport = "/dev/a"\nspacecraft = "A"'),
        'spacecraft is for source = "vizard" or "42"; remove it (source = "serial")',
    ),
    # the tracker's answers
    (more(answers(trust='["mine"]')), 'trust is for format = "python:MODULE:FUNCTION"'),
    (
        more(answers(format='"python:m:f"', trust='["no name"]')),
        "no name of a package",
    ),
    (more(answers(bind='"0.0.0.0:5562"')), "allow does not say which may send"),
    (more(answers(connect='"nowhere"')), '"nowhere" is no place of a tracker'),
    (more(answers(connect='"host:0"')), '"host:0" is no place of a tracker'),
    (more(answers(connect='"host:65536"')), '"host:65536" is no place of a tracker'),
    (more(answers(source='"serial"')), 'source = "serial" needs port'),
    (more(answers(source='"file"')), 'source = "file" needs path'),
    (more(answers(source='"tcp"')), "needs connect or listen, one of them"),
    (more(answers(source='"zmq"', bind='"127.0.0.1:7"')), 'is for source = "udp"; write true'),
    (more(answers(poll_hex='"00"')), "poll_hex over UDP needs connect"),
    # the frames that they come in
    (frames(framing='"sync"'), 'framing = "sync" needs sync_hex'),
    (frames(sync_hex='"1ACF"'), "no other has it"),
    (more(answers(format='"frame"')), "needs framing"),
    (frames(length='{at = 2, type = "u8"}'), "needs length, in bytes"),
    (
        more(answers(format='"frame"', framing='"sync"', sync_hex='"1A"')),
        'framing = "sync" needs length',
    ),
    (
        frames(framing='"sync"', sync_hex='"1A"', length='{at = 2, type = "i16be"}'),
        'length = { type = "i16be" }',
    ),
    (frames(fields=f"[{QUATERNION.replace('qy', 'qx')}]"), 'fields has name = "qx" twice'),
    (frames(fields=f"[{QUATERNION.splitlines()[0][:-1]}]"), "fields lacks qy, qz"),
    (frames(convention='{scalar = "last"}'), "fields says by the name qw"),
    (frames(number("wx", 20, "f32be")), "one or two of wx, wy, wz"),
    (frames(number("wz", 20, "f32be"), number("wy", 24, "f32be")), "one or two of wx, wy, wz"),
    (frames(number("t_ns", 20, "u32be"), number("t_s", 24, "u16be")), "t_ns beside t_s or t_sub"),
    (frames(number("t_ns", 20, "u32be"), number("t_sub", 24, "u8")), "t_ns beside t_s or t_sub"),
    (frames(number("mode", 20, "u12be")), 'mode has type = "u12be"'),
    (frames(number("mode", 20, "f16be")), 'mode has type = "f16be"'),
    (frames(number("mode", 20, "i8", ", mask = 3")), "mode has a mask, which is for u8 to u64"),
    (frames(number("t_ns", 25, "u64le")), "t_ns ends with byte 32, and length = 32"),
    (frames(number("t_s", 20, "u16le", ", scale = 0")), "t_s has scale = 0"),
    (more(answers(framing='"slip"')), 'framing is for format = "frame"; remove it'),
    (more(answers(checksum='"crc32"')), 'checksum is for format = "frame"; remove it'),
    (more(answers(format='"xml"')), 'format = "xml"; "packet", "json", "frame" or'),
    # where they come from
    (more(answers(path='"t.bin"')), 'path is for source = "file"; remove it (source = "udp")'),
    (
        more(answers(source='"tcp"', listen='"127.0.0.1:7000"', connect='"h:1"')),
        "needs connect or listen, one of them",
    ),
    (more(answers(source='"serial"', port="7000")), 'source = "serial" needs port'),
    (
        more(answers(source='"tcp"', listen='"0.0.0.0:7000"')),
        "is open to other machines, and allow does not say which may send",
    ),
    (more(answers(connect='"h:0"')), "is no place of a tracker"),
    (more(answers(connect='"h:65536"')), "is no place of a tracker"),
    (
        more(answers(connect='"h:1"', poll_hex=f'"{"00" * 1025}"')),
        "poll_hex has over 1024 bytes",
    ),
    (more(aligned([[-0.5, 0, 0], [0, 2, 0], [0, 0, 9]])), "a variance is below 0"),
    (
        more(answers(connect='"h:1"', poll_hex=f'"{"00" * 5000}"')),
        "write what one question is",
    ),
    ("x = " + "[" * 5000, ""),
    ("x = " + "[" * 900 + "]" * 900, ""),
    ("[" + ".".join(["a"] * 2000) + "]", ""),
]


@pytest.mark.parametrize(("text", "words"), REFUSED, ids=range(len(REFUSED)))
def test_what_is_wrong_is_said_with_what_to_write(tmp_path, text, words):
    path = tmp_path / "bench.toml"
    path.write_text(text)
    answer = refusal(read_config, path)
    assert answer.startswith(f"{path}: ") and words in answer


READ = [
    SMALL_BENCH,
    more("[render]\nflux_at_white_e_per_s = 1e4"),
    more("[render]\nbrightest_v_mag = 2.0"),
    more("[render]\nbit_stealing = true"),
    more("[verify]\ntrue_pixel_pitch_um = 60"),
    more("q_cam_to_mon = [1.0005, 0, 0, 0]"),
    more(
        '[attitude]\nendpoint = "tcp://127.0.0.1:7001"\n[faults]\nendpoint = "tcp://127.0.0.1:7002"'
    ),
    more(DATED + "[sky.bodies]\nmoon = true"),
    more(DATED),
    more(SITE),
    more(VIZARD + '[spacecraft]\norbit = "source"'),
    more(VIZARD + 'use_velocity = false\n[spacecraft]\norbit = "o.tle"'),
    more(SITE + '[attitude]\nsource = "vizard"\nuse_velocity = false'),
    more("[sky]\nobserver_velocity_km_s = [2.9e5, 0, 0]"),
    more(aligned([[4, 1, 0], [1, 2, -4], [0, -4, 9]])),
    more("[alignment]\nq_mon_to_reference = [0.5, 0.5, -0.5, 0.5]"),
    more('[attitude]\nsource = "scpi"'),
    more('[attitude]\nsource = "udp"\nbind = "127.0.0.1:5560"'),
    more('[attitude]\nsource = "udp"\nbind = "0.0.0.0:5560"\nallow = ["10.0.0.7"]'),
    more(answers()),
    more(answers(connect='"host:65535"')),
    more(answers(connect='"host:1"', poll_hex=f'"{"00" * 1024}"')),
    more(answers(source='"tcp"', listen='"0.0.0.0:7000"', allow='["10.0.0.7"]')),
    more(answers(connect='"[::1]:7000"', poll_hex='"00ff"')),
    more(answers(format='"python:m:f"', trust='["mine"]')),
    frames(),
    frames(number("t_ns", 24, "u64le"), number("valid", 20, "u8", ", mask = 3")),
    frames(number("t_s", 20, "u16le", ", scale = -0.5"), number("t_sub", 22, "u24be")),
    frames(*(number(name, 20 + 4 * k, "f32be") for k, name in enumerate(("wx", "wy", "wz")))),
    frames(framing='"sync"', sync_hex='"1A CF"', length='{at = 2, type = "u16le", add = -4}'),
    more(answers(source='"serial"', port='"/dev/ttyUSB0"')),
    more(answers(source='"file"', path='"tracker.bin"')),
    more(answers(source='"tcp"', listen='"127.0.0.1:7000"')),
    more(answers(source='"zmq"', bind="true", endpoint='"tcp://127.0.0.1:7"')),
]


@pytest.mark.parametrize("text", READ, ids=range(len(READ)))
def test_what_is_right_beside_it_is_read(tmp_path, text):
    path = tmp_path / "bench.toml"
    path.write_text(text)
    assert read_config(path).tracker.aperture_mm == 30


def test_a_bench_file_that_is_not_there_is_refused(tmp_path):
    assert "No such file" in refusal(read_config, tmp_path / "none.toml")
