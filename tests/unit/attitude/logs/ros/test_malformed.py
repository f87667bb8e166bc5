"""Bags that are damaged, or say what is not so: one line each."""

from __future__ import annotations

import sqlite3

import pytest

from hilstar.attitude.logs.log_file import open_log
from hilstar.basics.errors import InputError
from tests.support.log_files import BAGS, poses
from tests.support.refusals import refusal
from tests.support.sources.ros_bags import write_bag2


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.bag", b"#ROSBAG V1.2\n" + bytes(50), "version 102 is not supported"),
        ("a.bag", b"#ROSBAG V2.0\n", "rosbag reindex a.bag"),
        ("a.bag", b"#ROSBAG V2.0\n" + b"\xff" * 50, "rosbags cannot read it"),
        ("a.db3", b"SQLite format 3\x00" + bytes(100), "rosbags cannot read it"),
        ("a.bag", b"", "contains no attitude"),
        ("a.db3", b"\x00" * 100, "not UTF-8|header|t_s"),
    ],
)
def test_what_is_no_bag_is_refused(tmp_path, name, content, why):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=why):
        open_log(tmp_path / name)


CHANGED = "UPDATE messages SET data = ? WHERE id = 3"
NO_POSE = "message 3 of /pose is no geometry_msgs/msg/PoseStamped"


@pytest.mark.parametrize(
    ("statement", "values", "words"),
    [
        (CHANGED, (b"",), NO_POSE),
        (CHANGED, (b"\0\1\0\0",), NO_POSE),
        (CHANGED, (b"\0\1\0\0" + b"\xff" * 60,), NO_POSE),
        ("DELETE FROM messages", (), "has no message of /pose; record it, or choose another"),
    ],
    ids=["nothing", "cut", "counts in billions", "no message"],
)
def test_a_bag_whose_messages_are_no_poses_is_refused(tmp_path, statement, values, words):
    bag = write_bag2(tmp_path / "a", poses("jazzy")) / "a.db3"
    with sqlite3.connect(bag) as database:
        database.execute(statement, values)
    database.close()
    assert words in refusal(open_log, bag)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "relative_file_paths: 7",
        "rosbag2_bagfile_information: {version: 10}",
        "[" * 10_000,
        "# " + "long" * 600_000,
    ],
)
def test_metadata_that_is_none_is_refused(tmp_path, text):
    bag = write_bag2(tmp_path / "a", poses("jazzy"))
    (bag / "metadata.yaml").write_text(text)
    assert "ros2 bag reindex" in refusal(open_log, bag)


def test_without_rosbags_one_line_says_what_to_install(tmp_path, monkeypatch):
    import sys

    from hilstar.basics.errors import MachineError

    # as Python has it where a package is not installed
    monkeypatch.setitem(sys.modules, "rosbags", None)
    for kind in ("ROS 1", "db3", "MCAP"):
        (tmp_path / kind).mkdir()
        with pytest.raises(
            MachineError, match=r"a ROS bag; reading it needs rosbags: pip install 'hilstar\[ros\]'"
        ):
            open_log(BAGS[kind](tmp_path / kind))
