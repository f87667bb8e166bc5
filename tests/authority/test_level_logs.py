"""CSV and JSON lines whose attitudes are a body's, or refer to a level frame, against SciPy's
rotations and Astropy's Earth.

ICRS components become the Earth's by Astropy's GCRS and ITRS; east, north and up are at a geodetic
latitude and longitude.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from astropy.coordinates import GCRS, ITRS, CartesianRepresentation
from astropy.time import Time, TimeDelta
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.attitude.wire.source import Convention, Mounting
from tests.support.commands import run_hilstar_here

pytestmark = pytest.mark.usefixtures("iers_of_package")
ORION = (0.6987226, 0.7135120, -0.0370377, 0.0362700)
MOUNTING = (0.5, -0.5, -0.5, -0.5)
PLACE_DEG, DATE = (47.0, 8.0), "2024-01-01T00:00:00"
LEVEL = ("--place", "47,8,400", "--epoch-utc", DATE)
# Four digits of a degree are shown.
SHOWN_DEG = 6e-5
# hilstar leaves out s', tides and the pole's offsets: 1 mas. Its rate of a level frame is about the
# Earth's third axis, from which the pole of rotation is 0.6 arcsec away at most: 7.3e-5 rad/s of
# 3e-6 rad.
EARTH_RAD, RATE_RAD_S = 1e-8, 2.2e-10


def icrs_to_enu(seconds: float, kind: str = "enu") -> Rotation:
    at = Time(DATE, scale="utc") + TimeDelta(seconds, format="sec")
    axes = [
        GCRS(CartesianRepresentation(*axis), obstime=at).transform_to(ITRS(obstime=at))
        for axis in np.eye(3)
    ]
    to_earth = np.stack([axis.cartesian.xyz.value for axis in axes], axis=1)
    latitude, longitude = np.radians(PLACE_DEG)
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    north = [
        -np.sin(latitude) * np.cos(longitude),
        -np.sin(latitude) * np.sin(longitude),
        np.cos(latitude),
    ]
    up = [
        np.cos(latitude) * np.cos(longitude),
        np.cos(latitude) * np.sin(longitude),
        np.sin(latitude),
    ]
    rows = [east, north, up] if kind == "enu" else [north, east, np.negative(up)]
    return Rotation.from_matrix(np.array(rows) @ to_earth)


def pointing(path, *statements: object) -> tuple[float, float]:
    result = run_hilstar_here("attitude", path, "--json", *statements)
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    return found["ra_deg"], found["dec_deg"]


def boresight_deg(icrs_to_cam: Rotation) -> tuple[float, float]:
    x, y, z = icrs_to_cam.inv().apply([0.0, 0.0, 1.0])
    return np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arcsin(z))


@pytest.fixture(params=["csv", "jsonl"])
def level_log(request, tmp_path):
    path = tmp_path / f"body.{request.param}"
    rows = [f"{k},{','.join(map(str, ORION))}" for k in range(2)]
    objects = [json.dumps({"t_ns": k * 10**9, "q": ORION}) for k in range(2)]
    path.write_text(
        "\n".join(["t_s,qw,qx,qy,qz", *rows] if request.param == "csv" else objects) + "\n"
    )
    return path


def test_a_log_of_the_body_looks_where_scipy_says(level_log):
    camera = Rotation.from_quat(MOUNTING, scalar_first=True) * Rotation.from_quat(
        ORION, scalar_first=True
    )
    ra_deg, dec_deg = pointing(level_log, "--mounting", ",".join(map(str, MOUNTING)))
    assert (ra_deg, dec_deg) == pytest.approx(boresight_deg(camera), abs=SHOWN_DEG)
    assert (ra_deg, dec_deg) == pytest.approx((354.0570, 0.0), abs=SHOWN_DEG)


def test_a_log_that_refers_to_east_north_up_looks_where_astropy_says(level_log):
    camera = Rotation.from_quat(ORION, scalar_first=True) * icrs_to_enu(0.0)
    ra_deg, dec_deg = pointing(level_log, "--reference", "enu", *LEVEL)
    assert (ra_deg, dec_deg) == pytest.approx(boresight_deg(camera), abs=SHOWN_DEG)
    assert (ra_deg, dec_deg) == pytest.approx((280.0145, 41.4978), abs=SHOWN_DEG)


@pytest.mark.parametrize("kind", ["enu", "ned"])
@pytest.mark.parametrize("direction", ["icrs_to_cam", "cam_to_icrs"])
def test_attitudes_and_rates_of_a_body_in_a_level_frame_become_the_cameras_in_the_stars(
    tmp_path, kind, direction
):
    """A body that turns at a constant rate with respect to the level frame; rates are in the body's
    components.
    """
    rate, mounting = np.array([0.01, -0.02, 0.03]), Rotation.from_quat(MOUNTING, scalar_first=True)
    rows, camera = [], []
    for k in range(3):
        level_to_body = Rotation.from_rotvec(-rate * 60 * k) * Rotation.from_quat(
            ORION, scalar_first=True
        )
        sent = level_to_body if direction == "icrs_to_cam" else level_to_body.inv()
        rows.append(
            ",".join(
                map(repr, [60.0 * k, *sent.as_quat(scalar_first=True).tolist(), *rate.tolist()])
            )
        )
        camera.append(mounting * level_to_body * icrs_to_enu(60.0 * k, kind))
    path = tmp_path / "level.csv"
    path.write_text("\n".join(["t_s,qw,qx,qy,qz,rx,ry,rz", *rows]))
    convention = Convention(direction=direction, frame="body")
    stated = Stated(
        Mounting(MOUNTING),
        reference=kind,
        place=(*PLACE_DEG, 400.0),
        epoch_utc=DATE,
        convention=convention,
    )
    for k, sample in enumerate(open_log(path, stated).samples):
        found = Rotation.from_quat(sample.q_icrs_to_cam, scalar_first=True)
        assert (found * camera[k].inv()).magnitude() < EARTH_RAD
        # The level frame's own rate, in its components, by Astropy over two minutes.
        turned = icrs_to_enu(60.0 * k + 60, kind) * icrs_to_enu(60.0 * k - 60, kind).inv()
        level_to_cam = camera[k] * icrs_to_enu(60.0 * k, kind).inv()
        wanted = mounting.apply(rate) + level_to_cam.apply(-turned.as_rotvec() / 120)
        assert sample.rate_cam_rad_s == pytest.approx(wanted, abs=RATE_RAD_S)
