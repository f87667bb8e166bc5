"""SCPI as lines in and units out: forms, headers after headers, standard errors, and whatever
bytes come.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

from hilstar.server.console import scpi
from hilstar.server.console.scpi import (
    MAX_ERRORS,
    MAX_LINE_BYTES,
    Headers,
    InstrumentStatus,
    LineBuffer,
    NotScpi,
    ScpiError,
    Unit,
    _parameter,
)
from hilstar.server.console.server.scpi_server import BARE, COMMANDS, HEADERS, QUERIES

LINES = 6000
# a line of 4096 bytes takes a millisecond; 0.9 s where digits were tried in every split
CPU_S = 0.1


def units(line: str) -> list[Unit]:
    return list(HEADERS.units(line))


def patterns(line: str) -> list[str]:
    return [unit.pattern for unit in units(line)]


def scpi_error(line: str) -> int:
    """The error of a line, read as a server reads it: units up to the first that is wrong, and
    their parameters.
    """
    with pytest.raises(ScpiError) as raised:
        for unit in HEADERS.units(line):
            for parameter in scpi.count(unit, 4 if unit.pattern == "SKY:ATTitude" else 1):
                if unit.pattern == "SKY:BLANk":
                    scpi.boolean(parameter)
                elif unit.pattern.startswith("SKY:"):
                    scpi.number(parameter, "DEG/S")
                else:
                    scpi.integer(parameter, 255)
    assert raised.value.text.startswith(
        f'{raised.value.number},"{scpi.DESCRIPTIONS[raised.value.number]}'
    )
    return raised.value.number


def test_every_command_has_its_short_and_its_long_form_in_any_case():
    for pattern in [*QUERIES, *COMMANDS]:
        bare = pattern.replace("[:EVENt]", "").replace("[:NEXT]", "")
        short = "".join(c for c in bare if not c.islower())
        for form in (
            short,
            short.lower(),
            bare,
            bare.upper(),
            pattern.replace("[", "").replace("]", ""),
        ):
            assert patterns(form + " 1") == [pattern], form
            assert patterns(("" if form.startswith("*") else ":") + form) == [pattern], form


def test_the_commands_of_the_issue_are_there():
    line = (
        "*IDN?;*CLS;*RST;*OPC;*OPC?;*ESE 0;*ESR?;*SRE"
        " 0;*STB?;*TST?;*WAI;:SYST:ERR?;:SYST:VERS?;:STAT:OPER?;:STAT:QUES?;:SKY:BLANK ON;:SKY:ATT"
        " 1,0,0,0;:SKY:RATE 0,0,0;:SKY:ATT?;:SKY:FAULT 'a';:LEDG:STATE"
        " ON;:TRAC:RES?;:FRAM:MISS?;:SYST:AUTH 'b'"
    )
    assert len(patterns(line)) == 24


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("SKY:BLAN ON;ATT?", ["SKY:BLANk", "SKY:ATTitude?"]),
        ("SKY:BLAN ON;*IDN?;ATT?", ["SKY:BLANk", "*IDN?", "SKY:ATTitude?"]),
        ("SKY:BLAN ON;:SYST:ERR?", ["SKY:BLANk", "SYSTem:ERRor[:NEXT]?"]),
        ("SYST:ERR?;VERS?", ["SYSTem:ERRor[:NEXT]?", "SYSTem:VERSion?"]),
        ("SYST:ERR:NEXT?;COUN?", ["SYSTem:ERRor[:NEXT]?", "SYSTem:ERRor:COUNt?"]),
        ('SKY:FAUL "a;b";BLAN?;;', ["SKY:FAULt", "SKY:BLANk?"]),
        ("", []),
    ],
)
def test_a_header_goes_on_from_the_one_before(line, wanted):
    assert patterns(line) == wanted


@pytest.mark.parametrize(
    ("line", "number"),
    [
        ("SKY:BLAN ON;SYST:ERR?", -113),  # from SKY on
        ("SKY:ATTI 1,0,0,0", -113),  # neither form
        ("*IDN", -113),
        ("SKY:ATT", -109),
        ("SKY:ATT 1,0,0", -109),
        ("SKY:ATT 1,0,0,0,0", -108),
        ("SKY:ATT 1,,0,0", -109),
        ("SKY:ATT 1 0 0 0", -103),
        ("SKY:ATT 1,0,0,zero", -148),
        ("SKY:ATT 1,0,0,'0'", -158),
        ("SKY:ATT 1,0,0,1x?", -121),
        ("SKY:ATT 1,0,0,0 RAD/S", -131),
        ("SKY:ATT 1,0,0,1e999", -222),
        ("SKY:ATT 1,0,0,1e99999", -123),
        ("SKY:ATT 1,0,0,1e32001", -123),
        ("SKY:ATT 1,0,0,1e-32001", -123),
        (f"SKY:ATT {'1' * 300},0,0,0", -124),
        (f"*ESE #H{'F' * 4000}", -124),
        # at most 255 digits, and exponents to 32 000: what stands at these limits is only too large
        (f"SKY:ATT 1,0,0,{'1' * 256}", -124),
        (f"SKY:ATT {'1' * 255},0,0,1e32000", -222),
        (f"*ESE #H{'F' * 256}", -124),
        (f"*ESE #H{'F' * 255}", -222),
        ("*ESE 256", -222),
        ("*ESE 1 V", -138),
        ("*ESE #14abcd", -168),
        ("*ESE (1+1)", -178),
        ("*ESE 'a", -151),
        ("*ESE 'a'b'", -151),
        ("*ESE %", -141),
        ("SKY,1", -103),
        ("1SKY", -102),
        ("SKY::ATT?", -110),
        ("SKY:BLANKBLANKBLANK ON", -112),
        ("SKY:BLANK \u00e9", -101),
    ],
)
def test_what_is_wrong_has_its_standard_number(line, number):
    assert scpi_error(line) == number


def test_numbers_are_read_as_ieee_488_writes_them():
    (unit,) = units("SKY:RATE 1.5 E -1 DEG/S, #HfF ,-.5deg/s")
    assert [scpi.number(each, "DEG/S") for each in unit.parameters] == [0.15, 255.0, -0.5]
    (unit,) = units('SKY:FAUL "say ""so""", \'ON\'')
    assert [each.text for each in unit.parameters] == ['say "so"', "ON"]
    (unit,) = units('SKY:FAUL "it\'s; on, now", \'a "b"\'')
    assert [each.text for each in unit.parameters] == ["it's; on, now", 'a "b"']
    assert [scpi.boolean(units(f"SKY:BLAN {word}")[0].parameters[0]) for word in ("on", "OFF", "0", "0.4", "0.6", "7")] == [
        True, False, False, False, True, True,
    ]  # fmt: skip
    masks = [units(f"*ESE {text}")[0].parameters[0] for text in ("1.6", "1.4")]
    assert [scpi.integer(mask, 255) for mask in masks] == [2, 1]


