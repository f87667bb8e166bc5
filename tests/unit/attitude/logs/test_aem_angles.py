"""AEM with Euler angles and spins, against SciPy's rotations: each sequence, both directions,
rates, both forms.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log, write_log
from hilstar.attitude.wire.source import Mounting
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import to_matrix
from tests.support.sources.aem_messages import (
    EPOCHS,
    angle_elements,
    elements,
    kvn,
    read,
    rows_of,
    xml_of,
)

# Angles are written with 17 digits; three turns of them are a few roundings of 1 rad.
MATRIX_TOLERANCE = 2e-14
# Rates of angles are central differences over 2 h = 2e-4 s: h^2 w^3 / 6 = 1e-8 here, more by the
# tangents of the angles.
H_S = 1e-4
RATE_TOLERANCE_RAD_S = 1e-6
RATE_CAM_RAD_S = np.array([0.3, -1.1, 0.7])
AXES = {"X": "1", "Y": "2", "Z": "3"}
SEQUENCES = [a + b + c for a in AXES for b in AXES for c in AXES if a != b != c]


def camera_turn_from(seconds=0.0, first=None):
    """Of cam's components into ICRS components."""
    return (first or Rotation.from_quat([0.1, -0.5, 0.7, 0.3])) * Rotation.from_rotvec(
        RATE_CAM_RAD_S * seconds
    )


def placed(frame_a, direction, rotation):
    """Of the file's first frame's components into the second's, and whether the second is the
    camera.
    """
    to_cam = (frame_a == "ICRF") == (direction == "A2B")
    return (rotation.inv() if to_cam else rotation), to_cam


def keywords(version, frame_a, direction, names, **more):
    other = "SC_BODY_1" if frame_a == "ICRF" else "ICRF"
    meta = {
        "REF_FRAME_A": frame_a,
        "REF_FRAME_B": other,
        "QUATERNION_TYPE": None,
        "EULER_ROT_SEQ": names,
    } | more
    return meta | ({"ATTITUDE_DIR": direction} if version == "1.0" else {})


def angles_deg(rotation, names):
    """Turns of the frame, one after another: SciPy's upper-case sequence of the rotation that
    carries the axes along.
    """
    return rotation.inv().as_euler(names, degrees=True)


CASES = [("1.0", "A2B"), ("1.0", "B2A"), ("2.0", "A2B")]


@pytest.mark.parametrize("names", SEQUENCES)
@pytest.mark.parametrize(("version", "direction"), CASES)
@pytest.mark.parametrize("frame_a", ["ICRF", "SC_BODY_1"])
def test_each_sequence_of_euler_angles_is_scipys(tmp_path, frame_a, version, direction, names):
    rng = np.random.default_rng(SEQUENCES.index(names))
    for first in Rotation.random(4, random_state=rng):
        rotation, _ = placed(frame_a, direction, camera_turn_from(0.0, first))
        written = "".join(AXES[name] for name in names) if version == "1.0" else names
        meta = keywords(version, frame_a, direction, written, ATTITUDE_TYPE="EULER_ANGLE")
        (sample,) = read(tmp_path, kvn(rows_of(angles_deg(rotation, names)), version, **meta))
        assert to_matrix(sample.q_icrs_to_cam) == pytest.approx(
            first.inv().as_matrix(), abs=MATRIX_TOLERANCE
        )
        assert sample.rate_cam_rad_s is None


@pytest.mark.parametrize("names", SEQUENCES)
@pytest.mark.parametrize("frame_a", ["ICRF", "SC_BODY_1"])
def test_the_angles_derivatives_give_the_rate_of_the_camera(tmp_path, frame_a, names):
    before, angles, after = (
        angles_deg(placed(frame_a, "A2B", camera_turn_from(s))[0], names) for s in (-H_S, 0.0, H_S)
    )
    turned = (after - before + 180.0) % 360.0 - 180.0
    row = np.concatenate([angles, turned / (2 * H_S)])
    meta = keywords("2.0", frame_a, "A2B", names, ATTITUDE_TYPE="EULER_ANGLE/DERIVATIVE")
    (sample,) = read(tmp_path, kvn(rows_of(row), "2.0", **meta))
    assert to_matrix(sample.q_icrs_to_cam) == pytest.approx(
        camera_turn_from().inv().as_matrix(), abs=MATRIX_TOLERANCE
    )
    assert sample.rate_cam_rad_s == pytest.approx(RATE_CAM_RAD_S, abs=RATE_TOLERANCE_RAD_S)


