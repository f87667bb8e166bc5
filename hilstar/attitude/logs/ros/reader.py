"""Attitudes of a bag of ROS: which topic, which frames, and what its times are.

The header's stamp is the time of an attitude: ns since 1970 (UTC without leap seconds), or of a simulated clock. Messages that
have none, or never set it, have the time at which they were recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain, islice
from typing import NamedTuple

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.entries import Entry, LogReading, Stated
from hilstar.attitude.logs.in_order import in_order
from hilstar.attitude.logs.level import FIRST_DATE_NS, Kind, Reference, stated_reference, to_icrs
from hilstar.attitude.logs.ros.bag import Bag
from hilstar.attitude.logs.ros.definitions import check_definition, decoded
from hilstar.attitude.logs.ros.frames import kind_of_frame, named
from hilstar.attitude.logs.ros.storage import Topic
from hilstar.attitude.logs.ros.tf import Tree
from hilstar.attitude.logs.ros.turns import TF_TYPES, TYPES, Turn, frame, turns
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, checked_sample
from hilstar.attitude.wire.source import Conventions, components
from hilstar.errors import InputError, shortened
from hilstar.rotation import conjugate, multiply
from hilstar.units import NS_PER_S

MAX_NAMED_TOPICS = 12
STATIC_TF = "tf_static"
IMU = "sensor_msgs/msg/Imu"
OPTICAL = ("_optical_frame", "_optical")
ADVICE = "the bag has two attitudes of one time, or its clock was set back; choose one sender, or cut the bag there"


class Heard(NamedTuple):
    """An orientation, where it stands in the bag, and when it was recorded."""

    where: str
    receive_ns: int
    turn: Turn


class Start(NamedTuple):
    """The first orientation, and whether the messages have times of their own."""

    turn: Turn
    receive_ns: int
    stamped: bool

    def t_ns(self, turn: Turn, receive_ns: int) -> int:
        """The time of an orientation of the same topic."""
        return (turn.stamp_ns or 0) if self.stamped else receive_ns

    @property
    def first_ns(self) -> int:
        """The time of the first."""
        return self.t_ns(self.turn, self.receive_ns)


def read_ros(bag: Bag, stated: Stated) -> LogReading:
    """The body's attitudes of one topic. Raises InputError where the bag, or what is stated, does not say which they are."""
    topic = _chosen(bag, stated.topic)
    check_definition(f"{bag.path}: {topic.name}", topic)
    told: list[tuple[str, str]] = []
    every = _of_tf(bag, topic, stated, told) if topic.type in TF_TYPES else _of_topic(bag, topic)
    start, heard = _begin(bag, topic, every, stated.body)
    if not start.stamped:
        told.append(("log-stamp", f"the messages of {topic.name} have no time of their own; when they were recorded is taken"))
    reference = _reference(bag, topic, start, stated, told)
    entries = to_icrs(_entries(heard, start), reference, start.turn.gyro, told)
    _say_optical(start.turn.body, stated, told)
    return LogReading(_with_notices(in_order(entries, told), bag, told), _conventions(topic, start, reference), ADVICE, told)


def _begin(bag: Bag, topic: Topic, heard: Iterator[Heard], body: str | None) -> tuple[Start, Iterator[Heard]]:
    """What the first orientations say, and all of those of the stated body. Raises InputError where there are none."""
    first = next(heard, None)
    if first is None:
        raise InputError(f"{bag.path}: has no message of {topic.name}; record it, or choose another with --topic")
    if first.turn.body is None and body is not None:
        raise InputError(f"{bag.path}: the messages of {topic.name} name no body; leave out --body {body}")
    heard = chain([first], heard)
    if body is not None:
        wanted = frame(body)
        heard = (each for each in heard if each.turn.body == wanted)
    begin = list(islice(heard, 2))
    if not begin:
        raise InputError(f"{bag.path}: {topic.name} has no attitude of {body}; leave out --body to be told what it has")
    # A simulated clock may begin at 0; one that is still 0 in the second message was never set.
    stamped = any(each.turn.stamp_ns for each in begin)
    return Start(begin[0].turn, begin[0].receive_ns, stamped), chain(begin, heard)


def _chosen(bag: Bag, wanted: str | None) -> Topic:
    """The topic that is read. Raises InputError with those that there are."""
    topics = bag.topics()
    readable = [topic for topic in topics if topic.type in TYPES]
    if wanted is not None:
        for topic in topics:
            if topic.name.lstrip("/") == wanted.lstrip("/"):
                if topic not in readable:
                    types = ", ".join(sorted({kind.rpartition("/")[2] for kind in TYPES}))
                    raise InputError(f"{bag.path}: {topic.name} is of {topic.type}, which says no attitude; read are {types}")
                return topic
        raise InputError(f"{bag.path}: has no topic {wanted}; it has {_named(topics)}")
    dynamic = [topic for topic in readable if not topic.name.endswith(STATIC_TF)]
    choice = dynamic or readable
    if not choice:
        raise InputError(f"{bag.path}: has no topic with attitudes; it has {_named(topics)}")
    if len(choice) > 1:
        raise InputError(f"{bag.path}: has several topics with attitudes: {_named(choice)}; choose one with --topic NAME")
    return choice[0]


def _named(topics: list[Topic]) -> str:
    names = [f"{topic.name} ({topic.type.replace('/msg/', '/')})" for topic in topics[:MAX_NAMED_TOPICS]]
    return shortened(", ".join([*names, *(["..."] if len(topics) > MAX_NAMED_TOPICS else [])]) or "no topic of ROS", 600)