def test_a_command_says_how_many_parameters_it_takes():
    (unit,) = units("SKY:FAULT 'a','b','c'")
    for limits, text in (((1, 2), "takes 2"), ((0,), "takes none"), ((4,), "takes 4")):
        with pytest.raises(ScpiError, match=f"SKY:FAULt {text}"):
            scpi.count(unit, *limits)
    assert scpi.count(unit, 1, 3) == scpi.count(unit, 3) == unit.parameters


def test_the_queue_of_errors_is_bounded_and_its_last_says_so():
    status = InstrumentStatus()
    for k in range(3 * MAX_ERRORS):
        status.add(ScpiError(-222, f'"{k}"'))
    assert status.next_error() == "-222,\"Data out of range;'0'\""
    told = [status.next_error() for _ in range(MAX_ERRORS)]
    assert told[-2:] == ['-350,"Queue overflow"', '0,"No error"']
    assert status.standard.read() == 16 | 8 and status.standard.read() == 0


def test_the_status_byte_sums_up_what_is_enabled():
    status = InstrumentStatus(standard=scpi.Register(enable=16), service_enable=32)
    assert status.byte(False) == 0
    status.add(ScpiError(-221))
    assert status.byte(False) == scpi.ERRORS_WAIT | scpi.STANDARD_EVENT | scpi.MASTER
    status.questionable.see(1 << 9)
    status.questionable.see(0)
    assert status.byte(True) & scpi.QUESTIONABLE == 0
    status.questionable.enable = 1 << 9
    assert (
        status.byte(True) & (scpi.QUESTIONABLE | scpi.MESSAGE_WAITS)
        == scpi.QUESTIONABLE | scpi.MESSAGE_WAITS
    )
    assert (status.questionable.read(), status.questionable.read()) == (1 << 9, 0)
    status.operation.see(4)
    assert status.byte(False) & scpi.OPERATION == 0
    status.operation.enable = 4
    assert status.byte(False) & scpi.OPERATION
    status.preset()
    assert status.operation.enable == status.questionable.enable == 0
    status.completes = True
    status.clear()
    assert status.byte(False) == 0 and status.standard.enable == 16 and not status.completes


