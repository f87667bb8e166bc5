"""Who holds a tracker's TCP line, and which files are read: what is refused, let go, told, and
taken again.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import time
from collections.abc import Callable, Iterator
from ipaddress import ip_address
from pathlib import Path

import numpy as np
import pytest

from hilstar.attitude.wire.apart import (
    ReaderProcess,
    ReadOrder,
    Record,
    RecordStream,
    pack,
    process_state,
    why_hung,
)
from hilstar.attitude.wire.apart_child import Wire, _ForwardedNotices, _Reading, as_read
from hilstar.attitude.wire.endpoint import AllowedSenders, UdpPlace
from hilstar.attitude.wire.file_road import FileRoad, refuse_no_file
from hilstar.attitude.wire.roads import (
    ANSWERS,
    MAX_READ_BYTES,
    ByteRoad,
    LinkCounts,
    RawMessage,
    read_device,
)
from hilstar.attitude.wire.serial_link import SerialRoad
from hilstar.attitude.wire.tcp import ACCEPT_EACH_S, TOLD_S, TcpRoad
from hilstar.attitude.wire.udp import UdpRoad
from hilstar.attitude.wire.zmq_links import ZmqRoad
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.server.answers.reader import HELD_S
from tests.support.fake_clock import FakeClock
from tests.support.waiting import wait_for
from tests.support.wire.far_ends import SerialFar, ZmqFar

SOON_MS = 20


@contextlib.contextmanager
def listening(
    clock: FakeClock, notices: Notices, allow: tuple[str, ...] = ()
) -> Iterator[tuple[TcpRoad, int]]:
    with TcpRoad(
        ("127.0.0.1", 0),
        AllowedSenders(allow),
        ANSWERS,
        notices,
        clock,
        listening=True,
        held_s=HELD_S,
    ) as link:
        yield link, int(link.endpoint.rpartition(":")[2])


def connect(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), 5)


def taken(link: ByteRoad) -> bytes:
    """What has come within a look."""
    return b"".join(chunk.parts[-1] for chunk in link.taken(SOON_MS))


def closed(link: TcpRoad, made: socket.socket) -> bool:
    """Whether the link has closed a connection, which it may do at its next look."""
    link.taken(SOON_MS)
    made.settimeout(0.05)
    try:
        return made.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def hold(link: TcpRoad, port: int, clock: FakeClock) -> socket.socket:
    """A connection that is accepted and has sent."""
    made = connect(port)
    made.sendall(b"a")
    wait_for(lambda: taken(link) == b"a", "the first bytes")
    clock.work(1e9 * ACCEPT_EACH_S)
    return made


def test_a_link_without_a_tracker_rests_after_a_stranger_that_it_refused():
    """Whoever connects again and again from a place that is not allowed keeps no core busy."""
    clock, notices = FakeClock(), Notices()
    with listening(clock, notices, ("192.0.2.0/24",)) as (link, port), connect(port) as stranger:
        wait_for(lambda: closed(link, stranger), "the refusal")
        looks = 0
        begun_ns = clock.now_ns()
        while clock.now_ns() - begun_ns < 1e9 and looks < 1000:
            connect(port).close()
            link.taken(SOON_MS)
            looks += 1
    assert looks <= 2.5 / ACCEPT_EACH_S  # a connection, and the rest after it


def test_a_second_connection_is_refused_and_named_while_the_first_sends():
    clock, notices = FakeClock(), Notices()
    with listening(clock, notices) as (link, port), hold(link, port, clock) as first:
        assert link.trouble == ""
        for _ in range(5):
            second = connect(port)
            own = second.getsockname()[1]
            second.sendall(b"lies")
            wait_for(lambda second=second: closed(link, second), "the refusal")
            second.close()
            assert (
                f"from 127.0.0.1:{own}" in link.trouble
                and f":{first.getsockname()[1]} holds the line" in link.trouble
            )
            clock.work(0.9e9 * HELD_S)
            first.sendall(b"b")
            wait_for(lambda: taken(link) == b"b", "the first one's bytes")
        assert notices.counts() == {"second-connection": 5}
        assert (link.link_counts.refused, link.link_counts.connections) == (5, 1)
        clock.work(1e9 * TOLD_S)
        assert link.trouble == ""


def test_a_tracker_behind_a_half_open_line_is_back_after_three_seconds_and_not_before():
    clock, notices = FakeClock(), Notices()
    with listening(clock, notices) as (link, port), hold(link, port, clock) as half_open:
        clock.work(0.9e9 * HELD_S)
        with connect(port) as early:
            wait_for(lambda: closed(link, early), "the refusal")
        clock.work(0.1e9 * HELD_S)
        with connect(port) as again:
            again.sendall(b"c")
            wait_for(lambda: taken(link) == b"c", "the tracker's bytes")
            assert closed(link, half_open)
            assert link.trouble == ""
    assert notices.counts() == {"second-connection": 1, "answers-lost": 1, "answers-back": 1}


def test_a_tracker_whose_hold_has_no_end_keeps_the_line_however_long_it_is_silent():
    clock, notices = FakeClock(), Notices()
    with TcpRoad(
        ("127.0.0.1", 0), AllowedSenders(), ANSWERS, notices, clock, listening=True
    ) as link:
        port = int(link.endpoint.rpartition(":")[2])
        with hold(link, port, clock) as first:
            clock.work(3600e9)
            with connect(port) as second:
                wait_for(lambda: closed(link, second), "the refusal")
            first.sendall(b"b")
            wait_for(lambda: taken(link) == b"b", "the first one's bytes")
    assert (link.link_counts.refused, link.link_counts.connections) == (1, 1)
    assert notices.counts() == {"second-connection": 1}


def test_bytes_of_tcp_came_after_the_last_look_that_found_none():
    clock = FakeClock()
    with listening(clock, Notices()) as (link, port), hold(link, port, clock) as tracker:
        before_ns = clock.now_ns()
        assert link.taken(0) == []
        after_ns = clock.now_ns()
        clock.work(1e9)
        tracker.sendall(b"b")
        wait_for(lambda: link.wait_for_message(SOON_MS), "the bytes")
        (chunk,) = link.taken(SOON_MS)
    assert chunk.parts == [b"b"]
    assert before_ns <= chunk.empty_ns <= after_ns


def test_what_a_full_line_takes_in_part_is_not_sent():
    clock = FakeClock()
    with listening(clock, Notices()) as (link, port), hold(link, port, clock) as tracker:
        assert link.put(b"all")
        assert tracker.recv(3) == b"all"
        assert not link.put(bytes(1 << 26))


@pytest.mark.parametrize(
    ("host", "endpoint"), [("::1", "tcp://[::1]:5560"), ("192.0.2.1", "tcp://192.0.2.1:5560")]
)
def test_a_tcp_endpoint_has_an_ipv6_address_in_brackets(host, endpoint):
    with TcpRoad((host, 5560), AllowedSenders(), ANSWERS, listening=False) as road:
        assert (road.endpoint, road.verb) == (endpoint, "connecting to")


def test_a_tracker_that_closed_its_line_is_back_at_once():
    clock, notices = FakeClock(), Notices()
    with listening(clock, notices) as (link, port):
        hold(link, port, clock).close()
        with connect(port) as again:  # both wait: the end of the first line, and the second
            again.sendall(b"d")
            wait_for(lambda: taken(link) == b"d", "the tracker's bytes")
    assert "second-connection" not in notices.counts()


def test_a_line_that_never_sent_holds_for_as_long_and_no_longer():
    clock = FakeClock()
    with listening(clock, Notices()) as (link, port), connect(port):
        wait_for(
            lambda: link.taken(SOON_MS) == [] and link.link_counts.connections == 1,
            "the silent one",
        )
        clock.work(1e9 * HELD_S)
        with connect(port) as tracker:
            tracker.sendall(b"e")
            wait_for(lambda: taken(link) == b"e", "the tracker's bytes")


def test_the_kernel_asks_a_tracker_that_says_nothing_whether_it_is_there():
    """A cable that was pulled ends the connection in seconds, and not in two hours."""
    clock = FakeClock()
    with listening(clock, Notices()) as (link, port), hold(link, port, clock):
        option = link._connection.getsockopt
        assert option(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        tcp = [socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT]
        idle_s, interval_s, count = [option(socket.IPPROTO_TCP, name) for name in tcp]
        assert idle_s + interval_s * count <= 6


def replaced(path: Path, kind: str) -> None:
    path.unlink(missing_ok=True)
    if kind == "a device":
        path.symlink_to("/dev/zero")
    elif kind == "a FIFO":
        os.mkfifo(path)
    elif kind == "a directory":
        path.mkdir()
    else:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(str(path))


@pytest.mark.parametrize("kind", ["a device", "a FIFO", "a directory", "a socket"])
def test_a_file_that_becomes_something_else_is_let_go_told_once_and_taken_again(tmp_path, kind):
    path, notices, clock = tmp_path / "t.bin", Notices(), FakeClock()
    path.touch()
    with FileRoad(path, ANSWERS, notices, clock) as link:
        path.write_bytes(b"one")
        assert taken(link) == b"one"
        replaced(path, kind)
        for _ in range(3):
            assert taken(link) == b""
        assert link.trouble == f"it is {kind} now, and no regular file"
        assert notices.counts() == {"answers-lost": 1}
        if kind == "a directory":
            path.rmdir()
        else:
            path.unlink()
        path.write_bytes(b"two")
        assert taken(link) == b"two"
        assert link.trouble == ""
        assert notices.counts() == {"answers-lost": 1, "answers-back": 1}


@pytest.mark.parametrize("kind", ["a device", "a FIFO", "a directory", "a socket"])
def test_a_path_that_names_no_regular_file_at_the_start_is_refused(tmp_path, kind):
    replaced(tmp_path / "t.bin", kind)
    with pytest.raises(InputError, match=f"path = .*t.bin: {kind}; write the file"):
        refuse_no_file(tmp_path / "t.bin")
    # A reader that is started again in a run waits for the file instead.
    with FileRoad(tmp_path / "t.bin", ANSWERS, Notices(), FakeClock()) as link:
        assert taken(link) == b"" and kind in link.trouble


@pytest.mark.parametrize("then", ["gone", "a link to itself", "a link to nothing"])
def test_a_file_that_cannot_be_read_any_more_is_told_while_that_lasts(tmp_path, then):
    path, notices = tmp_path / "t.bin", Notices()
    path.touch()
    with FileRoad(path, ANSWERS, notices, FakeClock()) as link:
        assert taken(link) == b"" and link.trouble == ""
        path.unlink()
        if then != "gone":
            path.symlink_to(path if then == "a link to itself" else tmp_path / "nothing")
        assert taken(link) == b"" and f"{path} cannot be read (" in link.trouble
        path.unlink(missing_ok=True)
        path.write_bytes(b"two")
        assert taken(link) == b"two" and link.trouble == ""


def test_a_file_is_read_from_its_end_on_and_from_its_beginning_once_it_was_cut(tmp_path):
    path = tmp_path / "t.bin"
    path.write_bytes(b"before")
    with FileRoad(path, ANSWERS, Notices(), FakeClock()) as link, path.open("ab", 0) as growing:
        assert taken(link) == b""
        growing.write(b"one")
        assert taken(link) == b"one"
        os.truncate(path, 0)
        growing.write(b"two")
        assert taken(link) == b"two"
        growing.write(b"three")
        assert taken(link) == b"three"


def test_a_device_s_bytes_that_wait_already_may_have_come_at_any_time():
    """Those that come later came after the last look that found none."""
    clock = FakeClock()
    here, there = socket.socketpair()
    reading, writing = os.pipe()
    stream = RecordStream()

    def handed_over() -> RawMessage:
        under_way.hand_over(under_way.link)
        (record,) = stream.feed(here.recv(1 << 16))
        assert record.order == 3
        return record.message

    with here, there:
        under_way = _Reading(Wire(there, clock), ReadOrder(3, device=True), reading, clock)
        os.write(writing, b"one")
        clock.sleep(1.0)
        first = handed_over()
        assert (first.parts, first.empty_ns, first.timely) == ([b"one"], 0, False)
        looked_ns = clock.now_ns()
        under_way.hand_over(under_way.link)
        os.write(writing, b"two")
        clock.sleep(1.0)
        second = handed_over()
        assert looked_ns <= second.empty_ns < clock.now_ns() - 500_000_000
        under_way.close()
    os.close(writing)


def test_a_sign_of_life_is_given_each_tenth_of_a_second():
    clock = FakeClock()
    here, there = socket.socketpair()
    stream = RecordStream()
    with here, there:
        wire = Wire(there, clock)
        for _ in range(100):
            wire.sign()
            clock.sleep(0.01)
        assert len(list(stream.feed(here.recv(1 << 16)))) == pytest.approx(10, abs=1)


def test_a_file_that_comes_back_is_no_trouble_any_more(tmp_path):
    path, aside = tmp_path / "t.bin", tmp_path / "aside.bin"
    path.touch()
    with FileRoad(path, ANSWERS, Notices(), FakeClock()) as link:
        path.rename(aside)
        assert taken(link) == b"" and link.trouble
        aside.rename(path)
        assert taken(link) == b"" and link.trouble == ""


def test_a_path_that_names_nothing_yet_and_then_a_device_is_not_opened(tmp_path):
    path, notices = tmp_path / "t.bin", Notices()
    with FileRoad(path, ANSWERS, notices, FakeClock()) as link:
        assert taken(link) == b"" and "cannot be read (No such file" in link.trouble
        path.symlink_to("/dev/zero")
        assert taken(link) == b"" and "a device" in link.trouble


@pytest.mark.parametrize("kind", ["serial", "tcp"])
def test_a_road_that_is_lost_is_tried_at_growing_intervals_and_told_as_its_user_s(tmp_path, kind):
    """A read that opens it brings nothing, and none waits for longer than it may."""
    clock, notices = FakeClock(), Notices()
    with lost_road(kind, tmp_path, clock, notices) as (road, bring_back, lose):
        assert road.link_counts.lost == 1 and notices.counts() == {"answers-lost": 1}
        tries_ns: list[int] = []
        opens = road._open if isinstance(road, SerialRoad) else road._connect

        def tried() -> None:
            tries_ns.append(clock.now_ns())
            opens()

        name = "_open" if isinstance(road, SerialRoad) else "_connect"
        setattr(road, name, tried)
        begun_ns = clock.now_ns()
        while len(tries_ns) < 6:
            before_ns = clock.now_ns()
            assert road.taken(SOON_MS) == []
            assert not road.put(b"?") and not road.wait_for_message(0)
            assert clock.now_ns() - before_ns <= SOON_MS * 1_000_000
        waits_s = np.diff([begun_ns, *tries_ns]) / 1e9
        assert waits_s == pytest.approx([0.05, 0.1, 0.2, 0.25, 0.25, 0.25], abs=0.001)
        bring_back()
        while road.openings < 2:
            assert road.taken(SOON_MS) == []
        assert (road.reconnects, road.link_counts.lost) == (1, 1)
        assert notices.counts() == {"answers-lost": 1, "answers-back": 1}
        assert road.put(b"?")
        lose()
        wait_for(lambda: not road.taken(SOON_MS) and road.link_counts.lost == 2, "another loss")
        tries_ns.clear()
        lost_ns = clock.now_ns()
        while not tries_ns:
            road.taken(SOON_MS)
        assert tries_ns[0] - lost_ns == pytest.approx(0.05e9, abs=1e6)  # as soon as the first time


def test_a_device_that_is_readable_and_brings_nothing_has_gone():
    reading, writing = os.pipe()
    try:
        assert read_device(reading, 0) == []
        os.write(writing, b"some")
        assert [chunk.parts for chunk in read_device(reading, 0)] == [[b"some"]]
        os.close(writing)
        with pytest.raises(OSError, match="it was readable, and nothing came") as gone:
            read_device(reading, 0)
        assert gone.value.errno == errno.EIO
    finally:
        os.close(reading)


@contextlib.contextmanager
def lost_road(
    kind: str, folder: Path, clock: FakeClock, notices: Notices
) -> Iterator[tuple[SerialRoad | TcpRoad, Callable[[], None], Callable[[], object]]]:
    """A road to a tracker that has gone, what brings the tracker back, and what takes it away."""
    with contextlib.ExitStack() as stack:
        if kind == "serial":
            far = SerialFar(folder)
            road = SerialRoad(str(folder / "port"), 115_200, ANSWERS, notices, clock)
            stack.enter_context(road)
            far.vanish()
            wait_for(lambda: not road.taken(SOON_MS) and road.link_counts.lost, "the loss")
            yield road, far.come, far.vanish
            return
        with socket.create_server(("127.0.0.1", 0)) as server:
            place = ("127.0.0.1", server.getsockname()[1])
            road = TcpRoad(place, AllowedSenders(), ANSWERS, notices, clock, listening=False)
            stack.enter_context(road)
            assert road.taken(SOON_MS) == [] and road.openings == 1
            server.accept()[0].close()
            wait_for(lambda: not road.taken(SOON_MS) and road.link_counts.lost, "the loss")

        servers: list[socket.socket] = []

        def come_back() -> None:
            servers.append(stack.enter_context(socket.create_server(place)))

        def go_away() -> None:
            connection, _ = servers[0].accept()
            connection.close()

        yield road, come_back, go_away


def test_a_port_that_is_lost_at_a_write_is_let_go_by_the_process_that_reads_it(
    tmp_path, monkeypatch
):
    """Else it would stay open and locked, and could not be opened again."""

    def unplugged(*_: object) -> int:
        raise OSError(errno.EIO, "unplugged")

    far = SerialFar(tmp_path, apart=True)
    with far.link(Notices()) as link:
        port = os.ttyname(far._slave)
        files = Path(f"/proc/{link._road._reader._process.pid}/fd")

        def is_held() -> bool:
            held = []
            for file in files.iterdir():
                with contextlib.suppress(FileNotFoundError):  # closed since
                    held.append(str(file.readlink()))
            return port in held

        wait_for(lambda: not link.receive(SOON_MS) and is_held(), "the process to read")
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", unplugged)
            assert not link.send_bytes(b"?")
        assert link.link_counts.lost == 1
        wait_for(lambda: not is_held(), "the process to let go")
    far.vanish()


def test_a_tracker_that_is_asked_over_udp_is_the_only_one_that_is_heard():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tracker:
        tracker.bind(("127.0.0.1", 0))
        place = tracker.getsockname()
        with (
            UdpRoad(place, AllowedSenders(), ANSWERS) as road,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
        ):
            assert road.endpoint == f"udp://127.0.0.1:{place[1]}"
            assert road.put(b"?")
            asked, asker = tracker.recvfrom(10)
            assert asked == b"?"
            stranger.sendto(b"lies", asker)
            tracker.sendto(b"answer", asker)
            assert taken(road) == b"answer" and taken(road) == b""
            assert (road.openings, road.reconnects) == (1, 0)


def test_a_bound_udp_road_sends_to_nobody_by_itself():
    with (
        UdpRoad(UdpPlace(ip_address("127.0.0.1"), 0), AllowedSenders(), ANSWERS) as road,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tracker,
    ):
        tracker.connect(("127.0.0.1", int(road.endpoint.rpartition(":")[2])))
        tracker.send(b"answer")
        assert taken(road) == b"answer"
        assert not road.put(b"?")


def test_a_tracker_over_zeromq_that_vanishes_is_told_as_the_tracker_and_not_as_the_sender(tmp_path):
    far, notices = ZmqFar(tmp_path), Notices()
    with ZmqRoad(far.place, notices=notices, use=ANSWERS) as road:

        def heard() -> bool:
            far.put(b"answer")
            return taken(road)[:6] == b"answer"

        wait_for(heard, "the road", poll_s=0.005)
        far.vanish()
        wait_for(lambda: not taken(road) and road.link_counts.lost == 1, "the loss")
        far.come()
        wait_for(heard, "the road again", poll_s=0.005)
        assert (road.openings, road.reconnects) == (2, 1)
    far.vanish()
    assert notices.counts() == {"answers-lost": 1, "answers-back": 1}


@pytest.mark.parametrize(
    ("count", "had_waited", "timely"),
    [(0, False, []), (1, False, [True]), (3, False, [False, False, True]), (1, True, [False])],
)
def test_of_what_was_read_together_only_what_woke_the_reader_did_not_wait(
    count, had_waited, timely
):
    taken = [RawMessage(1000 + k, [b"%d" % k]) for k in range(count)]
    stamped = as_read(taken, had_waited, 990)
    assert [message.timely for message in stamped] == timely
    waited_ns = [0 if is_timely else 10 + k for k, is_timely in enumerate(timely)]
    assert [message.waited_ns for message in stamped] == waited_ns
    assert [message.parts for message in stamped] == [message.parts for message in taken]


@pytest.mark.parametrize(
    ("is_starting", "state", "silent_s", "used_s", "why"),
    [
        (True, "R", 31.0, 20.0, "no sign of life for 30 s"),  # it imports for too long
        (True, "S", 31.0, 0.0, "no sign of life for 30 s"),
        (False, "S", 0.5, 0.0, "no sign of life for 0.4 s"),  # it waits for what never comes
        (False, "D", 0.5, 0.0, "no sign of life for 0.4 s"),
        (False, "R", 0.5, 0.1, ""),  # it may be waiting for a core
        (False, "R", 2.9, 0.9, ""),
        (False, "R", 3.1, 0.1, "no sign of life for 3 s"),  # for ever
        (False, "R", 1.5, 1.1, "it took 1.1 s of a core over one message, and did not return"),
    ],
)
def test_a_silent_reader_is_ended_unless_it_waits_for_a_core(
    is_starting, state, silent_s, used_s, why
):
    assert why_hung(is_starting, state, silent_s, used_s) == why


def test_what_a_process_does_and_its_own_cpu_time_are_those_of_proc():
    """proc(5): the state is the third word, utime and stime the 14th and 15th, those of its children
    the two after; the second may have blanks and brackets.
    """
    words = [
        "4711",
        "(a) name (b)",
        "S",
        *map(str, range(4, 14)),
        "250",
        "50",
        "7000",
        "8000",
        "20",
    ]
    assert process_state(" ".join(words)) == ("S", 300 / os.sysconf("SC_CLK_TCK"))
    state, own_s = process_state(Path("/proc/self/stat").read_text())
    assert state == "R"
    assert own_s == pytest.approx(time.process_time(), abs=0.1)


def test_a_reader_that_fails_again_and_again_is_begun_anew_ever_more_seldom():
    """One that says hello and ends; after ten steady seconds it is begun at once again."""
    clock, notices = FakeClock(), Notices()
    reader = ReaderProcess(notices, module="__hello__", clock=clock)
    waits_s = []
    for steady_s in (0.0, 0.0, 0.0, 9.9, 10.0, 0.0):
        clock.sleep(steady_s)
        generation = reader.generation
        wait_for(lambda: reader.wait(20) and not reader.take() and reader.trouble)
        waits_s.append(reader._again.left_s)
        assert "is being restarted" in reader.trouble
        clock.sleep(waits_s[-1])
        reader.wait(0)
        assert reader.generation == generation + 1
    reader.close()
    assert waits_s == pytest.approx([0.05, 0.1, 0.2, 0.4, 0.05, 0.1])
    assert notices.counts() == {"receiver-failed": 6}


def test_what_another_order_brought_is_passed_over():
    """A device that was let go may have sent something that is on its way."""
    reader = ReaderProcess(Notices(), module="__hello__")
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert reader._wire is not None
        reader._wire.close()
        reader._wire = ours
        for number in (1, 2):
            reader.read(device=None)
            assert reader._order.number == number
        for order in (1, 2, 1, 0, 2):
            theirs.sendall(pack(Record(order, RawMessage(order, [b"%d" % order]))))
        assert [record.order for record in reader.take()] == [2, 2]
        reader._wire = None
    reader.close()


def test_the_time_in_which_this_process_was_stopped_is_no_silence_of_the_reader(monkeypatch):
    """A minute counts as a tenth of a second; four more in which it says nothing are too many."""
    clock, notices = FakeClock(), Notices()
    reader = ReaderProcess(notices, module="__hello__", clock=clock)
    monkeypatch.setattr(reader, "_state", lambda: ("S", 0.0))
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert reader._wire is not None
        reader._wire.close()
        reader._wire = ours
        theirs.sendall(pack(Record()))
        assert reader.wait(1000) and reader.take() == []  # a sign of life
        clock.sleep(60.0)
        assert not reader.wait(0) and reader.trouble == ""
        for _ in range(3):
            clock.sleep(0.1)
            reader.wait(0)
        assert notices.counts() == {}
        theirs.sendall(pack(Record()))  # what it says ends a silence
        assert reader.wait(1000) and reader.take() == []
        for _ in range(4):
            clock.sleep(0.1)
            reader.wait(0)
        assert notices.counts() == {}
        clock.sleep(0.1)
        reader.wait(0)
        assert notices.counts() == {"receiver-failed": 1}
    reader.close()


def test_what_the_reader_counts_comes_once():
    """As counts grow, by what they have grown since."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        notices = _ForwardedNotices(Wire(theirs), 3)
        grown = []
        for lost, flooded in ((1, 0), (1, 5), (1, 5), (2, 9)):
            notices.link_counts.lost = lost
            notices.link_counts.flooded = flooded
            notices.count()
            ours.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                grown += RecordStream().feed(ours.recv(9999))
    assert [(one.counts.lost, one.counts.flooded) for one in grown] == [(1, 0), (0, 5), (1, 4)]


