"""The keywords of an AEM by section: those of CCSDS 504.0-B-1 and 504.0-B-2 together.

An unknown keyword is refused: ignoring QUATERNION_TYP would show the file with another orientation.
"""

from __future__ import annotations

import difflib

VERSION_KEY = "CCSDS_AEM_VERS"
HEADER = (VERSION_KEY, "CLASSIFICATION", "CREATION_DATE", "ORIGINATOR", "MESSAGE_ID")
METADATA = (
    *("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME_A", "REF_FRAME_B", "ATTITUDE_DIR", "TIME_SYSTEM"),
    *("START_TIME", "USEABLE_START_TIME", "USEABLE_STOP_TIME", "STOP_TIME", "ATTITUDE_TYPE", "QUATERNION_TYPE"),
    *("EULER_ROT_SEQ", "RATE_FRAME", "ANGVEL_FRAME", "INTERPOLATION_METHOD", "INTERPOLATION_DEGREE"),
)
SECTIONS = {"header": HEADER, "metadata": METADATA}


class AemFaultError(Exception):
    """What is wrong in an AEM, and where: a line (":12"), an epoch (", 2024-01-01T00:00:00") or nowhere in particular."""

    def __init__(self, where: str, detail: str) -> None:
        super().__init__(detail)
        self.where = where


def fault_of(key: str, section: str) -> str | None:
    """Why a keyword (other than COMMENT) may not stand in the "header" or "metadata", and what to write; None where it may."""
    if key in SECTIONS[section]:
        return None
    other = "metadata" if section == "header" else "header"
    if key in SECTIONS[other]:
        return f"{key} is in the {section}; it belongs in the {other}"
    near = difflib.get_close_matches(key.upper()[:40], SECTIONS[section], n=1)
    advice = f"did you mean {near[0]}?" if near else f"the keywords are {', '.join(SECTIONS[section])}"
    return f"{key[:40]} is not a keyword of an AEM's {section}; {advice}"