def test_a_condition_is_an_event_when_it_begins_alone():
    register = scpi.Register()
    for condition, events in ((1, 1), (1, 0), (3, 2), (2, 0), (3, 1)):
        register.see(condition)
        assert register.read() == events


@pytest.mark.parametrize("chunk", [1, 3, 10_000])
def test_lines_are_the_same_however_they_are_cut(chunk):
    data = (
        b"\r*IDN?\r\n\n"
        + b"x" * (MAX_LINE_BYTES + 1)
        + b"\n*CLS\n"
        + b"y" * MAX_LINE_BYTES
        + b"\nrest"
    )
    buffer, lines = LineBuffer(), []
    for at in range(0, len(data), chunk):
        lines += buffer.feed(data[at : at + chunk])
    assert lines == ["\r*IDN?", "", None, "*CLS", "y" * MAX_LINE_BYTES]


def mutated(rng: np.random.Generator) -> bytes:
    """A line of pieces of SCPI, some of its bytes others."""
    heads = [b"SKY:ATT 1,0,0,0", b"SKY:RATE ", b"SYST:ERR?;", b"*IDN?;", b":SKY:", b"SKY:FAUL 'a'"]
    pieces = [
        b":",
        b"?",
        b" ",
        b"1",
        b",",
        b"-.5e-1",
        b"'",
        b'"',
        b";",
        b"#H",
        b"(",
        b"DEG/S",
        *heads,
    ]
    chosen = [
        heads[rng.integers(len(heads))],
        *(pieces[k] for k in rng.integers(len(pieces), size=rng.integers(5))),
    ]
    data = bytearray(b"".join(chosen))
    for at in rng.integers(len(data), size=rng.integers(0, 3)):
        data[at] = rng.integers(256)
    return bytes(data)


def test_whatever_bytes_come_give_units_or_a_standard_error():
    rng, status = np.random.default_rng(34), InstrumentStatus()
    good = closed = 0
    for k in range(LINES):
        data = (
            mutated(rng)
            if k % 3
            else rng.integers(256, size=rng.integers(60), dtype=np.uint8).tobytes()
        )
        try:
            lines = list(LineBuffer().feed(data + b"\n"))
        except NotScpi:
            closed += 1
            assert any((byte < 32 and byte not in b"\t\r\n") or byte == 127 for byte in data)
            continue
        for line in lines:
            try:
                for unit in HEADERS.units(line or ""):
                    good += 1
                    without = unit.pattern in BARE or unit.pattern in QUERIES
                    scpi.count(unit, 0 if without else 1, 4)
                    for parameter in unit.parameters:
                        scpi.number(parameter, "DEG/S")
            except ScpiError as error:
                status.add(error)
                assert (
                    error.number in scpi.DESCRIPTIONS
                    and error.text.isascii()
                    and len(error.text) < 260
                )
    assert good > LINES / 30 and closed > LINES / 30 and len(status.errors) == MAX_ERRORS


BLANKED = b"\nSKY:BLAN ON\n"
LONG_PATH = b"/" + b"a" * 5000
METHODS = (
    b"GET",
    b"HEAD",
    b"POST",
    b"PUT",
    b"DELETE",
    b"CONNECT",
    b"OPTIONS",
    b"TRACE",
    b"PATCH",
    b"PRI",
    b"M-SEARCH",
    b"X!Y",
)
TARGETS = (
    b"/",
    b"*",
    b"/a?b=SKY:BLAN%20ON",
    LONG_PATH,
    b"http://127.0.0.1:5025/",
    b"127.0.0.1:5025",
)
CLIENT_HELLO = bytes.fromhex("16030100c8010000c40303") + bytes(range(32)) + BLANKED
SSL_2_HELLO = bytes.fromhex("802e010002001500000010") + BLANKED
STUN = bytes.fromhex("000300082112a442") + b"turn:127.0.0.1" + BLANKED


