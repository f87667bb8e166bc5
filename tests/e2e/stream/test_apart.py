"""Links that the kernel stamps, or a process of their own: no stamp waits for Python's lock, and
nothing ends the link.
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq
from cobs import cobs
from scipy.spatial.transform import Rotation

from hilstar.attitude.wire.apart import ReaderProcess, Record, RecordStream, pack
from hilstar.attitude.wire.endpoint import AllowedSenders, bound_place
from hilstar.attitude.wire.links import Arrival
from hilstar.attitude.wire.nasa42 import MessageReader, Nasa42Link
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.roads import ANSWERS, ByteRoad, LinkCounts, RawMessage
from hilstar.attitude.wire.serial_link import SerialApart
from hilstar.attitude.wire.source import Mounting
from hilstar.attitude.wire.tcp import TcpRoad
from hilstar.attitude.wire.udp import UdpLink, UdpRoad
from hilstar.attitude.wire.vizard import DifferenceRates, Follower, vizard_broadcast
from hilstar.attitude.wire.zmq_links import ZmqApart, ZmqReceiver
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_S
from tests.support.commands import run_started
from tests.support.forks import Started
from tests.support.senders import connected, free_port, packet, publisher
from tests.support.sources.nasa42 import message
from tests.support.waiting import PATIENCE_S, best_of_three, in_time, wait_for
from tests.support.wire.ptys import serial_line

HOLD_S = 0.5
# A stamp that waits for the lock is late by the rest of the hold; a process that is merely woken
# late, on a machine whose cores are all busy at normal priority, has been seen late by 0.05 s.
LATE_NS = 250_000_000


HELD_S = 0.05
# A datagram stamped when it is read is off by HELD_S or more; stamped on arrival it is off by
# microseconds.
STAMP_NS = round(HELD_S / 2 * NS_PER_S)


def hold_the_lock() -> None:
    """As a call into OpenGL does: C code that does not let Python's lock go."""
    ctypes.PyDLL(None).usleep(round(HOLD_S * 1e6))


def next_arrivals(link) -> list[Arrival]:
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        if arrivals := link.receive(20):
            return arrivals
    raise AssertionError("nothing came")


@contextmanager
def zmq_road(kind=ZmqApart) -> Iterator[tuple]:
    with publisher() as (sender, port):
        receiver = ZmqReceiver(f"tcp://127.0.0.1:{port}")
        with ZmqApart(receiver) if kind is ZmqApart else receiver as link:
            yield link, lambda k: sender.send(packet(k, time.monotonic_ns()))


@contextmanager
def serial_road() -> Iterator[tuple]:
    with serial_line() as (device, name), SerialApart(name, 921_600) as link:
        yield link, lambda k: os.write(device, cobs.encode(packet(k, time.monotonic_ns())) + b"\0")


@contextmanager
def udp_road() -> Iterator[tuple]:
    with UdpLink(bound_place("127.0.0.1:0", "", None), AllowedSenders([])) as link:
        port = int(link.endpoint.rpartition(":")[2])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            yield link, lambda k: sender.sendto(packet(k, time.monotonic_ns()), ("127.0.0.1", port))


@contextmanager
def nasa42_road() -> Iterator[tuple]:
    with Nasa42Link("tcp://127.0.0.1:*", MessageReader(0, Mounting()), bind=True) as link:
        steps = itertools.count()
        host, _, port = link.endpoint.removeprefix("tcp://").rpartition(":")
        with socket.create_connection((host, int(port))) as sender:
            yield (
                link,
                lambda k: sender.sendall(message(0.1 * next(steps), Rotation.identity()).encode()),
            )


def await_packet(link, put, number: int) -> None:
    """Send until one is heard: the road is open."""

    def heard() -> bool:
        put(number)
        return bool(link.receive(20))

    wait_for(heard, "the road is open", poll_s=0.02)


def seen_late_ns(link, put) -> int:
    """How late a message is stamped that leaves just before the lock is held; one that was read
    has come before it.
    """
    await_packet(link, put, 0)
    while link.receive(100):
        pass
    left_ns = time.monotonic_ns()
    put(1)
    hold_the_lock()
    *_, arrival = next_arrivals(link)
    assert isinstance(arrival.event, AttitudeSample)
    assert link.stamped
    assert arrival.waited_ns >= 0
    in_time(arrival.waited_ns < LATE_NS, arrival.waited_ns)
    return arrival.host_ns - left_ns