def _of_topic(bag: Bag, topic: Topic) -> Iterator[Heard]:
    for number, message in enumerate(bag.messages(topic), start=1):
        where = f": message {number} of {topic.name}"
        try:
            found = list(turns(topic.type, decoded(topic, message.data)))
        except Exception as error:  # rosbags's generated code raises what its bytes lead to
            raise InputError(f"{bag.path}{where} is no {topic.type} ({shortened(error)}); record the bag again") from error
        yield from (Heard(where, message.receive_ns, turn) for turn in found)


def _of_tf(bag: Bag, topic: Topic, stated: Stated, told: list[tuple[str, str]]) -> Iterator[Heard]:
    """The chain of transforms that is stated, from this topic and the static one beside it."""
    beside = topic.name.rpartition("/")[0] + "/" + STATIC_TF
    statics = [other for other in bag.topics() if other.type in TF_TYPES and other.name == beside and other != topic]
    found = chain.from_iterable(_of_topic(bag, each) for each in [*statics, topic])
    tree = Tree(bag.path, ((heard.receive_ns, heard.turn) for heard in found))
    body = None if stated.body is None else frame(stated.body)
    links = tree.chain(body, named(stated.reference).frame)
    name = f"{links.timed.parent} -> {links.timed.child}"
    for number, (receive_ns, turn) in enumerate(links.turns(told), start=1):
        yield Heard(f": transform {number} of {name}", receive_ns, turn)


def _reference(bag: Bag, topic: Topic, start: Start, stated: Stated, told: list[tuple[str, str]]) -> Reference:
    why = f"the messages of {topic.name} do not say which frame their orientation refers to"
    if topic.type == IMU:
        why += " (ROS recommends east, north, up: REP 145)"
    kind: Kind = kind_of_frame(bag.path, start.turn.reference, stated, why, told)
    return stated_reference(bag.path, kind, stated, start.first_ns)


def _entries(heard: Iterator[Heard], start: Start) -> Iterator[Entry]:
    """Each attitude from the reference to the body, at its time, or why it is none."""
    for where, receive_ns, turn in heard:
        yield Entry(where, _fault(turn, start) or _sample(turn, start.t_ns(turn, receive_ns)))


def _sample(turn: Turn, t_ns: int) -> AttitudeSample | Refusal:
    w, x, y, z = turn.q
    return checked_sample(t_ns, (w, -x, -y, -z), turn.rate)


def _fault(turn: Turn, start: Start) -> Refusal | None:
    first = start.turn
    if turn.fault is not None:
        return Refusal("format", turn.fault)
    if turn.reference != first.reference:
        return Refusal("format", f"refers to the frame {turn.reference!r}, the first to {first.reference!r}")
    if turn.body != first.body:
        return Refusal("format", f"is of the frame {turn.body!r}, the first of {first.body!r}; choose one with --body")
    if turn.stamp_ns and not start.stamped:
        return Refusal("time", "some messages have a stamp and some have none (0); set it in all of them")
    return None


def _with_notices(entries: Iterator[Entry], bag: Bag, told: list[tuple[str, str]]) -> Iterator[Entry]:
    """The entries; what the bag has to say of itself is known at their end."""
    yield from entries
    told.extend(bag.told())


def _say_optical(body: str | None, stated: Stated, told: list[tuple[str, str]]) -> None:
    """An optical frame (REP 103: z forward, x right, y down) is the camera's own: a mounting would turn it twice."""
    if body is not None and body.endswith(OPTICAL) and abs(stated.mounting.q_body_to_cam[0]) < 1:
        told.append(("mounting", f"{body!r} has the axes of a camera by its name, and is turned by q_body_to_cam all the same"))


def _conventions(topic: Topic, start: Start, reference: Reference) -> Conventions:
    turn = start.turn
    if not start.stamped:
        time = "when each message was recorded, ns since 1970"
    elif start.first_ns >= FIRST_DATE_NS:
        time = "header.stamp: UTC, ns since 1970-01-01T00:00:00, leap seconds not counted"
    else:
        time = "header.stamp: seconds of a simulated clock"
    rates = "; the gyroscope's rate, with respect to the stars" if turn.gyro and turn.rate is not None else ""
    frames = f"{_quoted(turn.body, 'the body')} into those of {_quoted(turn.reference, 'the reference')}"
    return Conventions(
        f"ROS {topic.name} ({topic.type.replace('/msg/', '/')})",
        f"turns components of {frames}, taken as {reference.words}{rates}",
        "scalar last (x, y, z, w), Hamilton",
        time,
        of_body=True,
        written=_written(reference, start.first_ns),
        scale="UTC" if start.first_ns >= FIRST_DATE_NS else None,
    )


def _quoted(frame: str | None, unnamed: str) -> str:
    return f"'{frame}'" if frame else unnamed


def _written(reference: Reference, t_ns: int) -> Callable[[FloatArray], str]:
    """An attitude (q_icrs_to_body) as the messages have it, at a time of the log."""

    def words(q: FloatArray) -> str:
        of_body = multiply(reference.q_icrs_to_reference([t_ns])[0], conjugate(q))
        when = "" if reference.kind == "icrs" else f" at {t_ns / NS_PER_S:.9f} s"
        return f"x y z w = {components(np.roll(of_body, -1))}{when}"

    return words