def obeyed(data: bytes, cuts: list[int]) -> tuple[list[str | None], bool]:
    """The lines that come of data cut at these places, and whether the connection is closed."""
    buffer, lines = LineBuffer(), []
    try:
        for begin, end in zip([0, *cuts], [*cuts, len(data)], strict=True):
            lines += buffer.feed(data[begin:end])
    except NotScpi:
        return lines, True
    return lines, False


def request(
    method: bytes, target: bytes, version: bytes, blank: bytes = b" ", end: bytes = b"\r\n"
) -> bytes:
    return (
        method
        + blank
        + target
        + blank
        + version
        + end
        + b"Host: 127.0.0.1:5025\r\nOrigin: http://a"
        + end
        + BLANKED
    )


def test_a_request_of_any_method_case_length_and_cut_is_closed_before_a_line_of_it_is_read(rng):
    for method in METHODS:
        for target in TARGETS:
            for version in (b"HTTP/1.1", b"HTTP/1.0", b"HTTP/2.0"):
                for blank, end in ((b" ", b"\r\n"), (b"  ", b"\n"), (b"\t", b" \r\n")):
                    whole = request(method, target, version, blank, end)
                    for data in (whole, whole.lower(), whole.swapcase(), b"\r\n\r\n" + whole):
                        cuts = sorted(rng.integers(0, len(data), size=rng.integers(0, 4)).tolist())
                        lines, closed = obeyed(data, cuts)
                        assert closed and not any(lines), (data[:60], cuts)


@pytest.mark.parametrize(
    "data",
    [
        b"POST " + LONG_PATH + b" HTTP/1.1" + b" " * 9000 + b"\r\n" + BLANKED,
        b" " * 9000 + b"post * http/1.1\r\n" + BLANKED,
        b"A" * 9000 + b" / HTTP/1.1\r\n" + BLANKED,
        b"GET /\r\n" + BLANKED,  # HTTP/0.9
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + BLANKED,
        CLIENT_HELLO,
        SSL_2_HELLO,
        STUN,
    ],
)
@pytest.mark.parametrize("piece", [1, 7, 10_000])
def test_what_a_browser_sends_otherwise_is_closed_too(data, piece):
    lines, closed = obeyed(data, list(range(piece, len(data), piece)))
    assert closed and not any(lines)


@pytest.mark.parametrize("byte", [*range(9), 11, 12, *range(14, 32), 127])
def test_a_control_character_closes_the_connection_wherever_it_stands(byte):
    assert obeyed(bytes([byte]), []) == ([], True)
    assert obeyed(b"*IDN?\n*ID" + bytes([byte]) + b"N?" + BLANKED, [3]) == (["*IDN?"], True)
    assert obeyed(b"x" * 5000 + bytes([byte]) + BLANKED, [4999]) == ([], True)


@pytest.mark.parametrize(
    "line",
    [
        "SKY:FAUL 'GET / HTTP/1.1'",
        "SKY:RATE 1,2,3 DEG/S",
        "POST",
        "post:sky /1",
        "*ESE /1",
        "HTTP/1.1",
        "SKY:ATT 1,0,0,0 /",
        "SKY:BLAN ON;\tATT?",
        "SKY:BLANK \u00e9",
    ],
)
def test_a_mistyped_line_is_none_of_these(line):
    assert obeyed(line.encode("latin-1") + b"\r\n", []) == ([line], False)


def test_two_lines_together_are_no_request():
    lines = ["GET ", "/ ", "A ", "HTTP/1.1"]
    assert obeyed("\n".join([*lines, ""]).encode(), []) == (lines, False)


@pytest.mark.timing
def test_a_number_of_four_thousand_digits_is_refused_at_once():
    begun_s = time.process_time()
    assert scpi_error(f"SKY:ATT {'1' * 4000}!,0,0,0") == -121
    assert time.process_time() - begun_s < CPU_S


def test_a_device_s_own_headers_may_leave_out_what_stands_in_brackets():
    headers = Headers(["SOURce[:SKY]:POWer"])
    assert [next(headers.units(line)).pattern for line in ("SOUR:POW 1", "source:sky:power 1")] == [
        "SOURce[:SKY]:POWer"
    ] * 2


@pytest.mark.parametrize("text", ["#H1F", "#h1f", "#Q37", "#B11111", "31"])
def test_a_whole_number_is_read_to_its_base(text):
    parameter = _parameter(text)
    assert (parameter.kind, float(parameter.text)) == ("number", 31.0)