@pytest.mark.parametrize("resolved_in", ["ICRF", "SC_BODY_1"])
@pytest.mark.parametrize("frame_a", ["ICRF", "SC_BODY_1"])
def test_an_angular_velocity_beside_euler_angles_gives_the_rate_of_the_camera(
    tmp_path, frame_a, resolved_in
):
    rotation, to_cam = placed(frame_a, "A2B", camera_turn_from())
    rate = RATE_CAM_RAD_S if to_cam else -RATE_CAM_RAD_S
    if resolved_in == "ICRF":
        rate = camera_turn_from().apply(rate)
    row = np.concatenate([angles_deg(rotation, "ZYX"), np.degrees(rate)])
    meta = keywords(
        "2.0", frame_a, "A2B", "ZYX", ATTITUDE_TYPE="EULER_ANGLE/ANGVEL", ANGVEL_FRAME=resolved_in
    )
    (sample,) = read(tmp_path, kvn(rows_of(row), "2.0", **meta))
    assert sample.rate_cam_rad_s == pytest.approx(RATE_CAM_RAD_S, abs=MATRIX_TOLERANCE)


def test_rates_whose_meaning_the_file_does_not_state_are_not_used_and_a_notice_says_so(tmp_path):
    meta = keywords(
        "1.0", "ICRF", "A2B", "312", ATTITUDE_TYPE="EULER_ANGLE/RATE", RATE_FRAME="REF_FRAME_A"
    )
    (tmp_path / "log").write_text(
        kvn(rows_of([-26.78, 46.26, 144.10, 0.1045, 0.03214, 0.02156]), **meta)
    )
    log = open_log(tmp_path / "log")
    assert log.samples[0].rate_cam_rad_s is None
    assert "aem-rates" in [kind for kind, _ in log.told]


# Spins


class SpinningBody:
    """A body whose +z axis nutates about its angular momentum: turns ZXZ at constant rates from
    the momentum's frame.
    """

    precession_rad_s, nutation_rad, spin_rad_s = 0.4, 0.3, -1.5

    def __init__(self, rng):
        self.ra_deg, self.dec_deg = rng.uniform(0, 360), rng.uniform(-80, 80)
        self._base = Rotation.from_euler("ZY", [self.ra_deg, 90 - self.dec_deg], degrees=True)
        self._start = rng.uniform(0, 6, 2)

    def turn(self, seconds):
        """Of the body's components into ICRS components."""
        first, third = self._start + seconds * np.array([self.precession_rad_s, self.spin_rad_s])
        return self._base * Rotation.from_euler("ZXZ", [first, self.nutation_rad, third])

    def rate(self):
        return (self.turn(-H_S).inv() * self.turn(H_S)).as_rotvec() / (2 * H_S)

    def spin_deg(self):
        """Right ascension and declination of +z, and the angle of the turn about it."""
        node, tilt, angle = self.turn(0.0).as_euler("ZXZ", degrees=True)
        axis = self.turn(0.0).apply([0.0, 0.0, 1.0])
        alpha, delta = np.degrees([np.arctan2(axis[1], axis[0]), np.arcsin(axis[2])])
        assert (alpha + 90 - node) % 360 == pytest.approx(0, abs=1e-9) or (
            alpha + 90 - node
        ) % 360 == pytest.approx(360)
        assert 90 - delta == pytest.approx(tilt)
        return alpha, delta, angle

    @property
    def phase_deg(self):
        momentum = self.turn(0.0).inv().apply(self._base.apply([0.0, 0.0, 1.0]))
        return np.degrees(np.arctan2(-momentum[1], momentum[0]))


def spin_row(body, kind):
    head = [*body.spin_deg(), np.degrees(body.spin_rad_s)]
    if kind == "SPIN":
        return head
    nutation = [np.degrees(body.nutation_rad), 2 * np.pi / body.precession_rad_s, body.phase_deg]
    momentum = [body.ra_deg, body.dec_deg, np.degrees(body.precession_rad_s)]
    return head + (nutation if kind == "SPIN/NUTATION" else momentum)


@pytest.mark.parametrize("kind", ["SPIN", "SPIN/NUTATION", "SPIN/NUTATION_MOM"])
@pytest.mark.parametrize("frame_a", ["ICRF", "SC_BODY_1"])
def test_a_spin_is_that_of_a_nutating_body(tmp_path, frame_a, kind):
    for seed in range(4):
        body = SpinningBody(np.random.default_rng(seed))
        if kind == "SPIN":
            body.precession_rad_s = 0.0
        version, direction = (
            ("2.0", "A2B")
            if kind.endswith("MOM")
            else ("1.0", "A2B" if frame_a == "ICRF" else "B2A")
        )
        if version == "2.0" and frame_a != "ICRF":
            continue  # the second frame is then not the one that spins
        meta = keywords(version, frame_a, direction, None, ATTITUDE_TYPE=kind)
        rows = rows_of(spin_row(body, kind), spin_row(body, kind))  # 1.75 s, so 150 degrees, apart
        sample, _ = read(tmp_path, kvn(rows, version, **meta))
        assert to_matrix(sample.q_icrs_to_cam) == pytest.approx(
            body.turn(0.0).inv().as_matrix(), abs=MATRIX_TOLERANCE
        )
        assert sample.rate_cam_rad_s == pytest.approx(body.rate(), abs=RATE_TOLERANCE_RAD_S)


