"""Attitudes from a ROS bag: which topic, which frames, and what its times are.

The header's stamp is the time of an attitude: ns since 1970 (UTC without leap seconds), or of a
simulated clock. Messages without a stamp, or with a stamp that never changes from 0, have the time
at which they were recorded.

In every message type the quaternion (x, y, z, w) turns components of the body (child) frame into
those of the frame that it refers to (REP 103, REP 105). The header names that frame, except for an
Imu: there it names the body, and the reference of the orientation has no name (REP 145).

`--reference MEANING` says what the axes of the bag's frame are: icrs, or enu or ned at --place.
`--reference FRAME=MEANING` also names the frame; `--reference FRAME` names one whose name says what
its axes are.

tf is a tree of frames; a chain of transforms gives the attitude of one frame in another. A
transform whose rotation never changes is static, whichever topic it comes on. Where several
transforms of a chain move, the attitudes have the times of the one with the most samples, and the
others are interpolated to those (SLERP, as in tf2), never extrapolated.

A type that has the name of ROS's own and other fields is refused.
"""

import contextlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.attitude.logs.earth import (
    AXES,
    EXACT,
    KINDS,
    Kind,
    Reference,
    loosely_icrs,
    stated_reference,
    to_icrs,
)
from hilstar.attitude.logs.entries import LogEntry, LogReading, Stated, in_order
from hilstar.attitude.logs.log_formats import LogFormat, require
from hilstar.attitude.logs.log_times import FIRST_DATE_NS
from hilstar.attitude.logs.packet_logs import LEVEL
from hilstar.attitude.logs.ros_bags import ENDINGS, OLD_TF, TF, Bag, BagTopic, is_bag, open_bag
from hilstar.attitude.wire.packet import Refusal, checked_sample, is_unset
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.attitude.wire.source import Conventions, components
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vectors,
    multiply,
    normalise,
    to_rotation_vector,
)
from hilstar.basics.units import NS_PER_S

TF_TYPES = frozenset({TF, OLD_TF})
TRANSFORM, IMU, ODOMETRY = (
    "geometry_msgs/msg/TransformStamped",
    "sensor_msgs/msg/Imu",
    "nav_msgs/msg/Odometry",
)
# Where each message has its quaternion.
QUATERNIONS: dict[str, Callable[[Any], Any]] = {
    "geometry_msgs/msg/Quaternion": lambda message: message,
    "geometry_msgs/msg/QuaternionStamped": attrgetter("quaternion"),
    "geometry_msgs/msg/Pose": attrgetter("orientation"),
    "geometry_msgs/msg/PoseStamped": attrgetter("pose.orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": attrgetter("pose.pose.orientation"),
    "geometry_msgs/msg/Transform": attrgetter("rotation"),
    TRANSFORM: attrgetter("transform.rotation"),
    IMU: attrgetter("orientation"),
    ODOMETRY: attrgetter("pose.pose.orientation"),
}
TYPES = frozenset(QUATERNIONS) | TF_TYPES
Numbers = tuple[float, ...]
IntArray = npt.NDArray[np.int64]
MAX_EDGES = 10_000
MAX_NAMED = 8
FORM = "icrs, enu or ned"
STATE = (
    "state its axes with --reference icrs, or with --reference enu or ned and --place"
    " LAT,LON,HEIGHT"
)
MAX_NAMED_TOPICS = 12
STATIC_TF = "tf_static"
OPTICAL = ("_optical_frame", "_optical")
ORDER_ADVICE = (
    "the bag has two attitudes of one time, or its clock was set back; choose one sender, or cut"
    " the bag there"
)


class _RosTurn(NamedTuple):
    """One orientation: `q` (w, x, y, z) turns components of the body into those of the reference.

    `stamp_ns` is the header's time, None where it has none; frames are None where the message does
    not name them. `rate` is in components of the body, rad/s, with respect to the reference, or to
    the stars where `gyro` says so. `fault` is why it is no orientation.
    """

    stamp_ns: int | None
    reference: str | None
    body: str | None
    q: Numbers
    rate: Numbers | None = None
    gyro: bool = False
    fault: str | None = None


def frame(text: str) -> str:
    """A frame's name without the slash that the first tf had before it."""
    return text.lstrip("/")


def turns(type_name: str, message: Any) -> Iterator[_RosTurn]:
    """The orientations in a message of one of TYPES; several in a TFMessage."""
    if type_name in TF_TYPES:
        for transform in message.transforms:
            yield from turns(TRANSFORM, transform)
        return
    q = QUATERNIONS[type_name](message)
    header = getattr(message, "header", None)
    stamp_ns = reference = body = rate = fault = None
    if header is not None:
        stamp_ns = int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)
        reference = frame(header.frame_id)
    if type_name in {TRANSFORM, ODOMETRY}:
        body = frame(message.child_frame_id)
    if type_name == ODOMETRY:
        rate = _vector(message.twist.twist.angular)
    elif type_name == IMU:
        reference, body = None, reference
        if message.angular_velocity_covariance[0] == -1:
            rate = None
        else:
            rate = _vector(message.angular_velocity)
        if message.orientation_covariance[0] == -1:
            fault = "orientation_covariance[0] is -1: the IMU gives no orientation"
    yield _RosTurn(stamp_ns, reference, body, (q.w, q.x, q.y, q.z), rate, type_name == IMU, fault)


