"""A growing file, as the road of what another program records."""

import contextlib
import os
import stat
from pathlib import Path

from hilstar.attitude.wire.road_use import RoadUse
from hilstar.attitude.wire.roads import ANSWERS, MAX_READ_BYTES, ByteRoad, RawMessage
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock

FILE_LOOK_S = 0.005
KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
}


def no_file_kind(mode: int) -> str:
    """What a file's mode says that it is, "" for a regular file."""
    if stat.S_ISREG(mode):
        return ""
    return KINDS.get(stat.S_IFMT(mode), "no file")


def refuse_no_file(path: Path) -> None:
    """Refuse (InputError) a path that names something other than a regular file; it may name
    nothing yet.
    """
    try:
        kind = no_file_kind(path.stat().st_mode)
    except OSError:
        return
    if kind:
        raise InputError(
            f"[answers] path = {path}: {kind}; write the file to which answers are appended"
        )


class FileRoad(ByteRoad):
    """What is appended to a regular file after the start; one that is made anew or cut is read from
    its beginning.

    A path that comes to name something else (a device, a FIFO, a directory) is let go and told: a
    device may have bytes for ever. It is looked at again until it names a file. So is a path that
    names nothing, or what may not be read; a file that was open is read on meanwhile.
    """

    def __init__(
        self,
        path: Path,
        use: RoadUse = ANSWERS,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        super().__init__(str(path), use, notices, clock)
        self._path = path
        self._file = -1
        self._trouble = ""
        self._follow()
        if self._file >= 0:
            os.lseek(self._file, 0, os.SEEK_END)

    @property
    def trouble(self) -> str:
        """See `ByteRoad.trouble`."""
        return self._trouble

    def _open(self) -> None:
        """Open what the path names, if that is a regular file. Raises OSError."""
        file = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK)
        kind = no_file_kind(os.fstat(file).st_mode)
        if kind:
            os.close(file)
            self._let_go(kind)
            return
        self._file = file
        self._trouble = ""
        self._opened()

    def _let_go(self, kind: str) -> None:
        self.close()
        trouble = f"it is {kind} now, and no regular file"
        if self._trouble != trouble:
            self._trouble = trouble
            self._lose(trouble)

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `ByteRoad.taken`."""
        end = self._clock.within(timeout_ms / 1000)
        while True:
            data = b""
            with contextlib.suppress(OSError):
                if self._file >= 0:
                    data = os.read(self._file, MAX_READ_BYTES)
                # One that has more than a tracker says in a look may never end, while another
                # stands in its place.
                if not data or len(data) == MAX_READ_BYTES:
                    self._follow()
            if data:
                return [RawMessage(self._clock.now_ns(), [data])]
            if end.over:
                return []
            self._clock.sleep(min(FILE_LOOK_S, end.left_s))

    def wait_for_message(self, timeout_ms: int) -> bool:
        """Never known before it is read."""
        return False

    def _follow(self) -> None:
        """Read what the path names now; why it cannot be read is told while that lasts."""
        try:
            self._take(self._path.stat())
        except OSError as error:
            self._trouble = f"{self._path} cannot be read ({error.strerror})"

    def _take(self, named: os.stat_result) -> None:
        kind = no_file_kind(named.st_mode)
        if kind:
            self._let_go(kind)
            return
        if self._file < 0:
            self._open()
            return
        self._trouble = ""
        held = os.fstat(self._file)
        if (held.st_ino, held.st_dev) != (named.st_ino, named.st_dev):
            self.close()
            self._open()
        elif named.st_size < os.lseek(self._file, 0, os.SEEK_CUR):
            os.lseek(self._file, 0, os.SEEK_SET)

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