def records_at(ours: socket.socket) -> list[Record]:
    """What has been handed over by now."""
    return list(RecordStream().feed(ours.recv(1 << 16)))


def test_what_the_reader_is_told_is_handed_over_after_its_counts_and_lasts_or_not():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        notices = _ForwardedNotices(Wire(theirs), 3)
        notices.link_counts.lost = 2
        notices.tell("lost", "it is away", "a sender")
        notices.mention("connected", "it is here")
        handed = records_at(ours)
    assert [(one.order, one.notice, one.lasting) for one in handed] == [
        (3, None, True),
        (3, ("lost", "it is away", "a sender"), True),
        (3, ("connected", "it is here", ""), False),
    ]
    assert handed[0].counts == LinkCounts(lost=2)
    told = Notices()
    assert [one.told_to(told) for one in handed] == [False, True, True]
    assert (told.latest("lost"), told.latest("connected")) == ("it is away", "")


def test_of_several_orders_the_newest_is_carried_out_with_its_device():
    reader = ReaderProcess(Notices(), module="__hello__")
    ours, theirs = socket.socketpair()
    reading, writing = os.pipe()
    with ours, theirs:
        assert reader._wire is not None
        reader._wire.close()
        reader._wire = ours
        wire = Wire(theirs)
        assert wire.order(0) is None
        reader.read()
        reader.read(runs_user_code=True)
        assert wire.order(1000) == (ReadOrder(2, runs_user_code=True), None)
        reader.read(device=reading)
        order, file = wire.order(1000)
        assert order == ReadOrder(3, device=True)
        assert file not in (None, reading)
        os.write(writing, b"the device")
        assert os.read(file, 100) == b"the device"
        os.close(file)
        reader._wire = None
        wire.put(Record())
        ours.close()
        # what was never read resets the line, before its end is seen
        for _ in ("reset", "end"):
            with pytest.raises(EOFError):
                wire.order(1000)
        with pytest.raises(EOFError):
            wire.put(Record())
    os.close(reading)
    os.close(writing)
    reader.close()


