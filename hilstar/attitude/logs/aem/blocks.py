"""One block of an AEM's data as KVN or XML gives it, and its keywords: those of CCSDS 504.0-B-1 (AEM 1.0) and B-2 (2.0).

An unknown keyword is refused, and so is one of the other version: ignoring QUATERNION_TYP, or QUATERNION_TYPE in a file of
version 2.0, would show the file with another orientation than its writer meant.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from hilstar.arrays import FloatArray

VERSION_KEY = "CCSDS_AEM_VERS"
HEADER = (VERSION_KEY, "CLASSIFICATION", "CREATION_DATE", "ORIGINATOR", "MESSAGE_ID")
METADATA = (
    *("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME_A", "REF_FRAME_B", "ATTITUDE_DIR", "TIME_SYSTEM"),
    *("START_TIME", "USEABLE_START_TIME", "USEABLE_STOP_TIME", "STOP_TIME", "ATTITUDE_TYPE", "QUATERNION_TYPE"),
    *("EULER_ROT_SEQ", "RATE_FRAME", "ANGVEL_FRAME", "INTERPOLATION_METHOD", "INTERPOLATION_DEGREE"),
)
SECTIONS = {"header": HEADER, "metadata": METADATA}
# Keywords that one version alone has (504.0-B-2 annex J), and what the other has in their place.
ONLY_IN = {
    "ATTITUDE_DIR": ("1.0", "2.0 always turns from REF_FRAME_A to REF_FRAME_B"),
    "QUATERNION_TYPE": ("1.0", "2.0 always has the scalar last"),
    "RATE_FRAME": ("1.0", "2.0 has ANGVEL_FRAME"),
    "ANGVEL_FRAME": ("2.0", "1.0 has RATE_FRAME"),
}

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
TYPES = {
    "1.0": (QUATERNION, DERIVATIVE, RATE, EULER, EULER_RATE, SPIN, SPIN_NUTATION),
    "2.0": (
        *(QUATERNION, DERIVATIVE, ANGVEL, EULER, EULER_DERIVATIVE, EULER_ANGVEL),
        *(SPIN, SPIN_NUTATION, SPIN_NUTATION_MOM),
    ),
}


class AemFaultError(Exception):
    """What is wrong in an AEM, and where: a line (":12"), an epoch (", 2024-01-01T00:00:00") or nowhere in particular."""

    def __init__(self, where: str, detail: str) -> None:
        super().__init__(detail)
        self.where = where


@dataclass(frozen=True, slots=True)
class Block:
    """One block of data: its keywords; for each state its place and epoch; and `values` (n, COMPONENTS), scalar first."""

    meta: dict[str, str]
    where: list[str]
    epochs: list[str]
    values: FloatArray


def fault_of(key: str, section: str, version: str) -> str | None:
    """Why a keyword (other than COMMENT) may not stand in the "header" or "metadata", and what to write; None where it may."""
    if key in SECTIONS[section]:
        own, instead = ONLY_IN.get(key, (version, ""))
        if own == version or version not in TYPES:
            return None
        return f"{key} is of AEM {own}, and {VERSION_KEY} is {version}; {instead}: delete it, or write {VERSION_KEY} = {own}"
    other = "metadata" if section == "header" else "header"
    if key in SECTIONS[other]:
        return f"{key} is in the {section}; it belongs in the {other}"
    near = difflib.get_close_matches(key.upper()[:40], SECTIONS[section], n=1)
    advice = f"did you mean {near[0]}?" if near else f"the keywords are {', '.join(SECTIONS[section])}"
    return f"{key[:40]} is not a keyword of an AEM's {section}; {advice}"


def check_version(version: str) -> None:
    """Raises AemFaultError for a version that is not read."""
    if version not in TYPES:
        raise AemFaultError("", f"{VERSION_KEY} is {version[:40]}; write 1.0 or 2.0")


def check_metadata(meta: dict[str, str], where: str) -> None:
    """Raises AemFaultError for a version or type that is not supported, or a missing keyword."""
    version = meta.get(VERSION_KEY, "missing")
    check_version(version)
    for key in ("REF_FRAME_A", "REF_FRAME_B", "TIME_SYSTEM", "ATTITUDE_TYPE"):
        if key not in meta:
            raise AemFaultError(where, f"{key} is missing in the metadata of a block")
    order = meta.get("QUATERNION_TYPE", "LAST")
    if order not in {"FIRST", "LAST"}:
        raise AemFaultError(where, f"QUATERNION_TYPE is {order[:40]}; write FIRST or LAST, where the scalar is")
    if meta["ATTITUDE_TYPE"] not in TYPES[version]:
        types = ", ".join(TYPES[version])
        raise AemFaultError(
            where, f"ATTITUDE_TYPE = {meta['ATTITUDE_TYPE'][:40]} of AEM {version} is not read; write one of {types}"
        )


def plain(value: str) -> str:
    """A text value normalised for comparison: 504.0-B-2 6.8 ignores case, and treats blanks as underscores."""
    return "_".join(value.upper().replace("_", " ").split())