@pytest.mark.timing
@pytest.mark.parametrize("road", [zmq_road, serial_road, udp_road, nasa42_road])
@best_of_three(
    "the sender and the lock are of one process: what it waits for a core between them counts as"
    " late"
)
def test_a_packet_is_stamped_while_the_process_that_draws_holds_pythons_lock(road):
    with road() as (link, put):
        late_ns = seen_late_ns(link, put)
    in_time(0 <= late_ns < LATE_NS, late_ns)


def test_a_thread_of_that_process_would_stamp_it_after():
    """So the test above can fail."""
    with zmq_road(ZmqReceiver) as (link, put):
        await_packet(link, put, 0)
        left_ns = time.monotonic_ns()
        put(1)
        hold_the_lock()
        *_, arrival = next_arrivals(link)
    assert arrival.host_ns - left_ns > HOLD_S * 1e9


def child_of(link) -> int:
    assert link._road._reader._process is not None
    return link._road._reader._process.pid


def test_a_reader_that_hangs_is_begun_again_at_once(caplog):
    """Without waiting for the seconds that one gets which would run, on a machine whose cores
    are busy.
    """
    with serial_road() as (link, put):
        await_packet(link, put, 0)
        before = link._road._reader.generation  # a busy machine may have begun it again already
        os.kill(child_of(link), signal.SIGSTOP)
        wait_for(
            lambda: not link.receive(100) and link._road._reader.generation > before, poll_s=0.0
        )
        await_packet(link, put, 2)
    assert "the attitude receiver stopped (no sign of life for 0.4 s); restarting it" in caplog.text


@pytest.mark.parametrize("road", [zmq_road, serial_road])
def test_a_reader_that_dies_is_begun_again_and_the_link_goes_on(road, caplog):
    with road() as (link, put):
        await_packet(link, put, 0)
        first = child_of(link)
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: not link.receive(20) and link._road._reader.generation == 2)
        await_packet(link, put, 1)
        second = child_of(link)
    assert link._notices.counts()["receiver-failed"] == 1
    assert "the attitude receiver stopped (signal 9); restarting it" in caplog.text
    assert second != first
    for each in (first, second):
        assert not Path(f"/proc/{each}").exists()