def _vector(vector: Any) -> Numbers:
    return (vector.x, vector.y, vector.z)


@dataclass(slots=True)
class _Edge:
    """Every transform from one child to one parent: times (header's and recorder's), and (w, x,
    y, z) from child to parent.
    """

    parent: str
    child: str
    stamps_ns: "array[int]" = field(default_factory=lambda: array("q"))
    received_ns: "array[int]" = field(default_factory=lambda: array("q"))
    numbers: "array[float]" = field(default_factory=lambda: array("d"))
    moves: bool = False

    def add(self, turn: _RosTurn, received_ns: int) -> None:
        self.moves |= bool(self.numbers) and tuple(self.numbers[:4]) != turn.q
        self.stamps_ns.append(turn.stamp_ns or 0)
        self.received_ns.append(received_ns)
        self.numbers.extend(turn.q)

    @property
    def q(self) -> FloatArray:
        """(n, 4), as recorded."""
        return np.array(self.numbers, dtype=np.float64).reshape(-1, 4)

    @property
    def times_ns(self) -> IntArray:
        """(n,): the stamps, or where they are not set when the transforms were recorded."""
        stamps = np.array(self.stamps_ns, dtype=np.int64)
        if stamps.any():
            return stamps
        return np.array(self.received_ns, dtype=np.int64)

    def at(self, t_ns: IntArray) -> FloatArray:
        """The rotations (m, 4) at other times (m,); NaN before its first and after its last."""
        q = normalise(self.q)
        if not self.moves:
            return np.tile(q[0], (len(t_ns), 1))
        times, first = np.unique(self.times_ns, return_index=True)
        q = q[first]
        if len(times) < 2:
            return np.where((t_ns == times[0])[:, None], q[0], np.nan)
        after = np.clip(np.searchsorted(times, t_ns), 1, len(times) - 1)
        share = (t_ns - times[after - 1]) / (times[after] - times[after - 1])
        turn = to_rotation_vector(multiply(q[after], conjugate(q[after - 1])))
        turned_q = multiply(from_rotation_vectors(share[:, None] * turn), q[after - 1])
        turned_q[(t_ns < times[0]) | (t_ns > times[-1])] = np.nan
        return turned_q


