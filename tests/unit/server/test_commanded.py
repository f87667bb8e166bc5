"""The commanded attitude between the frames of a run."""

from __future__ import annotations

import numpy as np

from hilstar.server.record.commanded import Commanded
from tests.support.planted_tracker import ARCSEC_PER_RAD, attitude, scalar_first, scan


def test_a_jump_between_frames_is_not_taken_for_a_motion() -> None:
    t_s = np.arange(0.0, 10.0, 0.1)
    angle = np.where(t_s < 5.05, 0.0, np.radians(0.5)) / 2
    commanded = Commanded(t_s, np.stack([np.cos(angle), np.sin(angle), 0 * t_s, 0 * t_s], axis=1))
    assert np.flatnonzero(~commanded.joined).tolist() == [50]
    assert commanded.at(np.array([4.95, 5.05, 5.15])).known.tolist() == [True, False, True]


def test_between_frames_the_commanded_attitude_is_that_of_the_motion() -> None:
    """The scan's third derivative is 3 deg (2 pi / 271 s)^3 = 0.13 arcsec/s^3 at most: dt^3 / 15
    of it is 1e-5 arcsec.
    """
    t_s = np.arange(0.0, 100.0, 0.1)
    commanded = Commanded(t_s, scalar_first(attitude(scan, t_s)))
    between = t_s[5:-5] + 0.037
    moments = commanded.at(between)
    truth = scalar_first(attitude(scan, between))
    assert moments.known.all()
    sine = np.abs(np.cross(moments.q[:, 1:], truth[:, 1:]))
    assert 2 * ARCSEC_PER_RAD * sine.max() < 1e-3
    ahead = commanded.at(between + 0.01)
    step = (attitude(scan, between + 0.01) * attitude(scan, between).inv()).as_rotvec()
    assert ahead.known.all()
    np.testing.assert_allclose(-step / 0.01, moments.rate_rad_s, atol=1e-6)
