"""Attitude Ephemeris Messages in KVN, made for tests, and how they are read or refused."""

from __future__ import annotations

import numpy as np

from hilstar.attitude.logs.log_file import read_log
from tests.support.refusals import refusal

EPOCHS = ("2024-02-29T23:59:59.25", "2024-03-01T00:00:01")


def kvn(rows, version="1.0", **keywords):
    """A message of one block; a keyword that is None is omitted."""
    meta = {"OBJECT_NAME": "X", "OBJECT_ID": "X", "REF_FRAME_A": "ICRF", "REF_FRAME_B": "SC_BODY_1"}
    if version == "1.0":
        meta |= {"ATTITUDE_DIR": "A2B", "QUATERNION_TYPE": "LAST"}
    meta |= {
        "TIME_SYSTEM": "UTC",
        "START_TIME": EPOCHS[0],
        "STOP_TIME": EPOCHS[1],
        "ATTITUDE_TYPE": "QUATERNION",
    } | keywords
    lines = [f"CCSDS_AEM_VERS = {version}", "CREATION_DATE = 2024-01-01T00:00:00", "ORIGINATOR = X"]
    lines += [
        "META_START",
        *(f"{key} = {value}" for key, value in meta.items() if value is not None),
        "META_STOP",
    ]
    return "\n".join([*lines, "DATA_START", *rows, "DATA_STOP"]) + "\n"


def rows_of(*numbers):
    return [
        " ".join([epoch, *map(repr, np.asarray(row, dtype=float).tolist())])
        for epoch, row in zip(EPOCHS, numbers, strict=False)
    ]


def read(tmp_path, text):
    (tmp_path / "log").write_text(text)
    return read_log(tmp_path / "log")


def aem_refusal(tmp_path, text):
    return refusal(read, tmp_path, text)