class _FrameChain(NamedTuple):
    """The transforms from a body up to the frame that its attitude refers to, and the one whose
    times the attitudes have.
    """

    body: str
    reference: str
    edges: tuple[_Edge, ...]
    timed: _Edge

    def heard(self, told: list[tuple[str, str]]) -> "Iterator[_Heard]":
        """The orientation of the whole chain at each transform of the timed part.

        Other parts are unit; the timed one keeps its norm, for its check.
        """
        t_ns = self.timed.times_ns
        whole = np.tile([1.0, 0.0, 0.0, 0.0], (len(t_ns), 1))
        known = np.ones(len(t_ns), dtype=bool)
        for edge in self.edges:
            if edge is self.timed:
                part = self.timed.q
            else:
                part = edge.at(t_ns)
            known &= np.isfinite(part).all(axis=1) | (edge is self.timed)
            # numbers of the timed part that are not finite are refused where they are checked
            with np.errstate(all="ignore"):
                whole = multiply(part, whole)
        others = [edge for edge in self.edges if edge.moves and edge is not self.timed]
        name = _edge_names([self.timed])
        if others:
            told.append(
                ("log-tf", f"{_edge_names(others)} interpolated (SLERP) to the times of {name}")
            )
        if not known.all():
            told.append(
                (
                    "log-tf",
                    (
                        f"{int((~known).sum())} attitudes at times that not all of these transforms"
                        " have are left out"
                    ),
                )
            )
        received_ns = np.array(self.timed.received_ns)[known]
        stamps_ns = np.array(self.timed.stamps_ns)[known]
        rows = zip(received_ns.tolist(), stamps_ns.tolist(), whole[known].tolist(), strict=True)
        for number, (received, stamp_ns, (w, x, y, z)) in enumerate(rows, start=1):
            turn = _RosTurn(stamp_ns, self.reference, self.body, (w, x, y, z))
            yield _Heard(f": transform {number} of {name}", received, turn)


class _Tree:
    def __init__(self, path: Path, transforms: "Iterable[_Heard]") -> None:
        self._path = path
        self._up: dict[str, dict[str, _Edge]] = {}
        count = 0
        for _, received_ns, turn in transforms:
            body = turn.body or ""
            reference = turn.reference or ""
            parents = self._up.setdefault(body, {})
            if reference not in parents:
                parents[reference] = _Edge(reference, body)
                count += 1
                if count > MAX_EDGES:
                    raise InputError(
                        f"{path}: tf has more than {MAX_EDGES} transforms; record those that are"
                        " wanted"
                    )
            parents[reference].add(turn, received_ns)

    def _all(self) -> list[_Edge]:
        return [edge for parents in self._up.values() for edge in parents.values()]

    def chain(self, body: str | None, reference: str | None) -> _FrameChain:
        """From `body` up to `reference`, or as far as the tree goes; the body may be left out where
        one frame moves.

        Raises InputError where the tree has no such chain, or one of its transforms is no rotation.
        """
        if body is None:
            moving = [edge for edge in self._all() if edge.moves] or self._all()
            if len(moving) != 1:
                raise InputError(
                    f"{self._path}: several transforms of tf could be meant: {_edge_names(moving)};"
                    " choose with --body FRAME"
                )
            body = moving[0].child
        edges = self._edges(body, reference)
        timed = max(edges, key=lambda edge: (edge.moves, len(edge.stamps_ns)))
        for edge in edges:
            with np.errstate(over="ignore"):
                worst = float(np.abs(np.linalg.norm(edge.q, axis=1) - 1).max())
            if edge is not timed and not worst <= NORM_TOLERANCE:
                raise InputError(
                    f"{self._path}: the transform {_edge_names([edge])} has a quaternion whose norm"
                    f" is off by {worst:.3g}"
                )
        return _FrameChain(body, edges[-1].parent, edges, timed)

    def _edges(self, body: str, reference: str | None) -> tuple[_Edge, ...]:
        edges: list[_Edge] = []
        frame = body
        visited = {body}
        while frame in self._up and frame != reference:
            parents = list(self._up[frame].values())
            if len(parents) > 1:
                raise InputError(
                    f"{self._path}: in tf, {frame!r} has several parents: {_edge_names(parents)};"
                    " record one of them"
                )
            edges.append(parents[0])
            frame = parents[0].parent
            if frame in visited:
                raise InputError(
                    f"{self._path}: tf goes in a circle at {frame!r}: {_edge_names(edges)}"
                )
            visited.add(frame)
        if not edges or (reference is not None and frame != reference):
            if reference is not None and edges:
                wanted = f"from {body!r} up to {reference!r}"
            else:
                wanted = f"of {body!r}"
            raise InputError(
                f"{self._path}: tf has no transform {wanted}; it has {_edge_names(self._all())}"
            )
        return tuple(edges)


