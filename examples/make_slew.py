"""Make slew.csv, an attitude log of a slew from rest to rest: `python make_slew.py > slew.csv`.

The camera starts on Orion's belt and turns by 20 degrees about an axis that is fixed in it: 1 s of
rest, 20 s of a
cycloidal profile, which starts and ends without a step in acceleration and is fastest, 2 deg/s, in
the middle, and 1 s of rest.
"""

from __future__ import annotations

import math

# RA 84.057, Dec -1.200, roll 0 deg
START_Q_ICRS_TO_CAM = (0.6987226, 0.7135120, -0.0370377, 0.0362700)
AXIS_CAM = (0.36, 0.80, 0.48)  # a unit vector
ANGLE_DEG, SLEW_S, REST_S = 20.0, 20.0, 1.0
SAMPLES_HZ = 10


def turned(angle_rad: float) -> tuple[float, float, float, float]:
    """The start attitude after a turn of the camera by `angle_rad` about AXIS_CAM: a unit
    quaternion (w, x, y, z).

    A Hamilton product, turn by start. The turn has a minus: q turns ICRS components into camera
    components, and a star
    seems to turn against the camera.
    """
    w, (x, y, z) = (
        math.cos(-0.5 * angle_rad),
        (math.sin(-0.5 * angle_rad) * component for component in AXIS_CAM),
    )
    a, b, c, d = START_Q_ICRS_TO_CAM
    q = (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    norm = math.hypot(*q)
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


def profile(t_s: float) -> tuple[float, float]:
    """The angle (rad) turned at a time, and its rate (rad/s)."""
    share = min(max((t_s - REST_S) / SLEW_S, 0.0), 1.0)
    angle_rad = math.radians(ANGLE_DEG)
    turned_rad = angle_rad * (share - math.sin(2 * math.pi * share) / (2 * math.pi))
    return turned_rad, angle_rad / SLEW_S * (1 - math.cos(2 * math.pi * share))


def main() -> None:
    """Write the log to stdout."""
    print(
        "# made by make_slew.py: 20 degrees from rest to rest in 20 s; q_icrs_to_cam, rates of the"
        " camera in rad/s"
    )
    print("t_s,qw,qx,qy,qz,rx,ry,rz")
    for k in range(round((SLEW_S + 2 * REST_S) * SAMPLES_HZ) + 1):
        angle_rad, rate_rad_s = profile(k / SAMPLES_HZ)
        numbers = [
            *(f"{q:.12f}" for q in turned(angle_rad)),
            *(f"{rate_rad_s * c:.12f}" for c in AXIS_CAM),
        ]
        print(f"{k / SAMPLES_HZ:.1f},{','.join(numbers)}")


if __name__ == "__main__":
    main()
