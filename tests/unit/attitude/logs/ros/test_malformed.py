"""Bags that are damaged, or say what is not so: one line each, and neither time nor memory without bound."""

from __future__ import annotations

import bz2
import resource
import sqlite3
import struct

import lz4.frame
import numpy as np
import pytest
import zstandard
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.errors import InputError
from tests.support.sources import ros_bags
from tests.support.sources.ros_bags import START_NS, Make, write_bag1, write_bag2, write_mcap

ICRS = Stated(reference="icrs")
MUTATIONS = 40
# Unpacked, the bombs here would be 2 GB; the process may grow by a tenth of that.
MAX_GROWTH_KB = 200_000


def poses(release, count=5):
    make = Make(release)
    for i, turn in enumerate(Rotation.random(count, rng=np.random.default_rng(3))):
        t_ns = START_NS + i * 10**8
        message = make.of(ros_bags.POSE_STAMPED, t_ns, "icrs", "", turn.as_quat(scalar_first=True), ())
        yield "/pose", ros_bags.POSE_STAMPED, t_ns, message


WHOLE = {
    "ROS 1": lambda path: write_bag1(path / "a.bag", poses("noetic")),
    "ROS 1, bz2": lambda path: write_bag1(path / "a.bag", poses("noetic"), "bz2"),
    "db3": lambda path: write_bag2(path / "a", poses("jazzy")) / "a.db3",
    "MCAP": lambda path: write_bag2(path / "a", poses("jazzy"), mcap=True, compression="storage") / "a.mcap",
    "MCAP of another program": lambda path: write_mcap(path / "a.mcap", poses("humble")),
}


@pytest.mark.parametrize("kind", WHOLE)
def test_a_damaged_bag_is_refused_in_one_line_or_read(tmp_path, kind):
    """Bytes changed, cut or doubled at random: nothing but a refusal, and every attitude that is given is one that was sent."""
    rng = np.random.default_rng(11)
    whole = WHOLE[kind](tmp_path)
    data = whole.read_bytes()
    sent = {START_NS + i * 10**8 for i in range(5)}
    for _ in range(MUTATIONS):
        changed = bytearray(data)
        for place in rng.integers(0, len(data), size=rng.integers(1, 8)):
            changed[place] = rng.integers(0, 256)
        if rng.random() < 0.4:
            del changed[rng.integers(0, len(data)) :]
        whole.write_bytes(changed)
        try:
            log = open_log(whole)
        except InputError as refusal:
            assert "\n" not in str(refusal)
        else:
            assert len(sent.intersection(sample.t_ns for sample in log.samples)) >= len(log.samples) - 7


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.bag", b"#ROSBAG V1.2\n" + bytes(50), "another version than 2.0"),
        ("a.bag", b"#ROSBAG V2.0\n", "has no topic with attitudes"),
        ("a.bag", b"#ROSBAG V2.0\n" + b"\xff" * 50, "the bag is damaged"),
        ("a.db3", b"SQLite format 3\x00" + bytes(100), "the bag is damaged"),
        ("a.bag", b"", "contains no attitude"),
        ("a.db3", b"\x00" * 100, "not UTF-8|header|t_s"),
    ],
)
def test_what_is_no_bag_is_refused(tmp_path, name, content, why):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=why):
        open_log(tmp_path / name)


def record(fields, data):
    head = b"".join(struct.pack("<I", len(name) + 1 + len(value)) + name + b"=" + value for name, value in fields.items())
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def bag_of(chunk_fields, data):
    head = {b"op": b"\x03", b"index_pos": bytes(8), b"conn_count": bytes(4), b"chunk_count": bytes(4)}
    return b"#ROSBAG V2.0\n" + record(head, b" " * 4000) + record({b"op": b"\x05", **chunk_fields}, data)


ZEROS = bytes(2_000_000)
BOMBS = {
    b"bz2": lambda: bz2.compress(ZEROS) * 1,
    b"lz4": lambda: lz4.frame.compress(ZEROS * 100),
}


@pytest.mark.parametrize("compression", BOMBS)
@pytest.mark.parametrize("claim", [10, 4_000_000_000])
def test_a_chunk_that_is_not_as_large_as_it_states_is_refused(tmp_path, compression, claim):
    fields = {b"compression": compression, b"size": struct.pack("<I", claim)}
    (tmp_path / "a.bag").write_bytes(bag_of(fields, BOMBS[compression]()))
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"more than the 10 bytes that it states|at most 256 MB are unpacked"):
        open_log(tmp_path / "a.bag")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < MAX_GROWTH_KB