def _edge_names(edges: Sequence[_Edge]) -> str:
    return _listed([f"{edge.parent} -> {edge.child}" for edge in edges], MAX_NAMED, 400)


def _listed(names: list[str], count: int, limit: int) -> str:
    return shortened(", ".join([*names[:count], *["..."] * (len(names) > count)]), limit)


def named(reference: str | None) -> tuple[str | None, Kind | None]:
    """What `--reference` says: the frame of the bag, and what its axes are; None for what it does
    not say.

    Raises InputError for a meaning that is none.
    """
    frame, equals, meaning = (reference or "").rpartition("=")
    kind = KINDS.get(meaning.lower())
    if equals and kind is None:
        raise InputError(
            f"--reference {reference}: the axes of {frame} are {FORM}; write --reference"
            f" {frame}=icrs, for example"
        )
    if kind is None:
        return (reference, None)
    return (frame or None, kind)


def _kind_of_frame(
    path: Path, frame: str | None, stated: Stated, why: str, told: list[tuple[str, str]]
) -> Kind:
    """What the axes of the bag's frame are; `why` says which frame that is, where the bag does not
    name it.

    Raises InputError where neither its name nor the user says, or they differ.
    """
    wanted, kind = named(stated.reference)
    refers = f"{path}: its attitudes refer to the frame {frame!r}"
    if frame is not None and wanted is not None and wanted != frame:
        raise InputError(f"{refers}, not to {wanted!r}; write --reference {frame}=icrs")
    own_kind = KINDS.get((frame or "").lower())
    if kind is None:
        if own_kind is None:
            raise InputError(f"{refers if frame else f'{path}: {why}'}; {STATE}")
        if (frame or "").lower() not in EXACT and own_kind == "icrs":
            told.append(("reference", loosely_icrs(str(frame))))
        return own_kind
    if own_kind is None:
        if frame:
            called = f"the frame {frame!r}"
        else:
            called = "the reference"
        told.append(("reference", f"{called} is taken as {AXES[kind]}, as stated"))
    elif own_kind != kind:
        raise InputError(f"{refers}, which is not {AXES[kind]}; leave out --reference")
    return kind


class _Heard(NamedTuple):
    where: str
    receive_ns: int
    turn: _RosTurn

    def t_ns(self, stamped: bool) -> int:
        if stamped:
            return self.turn.stamp_ns or 0
        return self.receive_ns


def read_ros(bag: Bag, stated: Stated) -> LogReading:
    """The body's attitudes of one topic. Raises InputError where the bag, or what is stated,
    does not say which they are.
    """
    topic = _chosen(bag, stated.topic)
    if not bag.has_own_fields(topic):
        where = f"{bag.path}: {topic.name}"
        raise InputError(
            f"{where}: its {topic.type} is not ROS's own (other fields); publish it as ROS"
            " defines it"
        )
    notices: list[tuple[str, str]] = []
    if topic.type in TF_TYPES:
        every = _of_tf(bag, topic, stated, notices)
    else:
        every = _of_topic(bag, topic)
    first, stamped, heard = _begin(bag, topic, every, stated.body)
    if not stamped:
        notices.append(
            (
                "log-stamp",
                (
                    f"the messages of {topic.name} have no time of their own; when they were"
                    " recorded is taken"
                ),
            )
        )
    why = f"the messages of {topic.name} do not say which frame their orientation refers to"
    if topic.type == IMU:
        why += " (ROS recommends east, north, up: REP 145)"
    kind = _kind_of_frame(bag.path, first.turn.reference, stated, why, notices)
    reference = stated_reference(bag.path, kind, stated, first.t_ns(stamped))
    entries = to_icrs(_entries(heard, first.turn, stamped), reference, first.turn.gyro, notices)
    body = first.turn.body
    # An optical frame (REP 103: z forward, x right, y down) is the camera's own: a mounting would
    # turn it twice.
    if body is not None and body.endswith(OPTICAL) and abs(stated.mounting.q_body_to_cam[0]) < 1:
        notices.append(
            (
                "mounting",
                (
                    f"{body!r} has the axes of a camera by its name, and is turned by q_body_to_cam"
                    " all the same"
                ),
            )
        )
    return LogReading(
        in_order(entries, notices),
        _conventions(topic, first, stamped, reference),
        ORDER_ADVICE,
        notices,
    )


