"""What is said of a serial line whose bytes are no packets."""

import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from hilstar.attitude.wire.likeness import MAX_LOOKED_AT
from hilstar.attitude.wire.packet import Refusal
from hilstar.attitude.wire.roads import RawMessage
from hilstar.attitude.wire.serial_link import (
    DRAIN_LOOK_S,
    SerialApart,
    SerialDecoder,
    SerialLink,
    read_lines,
)
from hilstar.basics.errors import InputError
from hilstar.basics.units import NS_PER_S
from hilstar.server.open_link import first_attitude
from tests.support.fake_clock import FakeClock
from tests.support.senders import packet
from tests.support.waiting import PATIENCE_S
from tests.support.wire.ptys import serial_line

BAUD = 115_200
WITHIN_S = 20.0
POLL_MS = 50


@pytest.mark.parametrize("kind", [SerialLink, SerialApart])
def test_a_text_shorter_than_a_frame_is_told_as_text(kind: type[SerialLink]) -> None:
    with serial_line() as (master, name), kind(name, BAUD) as link:
        assert link.trouble == ""
        os.write(master, b"tick 12\r\n")
        end_s = time.monotonic() + WITHIN_S
        while not link.trouble and time.monotonic() < end_s:
            assert link.receive(POLL_MS) == []
        assert "9 bytes came, and no frame ended: text, 'tick 12" in link.trouble
        assert "0x00" in link.trouble


def test_the_wait_for_an_attitude_says_what_came_instead() -> None:
    with serial_line() as (master, name), SerialLink(name, BAUD) as link:
        os.write(master, b"tick 12\r\n")
        with pytest.raises(InputError, match="text, 'tick 12") as refused:
            first_attitude(link, 0.5)
        assert "start the sender" not in str(refused.value)


def test_a_long_text_is_a_refused_message() -> None:
    with serial_line() as (master, name), SerialLink(name, BAUD) as link:
        os.write(master, b"RA 84.057 Dec -1.200\r\n" * 20)
        with pytest.raises(InputError, match=r"no 0x00 within \d+ bytes: text, 'RA 84.057"):
            first_attitude(link, 0.5)


def test_a_silent_line_is_a_sender_that_did_not_start() -> None:
    with (
        serial_line() as (_, name),
        SerialLink(name, BAUD) as link,
        pytest.raises(InputError, match="start the sender"),
    ):
        first_attitude(link, 0.2)


def test_a_bare_packet_is_named_whatever_came_on_the_line_before() -> None:
    """Its zeros cut it into frames that mean nothing: the newest bytes are looked at as they came."""
    decoder = SerialDecoder()
    decoder.whole(RawMessage(0, [b"\x01\x02\x00" * MAX_LOOKED_AT]))
    *_, last = decoder.whole(RawMessage(1, [packet(1, 2) + b"\x05\x00"]))
    event = decoder.event(last.parts[0])
    assert isinstance(event, Refusal)
    assert "a bare packet" in event.detail


@pytest.mark.parametrize("baud", [9600, 115_200])
def test_a_line_s_time_is_that_of_its_first_bit(baud: int) -> None:
    """Ten bits a byte and the end of the line: a clock that stands says when the last has come."""
    with serial_line() as (master, name):
        lines = read_lines(name, baud, 1.0, FakeClock(5 * NS_PER_S))

        def times_ns() -> dict[bytes, int]:
            came: dict[bytes, int] = {}
            while not {b"", b"light 12"} <= came.keys():
                host_ns, text = next(lines)
                came[text] = host_ns
            lines.close()
            return came

        with ThreadPoolExecutor(1) as pool:
            reading = pool.submit(times_ns)
            while not reading.done():  # what comes before the port is open is passed over
                os.write(master, b"\nlight 12\n")
                time.sleep(POLL_MS / 1000)
    by_text = reading.result()
    assert by_text[b"light 12"] == 5 * NS_PER_S - 9 * 10 * NS_PER_S // baud
    assert by_text[b""] == 5 * NS_PER_S - 10 * NS_PER_S // baud


class Draining:
    """A port that has sent `bytes_each` more of its bytes at each look."""

    def __init__(self, waiting: int, bytes_each: int) -> None:
        self.waiting = waiting
        self.bytes_each = bytes_each
        self.dropped = 0

    @property
    def out_waiting(self) -> int:
        self.waiting = max(0, self.waiting - self.bytes_each)
        return self.waiting

    def reset_output_buffer(self) -> None:
        self.dropped += self.waiting
        self.waiting = 0


@pytest.mark.parametrize(("bytes_each", "looks", "dropped"), [(30, 9, 0), (0, 100, 300)])
def test_what_is_sent_leaves_before_the_end_unless_the_line_stalls(bytes_each, looks, dropped):
    """300 bytes, of which the tenth look finds none; a line that stalls loses them after 0.5 s."""
    clock = FakeClock()
    with serial_line() as (_, name), SerialLink(name, BAUD, clock=clock) as link:
        device = Draining(300, bytes_each)
        own, link._road._device = link._road._device, device
        clock.slept_s.clear()
        link._road.drain()
        link._road._device = own
    assert (device.waiting, device.dropped) == (0, dropped)
    assert clock.slept_s[:looks] == [DRAIN_LOOK_S] * looks
    assert sum(clock.slept_s) == pytest.approx(looks * DRAIN_LOOK_S, abs=2 * DRAIN_LOOK_S)


def test_of_bytes_that_a_full_line_takes_in_part_it_is_said_that_they_were_not_sent() -> None:
    with serial_line() as (master, name), SerialLink(name, BAUD) as link:
        assert link.send_bytes(b"all of it")
        assert os.read(master, 100) == b"all of it"
        assert not link.send_bytes(bytes(1 << 20))
        assert len(os.read(master, 1 << 20)) < 1 << 20


def test_with_patience_all_bytes_go_to_a_reader_that_takes_them_in_parts() -> None:
    """More than a pty holds, 4 to 20 kB."""
    taken = bytearray()

    def reads(master: int) -> None:
        while len(taken) < 1 << 16:
            taken.extend(os.read(master, 1 << 12))

    with serial_line() as (master, name), SerialLink(name, BAUD) as link:
        reader = threading.Thread(target=reads, args=(master,), daemon=True)
        reader.start()
        assert link.send_bytes(bytes(1 << 16), PATIENCE_S)
        reader.join(PATIENCE_S)
    assert len(taken) == 1 << 16