def can_bind(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
        return True
    return False


def test_a_port_that_another_program_took_is_told_and_waited_for(caplog):
    port = free_port()
    with ZmqApart(ZmqReceiver(f"tcp://127.0.0.1:{port}", bind=True)) as link:
        wait_for(
            lambda: can_bind(port), "the port, which libzmq gives back from a thread of its own"
        )
        with socket.create_server(("127.0.0.1", port)):
            wait_for(lambda: link.receive(20) or "the port is in use" in caplog.text)
        with connected(port, zmq.PUB) as sender:
            wait_for(lambda: sender.send(packet(0, 0)) or link.receive(20), poll_s=0.02)
        wait_for(
            lambda: (
                not link.receive(20)
                and link.link_counts.lost == 0
                and link.link_counts.connections == 1
            )
        )


def test_the_reader_ends_with_a_process_that_is_killed():
    program = """
import sys, time
from hilstar.attitude.wire.zmq_links import ZmqApart, ZmqReceiver
link = ZmqApart(ZmqReceiver("tcp://127.0.0.1:*", bind=True))
link.receive(1)
print(link._road._reader._process.pid, flush=True)
time.sleep(60)
"""
    with Started([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        assert "wire.apart_child" in Path(f"/proc/{child}/cmdline").read_text()
        # a terminal's Ctrl-C is for the process that shows stars, which then ends this one
        assert os.getsid(child) == child
        process.kill()
    wait_for(lambda: not _lives(child), "it ends too")


def _lives(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_basilisks_topic_and_long_messages_pass_through():
    notices = Notices()
    # over what a socket takes at once, and over what a link of packets takes at all
    long = bytes(1 << 20)
    with publisher() as (sender, port):
        follower = Follower(None, Mounting(), DifferenceRates(10**9, 1.0), "attitude")
        with ZmqApart(
            vizard_broadcast(f"tcp://127.0.0.1:{port}", follower, notices=notices), notices
        ) as link:
            wait_for(
                lambda: sender.send_multipart([b"SIM_UPDATE", b"", long]) or link.receive(20),
                poll_s=0.02,
            )
            sender.send(b"SYNC_SETTINGS")
            sender.send_multipart([b"SIM_UPDATE", b"", long])
            *_, last = next_arrivals(link)
    assert last.raw == long


@contextmanager
def udp_bytes() -> Iterator[tuple[ByteRoad, socket.socket]]:
    with (
        UdpRoad(bound_place("127.0.0.1:0", "", None), AllowedSenders(), ANSWERS) as road,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        sender.connect(("127.0.0.1", int(road.endpoint.rpartition(":")[2])))
        yield road, sender


@contextmanager
def tcp_bytes() -> Iterator[tuple[ByteRoad, socket.socket]]:
    place = ("127.0.0.1", 0)
    with TcpRoad(place, AllowedSenders(), ANSWERS, listening=True) as road:
        port = int(road.endpoint.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port)) as sender:
            wait_for(lambda: not road.taken(20) and road.openings == 1, "the connection")
            yield road, sender


@pytest.mark.parametrize("kind", [udp_bytes, tcp_bytes])
def test_what_was_read_late_has_the_time_of_its_arrival(kind):
    with kind() as (road, sender):

        def held() -> tuple[int, int]:
            """How long after it began to be sent, and after it was sent, what is read late
            arrived.
            """
            before_ns = time.monotonic_ns()
            sender.send(b"now")
            after_ns = time.monotonic_ns()
            time.sleep(HELD_S)
            (message,) = road.taken(0)
            return message.host_ns - before_ns, message.host_ns - after_ns

        # The kernel switches its stamps on from a work queue, some time after the socket asks for
        # them.
        wait_for(lambda: held()[1] < STAMP_NS, "stamps")
        late_ns = [held() for _ in range(5)]
    # The stamp is made while it is sent, however long this process is held up there.
    for after_begin_ns, after_end_ns in late_ns:
        assert after_begin_ns > -STAMP_NS and after_end_ns < STAMP_NS, late_ns


def test_records_come_out_whole_however_they_were_cut():
    late, timely = RawMessage(5, [b"", b"abc"], 3, False), RawMessage(-1, [b"x" * 1000], 0, True)
    sent = [
        Record(1, late),
        Record(1, gone="why"),
        Record(),
        Record(1, timely),
        Record(2, counts=LinkCounts(3, resets=1)),
        Record(2, notice=("flood", "a", "")),
    ]
    whole = b"".join(map(pack, sent))
    for size in (1, 7, len(whole)):
        stream = RecordStream()
        assert [
            record
            for at in range(0, len(whole), size)
            for record in stream.feed(whole[at : at + size])
        ] == sent
    assert (late.waited_ns, timely.waited_ns) == (2, 0)
    with pytest.raises(ValueError, match="a record of"):
        list(RecordStream().feed(b"\xff" * 9))
    with pytest.raises(ValueError, match="not a record"):
        list(RecordStream().feed(b"\x02\0\0\0ab"))


def test_a_reader_that_cannot_begin_is_tried_again_and_ends_nothing(caplog):
    reader = ReaderProcess(notices := Notices(), "hilstar.no_such_module")
    wait_for(
        lambda: reader.wait(20) and not reader.take() and notices.counts()["receiver-failed"] >= 2
    )
    reader.close()
    assert "exit code 1" in caplog.text


def test_a_process_that_works_for_long_loses_its_priority_until_it_rests():
    program = """
import os
from hilstar.basics.process.scheduling import PromptWhileLight
now_s = used_s = 0.0
def scheduled(): return os.sched_getscheduler(0)
prompt = PromptWhileLight(lambda: now_s, lambda: used_s)
print(scheduled())
now_s, used_s = 0.4, 0.4
prompt.tend()
print(scheduled())
now_s = 0.8
prompt.tend()
print(scheduled())
"""
    run = run_started([sys.executable, "-c", program])
    first, busy, rested = map(int, run.stdout.split())
    assert busy == os.SCHED_OTHER
    assert rested == first
