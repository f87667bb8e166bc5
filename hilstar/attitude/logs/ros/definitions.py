"""What rosbags knows of ROS's own message types, and whether a bag means the same by them.

A bag's own text of a type is compared and never compiled: rosbags makes Python code of types that it is given.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

from hilstar.attitude.logs.ros.storage import Encoding, Topic
from hilstar.errors import InputError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

TF, OLD_TF = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
TF_TEXT = "geometry_msgs/TransformStamped[] transforms"
ALIASES = {"Header": "std_msgs/Header"}
MAX_DEFINITION_CHARACTERS = 100_000
Sections = dict[str, list[tuple[str, str]]]


@lru_cache(maxsize=2)
def typestore(encoding: Encoding) -> Typestore:
    """ROS's own types: of Noetic for ROS 1, of rosbags's latest ROS 2 (these have not changed since the first)."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if encoding == "cdr":
        return get_typestore(Stores.LATEST)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(TF_TEXT, TF))
    return store


def own_name(type_name: str) -> str:
    """The type's name in rosbags's stores."""
    return TF if type_name == OLD_TF else type_name


def decoded(topic: Topic, data: bytes) -> Any:
    """The message in some bytes. Raises rosbags.serde.SerdeError."""
    store = typestore(topic.encoding)
    read = store.deserialize_cdr if topic.encoding == "cdr" else store.deserialize_ros1
    return read(data, own_name(topic.type))


def check_definition(where: str, topic: Topic) -> None:
    """Refuse (InputError) a type that only has the name of ROS's own."""
    if not topic.definition:
        return
    version = 1 if topic.encoding == "ros1" else 2
    name = own_name(topic.type)
    text, _ = typestore(topic.encoding).generate_msgdef(name, ros_version=version)
    ours, theirs = _sections(text, name), _sections(topic.definition[:MAX_DEFINITION_CHARACTERS], name)
    if any(theirs.get(kind, fields) != fields for kind, fields in ours.items()):  # some writers leave out the inner types
        raise InputError(f"{where}: its {topic.type} is not ROS's own (other fields); publish it as ROS defines it")


def _sections(text: str, name: str) -> Sections:
    """The fields, type and name, of a definition and of those that it has after its lines of equals signs."""
    sections: Sections = {}
    current = _short(name)
    for line in text.splitlines():
        words = line.partition("#")[0].split()
        if not words or set(line.strip()) == {"="}:
            continue
        if words[0] == "MSG:" and len(words) == 2:
            current = _short(words[1])
        elif "=" not in line.partition("#")[0] and len(words) >= 2:
            sections.setdefault(current, []).append((_field_type(words[0], current), words[1]))
    return sections


def _field_type(text: str, owner: str) -> str:
    base, bracket, size = text.partition("[")
    base = _short(ALIASES.get(base, base))
    if "/" not in base and base[:1].isupper():
        base = f"{owner.partition('/')[0]}/{base}"
    return base + bracket + size


def _short(name: str) -> str:
    return name.replace("/msg/", "/")
