"""Where methods fail with directions and attitudes: poles, the wrap of right ascension, field
edges, quaternions.

Attitudes: two signs of one quaternion, half turns, fast turns, NaN and infinity.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, decode, encode
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import (
    angle_between_rad,
    direction_of,
    from_radec_roll_deg,
    propagate,
    slerp,
    to_matrix,
    to_radec_roll_deg,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.display.geometry import monitor_camera
from hilstar.instruments.study.stability import CaseFigures, FailureCase
from hilstar.optics.camera import Camera
from hilstar.optics.sprites import pack_sprites
from hilstar.sky.catalog import HIPPARCOS_EPOCH_JYEAR, load_catalog
from hilstar.sky.stars import RAD_PER_MAS, cell_grid, unit_vectors_icrs

# float64 knows a direction to 2e-16 rad, 5e-8 mas: 200 times that for the few operations on it.
DIRECTION_MAS = 1e-5
# Turning by 2e-16 rad moves a place by that times f / cos^2: 1.7 px * 3.3e5 * 2e-16 = 1e-10 px at
# 89.9 degrees. Times 100.
EDGE_PX = 1e-8
NONE_LOST = 0.0
ALIGNED = np.array([1.0, 0.0, 0.0, 0.0])
# The demo's lens and pitch (configs/demo.toml), and about the field angle of its monitor's corner,
# which weak perspective is judged at; README.md promises centroids to 1.1e-5 px.
FOCAL_LENGTH_MM, PITCH_UM = 350.0, 57.65
CORNER_DEG = 10.0
CENTROID_PX = 1.1e-5
START = from_radec_roll_deg(84.057, -1.2, 30.0)
AXIS = np.array([0.36, -0.48, 0.8])
PERIOD_S = 0.1
FRACTIONS = np.linspace(0.05, 0.95, 19)
# float64 knows an angle to 2e-16 rad, 5e-11 arcsec; times 200 for the some twenty operations from
# rate to attitude.
ANGLE_ARCSEC = 1e-8
NONE_TAKEN = 0.0
POLICY = Policy(max_extrapolation_ns=NS_PER_S, stale_after_ns=NS_PER_S)
TURNS_DEG = (170.0, 179.999, 180.001, 190.0, 270.0, 350.0)


Between = Callable[[FloatArray, FloatArray, float], FloatArray]


def motion_at_pole() -> FailureCase:
    """Proper motion a thousandth of a degree from the pole."""
    catalog = load_catalog().brighter_than(-1.0)  # Sirius alone, whose numbers are then replaced
    n, years = len(catalog), 34.75
    at_pole = replace(
        catalog,
        ra_deg=np.full(n, 359.9999),
        dec_deg=np.full(n, 89.999),
        pm_ra_cosdec_mas_yr=np.full(n, 100.0),
        pm_dec_mas_yr=np.full(n, 50.0),
    )
    moved = unit_vectors_icrs(at_pole, HIPPARCOS_EPOCH_JYEAR + years)[0]
    turn_deg = 100.0 * years * RAD_PER_MAS / np.radians(1.0)
    dec_deg = 89.999 + turn_deg / 2
    wrong = [
        direction_of(359.9999 + turn_deg / cosine, dec_deg)
        for cosine in (1.0, np.cos(np.radians(89.999)))
    ]
    exact = _great_circle(359.9999, 89.999, np.array([100.0, 50.0]) * years * RAD_PER_MAS)
    error, *faults = (_apart_rad(v, exact) / RAD_PER_MAS for v in (moved, *wrong))
    return FailureCase(
        "proper motion at declination 89.999",
        "RA + pm t, as eq. 2.1; with pm / cos(dec)",
        f"{faults[0]:.0f} mas off after {years:g} years; {faults[1]:.2g} mas",
        f"{error:.1e} mas off a great circle",
        "space motion on unit vectors: nothing divides by cos(dec)",
        CaseFigures(error, min(faults), DIRECTION_MAS),
    )


def _great_circle(ra_deg: float, dec_deg: float, path_rad: FloatArray) -> FloatArray:
    """Where a straight path in space ends, seen at `path_rad` (east, north), by angles along a
    great circle.
    """
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    length = float(np.hypot(*path_rad))
    along = (path_rad[0] * east + path_rad[1] * north) / length
    angle = np.arctan(length)
    return np.asarray(np.cos(angle) * direction_of(ra_deg, dec_deg) + np.sin(angle) * along)


def _apart_rad(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(np.cross(a, b)))


def fields_over_wrap_and_pole() -> FailureCase:
    """Fields of 10 degrees on the RA wrap and about the pole."""
    catalog = load_catalog().brighter_than(7.5)
    vectors = unit_vectors_icrs(catalog, HIPPARCOS_EPOCH_JYEAR)
    grid, radius = cell_grid(vectors), 10.0
    lost, box_lost, seen = 0, 0, 0
    for ra_deg, dec_deg in ((0.01, 0.0), (359.99, -45.0), (200.0, 89.0), (20.0, -90.0)):
        axis = direction_of(ra_deg, dec_deg)
        inside = np.flatnonzero(vectors @ axis >= np.cos(np.radians(radius)))
        box = (np.abs(catalog.ra_deg - ra_deg) <= radius) & (
            np.abs(catalog.dec_deg - dec_deg) <= radius
        )
        lost += len(np.setdiff1d(inside, grid.order[grid.near(axis, np.radians(radius))]))
        box_lost, seen = box_lost + int((~box[inside]).sum()), seen + len(inside)
    return FailureCase(
        "fields over RA = 0 and over the poles",
        "stars chosen by a box in RA and declination",
        f"{box_lost} of {seen} stars within {radius:.0f} degrees lost",
        f"{lost} lost",
        "cells of the sphere are chosen by the angle between unit vectors",
        CaseFigures(float(lost), float(box_lost), NONE_LOST),
    )


def stars_behind() -> FailureCase:
    """Half of the sky lies behind the camera."""
    camera, vectors = (
        _camera(70.0),
        unit_vectors_icrs(load_catalog().brighter_than(7.5), HIPPARCOS_EPOCH_JYEAR),
    )
    behind = vectors[vectors[:, 2] <= 0]
    ghosts = _on_image(
        behind[:, :2] / behind[:, 2:] * camera.focal_length_px + camera.principal_point_px, camera
    )
    ours = _on_image(np.column_stack(camera.project(behind)), camera)
    return FailureCase(
        "stars behind the camera",
        "x = f X / Z for every star",
        f"{ghosts} of {len(behind)} stars behind are drawn, mirrored",
        f"{ours} drawn",
        "only stars with Z > 0 are projected",
        CaseFigures(float(ours), float(ghosts), NONE_LOST),
    )


def _camera(half_field_deg: float) -> Camera:
    """A camera of 2001 x 2001 px with `half_field_deg` from the middle to the edge."""
    focal_length_mm = 1000.0 / np.tan(np.radians(half_field_deg)) * 1e-3
    return monitor_camera((2001, 2001), 1.0, focal_length_mm, ALIGNED)


def _on_image(places_px: FloatArray, camera: Camera) -> int:
    flux, star = np.ones(len(places_px)), np.arange(len(places_px), dtype=np.intp)
    return len(pack_sprites(places_px[:, 0], places_px[:, 1], flux, star, camera.resolution_px, 1))


def field_of_180_deg() -> FailureCase:
    """A field that grows to 180 degrees."""
    error, fault, spread = 0.0, 0.0, 0.0
    for half_deg in (60.0, 85.0, 89.0, 89.9):
        camera = _camera(half_deg)
        angle = np.radians(np.linspace(0.0, half_deg, 1000))
        vectors = np.column_stack([np.sin(angle), np.zeros(1000), np.cos(angle)])
        exact = camera.focal_length_px * np.tan(angle) + 1000.0
        error = max(error, float(np.abs(camera.project(vectors)[0] - exact).max()))
        fault = max(
            fault,
            float(
                np.abs(
                    camera.project(vectors.astype(np.float32).astype(np.float64))[0] - exact
                ).max()
            ),
        )
        spread = 1 / np.cos(angle[-1]) ** 2
    return FailureCase(
        "a field of 179.8 degrees",
        "float32 directions",
        f"{fault:.2g} px off at its edge, of 1000",
        f"{error:.1e} px off; but a degree at the edge is {spread:.2g} times as long as one in the"
        " middle",
        "float64; the perspective itself diverges at 180 degrees, as a flat monitor does",
        CaseFigures(error, fault, EDGE_PX),
    )


def boresight_at_pole() -> FailureCase:
    """A boresight a millionth of a degree from the pole, read back from its quaternion."""
    wanted_deg = 90.0 - 1e-6
    q = from_radec_roll_deg(123.0, wanted_deg, 10.0)
    naive_deg = float(np.degrees(np.arcsin(np.clip(to_matrix(q)[2, 2], -1, 1))))
    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(q)
    error, fault = (abs(d - wanted_deg) * 3.6e6 for d in (dec_deg, naive_deg))
    return FailureCase(
        "a boresight at declination 89.999999",
        "declination by arcsin",
        f"{fault:.2g} mas off",
        f"{error:.1g} mas off; RA {ra_deg:.6f} of 123 and roll {roll_deg:.6f} of 10 degrees",
        "arctan2 of all three components",
        CaseFigures(error, fault, DIRECTION_MAS),
    )


def weak_perspective_px(angle_rad: FloatArray, focal_length_px: float) -> FloatArray:
    """Distances from the axis, px, with one depth Z0 = 1 for every star: x = f X / Z0 (what eq.
    4.3 and 4.4 mean).
    """
    return np.asarray(focal_length_px * np.sin(angle_rad))


def weak_perspective_error(angle_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The error of weak perspective at field angles (n,), with the demo's lens and monitor: px
    and arcsec.
    """
    angle = np.radians(angle_deg)
    focal_length_px = FOCAL_LENGTH_MM * 1e3 / PITCH_UM
    off_px = weak_perspective_px(angle, focal_length_px) - focal_length_px * np.tan(angle)
    # The tracker takes the monitor for a plane, so it sees the star where that place's tangent is.
    return off_px, (np.arctan(np.sin(angle)) - angle) * ARCSEC_PER_RAD