def _begin(
    bag: Bag, topic: BagTopic, heard: Iterator[_Heard], body: str | None
) -> tuple[_Heard, bool, Iterator[_Heard]]:
    """The first orientation of the stated body that is set, whether the messages have times of
    their own, and all of its orientations.

    Raises InputError where there are none.
    """
    first = next(heard, None)
    if first is None:
        raise InputError(
            f"{bag.path}: has no message of {topic.name}; record it, or choose another with --topic"
        )
    if first.turn.body is None and body is not None:
        raise InputError(
            f"{bag.path}: the messages of {topic.name} name no body; leave out --body {body}"
        )
    heard = chain([first], heard)
    if body is not None:
        wanted = frame(body)
        heard = (message for message in heard if message.turn.body == wanted)
    # Zeros and NaN from before an estimator ran may lack stamps and frames, too: what follows them
    # counts.
    unset = []
    for message in heard:
        if not is_unset(message.turn.q):
            heard = chain([message], heard)
            break
        unset.append(message)
    begin = list(islice(heard, 2))
    if not begin and not unset:
        raise InputError(
            f"{bag.path}: {topic.name} has no attitude of {body}; leave out --body to be told what"
            " it has"
        )
    # A simulated clock may begin at 0; one that is still 0 in the second message was never set.
    stamped = any(message.turn.stamp_ns for message in begin)
    return [*begin, *unset][0], stamped, chain(unset, begin, heard)


def _chosen(bag: Bag, wanted: str | None) -> BagTopic:
    """The topic that is read. Raises InputError with those that there are."""
    topics = bag.topics()
    readable = [topic for topic in topics if topic.type in TYPES]
    if wanted is not None:
        found = next(
            (topic for topic in topics if topic.name.lstrip("/") == wanted.lstrip("/")), None
        )
        if found is None:
            raise InputError(f"{bag.path}: has no topic {wanted}; it has {_topic_names(topics)}")
        if found not in readable:
            types = ", ".join(sorted({kind.rpartition("/")[2] for kind in TYPES}))
            raise InputError(
                f"{bag.path}: {found.name} is of {found.type}, which says no attitude; read are"
                f" {types}"
            )
        return found
    choice = [topic for topic in readable if not topic.name.endswith(STATIC_TF)] or readable
    if not choice:
        raise InputError(f"{bag.path}: has no topic with attitudes; it has {_topic_names(topics)}")
    if len(choice) > 1:
        raise InputError(
            f"{bag.path}: has several topics with attitudes: {_topic_names(choice)}; choose one"
            " with --topic NAME"
        )
    return choice[0]


def _topic_names(topics: list[BagTopic]) -> str:
    names = [f"{topic.name} ({topic.type.replace('/msg/', '/')})" for topic in topics]
    return _listed(names, MAX_NAMED_TOPICS, 600) or "no topic of ROS"


def _of_topic(bag: Bag, topic: BagTopic) -> Iterator[_Heard]:
    for number, message in enumerate(bag.messages(topic), start=1):
        where = f": message {number} of {topic.name}"
        try:
            topic_turns = list(turns(topic.type, bag.decoded(topic, message.data)))
        except Exception as error:  # rosbags's generated code raises what its bytes lead to
            raise InputError(
                f"{bag.path}{where} is no {topic.type} ({shortened(error)}); record the bag again"
            ) from error
        yield from (_Heard(where, message.receive_ns, turn) for turn in topic_turns)