@pytest.mark.parametrize("fields", [{}, {b"conn": bytes(4)}, {b"conn": b"", b"time": bytes(8)}, {b"time": bytes(8)}])
def test_a_message_record_without_its_fields_is_refused(tmp_path, fields):
    chunk = record({b"op": b"\x02", **fields}, bytes(10))
    whole = write_bag1(tmp_path / "whole.bag", poses("noetic")).read_bytes()
    begun = bag_of({b"compression": b"none", b"size": struct.pack("<I", len(chunk))}, chunk)
    (tmp_path / "a.bag").write_bytes(begun + whole[len(b"#ROSBAG V2.0\n") + 4096 :])
    with pytest.raises(InputError, match="the bag is damaged"):
        open_log(tmp_path / "a.bag")


@pytest.mark.parametrize("size", [2**31, 2**32 - 1])
def test_a_record_of_billions_is_not_waited_for(tmp_path, size):
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + struct.pack("<I", size) + bytes(100))
    with pytest.raises(InputError, match=r"a record of [0-9]+ bytes; at most"):
        open_log(tmp_path / "a.bag")


def test_a_packed_file_that_unpacks_without_end_is_refused(tmp_path):
    bag = write_bag2(tmp_path / "a", poses("jazzy"), compression="file")
    (bag / "a.db3.zstd").write_bytes(zstandard.compress(ZEROS * 100))
    with pytest.raises(InputError, match="unpacks to more than 100 times its size"):
        open_log(bag)
    (bag / "a.db3.zstd").write_bytes(zstandard.compress(ZEROS)[:-4])
    with pytest.raises(InputError, match=r"the bag is damaged|not a file of a bag"):
        open_log(bag)


def test_a_message_that_is_cut_or_counts_in_billions_is_refused_with_its_number(tmp_path):
    bag = write_bag2(tmp_path / "a", poses("jazzy")) / "a.db3"
    for data in (b"", b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 60):
        with sqlite3.connect(bag) as database:
            database.execute("UPDATE messages SET data = ? WHERE id = 3", (data,))
        database.close()
        with pytest.raises(InputError, match=r"message 3 of /pose is no geometry_msgs/msg/PoseStamped"):
            open_log(bag)


def test_a_view_in_place_of_a_table_is_not_run(tmp_path):
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("INSERT INTO topics VALUES (1, '/pose', 'geometry_msgs/msg/PoseStamped', 'cdr')")
        endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
        columns = "i AS id, 1 AS topic_id, i AS timestamp, x'' AS data"
        database.execute(f"CREATE VIEW messages AS {endless} SELECT {columns} FROM n")
    database.close()
    with pytest.raises(InputError, match="no bag of ROS 2: it lacks topics and messages"):
        open_log(tmp_path / "a.db3")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "has no relative_file_paths"),
        ("relative_file_paths: 7", "has no relative_file_paths"),
        ("relative_file_paths: []", "names no files of a bag"),
        ("relative_file_paths: [../../../etc/passwd]", "lacks passwd, which its metadata.yaml names"),
        ("relative_file_paths:\n  - ../a.bag\n  - 'b.db3'\nversion: 9", "lacks a.bag, b.db3, which"),
        ("[" * 1_000_000, "has no relative_file_paths"),
        ("relative_file_paths:\n" + " -" * 900_000, "names no files of a bag"),
    ],
)
def test_metadata_that_is_none_is_refused(tmp_path, text, why):
    bag = write_bag2(tmp_path / "a", poses("jazzy"))
    (bag / "metadata.yaml").write_text(text)
    with pytest.raises(InputError, match=why):
        open_log(bag)


def test_a_topic_without_messages_is_refused(tmp_path):
    bag = write_bag2(tmp_path / "a", poses("jazzy")) / "a.db3"
    with sqlite3.connect(bag) as database:
        database.execute("DELETE FROM messages")
    database.close()
    with pytest.raises(InputError, match="has no message of /pose; record it, or choose another with --topic"):
        open_log(bag)


def test_without_rosbags_one_line_says_what_to_install(tmp_path, monkeypatch):
    import sys

    from hilstar.errors import MachineError

    monkeypatch.setitem(sys.modules, "rosbags", None)  # as Python has it where a package is not installed
    for kind in ("ROS 1", "db3", "MCAP"):
        (tmp_path / kind).mkdir()
        with pytest.raises(MachineError, match=r"a ROS bag; reading it needs rosbags: pip install 'hilstar\[ros\]'"):
            open_log(WHOLE[kind](tmp_path / kind))
