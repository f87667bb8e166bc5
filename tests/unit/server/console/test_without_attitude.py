"""The last line of a run that never had an attitude."""

from hilstar.attitude.receiver import PacketCounts
from hilstar.attitude.wire.packet import Refusal
from hilstar.server.console.terminal import without_attitude
from hilstar.server.summary import PacketSummary

PLACE = "udp://127.0.0.1:5560"


def summary_of(*refusals: Refusal) -> PacketSummary:
    counts = PacketCounts()
    for refusal in refusals:
        counts.refuse(refusal)
    return PacketSummary(len(refusals), 0, counts.refused, counts.refused_by, shown=counts.shown)


def test_what_the_first_refused_packet_showed_is_said_and_not_the_cable() -> None:
    shown = Refusal("crc", "the packet is big-endian; send it little-endian", telling=True)
    line = without_attitude(PLACE, summary_of(shown, shown))
    assert "2 for crc: the packet is big-endian; send it little-endian" in line
    assert "cable" not in line


def test_a_crc_that_shows_nothing_is_the_cable_s() -> None:
    assert "cable" in without_attitude(
        PLACE, summary_of(Refusal("crc", "the CRC-32 does not match the packet"))
    )


def test_what_the_link_knows_comes_before_start_the_sender() -> None:
    line = without_attitude(PLACE, summary_of(), f"{PLACE}: a PUSH socket is there")
    assert line == f"no attitude came from {PLACE}; a PUSH socket is there"
    assert "start the sender" in without_attitude(PLACE, summary_of())


def test_the_reason_of_most_packets_comes_first() -> None:
    crc = Refusal("crc", "the CRC-32 does not match the packet")
    norm = Refusal("norm", "norm 2")
    line = without_attitude(PLACE, summary_of(crc, norm, norm, crc, norm))
    assert line.startswith(f"all 5 packets from {PLACE} were refused, 3 for norm: ")
    assert "; 2 for crc: " in line
