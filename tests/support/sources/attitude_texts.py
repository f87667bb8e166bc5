"""Attitude files as the tools around VTS and STK write them."""

from __future__ import annotations

from collections.abc import Sequence

CIC_META = {
    "OBJECT_NAME": "SAT",
    "OBJECT_ID": "SAT",
    "REF_FRAME_A": "EME2000",
    "REF_FRAME_B": "SC_BODY_1",
    "ATTITUDE_DIR": "A2B",
    "TIME_SYSTEM": "UTC",
    "ATTITUDE_TYPE": "QUATERNION",
}
STK_KEYWORDS = {
    "ScenarioEpoch": "1 Jan 2025 00:00:00.000",
    "CentralBody": "Earth",
    "CoordinateAxes": "J2000",
}


def cic_text(rows: Sequence[str], comment: str = "", **meta: str | None) -> str:
    """A CIC AEM of these rows; `meta` changes keywords, and None leaves one out."""
    lines = [
        "CIC_AEM_VERS = 1.0",
        "CREATION_DATE = 2024-01-01T00:00:00",
        "ORIGINATOR = TEST",
        "",
        "META_START",
        "",
    ]
    lines += [f"COMMENT {comment}"] if comment else []
    lines += [f"{key} = {value}" for key, value in (CIC_META | meta).items() if value is not None]
    return "\n".join([*lines, "", "META_STOP", "", *rows, ""])


def stk_text(
    rows: Sequence[str],
    form: str = "AttitudeTimeQuaternions",
    end: str = "END Attitude",
    **keywords: str | None,
) -> str:
    """An attitude file of STK of these rows; `keywords` changes those of its head, and None
    leaves one out.
    """
    lines = [
        "stk.v.11.0",
        "# made by a test",
        "BEGIN Attitude",
        f"NumberOfAttitudePoints {len(rows)}",
    ]
    lines += [
        f"{key} {value}" for key, value in (STK_KEYWORDS | keywords).items() if value is not None
    ]
    return "\n".join([*lines, form, *rows, end, ""])