def weak_perspective() -> FailureCase:
    """One depth for every star, against the field angle."""
    angles = np.array([1.0, 5.0, CORNER_DEG])
    off_px, off_arcsec = weak_perspective_error(angles)
    camera = monitor_camera((4001, 4001), PITCH_UM, FOCAL_LENGTH_MM, ALIGNED)
    angle = np.radians(angles)
    x_px, _ = camera.project(np.column_stack([np.sin(angle), np.zeros(3), np.cos(angle)]))
    error = float(np.abs(x_px - 2000.0 - camera.focal_length_px * np.tan(angle)).max())
    fails = ", ".join(
        f"{a:g} deg: {px:.2g} px, {s:.3g} arcsec"
        for a, px, s in zip(angles, off_px, off_arcsec, strict=True)
    )
    return FailureCase(
        "field angle, one depth for all",
        "weak perspective, x = f X / Z0",
        fails,
        f"{error:.1e} px off at most",
        "each star's own Z; eq. 4.3 and 4.4 divide by it too, and so are not a weak perspective",
        CaseFigures(error, float(np.abs(off_px).max()), CENTROID_PX),
    )


def arccos_slerp(a: FloatArray, b: FloatArray, fraction: float) -> FloatArray:
    """SLERP as it stands in the books: the angle by arccos, no look at the sign."""
    angle = np.arccos(np.clip(np.dot(a, b), -1, 1))
    return np.asarray(
        (np.sin((1 - fraction) * angle) * a + np.sin(fraction * angle) * b) / np.sin(angle)
    )


