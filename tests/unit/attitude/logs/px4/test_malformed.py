"""Logs that lost power, or a part, or are not what they say: what is whole is read, and the rest said; or one line refuses."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.errors import InputError
from tests.support.sources.ulog_files import MAGIC, ULogWriter, message

STATED = Stated(epoch_utc="2024-07-01T11:59:50", place=(48.1, 11.6, 500.0))
COUNT = 50
MUTATIONS = 150


def still(synchronised=True):
    log = ULogWriter()
    log.topic("vehicle_attitude")
    log.topic("battery_status")
    return log, add_to(log, range(COUNT), synchronised)


def add_to(log, numbers, synchronised=True):
    """The place of each attitude in the file."""
    places = []
    for k in numbers:
        places.append(len(log.data))
        log.add("vehicle_attitude", timestamp=1000 * (k + 1), q=(1, 0, 0, 0))
        log.add("battery_status", timestamp=1000 * (k + 1), voltage_v=[11.1] * 64)
        if synchronised and k % 10 == 9:
            log.sync()
    return places


@pytest.fixture
def written(tmp_path):
    def write(data):
        (tmp_path / "log.ulg").write_bytes(data)
        return tmp_path / "log.ulg"

    return write


def times(log):
    return [sample.t_ns // 10**6 for sample in log.samples]


def test_a_log_that_lost_power_is_read_to_its_cut(written):
    log, places = still()
    read = open_log(written(log.data[: places[30] + 20]), STATED)
    assert times(read) == list(range(1, 31))
    assert f"ends within a message at byte {places[30]}" in dict(read.told)["log-cut"]


def test_damaged_bytes_cost_what_is_between_them_and_the_next_synchronisation(written):
    log, places = still()
    log.data[places[12] : places[12] + 3] = b"\xff\xff\xff"
    read = open_log(written(log.data), STATED)
    assert times(read) == [*range(1, 13), *range(21, 51)]
    assert "of the log are damaged, and are left out" in dict(read.told)["log-damage"]


def test_damage_without_synchronisation_costs_the_rest_and_is_said(written):
    log, places = still(synchronised=False)
    log.data[places[12] : places[12] + 3] = b"\xff\xff\xff"
    read = open_log(written(log.data), STATED)
    assert times(read) == list(range(1, 13))
    assert (
        dict(read.told)["log-damage"] == f"{(len(log.data) - places[12]) / 1e3:.4g} kB of the log are damaged, and are left out"
    )


def test_a_message_of_another_size_than_its_format_is_left_out_and_said(written):
    log, _ = still()
    log.data += message("D", struct.pack("<H", 0) + bytes(5))
    read = open_log(written(log.data), STATED)
    assert len(read.samples) == COUNT
    assert "have not the size of their format" in dict(read.told)["log-damage"]


def test_what_the_logger_lost_is_said(written):
    log, _ = still()
    log.dropout(250)
    log.dropout(500)
    assert dict(open_log(written(log.data), STATED).told)["log-dropout"] == "the logger lost 0.75 s of messages"


def test_data_appended_after_a_crash_is_read_past_the_cut_before_it(written):
    log, places = still()
    cut = places[40] + 7  # within a message
    whole = ULogWriter(appended=[cut])
    whole.data += log.data[len(whole.data) : cut]
    add_to_ids = log
    add_to_ids.data = bytearray()
    add_to(log, range(100, 105))
    whole.data += log.data
    read = open_log(written(whole.data), STATED)
    assert times(read) == [*range(1, 41), *range(101, 106)]


def test_a_time_that_goes_back_is_refused(written):
    log, _ = still()
    for _ in range(2):
        log.add("vehicle_attitude", timestamp=5_000_000, q=(1, 0, 0, 0))
    log.add("vehicle_attitude", timestamp=1000, q=(0, 1, 0, 0))
    with pytest.raises(InputError, match="time does not increase"):
        open_log(written(log.data), STATED)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (MAGIC, "cut within its first 16 bytes"),
        (MAGIC + bytes(9), "has no topic vehicle_attitude; it has no attitude at all"),
        (MAGIC + bytes(5000), "has no topic vehicle_attitude"),
        (bytes(ULogWriter(incompatible=bytes([2, *bytes(7)])).data), "a ULog of a newer kind"),
        (bytes(ULogWriter(incompatible=bytes([0, 9, *bytes(6)])).data), "a ULog of a newer kind"),
        (b"ULog\x02\x12\x35\x01" + bytes(9), "not UTF-8|header"),
    ],
)
def test_what_is_no_log_is_refused(written, data, why):
    with pytest.raises(InputError, match=why):
        open_log(written(data), STATED)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ("uint64_t timestamp;float[999999999] q;", "more than 1000 fields"),
        ("float[500] a;" * 300, "more than 1000 fields"),
        ("vehicle_attitude a;", "pyulog does not read it|has no attitude"),
        ("uint64_t timestamp;battery_status[900] a;", "pyulog does not read it|has no attitude"),
        ("uint64_t timestamp;float[3] q;", "has no attitude"),
        ("float[4] q;", "pyulog does not read it|has no attitude"),
        ("", "pyulog does not read it|has no attitude"),
    ],
)
def test_a_format_that_is_not_px4s_is_refused(written, fields, why):
    log = ULogWriter(formats={"vehicle_attitude": fields})
    log.data += message("A", struct.pack("<BH", 0, 0) + b"vehicle_attitude")
    for k in range(5):
        log.data += message("D", struct.pack("<HQ4f", 0, 1000 + k, 1, 0, 0, 0))
    with pytest.raises(InputError, match=why):
        open_log(written(log.data), STATED)


def test_a_boot_clock_of_centuries_is_refused(written):
    log = ULogWriter()
    log.topic("vehicle_attitude")
    log.add("vehicle_attitude", timestamp=2**64 - 1, q=(1, 0, 0, 0))
    with pytest.raises(InputError, match="microseconds since boot; the log is damaged"):
        open_log(written(log.data), STATED)


def test_a_log_damaged_at_random_is_read_or_refused_in_one_line(written, capsys):
    rng = np.random.default_rng(5)
    log, _ = still()
    log.topic("vehicle_gps_position")
    log.add(
        "vehicle_gps_position",
        timestamp=9,
        time_utc_usec=1_719_835_190_000_000,
        latitude_deg=1.0,
        longitude_deg=2.0,
        fix_type=3,
    )
    refused = 0
    for _ in range(MUTATIONS):
        data = bytearray(log.data)
        for place in rng.integers(0, 600 if rng.random() < 0.5 else len(data), size=rng.integers(1, 6)):
            data[place] = rng.integers(0, 256)
        if rng.random() < 0.3:
            del data[rng.integers(0, len(data)) :]
        try:
            read = open_log(written(data))
        except InputError as refusal:
            refused += 1
            assert "\n" not in str(refusal)
        else:
            assert 0 < len(read.samples) <= COUNT
    assert 0 < refused < MUTATIONS
    assert capsys.readouterr().out == ""  # pyulog prints what it thinks of a file
