"""An answer of a star tracker, whatever its format: when, which attitude, and what the tracker
says of itself.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import NS_PER_S

# a stamp that is off by more is of a clock that was set, not of an answer that was overtaken
JUMP_NS = NS_PER_S


class ReportedStar(NamedTuple):
    """A star that the tracker reports: its centroid in the tracker's pixels, its signal, and its
    Hipparcos number, if given.
    """

    x_px: float
    y_px: float
    dn: float | None = None
    hip: int | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer, after the bench file's conventions were applied.

    `host_ns`: the host's monotonic clock at its last byte. `t_ns`: the tracker's own stamp on its
    own clock, None where it sends none. `q_icrs_to_cam`: unit quaternion (w, x, y, z), None where
    it has no attitude. `mode` is the tracker's own word.
    """

    host_ns: int
    raw: bytes
    t_ns: int | None = None
    q_icrs_to_cam: FloatArray | None = None
    rate_cam_rad_s: FloatArray | None = None
    valid: bool = True
    mode: str = ""
    star_count: int | None = None
    rms_arcsec: float | None = None
    centroids: tuple[ReportedStar, ...] = ()


class StampOrder:
    """Counts the stamps that are before an earlier answer's (`fallen`): a datagram was overtaken
    by another.
    """

    def __init__(self) -> None:
        self.fallen = 0
        self._newest_ns: int | None = None

    def take(self, t_ns: int) -> None:
        """Take the stamp of the next answer. A step back by more than JUMP_NS begins anew: the
        clock was set.
        """
        newest_ns = self._newest_ns
        if newest_ns is not None and 0 < newest_ns - t_ns <= JUMP_NS:
            self.fallen += 1
        else:
            self._newest_ns = t_ns


class AnswerSource(Protocol):
    """Where answers come from. Never waits, never raises for what a tracker sends.

    `unread` says why nothing is read, "" while answers are: then it is not the tracker that is
    silent.
    """

    @property
    def unread(self) -> str:
        """Why nothing is read now."""

    def take(self) -> list[Answer]:
        """The answers since the last call, oldest first."""

    def refusals(self) -> dict[str, int]:
        """How much was refused so far, by reason."""

    def trouble(self) -> str:
        """What is wrong with the tracker's line for as long as it lasts, "" while nothing is."""

    def close(self) -> None:
        """Close it."""
