"""Where the first attitude of a run points, in words that a person compares with what the simulator
means.

Attitudes without rates, or at rest, cannot show that they are read in the wrong convention: every
unit quaternion is one. So the place is said once, with the brightest star there. The frame loop
only leaves the attitude here; a thread of its own looks for the star, in milliseconds.
"""

import threading
from typing import Self

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import printable
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import to_matrix, to_radec_roll_deg, turn_text
from hilstar.server.bench.config import Tracker
from hilstar.server.bench.frame import Bench
from hilstar.server.pacer import Shown
from hilstar.sky.catalog import star_names
from hilstar.sky.constellations import constellation_of
from hilstar.sky.stars import Stars

POINTING = "points-at"
LINE_ENDS = (
    "compare with the simulator; if it points elsewhere, its quaternions are of another [attitude]"
    " convention"
)


class Pointing:
    """Tells of a run's first attitude, while this is open. `see` costs a frame one comparison."""

    def __init__(self, bench: Bench, notices: Notices) -> None:
        self._tracker = bench.config.tracker
        self._stars = bench.stars
        self._notices = notices
        self._q_icrs_to_cam: FloatArray | None = None
        self._come = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="hilstar-pointing", daemon=True)

    def see(self, shown: Shown) -> None:
        """Take a frame; the first one with an attitude counts."""
        if self._q_icrs_to_cam is None and shown.attitude is not None:
            self._q_icrs_to_cam = shown.attitude.q_icrs_to_cam
            self._come.set()

    def _run(self) -> None:
        self._come.wait()
        if self._q_icrs_to_cam is not None and not self._closed:
            self._notices.begin(
                POINTING,
                f"{pointing_text(self._tracker, self._stars, self._q_icrs_to_cam)}: {LINE_ENDS}",
            )

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = self._q_icrs_to_cam is None
        self._come.set()
        self._thread.join()


def pointing_text(tracker: Tracker, stars: Stars, q_icrs_to_cam: FloatArray) -> str:
    """Right ascension, declination and roll of an attitude (4,), and the brightest star in the
    tracker's field.
    """
    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(q_icrs_to_cam)
    ra = turn_text(ra_deg, 3)
    roll = turn_text(roll_deg, 3)
    text = f"the first attitude points at RA {ra}, Dec {dec_deg:+.3f}, roll {roll} deg"
    matrix = to_matrix(q_icrs_to_cam)
    star = _brightest_in_view(tracker, stars, matrix)
    if star is None:
        return f"{text}, in {constellation_of(matrix[2])}, where the catalogue has no star in view"
    designation, name = star_names().get(int(stars.hip[star]), ("", ""))
    names = [part for part in (name, designation) if part] or [
        str(stars.designations(np.array([star]))[0])
    ]
    called = printable(", ".join(f"HIP {word}" if word.isdecimal() else word for word in names))
    where = constellation_of(np.asarray(stars.vectors[star]))
    return f"{text}; the brightest star in view is {called}, V {stars.v_mag[star]:.2f}, in {where}"


def _brightest_in_view(tracker: Tracker, stars: Stars, matrix: FloatArray) -> int | None:
    """The place of the brightest star of the catalogue in the tracker's field; None where none
    is there.
    """
    width, height = (
        0.5 * pixels * tracker.pixel_pitch_um * 1e-3 / tracker.focal_length_mm
        for pixels in tracker.resolution_px
    )
    fixed = len(stars) - len(stars.bodies)
    x, y, z = matrix @ np.asarray(stars.vectors[:fixed]).T
    inside = np.flatnonzero(
        (z > 0)
        & (np.abs(x) <= width * z)
        & (np.abs(y) <= height * z)
        & np.isfinite(stars.v_mag[:fixed])
    )
    if len(inside):
        return int(inside[stars.v_mag[inside].argmin()])
    return None
