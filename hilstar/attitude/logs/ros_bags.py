"""ROS bags, opened by rosbags' `AnyReader`; `ros` says what their messages mean.

A bag is one file (.bag of ROS 1; .db3 or .mcap of ROS 2) or the directory of a bag of ROS 2. Its
content says which; rosbags goes by the ending, so a file of another name is read by a link to it.
Types that a bag does not define are ROS's own.

A bag without an index (its recorder was killed) is refused with the command that rebuilds it.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hilstar.attitude.logs.bag_unpacking import UnpackingError, bound_unpacking, refuse_overlaps
from hilstar.attitude.logs.log_formats import LogHead
from hilstar.basics.errors import InputError, shortened, size_text
from hilstar.basics.files import MCAP_MAGIC, temporary_folder
from hilstar.basics.reading import HEAD_BYTES, open_regular

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

BAG_ADVICE = "give a bag of ROS 1 (.bag) or ROS 2 (.db3, .mcap, or the bag's directory)"
ROSBAG_MAGIC = b"#ROSBAG V"
SQLITE_MAGIC = b"SQLite format 3\x00"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # no message begins so, in CDR or of ROS 1
ENDINGS = {ROSBAG_MAGIC: ".bag", SQLITE_MAGIC: ".db3", MCAP_MAGIC: ".mcap"}
METADATA = "metadata.yaml"
MAX_METADATA_BYTES = 2_000_000  # a YAML reader's time has no bound
PACKED = f"its messages are packed; give the bag's directory, whose {METADATA} says so"
STORED = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")
OLD_TF = "tf/msg/tfMessage"
TF, TF_TEXT = "tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms"


class Message(NamedTuple):
    """A message: when it was recorded, ns of the recorder's clock, and its serialised bytes."""

    receive_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class BagTopic:
    """A topic of a bag: `type` as PACKAGE/msg/NAME, and rosbags' connections of it."""

    name: str
    type: str
    connections: "tuple[Connection, ...]"


@lru_cache(maxsize=2)
def own_types(is_ros2: bool) -> "Typestore":
    """ROS's own types: of the latest ROS 2 (unchanged since the first), or of Noetic."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if is_ros2:
        return get_typestore(Stores.LATEST)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(TF_TEXT, TF))
    return store


class Bag:
    """A bag that is open for reading."""

    def __init__(self, path: Path, reader: "AnyReader") -> None:
        self.path = path
        self._reader = reader

    def topics(self) -> list[BagTopic]:
        """Each topic once for each type of its messages, in the order of the bag."""
        by_name: dict[tuple[str, str], list[Connection]] = {}
        for connection in self._reader.connections:
            by_name.setdefault((connection.topic, connection.msgtype), []).append(connection)
        named = by_name.items()
        return [BagTopic(name, kind, tuple(connections)) for (name, kind), connections in named]

    def messages(self, topic: BagTopic) -> Iterator[Message]:
        """The messages of a topic in the order of their recording. Raises InputError for damage."""
        with _readable(self.path):
            for _, receive_ns, data in self._reader.messages(topic.connections):
                if data[:4] == ZSTD_MAGIC:
                    raise InputError(f"{self.path}: {PACKED}")
                yield Message(receive_ns, data)

    def decoded(self, topic: BagTopic, data: bytes) -> Any:
        """A message of its bytes. Raises what rosbags does for bytes that are none."""
        return self._reader.deserialize(data, topic.type)

    def has_own_fields(self, topic: BagTopic) -> bool:
        """Whether the bag defines the topic's type, and all within it, as ROS does."""
        theirs = self._reader.typestore.fielddefs
        ours = own_types(self._reader.is2).fielddefs
        waiting = [topic.type]
        visited = set()
        while waiting:
            kind = waiting.pop()
            known = TF if kind == OLD_TF else kind
            if kind in visited or known not in ours:
                continue
            visited.add(kind)
            if kind not in theirs or theirs[kind][1] != ours[known][1]:
                return False
            waiting += _inner_types(theirs[kind][1])
        return True


def _inner_types(fields: Any) -> Iterator[str]:
    """The names of the types within a type's fields, which rosbags has as nested tuples."""
    for _, (_, argument) in fields:
        while isinstance(argument, tuple) and isinstance(argument[0], tuple):  # of an array
            _, argument = argument[0]
        if isinstance(argument, str):
            yield argument


