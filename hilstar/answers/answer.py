"""An answer of a star tracker, whatever its format: when, which attitude, and what the tracker says of itself."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from hilstar.arrays import FloatArray


class ReportedStar(NamedTuple):
    """A star that the tracker reports: its centroid in the tracker's pixels, its signal, and its Hipparcos number, if given."""

    x_px: float
    y_px: float
    dn: float | None = None
    hip: int | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer, after the bench file's conventions were applied.

    `host_ns`: the host's monotonic clock at its last byte. `t_ns`: the tracker's own stamp on its own clock, None where it
    sends none. `q_icrs_to_cam`: unit quaternion (w, x, y, z), None where it has no attitude. `mode` is the tracker's own word.
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


class AnswerSource(Protocol):
    """Where answers come from. Never waits, never raises for what a tracker sends.

    `trouble` says why nothing is read, "" while answers are.
    """

    @property
    def trouble(self) -> str:
        """Why nothing is read now."""

    def take(self) -> list[Answer]:
        """The answers since the last call, oldest first."""

    def refusals(self) -> dict[str, int]:
        """How much was refused so far, by reason."""

    def close(self) -> None:
        """Close it."""