def test_a_spin_that_its_attitudes_tell_has_no_rate_of_its_own(tmp_path):
    # ST5's example of 504.0-B-1: -109.97 deg/s stated, while the spin angle turns by -89.94 deg/s.
    rows = rows_of([268.62511, 68.448486, 159.69509, -109.96528])
    rows += [
        rows[0].replace(EPOCHS[0], "2024-02-29T23:59:59.375").replace("159.69509", "148.45264")
    ]
    first, second = read(
        tmp_path, kvn(rows, **keywords("1.0", "ICRF", "A2B", None, ATTITUDE_TYPE="SPIN"))
    )
    assert first.rate_cam_rad_s is None
    assert second.rate_cam_rad_s is None


def test_a_spin_has_its_rates_where_one_step_alone_is_more_than_a_quarter_turn(tmp_path):
    """1.75 s and 0.25 s at -109.97 deg/s."""
    spin = [268.62511, 68.448486, 159.69509, -109.96528]
    rows = rows_of(spin, spin)
    rows.append(rows[1].replace(EPOCHS[1], "2024-03-01T00:00:01.25"))
    meta = keywords("1.0", "ICRF", "A2B", None, ATTITUDE_TYPE="SPIN")
    meta["STOP_TIME"] = "2024-03-01T00:00:02"
    for sample in read(tmp_path, kvn(rows, **meta)):
        assert np.linalg.norm(sample.rate_cam_rad_s) == pytest.approx(np.radians(109.96528))


# XML


SPIN_NAMES = ("SPIN_ALPHA", "SPIN_DELTA", "SPIN_ANGLE", "SPIN_ANGLE_VEL")
ANGLES = (10.0, 20.0, -30.0)
SPIN_VALUES = (10.0, 20.0, -30.0, 4.0)
XML_CASES = [
    (
        "1.0",
        "EULER_ANGLE",
        "313",
        "eulerAngle",
        ANGLES,
        f"<rotationAngles>{angle_elements('angle', 'ZXZ')}</rotationAngles>",
    ),
    (
        "1.0",
        "EULER_ANGLE/RATE",
        "321",
        "eulerAngleRate",
        (*ANGLES, 1.0, 2.0, 3.0),
        (
            f"<rotationAngles>{angle_elements('angle', 'ZYX')}</rotationAngles><rotationRates>{angle_elements('rate', 'ZYX')}</rotationRates>"
        ),
    ),
    ("1.0", "SPIN", None, "spin", SPIN_VALUES, elements(SPIN_NAMES, SPIN_VALUES)),
    (
        "1.0",
        "SPIN/NUTATION",
        None,
        "spinNutation",
        (*SPIN_VALUES, 5.0, 6.0, 7.0),
        elements(
            (*SPIN_NAMES, "NUTATION", "NUTATION_PER", "NUTATION_PHASE"),
            (*SPIN_VALUES, 5.0, 6.0, 7.0),
        ),
    ),
    (
        "2.0",
        "EULER_ANGLE",
        "ZXZ",
        "eulerAngle",
        ANGLES,
        elements(("ANGLE_1", "ANGLE_2", "ANGLE_3"), ANGLES),
    ),
    (
        "2.0",
        "EULER_ANGLE/DERIVATIVE",
        "XYZ",
        "eulerAngleDerivative",
        (*ANGLES, 1.0, 2.0, 3.0),
        elements(
            ("ANGLE_1", "ANGLE_2", "ANGLE_3", "ANGLE_1_DOT", "ANGLE_2_DOT", "ANGLE_3_DOT"),
            (*ANGLES, 1.0, 2.0, 3.0),
        ),
    ),
    (
        "2.0",
        "SPIN/NUTATION_MOM",
        None,
        "spinNutationMom",
        (*SPIN_VALUES, 5.0, 6.0, 7.0),
        elements(
            (*SPIN_NAMES, "MOMENTUM_ALPHA", "MOMENTUM_DELTA", "NUTATION_VEL"),
            (*SPIN_VALUES, 5.0, 6.0, 7.0),
        ),
    ),
]


