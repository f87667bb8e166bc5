"""Every kind of bag, as ROS's own library and other programs write it, gives the same attitudes."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from mcap.writer import CompressionType
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log, write_log
from hilstar.basics.errors import InputError
from tests.support.refusals import refusal
from tests.support.sources import ros_bags
from tests.support.sources.ros_bags import START_NS, Make, write_bag1, write_bag2, write_mcap

COUNT, STEP_NS = 40, 10**8
ICRS = Stated(reference="icrs")
# A product of unit quaternions in float64.
ROUNDING = 1e-15
KINDS = [
    ros_bags.Q,
    ros_bags.QUATERNION_STAMPED,
    ros_bags.POSE,
    ros_bags.POSE_STAMPED,
    ros_bags.POSE_COVARIANCE,
    ros_bags.TRANSFORM,
    ros_bags.TRANSFORM_STAMPED,
    ros_bags.TF,
    ros_bags.IMU,
    ros_bags.ODOMETRY,
]
WRITERS = {
    "ROS 1": lambda path, sent: write_bag1(path / "a.bag", sent("noetic")),
    "ROS 1, bz2, chunks": lambda path, sent: write_bag1(
        path / "a.bag", sent("noetic"), "bz2", chunk=1000
    ),
    "ROS 1, lz4, chunks": lambda path, sent: write_bag1(
        path / "a.bag", sent("noetic"), "lz4", chunk=1000
    ),
    "db3 directory": lambda path, sent: write_bag2(path / "a", sent("humble"), "humble"),
    "db3 file": lambda path, sent: write_bag2(path / "a", sent("jazzy")) / "a.db3",
    "db3, packed file": lambda path, sent: write_bag2(
        path / "a", sent("jazzy"), compression="file"
    ),
    "db3, packed messages": lambda path, sent: write_bag2(
        path / "a", sent("jazzy"), compression="message"
    ),
    "MCAP directory": lambda path, sent: write_bag2(path / "a", sent("jazzy"), mcap=True),
    "MCAP, packed chunks": lambda path, sent: (
        write_bag2(path / "a", sent("jazzy"), mcap=True, compression="storage") / "a.mcap"
    ),
    "MCAP, packed messages": lambda path, sent: write_bag2(
        path / "a", sent("jazzy"), mcap=True, compression="message"
    ),
    "other MCAP, lz4": lambda path, sent: write_mcap(path / "a.mcap", sent("humble")),
    "other MCAP, zstd": lambda path, sent: write_mcap(
        path / "a.mcap", sent("jazzy"), compression=CompressionType.ZSTD
    ),
    "ROS 1 of another name": (
        lambda path, sent: write_bag1(path / "a.bag", sent("noetic")).rename(path / "flight.log")
    ),
    "db3 of another name": (
        lambda path, sent: (write_bag2(path / "a", sent("jazzy")) / "a.db3").rename(
            path / "flight.log"
        )
    ),
}


@pytest.fixture(scope="module")
def truth():
    """Orientations of a body in the ICRS."""
    return Rotation.random(COUNT, rng=np.random.default_rng(1))


def messages(truth, kind, frame="icrs"):
    def of(release):
        make = Make(release)
        for i, q in enumerate(truth.as_quat(scalar_first=True)):
            t_ns = START_NS + i * STEP_NS
            yield "/pose", kind, t_ns, make.of(kind, t_ns, frame, "base_link", q, (0.1, -0.2, 0.3))

    return of


def assert_is_truth(log, truth):
    q = Rotation.from_quat([sample.q_icrs_to_cam for sample in log.samples], scalar_first=True)
    star = np.array([0.3, -0.4, 0.5])
    # the message turns body into reference
    assert q.apply(star) == pytest.approx(truth.inv().apply(star), abs=ROUNDING)
    assert [sample.t_ns for sample in log.samples] == [
        START_NS + i * STEP_NS for i in range(len(truth))
    ]


@pytest.mark.parametrize("writer", WRITERS)
def test_each_format_gives_the_attitudes_that_were_recorded(tmp_path, truth, writer):
    log = open_log(WRITERS[writer](tmp_path, messages(truth, ros_bags.POSE_STAMPED)))
    assert_is_truth(log, truth)
    assert log.conventions.of_body


@pytest.mark.parametrize("kind", KINDS)
def test_each_type_of_message_is_read_in_ros_1_and_ros_2(tmp_path, truth, kind):
    for writer in ("ROS 1", "db3 directory", "MCAP, packed chunks"):
        (tmp_path / writer).mkdir()
        log = open_log(WRITERS[writer](tmp_path / writer, messages(truth, kind)), ICRS)
        assert_is_truth(log, truth)
        has_rate = kind in {ros_bags.IMU, ros_bags.ODOMETRY}
        assert all((sample.rate_cam_rad_s is not None) == has_rate for sample in log.samples)
        if has_rate:
            assert log.samples[3].rate_cam_rad_s == pytest.approx([0.1, -0.2, 0.3], abs=0)


def test_a_bag_split_over_files_is_read_whole_and_in_order(tmp_path, truth):
    sent = list(messages(truth, ros_bags.IMU)("jazzy"))
    bag = write_bag2(tmp_path / "a", sent[:2])
    for part, span in ((2, slice(2, 20)), (10, slice(20, None))):  # a_10 sorts before a_2 as text
        piece = write_bag2(tmp_path / f"part{part}", sent[span])
        shutil.copy(piece / f"part{part}.db3", bag / f"a_{part}.db3")
    rewrite_files(bag, ["a.db3", "a_2.db3", "a_10.db3"])
    assert_is_truth(open_log(bag, ICRS), truth)
    (bag / "a_2.db3").unlink()
    with pytest.raises(InputError, match=r"missing.*a_2\.db3"):
        open_log(bag, ICRS)


def rewrite_files(bag, names):
    yaml = YAML(typ="safe")
    metadata = yaml.load((bag / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["relative_file_paths"] = names
    yaml.default_flow_style = False  # as ROS 2 writes it
    with (bag / "metadata.yaml").open("w") as file:
        yaml.dump(metadata, file)


def test_db3_of_old_releases_has_no_definitions(tmp_path, truth):
    """Before Iron the tables held none; before Foxy `topics` had no quality of service."""
    import sqlite3

    bag = (
        write_bag2(tmp_path / "a", messages(truth, ros_bags.POSE_STAMPED)("humble"), "humble")
        / "a.db3"
    )
    with sqlite3.connect(bag) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("DROP TABLE schema")
        database.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
        database.execute("ALTER TABLE topics DROP COLUMN offered_qos_profiles")
    database.close()
    assert_is_truth(open_log(bag), truth)


def half(path):
    """The same file, cut in its middle."""
    data = path.read_bytes()
    cut = path.with_name(f"half{path.suffix}")
    cut.write_bytes(data[: len(data) * 3 // 5])
    return cut


def without_metadata(path):
    (path / "metadata.yaml").unlink()
    return path


KILLED = {
    "ROS 1": (
        lambda path, sent: half(write_bag1(path / "a.bag", sent("noetic"), chunk=1000)),
        "rosbag reindex half.bag",
    ),
    "MCAP": (
        lambda path, sent: half(write_mcap(path / "a.mcap", sent("humble"))),
        "ros2 bag reindex DIRECTORY",
    ),
    "directory": (
        lambda path, sent: without_metadata(write_bag2(path / "a", sent("jazzy"))),
        "ros2 bag reindex a",
    ),
}


@pytest.mark.parametrize("kind", KILLED)
def test_a_bag_without_an_index_is_refused_with_the_command_that_makes_one(tmp_path, truth, kind):
    write, command = KILLED[kind]
    bag = write(tmp_path, messages(truth, ros_bags.POSE_STAMPED))
    with pytest.raises(InputError, match=f"{bag}: .*{command}"):
        open_log(bag)


def test_a_db3_whose_recorder_was_killed_names_the_file_that_has_the_rest(tmp_path, truth):
    import sqlite3

    bag = (
        write_bag2(tmp_path / "a", messages(truth, ros_bags.POSE_STAMPED)("humble"), "humble")
        / "a.db3"
    )
    with sqlite3.connect(bag) as database:
        database.execute("PRAGMA journal_mode = WAL")
        database.execute(
            "INSERT INTO messages SELECT id + 1000, topic_id, timestamp, data FROM messages"
        )
        database.commit()
        for name in ("a.db3", "a.db3-wal"):
            shutil.copy(bag.with_name(name), tmp_path / name)
    database.close()
    with pytest.raises(InputError, match=r"a\.db3-wal has the rest; merge it with: sqlite3 a\.db3"):
        open_log(tmp_path / "a.db3")
    # one that is empty has no rest: SQLite leaves it so
    (tmp_path / "a.db3-wal").write_bytes(b"")
    assert_is_truth(open_log(tmp_path / "a.db3"), truth)


def test_a_bags_metadata_of_over_two_megabytes_is_refused(tmp_path, truth):
    bag = write_bag2(tmp_path / "a", messages(truth, ros_bags.POSE_STAMPED)("jazzy"))
    metadata = bag / "metadata.yaml"
    with metadata.open("ab") as file:
        file.truncate(2_000_001)
    line = refusal(open_log, bag)
    assert line == f"{metadata}: has 2 MB; make it anew: ros2 bag reindex a"


@pytest.mark.parametrize(("release", "profile"), [("humble", ""), ("noetic", "ros1")])
def test_an_mcap_whose_profile_is_not_ros_2s_is_refused_with_the_way_to_one(
    tmp_path, truth, release, profile
):
    sent = messages(truth, ros_bags.POSE_STAMPED)(release)
    path = write_mcap(tmp_path / "a.mcap", sent, release, profile=profile)
    with pytest.raises(
        InputError, match="MCAP of another kind than ROS 2's; write it again with ros2 bag convert"
    ):
        open_log(path)


def test_messages_that_are_packed_by_themselves_need_their_directory(tmp_path, truth):
    bag = write_bag2(
        tmp_path / "a", messages(truth, ros_bags.POSE_STAMPED)("jazzy"), compression="message"
    )
    assert "its messages are packed; give the bag's directory" in refusal(open_log, bag / "a.db3")


def test_hilstars_own_mcap_is_not_taken_for_a_bag(tmp_path, truth):
    log = open_log(
        write_mcap(tmp_path / "ros.mcap", messages(truth, ros_bags.POSE_STAMPED)("humble"))
    )
    write_log(tmp_path / "own.mcap", log.samples)
    own = open_log(tmp_path / "own.mcap")
    assert own.conventions.source == "MCAP"
    assert [sample.t_ns for sample in own.samples] == [sample.t_ns for sample in log.samples]


def test_a_log_in_a_directory_of_other_files_is_not_looked_for(tmp_path):
    assert "is a directory" in refusal(open_log, tmp_path)