def _of_tf(
    bag: Bag, topic: BagTopic, stated: Stated, told: list[tuple[str, str]]
) -> Iterator[_Heard]:
    """The chain of transforms that is stated, from this topic and the static one beside it."""
    beside = topic.name.rpartition("/")[0] + "/" + STATIC_TF
    statics = []
    for other in bag.topics():
        if other.type in TF_TYPES and other.name == beside and other != topic:
            statics.append(other)
    tree = _Tree(
        bag.path, chain.from_iterable(_of_topic(bag, tf_topic) for tf_topic in [*statics, topic])
    )
    if stated.body is None:
        body = None
    else:
        body = frame(stated.body)
    yield from tree.chain(body, named(stated.reference)[0]).heard(told)


def _entries(heard: Iterator[_Heard], first: _RosTurn, stamped: bool) -> Iterator[LogEntry]:
    """Each attitude from the reference to the body, at its time, or why it is none."""
    for message in heard:
        w, x, y, z = message.turn.q
        if is_unset(message.turn.q):
            fault = None
        else:
            fault = _fault(message.turn, first, stamped)
        yield LogEntry(
            message.where,
            fault or checked_sample(message.t_ns(stamped), (w, -x, -y, -z), message.turn.rate),
        )


def _fault(turn: _RosTurn, first: _RosTurn, stamped: bool) -> Refusal | None:
    if turn.fault is not None:
        return Refusal("format", turn.fault)
    if turn.reference != first.reference:
        return Refusal(
            "format", f"refers to the frame {turn.reference!r}, the first to {first.reference!r}"
        )
    if turn.body != first.body:
        return Refusal(
            "format",
            f"is of the frame {turn.body!r}, the first of {first.body!r}; choose one with --body",
        )
    if turn.stamp_ns and not stamped:
        return Refusal(
            "time", "some messages have a stamp and some have none (0); set it in all of them"
        )
    return None


def _conventions(
    topic: BagTopic, first: _Heard, stamped: bool, reference: Reference
) -> Conventions:
    turn = first.turn
    t_ns = first.t_ns(stamped)
    if not stamped:
        time = "when each message was recorded, ns since 1970"
    elif t_ns >= FIRST_DATE_NS:
        time = "header.stamp: UTC, ns since 1970-01-01T00:00:00, leap seconds not counted"
    else:
        time = "header.stamp: seconds of a simulated clock"
    if turn.gyro and turn.rate is not None:
        rates = "; the gyroscope's rate, with respect to the stars"
    else:
        rates = ""
    body = f"'{turn.body}'" if turn.body else "the body"
    frames = f"{body} into those of " + (
        f"'{turn.reference}'" if turn.reference else "the reference"
    )

    def written(q: FloatArray) -> str:
        of_body = multiply(reference.q_icrs_to_reference([t_ns])[0], conjugate(q))
        if reference.kind == "icrs":
            when = ""
        else:
            when = f" at {t_ns / NS_PER_S:.9f} s"
        return f"x y z w = {components(np.roll(of_body, -1))}{when}"

    return Conventions(
        f"ROS {topic.name} ({topic.type.replace('/msg/', '/')})",
        f"turns components of {frames}, taken as {reference.words}{rates}",
        "scalar last (x, y, z, w), Hamilton",
        time,
        of_body=True,
        written=written,
        scale="UTC" if t_ns >= FIRST_DATE_NS else None,
    )


@contextlib.contextmanager
def _open(path: Path, stated: Stated) -> Iterator[LogReading]:
    require("rosbags", "ros", f"{path}: a ROS bag")
    with open_bag(path) as bag:
        yield read_ros(bag, stated)


log_format = LogFormat(
    "a ROS bag",
    _open,
    listed="bags of ROS",
    uses=LEVEL | {"mounting", "topic", "body"},
    magic=tuple(ENDINGS),
    begins=is_bag,
)