def test_a_device_that_has_gone_is_said_and_let_go():
    ours, theirs = socket.socketpair()
    reading, writing = os.pipe()
    with ours, theirs:
        under_way = _Reading(Wire(theirs), ReadOrder(4, device=True), reading)
        os.write(writing, b"a")
        under_way.hand_over(under_way.link)
        os.close(writing)
        under_way.hand_over(under_way.link)
        came, gone = records_at(ours)
    assert (came.order, came.message.parts, came.gone) == (4, [b"a"], None)
    # the bytes may have come at any time before they were looked for
    assert not came.message.timely and came.message.empty_ns == 0
    assert (gone.order, gone.message, gone.gone) == (4, None, "it was readable, and nothing came")
    assert under_way.link is None
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(reading)


def test_a_file_that_is_never_read_to_its_end_does_not_hide_the_one_in_its_place(tmp_path):
    """It grows as fast as it is read; what was begun anew under its name is read from the next look
    on, from its beginning.
    """
    path = tmp_path / "answers.txt"
    path.write_bytes(b"")
    with FileRoad(path) as road, path.open("ab") as growing:
        growing.write(b"a" * (3 * MAX_READ_BYTES))
        growing.flush()
        path.rename(tmp_path / "old.txt")
        path.write_bytes(b"anew")
        (first,) = road.taken(0)
        assert first.parts == [b"a" * MAX_READ_BYTES]
        (second,) = road.taken(0)
        assert second.parts == [b"anew"]