def straight_line(a: FloatArray, b: FloatArray, fraction: float) -> FloatArray:
    """The normalised straight line from `a` to `b`, by the shorter way."""
    mean = (1 - fraction) * a + fraction * (b if np.dot(a, b) >= 0 else -b)
    return np.asarray(mean / np.linalg.norm(mean))


def turned(turn_deg: float, fraction: float = 1.0) -> FloatArray:
    """START after a part of a turn about AXIS."""
    return propagate(START, np.radians(turn_deg) * fraction * AXIS, 1.0)


def way_error_arcsec(between: Between, sign: float, turn_deg: float) -> float:
    """The largest error of `between` (`slerp`, or one that fails) on a turn whose end has this
    sign, arcsec; NaN if any is.
    """
    with np.errstate(invalid="ignore"):
        ways = [between(START, sign * turned(turn_deg), float(f)) for f in FRACTIONS]
    errors = [
        angle_between_rad(q, turned(turn_deg, f)) for q, f in zip(ways, FRACTIONS, strict=True)
    ]
    return float(np.max(errors) * ARCSEC_PER_RAD)


def two_signs() -> FailureCase:
    """A sender that writes -q for the next sample, one degree on."""
    error, fault = (way_error_arcsec(between, -1.0, 1.0) for between in (slerp, arccos_slerp))
    return FailureCase(
        "q, then -q one degree on",
        "SLERP from one to the other as they are",
        f"goes round the long way: {fault / 3600:.0f} degrees off",
        f"{error:.0e} arcsec off",
        "q and -q are one attitude: the nearer of them is taken",
        CaseFigures(error, fault, ANGLE_ARCSEC),
    )


def antipodal() -> FailureCase:
    """The same attitude twice, with either sign."""
    error, fault = (
        float(np.max([way_error_arcsec(between, sign, 0.0) for sign in (1.0, -1.0)]))
        for between in (slerp, arccos_slerp)
    )
    return FailureCase(
        "SLERP from q to q and to -q",
        "SLERP by arccos",
        f"{fault:.0f}: sin(angle) is 0",
        f"{error:.0e} arcsec off",
        "the angle comes from both chords, and a small one is a straight line",
        CaseFigures(error, fault, ANGLE_ARCSEC),
    )