def is_bag_directory(path: Path) -> bool:
    """Whether a directory has what a bag of ROS 2 has. Raises OSError where it cannot be listed."""
    if not path.is_dir():
        return False
    names = [file.name for file in path.iterdir()]
    return METADATA in names or any(name.endswith(STORED) for name in names)


@contextlib.contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """A .bag, .db3 or .mcap file, or a directory of the latter two. Raises InputError."""
    from rosbags.highlevel import AnyReader

    bound_unpacking()
    with temporary_folder("bag") as place, contextlib.ExitStack() as stack:
        if path.is_dir():
            named = _directory(path)
        else:
            named = _by_its_ending(path, place)
        with _readable(path):
            types = own_types(named.suffix != ".bag")
            reader = stack.enter_context(AnyReader([named], default_typestore=types))
            _refuse_overlaps(path, reader)
        yield Bag(path, reader)


def _refuse_overlaps(path: Path, reader: "AnyReader") -> None:
    """Refuse (InputError) MCAP files whose chunks of one time are too large together."""
    for bag in reader.readers:
        for storage in getattr(bag, "storages", ()):
            refuse_overlaps(path, getattr(storage, "chunks", ()))


def _directory(path: Path) -> Path:
    """A bag's directory as it is. Raises InputError where it has no index that anybody wrote."""
    metadata = path / METADATA
    if not metadata.is_file():
        missing = f"{path}: has no {METADATA} (its recorder was killed?)"
        raise InputError(f"{missing}; make one: ros2 bag reindex {path.name}")
    size = metadata.stat().st_size
    if size > MAX_METADATA_BYTES:
        too_large = f"{metadata}: has {size_text(size)}"
        raise InputError(f"{too_large}; make it anew: ros2 bag reindex {path.name}")
    return path


def _by_its_ending(path: Path, place: Path) -> Path:
    """A file whose name ends as its content says, or a link to it in `place`. Raises InputError."""
    with open_regular(path, BAG_ADVICE) as file:
        head = file.read(HEAD_BYTES)
    ending = next(ending for magic, ending in ENDINGS.items() if head.startswith(magic))
    _refuse_unmerged(path)
    if path.suffix == ending:
        return path
    link = place / f"bag{ending}"
    link.symlink_to(path.resolve())
    return link


def _refuse_unmerged(path: Path) -> None:
    """Refuse (InputError) an SQLite file whose last messages its recorder left beside it."""
    log = path.with_name(path.name + "-wal")
    if log.is_file() and log.stat().st_size:
        merge = f"sqlite3 {path.name} 'PRAGMA wal_checkpoint(TRUNCATE)'"
        rest = f"its recorder did not close it, and {log.name} has the rest"
        raise InputError(f"{path}: {rest}; merge it with: {merge}")


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Whatever rosbags raises over a bag as one line (InputError)."""
    try:
        yield
    except InputError:
        raise
    except UnpackingError as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # its readers pass on what struct, sqlite, yaml and others raise
        reason = " ".join(str(error).split()) or type(error).__name__
        refusal = f"{path}: rosbags cannot read it ({shortened(reason)})"
        raise InputError(f"{refusal}; {_mend(path, reason)}") from error


def _mend(path: Path, reason: str) -> str:
    """What to do with a bag that cannot be read."""
    if "Profile" in reason:
        other = "it is MCAP of another kind than ROS 2's"
        return f"{other}; write it again with ros2 bag convert, or give the bag that it is of"
    if path.suffix == ".bag" or reason.startswith("Bag"):
        return f"where its index is missing or damaged: rosbag reindex {path.name} (of ROS 1)"
    return (
        "where its index is missing or damaged: ros2 bag reindex DIRECTORY (an MCAP file that was"
        f" cut off, first: mcap recover {path.name} -o NEW.mcap)"
    )


def is_bag(beginning: LogHead) -> bool:
    """Whether a log is a bag, by its beginning. Raises InputError for damage there."""
    if beginning.path.is_dir():
        return is_bag_directory(beginning.path)
    if beginning.head.startswith(MCAP_MAGIC):
        from hilstar.attitude.logs.mcap_log import holds_ros

        return holds_ros(beginning.path)
    return beginning.head.startswith((ROSBAG_MAGIC, SQLITE_MAGIC))
