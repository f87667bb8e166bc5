"""One block of an AEM's data as KVN or XML gives it, and the keywords that it requires."""

from __future__ import annotations

from dataclasses import dataclass

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.aem.keywords import VERSION_KEY, AemFaultError

QUATERNION, DERIVATIVE, RATE, ANGVEL = "QUATERNION", "QUATERNION/DERIVATIVE", "QUATERNION/RATE", "QUATERNION/ANGVEL"
COMPONENTS = {QUATERNION: 4, DERIVATIVE: 8, RATE: 7, ANGVEL: 7}
# For each version and type: the state's element in the library's tree, and the part of it besides the quaternion.
ELEMENTS = {
    "1.0": {
        QUATERNION: ("quaternion_state", ""),
        DERIVATIVE: ("quaternion_derivative", "quaternion_rate"),
        RATE: ("quaternion_euler_rate", "rotation_rates"),
    },
    "2.0": {
        QUATERNION: ("quaternion_ephemeris", ""),
        DERIVATIVE: ("quaternion_derivative", "quaternion_dot"),
        ANGVEL: ("quaternion_ang_vel", "ang_vel"),
    },
}


@dataclass(frozen=True, slots=True)
class Block:
    """One block of data: its keywords; for each state its place and epoch; and `values` (n, 4, 7 or 8), scalar first."""

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
