"""One answer of a star tracker, independent of the byte format: its times, its attitude, and the
tracker's status.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from hilstar.basics.arrays import FloatArray
from hilstar.basics.units import NS_PER_S

# A stamp that steps back by more means that the tracker's clock was set; by less, that a datagram
# was overtaken on its way.
JUMP_NS = NS_PER_S


class ReportedStar(NamedTuple):
    """A star that the tracker reports: its centroid in the tracker's pixels, its signal `dn` in
    digital numbers, its Hipparcos number `hip` and its width `width_px`, one sigma of its image,
    None where the tracker gives none.
    """

    x_px: float
    y_px: float
    dn: float | None = None
    hip: int | None = None
    width_px: float | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer, after the bench file's conventions were applied.

    `host_ns`: the host's monotonic clock when the last byte arrived. `raw`: the answer's bytes.
    `t_ns`: the time stamp that the tracker sends, on the tracker's clock, None where it sends none.
    `q_icrs_to_cam`: unit quaternion (w, x, y, z), None where the answer has no attitude.
    `rate_cam_rad_s`: (3,), rad/s, camera axes, None where it has no rate. `valid`: False where the
    tracker marks the answer as invalid or sends no attitude. `mode`: the tracker's name for its
    mode. `rms_arcsec`: the rms that the tracker reports.
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
    """Counts answers that arrive out of order: `fallen` is the number of stamps that lie before
    the stamp of an answer that arrived earlier.
    """

    def __init__(self) -> None:
        self.fallen = 0
        self._newest_ns: int | None = None

    def take(self, t_ns: int) -> None:
        """Compare the stamp of the next answer, ns on the tracker's clock, with the newest one.
        After a step back by more than JUMP_NS the count goes on from the new stamp: the clock was
        set.
        """
        newest_ns = self._newest_ns
        if newest_ns is not None and 0 < newest_ns - t_ns <= JUMP_NS:
            self.fallen += 1
        else:
            self._newest_ns = t_ns


class AnswerSource(Protocol):
    """Gives the tracker's answers to the server. No method waits, and none raises an exception
    because of what a tracker sends.
    """

    @property
    def unread(self) -> str:
        """Why the server itself cannot read the line now, "" while it can. Tells a failed reader
        from a silent tracker.
        """

    def take(self) -> list[Answer]:
        """The answers since the last call, oldest first."""

    def refusals(self) -> dict[str, int]:
        """How many messages or pieces of data were refused since the start, by reason."""

    def trouble(self) -> str:
        """The present fault of the tracker's line (e.g. an unplugged port), "" without a fault."""

    def close(self) -> None:
        """Stop reading and close the line."""
