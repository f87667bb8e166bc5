"""One block of an AEM's data as KVN or XML gives it, and the keywords that it requires."""

from __future__ import annotations

from dataclasses import dataclass

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.aem.keywords import VERSION_KEY, AemFaultError

QUATERNION, DERIVATIVE, RATE, ANGVEL = "QUATERNION", "QUATERNION/DERIVATIVE", "QUATERNION/RATE", "QUATERNION/ANGVEL"
EULER, EULER_RATE = "EULER_ANGLE", "EULER_ANGLE/RATE"
EULER_DERIVATIVE, EULER_ANGVEL = "EULER_ANGLE/DERIVATIVE", "EULER_ANGLE/ANGVEL"
SPIN, SPIN_NUTATION, SPIN_NUTATION_MOM = "SPIN", "SPIN/NUTATION", "SPIN/NUTATION_MOM"
QUATERNIONS = frozenset({QUATERNION, DERIVATIVE, RATE, ANGVEL})
SPINS = frozenset({SPIN, SPIN_NUTATION, SPIN_NUTATION_MOM})
COMPONENTS = {
    **{QUATERNION: 4, DERIVATIVE: 8, RATE: 7, ANGVEL: 7},
    **{EULER: 3, EULER_RATE: 6, EULER_DERIVATIVE: 6, EULER_ANGVEL: 6},
    **{SPIN: 4, SPIN_NUTATION: 7, SPIN_NUTATION_MOM: 7},
}
SPIN_PARTS = "spin_alpha spin_delta spin_angle spin_angle_vel"
NUTATION_PARTS = f"{SPIN_PARTS} nutation nutation_per nutation_phase"
# For each version and type: the state's element in the library's tree, and the parts of it besides the quaternion.
ELEMENTS = {
    "1.0": {
        QUATERNION: ("quaternion_state", ""),
        DERIVATIVE: ("quaternion_derivative", "quaternion_rate"),
        RATE: ("quaternion_euler_rate", "rotation_rates"),
        EULER: ("euler_angle", "rotation_angles"),
        EULER_RATE: ("euler_angle_rate", "rotation_angles rotation_rates"),
        SPIN: ("spin", SPIN_PARTS),
        SPIN_NUTATION: ("spin_nutation", NUTATION_PARTS),
    },
    "2.0": {
        QUATERNION: ("quaternion_ephemeris", ""),
        DERIVATIVE: ("quaternion_derivative", "quaternion_dot"),
        ANGVEL: ("quaternion_ang_vel", "ang_vel"),
        EULER: ("euler_angle", "angle_1 angle_2 angle_3"),
        EULER_DERIVATIVE: ("euler_angle_derivative", "angle_1 angle_2 angle_3 angle_1_dot angle_2_dot angle_3_dot"),
        EULER_ANGVEL: ("euler_angle_ang_vel", "angle_1 angle_2 angle_3 angvel_x angvel_y angvel_z"),
        SPIN: ("spin", SPIN_PARTS),
        SPIN_NUTATION: ("spin_nutation", NUTATION_PARTS),
        SPIN_NUTATION_MOM: ("spin_nutation_mom", f"{SPIN_PARTS} momentum_alpha momentum_delta nutation_vel"),
    },
}


@dataclass(frozen=True, slots=True)
class Block:
    """One block of data: its keywords; for each state its place and epoch; and `values` (n, COMPONENTS), scalar first."""

    meta: dict[str, str]
    where: list[str]
    epochs: list[str]
    values: FloatArray


def check_metadata(meta: dict[str, str], where: str) -> None:
    """Raises AemFaultError for a version or type that is not supported, or a missing keyword."""
    version = meta.get(VERSION_KEY, "missing")
    if version not in ELEMENTS:
        raise AemFaultError("", f"{VERSION_KEY} is {version}; write 1.0 or 2.0")
    for key in ("REF_FRAME_A", "REF_FRAME_B", "TIME_SYSTEM", "ATTITUDE_TYPE"):
        if key not in meta:
            raise AemFaultError(where, f"{key} is missing in the metadata of a block")
    if meta["ATTITUDE_TYPE"] not in ELEMENTS[version]:
        types = ", ".join(ELEMENTS[version])
        raise AemFaultError(
            where, f"ATTITUDE_TYPE = {meta['ATTITUDE_TYPE']} of AEM {version} is not read; write one of {types}"
        )


def plain(value: str) -> str:
    """A text value normalised for comparison: 504.0-B-2 6.8 ignores case, and treats blanks as underscores."""
    return "_".join(value.upper().replace("_", " ").split())
