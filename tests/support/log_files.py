"""A file of every registered log format, and of each form that a format has, with what has to be
stated of it to be read at all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import write_log
from hilstar.attitude.logs.log_formats import NOTHING_STATED
from hilstar.attitude.logs.mcap_formats import ledger_format
from hilstar.attitude.logs.mcap_log import attitude_message, register_attitudes
from hilstar.attitude.wire.packet import AttitudeSample
from tests.support.sources import ros_bags
from tests.support.sources import spice_kernels as ck
from tests.support.sources.aem_messages import kvn
from tests.support.sources.attitude_texts import cic_text, stk_text

TURNS = Rotation.from_euler("xyz", [[10, 20, 30 + k] for k in range(3)], degrees=True)
QUATERNIONS = TURNS.as_quat(scalar_first=True)
SAMPLES = [AttitudeSample(k * 10**9, q) for k, q in enumerate(QUATERNIONS)]
LEVEL = Stated(reference="enu", place=(48.1, 11.6, 500.0), epoch_utc="2024-07-01T11:59:50")
ICRS = Stated(reference="icrs")
CSV_TEXT = "t_s,qw,qx,qy,qz\n" + "".join(
    f"{k},{','.join(f'{c:.7f}' for c in q)}\n" for k, q in enumerate(QUATERNIONS)
)
AEM_ROWS = [f"2026-01-01T00:00:0{k} 0 0 0 1" for k in range(3)]


def written(name: str) -> Callable[[Path], Path]:
    """What writes the samples by hilstar's own writer."""

    def write(folder: Path) -> Path:
        write_log(folder / name, SAMPLES)
        return folder / name

    return write


def text_file(name: str, text: str) -> Callable[[Path], Path]:
    """What writes a text."""

    def write(folder: Path) -> Path:
        (folder / name).write_text(text)
        return folder / name

    return write


def ledger(folder: Path) -> Path:
    """The ledger of a run that had these attitudes."""
    path = folder / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="hilstar")
        writer.add_metadata("hilstar", {"run_id": "1", "part": "0"})
        channel = register_attitudes(writer)
        for sample in SAMPLES:
            writer.add_message(
                channel,
                log_time=sample.t_ns,
                data=attitude_message(sample),
                publish_time=sample.t_ns,
            )
        writer.finish()
    return path


def bag(folder: Path) -> Path:
    """A ROS 2 bag: a directory."""
    make = ros_bags.Make("humble")
    sent = []
    for k, (w, x, y, z) in enumerate(QUATERNIONS.tolist()):
        t_ns = k * 10**9 + 1
        message = make.imu(t_ns, "cam", (w, -x, -y, -z), (0, 0, 0))
        sent.append(("/pose", ros_bags.IMU, t_ns, message))
    return ros_bags.write_bag2(folder / "bag", sent, "humble")


def poses(release: str, count: int = 5) -> Iterable[tuple[str, str, int, bytes]]:
    """Poses in the ICRS as a release of ROS has them."""
    make = ros_bags.Make(release)
    for i, turn in enumerate(Rotation.random(count, rng=np.random.default_rng(3))):
        t_ns = ros_bags.START_NS + i * 10**8
        q = turn.as_quat(scalar_first=True)
        message = make.of(ros_bags.POSE_STAMPED, t_ns, "icrs", "", q, ())
        yield "/pose", ros_bags.POSE_STAMPED, t_ns, message


BAGS: dict[str, Callable[[Path], Path]] = {
    "ROS 1": lambda path: ros_bags.write_bag1(path / "a.bag", poses("noetic")),
    "ROS 1, bz2": lambda path: ros_bags.write_bag1(path / "a.bag", poses("noetic"), "bz2"),
    "db3": lambda path: ros_bags.write_bag2(path / "a", poses("jazzy")) / "a.db3",
    "MCAP": lambda path: (
        ros_bags.write_bag2(path / "a", poses("jazzy"), mcap=True, compression="storage") / "a.mcap"
    ),
    "MCAP of another program": lambda path: ros_bags.write_mcap(path / "a.mcap", poses("humble")),
}


def c_kernel(folder: Path) -> Path:
    """A CK beside the kernels that it needs."""
    ck.write_texts(folder)
    with ck.new_ck(folder / "a.bc") as handle:
        ck.write_segment(handle, 3, ck.Motion(np.random.default_rng(1)), np.arange(0.0, 5.0, 0.25))
    return folder / "a.bc"


@dataclass(frozen=True)
class LogFile:
    """A file of a format.

    `own_times`: each attitude has its time with it, and nothing else in the file moves it.
    `checked`: a checksum is over each. `trials`: how often it is read, damaged, in a test.
    """

    format_name: str
    make: Callable[[Path], Path]
    stated: Stated = NOTHING_STATED
    own_times: bool = False
    checked: bool = False
    trials: int = 40


# One of each format, by its name.
FILES: dict[str, LogFile] = {
    each.format_name: each
    for each in (
        LogFile("CSV", written("a.csv"), LEVEL),
        LogFile("JSON lines", written("a.jsonl"), LEVEL, own_times=True),
        LogFile("an MCAP file", written("a.mcap"), LEVEL, own_times=True),
        LogFile(ledger_format.name, ledger, own_times=True, checked=True),
        LogFile("a CCSDS AEM", text_file("a.aem", kvn(AEM_ROWS, QUATERNION_TYPE="LAST"))),
        LogFile("a CCSDS message", text_file("a.oem", "CCSDS_OEM_VERS = 2.0\n")),
        LogFile("a ROS bag", bag, LEVEL, own_times=True),
        LogFile(
            "a CIC AEM", text_file("a.cic", cic_text(["60310 0.0 1 0 0 0", "60310 1.0 1 0 0 0"]))
        ),
        LogFile("an STK attitude file", text_file("a.a", stk_text(["0 0 0 0 1", "1 0 0 0 1"]))),
        LogFile("a SPICE CK", c_kernel),
    )
}
ULOG = LogFile("a ULog of PX4", text_file("a.ulg", "ULog\x01\x12\x35\x01"))  # always refused
# Files that are read, in every form: what stands alone, in one file.
FORMS: dict[str, LogFile] = {
    "CSV": LogFile("CSV", written("a.csv")),
    "JSON lines": LogFile("JSON lines", written("a.jsonl"), own_times=True),
    "an MCAP file": LogFile("an MCAP file", written("a.mcap"), own_times=True, checked=True),
    "CSV of another program": LogFile("CSV", text_file("a.csv", CSV_TEXT)),
    **{
        name: FILES[name]
        for name in (
            ledger_format.name,
            "a CCSDS AEM",
            "a CIC AEM",
            "an STK attitude file",
            "a SPICE CK",
        )
    },
    "a CCSDS AEM, written": LogFile("a CCSDS AEM", written("a.aem")),
    "a CCSDS AEM, XML": LogFile("a CCSDS AEM", written("a.xml")),
    # of a chunk that is packed whole, a byte may be in every message
    **{
        name: LogFile("a ROS bag", make, own_times="MCAP" not in name, trials=15)
        for name, make in BAGS.items()
    },
}


def spoiled(data: bytes, rng: np.random.Generator, count: int) -> bytes:
    """A file with so many bytes changed, by chance to any value or by their lowest bit."""
    changed = np.frombuffer(data, dtype=np.uint8).copy()
    places: Any = rng.integers(0, len(data), size=count)
    if rng.random() < 0.5:
        changed[places] = rng.integers(0, 256, size=count)
    else:
        changed[places] ^= 1
    return changed.tobytes()
