"""A bag, whichever its format: one file, or the directory of a ROS 2 bag with its metadata.yaml."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hilstar.attitude.logs.ros.bag_file import BagFile
from hilstar.attitude.logs.ros.db3 import Db3File
from hilstar.attitude.logs.ros.mcap_bag import McapBag
from hilstar.attitude.logs.ros.storage import ADVICE, ZSTD_MAGIC, Message, Storage, Topic, unpack_file
from hilstar.errors import InputError, shortened
from hilstar.files import temporary_folder
from hilstar.reading import HEAD_BYTES, MCAP_MAGIC, ROSBAG_MAGIC, SQLITE_MAGIC, open_regular, read_text, refuse_kind

METADATA = "metadata.yaml"
MAX_METADATA_BYTES = 2_000_000
MAX_FILES = 10_000
MAX_NAME_CHARACTERS = 255
FILE_LIST = re.compile(r"^[ ]*relative_file_paths:[ ]*(?:\[([^\]\n]*)\]|\n((?:[ ]*-[ ][^\n]*(?:\n|\Z))+))", re.MULTILINE)
FILE_NAME = re.compile(r".*\.(db3|mcap)(\.zstd)?")


class Bag:
    """A bag that is open for reading."""

    def __init__(self, path: Path, files: list[Storage], told: list[tuple[str, str]]) -> None:
        self.path = path
        self._files = files
        self._told = told
        self._topics: list[Topic] | None = None

    def topics(self) -> list[Topic]:
        """The topics of all files, each once; the files are looked through once. Raises InputError for damage."""
        if self._topics is None:
            self._topics = list(dict.fromkeys(topic for file in self._files for topic in file.topics()))
        return self._topics

    def messages(self, topic: Topic) -> Iterator[Message]:
        """The messages of a topic, file by file. Raises InputError for damage."""
        for file in self._files:
            yield from file.messages(topic)

    def told(self) -> list[tuple[str, str]]:
        """Notices of what was read so far."""
        return [*self._told, *(notice for file in self._files for notice in file.told())]


def is_bag_directory(path: Path) -> bool:
    """Whether a directory has what a bag of ROS 2 has. Raises OSError where it cannot be listed."""
    return path.is_dir() and any(file.name == METADATA or FILE_NAME.fullmatch(file.name) for file in path.iterdir())


@contextlib.contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """A .bag, .db3 or .mcap file, or a directory of the latter two. Raises InputError."""
    told: list[tuple[str, str]] = []
    paths = _files_of(path, told) if is_bag_directory(path) else [path]
    with temporary_folder("bag") as place:
        yield Bag(path, [_storage(file, place) for file in paths], told)


def _files_of(path: Path, told: list[tuple[str, str]]) -> list[Path]:
    """The files that the bag's metadata names; without it, all of the directory."""
    if (path / METADATA).is_file():
        files = [path / Path(name).name for name in _named(path / METADATA)]
        missing = [file.name for file in files if not file.is_file()]
        if missing:
            raise InputError(f"{path}: lacks {shortened(', '.join(missing))}, which its {METADATA} names; copy the whole bag")
    else:
        files = sorted((file for file in path.iterdir() if FILE_NAME.fullmatch(file.name)), key=_number)
        told.append(("log-cut", f"{path} has no {METADATA} (its recorder was killed?); all of its bag files are read"))
    return files


def _number(file: Path) -> list[Any]:
    """NAME_2 comes before NAME_10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.name)]


def _named(metadata: Path) -> list[str]:
    """relative_file_paths, one to a line or in brackets, as ROS 2 writes them; a YAML reader's time has no bound."""
    text = read_text(metadata, "give a bag of ROS 2", MAX_METADATA_BYTES)
    found = FILE_LIST.search(text)
    if found is None:
        raise InputError(f"{metadata}: has no relative_file_paths; remove the file to read all of the directory")
    items = found[1].split(",") if found[1] is not None else [line.strip()[1:] for line in found[2].splitlines()]
    names = [name for item in items if (name := item.strip().strip("'\""))]
    if not names or len(names) > MAX_FILES or max(map(len, names)) > MAX_NAME_CHARACTERS:
        raise InputError(f"{metadata}: names no files of a bag; remove it to read all of the directory")
    return names


def _storage(path: Path, place: Path) -> Storage:
    """The reader of a file, by its first bytes; what is packed is unpacked into `place` first."""
    with open_regular(path, ADVICE) as file:
        head = file.read(HEAD_BYTES)
        if head.startswith(ZSTD_MAGIC):
            whole = place / path.stem
            file.seek(0)
            with whole.open("wb") as target:
                unpack_file(path, file, target)
            return _storage(whole, place)
    if head.startswith(ROSBAG_MAGIC):
        return BagFile(path)
    if head.startswith(SQLITE_MAGIC):
        return Db3File(path)
    if head.startswith(MCAP_MAGIC):
        return McapBag(path)
    refuse_kind(path, head, ADVICE)
    raise InputError(f"{path}: not a file of a bag; {ADVICE}")