def half_turn() -> FailureCase:
    """Samples nearly half a turn apart."""
    error, fault = (way_error_arcsec(between, 1.0, 179.999) for between in (slerp, straight_line))
    return FailureCase(
        "SLERP over 179.999 degrees",
        "the normalised straight line",
        f"up to {fault / 3600:.1f} degrees off, and still on the great circle",
        f"{error:.0e} arcsec off",
        "SLERP turns at a constant rate, right up to the half turn where two ways are equally"
        " short",
        CaseFigures(error, fault, ANGLE_ARCSEC),
    )


def sampled_error_arcsec(turn_deg: float, with_rates: bool) -> float:
    """The largest error of a timeline between samples that are `turn_deg` of a steady turn
    apart, arcsec.
    """
    rate = np.radians(turn_deg) / PERIOD_S * AXIS if with_rates else None
    timeline = Timeline(POLICY)
    for k in range(3):
        timeline.add(AttitudeSample(round(k * PERIOD_S * NS_PER_S), turned(turn_deg, k), rate))
    worst = 0.0
    for fraction in FRACTIONS:
        t_ns = round((1 + fraction) * PERIOD_S * NS_PER_S)
        attitude = timeline.at(t_ns)
        if attitude is None:
            raise AssertionError("a timeline with samples has an attitude")
        worst = max(
            worst,
            angle_between_rad(attitude.q_icrs_to_cam, turned(turn_deg, t_ns / NS_PER_S / PERIOD_S)),
        )
    return worst * ARCSEC_PER_RAD


def fast_turns() -> FailureCase:
    """Turns of about pi, and more, from sample to sample."""
    error, fault = (
        max(sampled_error_arcsec(turn, rates) for turn in TURNS_DEG) for rates in (True, False)
    )
    just_under, just_over = (sampled_error_arcsec(turn, False) / 3600 for turn in TURNS_DEG[1:3])
    return FailureCase(
        f"{TURNS_DEG[0]:g} to {TURNS_DEG[-1]:g} degrees from sample to sample",
        "samples without rates",
        f"{just_under:.0e} degrees off at {TURNS_DEG[1]:g}, {just_over:.0f} at {TURNS_DEG[2]:g}:"
        " the other way is shorter",
        f"with rates: {error:.0e} arcsec off",
        "the rates say which way, and how often round; send them, or more than two samples a turn",
        CaseFigures(error, fault, ANGLE_ARCSEC),
    )


def norm_alone(q: tuple[float, ...]) -> bool:
    """Whether a quaternion passes that is refused where abs(norm - 1) is too large: NaN is never
    larger.
    """
    return not abs(math.sqrt(sum(c * c for c in q)) - 1.0) > NORM_TOLERANCE


def not_a_number() -> FailureCase:
    """NaN and infinity in each number of a packet and of JSON."""
    taken, passed, sent = 0, 0, 0
    for place, value in product(range(7), (math.nan, math.inf, -math.inf)):
        numbers = [*START, 0.0, 0.0, 0.0]
        numbers[place] = value
        text = json.dumps({"t_ns": 1, "q": list(numbers[:4]), "rate": numbers[4:]})
        for message in (
            encode(AttitudeSample(1, np.array(numbers[:4]), np.array(numbers[4:]))),
            text.encode(),
        ):
            taken += not isinstance(decode(message), Refusal)
            passed += norm_alone(tuple(numbers[:4]))
            sent += 1
    return FailureCase(
        "NaN or infinity in an attitude",
        "a check of abs(norm - 1) > 1e-3 alone",
        f"{passed} of {sent} pass: NaN is not larger, and a rate has no norm to check",
        f"{taken} taken",
        "every number has to be finite before anything is computed from it",
        CaseFigures(float(taken), float(passed), NONE_TAKEN),
    )


def weak_perspectives() -> dict[str, FloatArray]:
    """What one depth for every star costs against the field angle."""
    angle_deg = np.geomspace(0.1, 60.0, 200)
    off_px, off_arcsec = weak_perspective_error(angle_deg)
    return {"field_angle_deg": angle_deg, "error_px": off_px, "error_arcsec": off_arcsec}


def turns() -> dict[str, FloatArray]:
    """Interpolation against the turn from one sample to the next."""
    turn_deg = np.concatenate(
        [np.linspace(5, 175, 35), [178.0, 179.9, 180.1, 182.0], np.linspace(185, 355, 35)]
    )
    curves = {
        "straight line, normalised": [
            way_error_arcsec(straight_line, 1.0, float(t)) for t in turn_deg
        ],
        "SLERP (samples without rates)": [sampled_error_arcsec(float(t), False) for t in turn_deg],
        "samples with rates": [sampled_error_arcsec(float(t), True) for t in turn_deg],
    }
    return {"turn_deg": turn_deg} | {
        f"{name} [arcsec]": np.array(errors) for name, errors in curves.items()
    }