@pytest.mark.parametrize(("version", "kind", "names", "element", "values", "inside"), XML_CASES)
def test_xml_and_kvn_of_angles_hold_the_same(
    tmp_path, version, kind, names, element, values, inside
):
    more = {"RATE_FRAME": "REF_FRAME_B"} if kind.endswith("/RATE") else {}
    text = kvn(
        rows_of(values),
        version,
        **keywords(version, "ICRF", "A2B", names, ATTITUDE_TYPE=kind, **more),
    )
    state = f"<{element}><EPOCH>{EPOCHS[0]}</EPOCH>{inside}</{element}>"
    (from_kvn,), (from_xml,) = read(tmp_path, text), read(tmp_path, xml_of(text, [state]))
    assert from_xml.t_ns == from_kvn.t_ns
    assert from_xml.q_icrs_to_cam.tolist() == from_kvn.q_icrs_to_cam.tolist()
    rates = [
        None if s.rate_cam_rad_s is None else s.rate_cam_rad_s.tolist()
        for s in (from_kvn, from_xml)
    ]
    assert rates[0] == rates[1]


# CCSDS 504.0-B-2: angles in degrees, rates in degrees a second, a period in seconds
UNITS = {
    "SPIN_ALPHA": "deg",
    "SPIN_DELTA": "deg",
    "SPIN_ANGLE": "deg",
    "SPIN_ANGLE_VEL": "deg/s",
    "NUTATION": "deg",
    "NUTATION_PER": "s",
    "NUTATION_PHASE": "deg",
    "MOMENTUM_ALPHA": "deg",
    "MOMENTUM_DELTA": "deg",
    "NUTATION_VEL": "deg/s",
    "ANGLE_1": "deg",
    "ANGLE_2": "deg",
    "ANGLE_3": "deg",
    "ANGLE_1_DOT": "deg/s",
    "ANGLE_2_DOT": "deg/s",
    "ANGLE_3_DOT": "deg/s",
}
OF_UNITS = [case for case in XML_CASES if case[1].startswith("SPIN") or case[0] == "2.0"]


@pytest.mark.parametrize(("version", "kind", "names", "element", "values", "inside"), OF_UNITS)
def test_each_number_in_xml_may_state_its_unit_and_no_other(
    tmp_path, version, kind, names, element, values, inside
):
    given = keywords(version, "ICRF", "A2B", names, ATTITUDE_TYPE=kind)
    text = kvn(rows_of(values), version, **given)

    def message(inside: str) -> str:
        epoch = f"<EPOCH>{EPOCHS[0]}</EPOCH>"
        return xml_of(text, [f"<{element}>{epoch}{inside}</{element}>"])

    stated = inside
    for name, unit in UNITS.items():
        stated = stated.replace(f"<{name}>", f'<{name} units="{unit}">')
    (plain,), (with_units,) = read(tmp_path, message(inside)), read(tmp_path, message(stated))
    assert with_units.q_icrs_to_cam.tolist() == plain.q_icrs_to_cam.tolist()
    for name, unit in UNITS.items():
        wrong = inside.replace(f"<{name}>", f'<{name} units="rad">')
        if wrong != inside:
            with pytest.raises(InputError, match=f"<{name}> in 'rad'; write {unit}\\)$"):
                read(tmp_path, message(wrong))


# Whose attitude it is, and whose time


@pytest.mark.parametrize(
    ("frame", "mounted"),
    [
        ("SC_BODY_1", True),
        ("GYRO_1", True),
        ("STARTRACKER_1", False),
        ("INSTRUMENT_A", False),
        ("CAM", False),
    ],
)
def test_the_mounting_is_of_a_body_and_not_of_a_camera(tmp_path, frame, mounted):
    (tmp_path / "log").write_text(kvn(rows_of([0, 0, 0, 1]), REF_FRAME_B=frame, TIME_SYSTEM="TAI"))
    log = open_log(tmp_path / "log", Stated(Mounting((0.6, 0.8, 0.0, 0.0))))
    assert log.conventions.of_body == mounted
    assert log.samples[0].q_icrs_to_cam.tolist() == (
        [0.6, 0.8, 0.0, 0.0] if mounted else [1.0, 0.0, 0.0, 0.0]
    )
    lines = log.conventions.lines(Mounting())
    assert f"turns components of ICRF into those of {frame}" in lines[0]
    assert lines[2] == "time: TAI, from 1970-01-01T00:00:00 TAI"


def test_what_is_written_of_a_log_keeps_its_scale_and_is_the_cameras(tmp_path):
    (tmp_path / "log").write_text(kvn(rows_of([0, 0, 0, 1]), TIME_SYSTEM="TDB"))
    log = open_log(tmp_path / "log")
    for name in ("a.aem", "a.xml"):
        write_log(tmp_path / name, log.samples, log.conventions.scale)
        again = open_log(tmp_path / name, Stated(Mounting((0.6, 0.8, 0.0, 0.0))))
        assert again.conventions.scale == "TDB"
        assert [s.q_icrs_to_cam.tolist() for s in again.samples] == [
            s.q_icrs_to_cam.tolist() for s in log.samples
        ]
