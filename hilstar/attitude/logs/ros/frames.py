"""Which frame the orientations of a bag refer to, by the frame's own name or as the user states it.

`--reference MEANING` says what the axes of the bag's frame are: icrs, or enu or ned at --place. `--reference FRAME=MEANING`
also names the frame, and `--reference FRAME` names one whose name says what its axes are.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.level import AXES, EXACT, KINDS, Kind
from hilstar.errors import InputError

FORM = "icrs, enu or ned"
STATE = "state its axes with --reference icrs, or with --reference enu or ned and --place LAT,LON,HEIGHT"


class Named(NamedTuple):
    """What `--reference` says: the frame of the bag, and what its axes are; None for what it does not say."""

    frame: str | None = None
    kind: Kind | None = None


def named(reference: str | None) -> Named:
    """What `--reference` says. Raises InputError for a meaning that is none."""
    if reference is None:
        return Named()
    frame, equals, meaning = reference.rpartition("=")
    kind = KINDS.get(meaning.lower())
    if equals and kind is None:
        raise InputError(
            f"--reference {reference}: the axes of {frame} are {FORM}; write --reference {frame}=icrs, for example"
        )
    if kind is not None:
        return Named(frame or None, kind)
    return Named(reference)


def kind_of_frame(path: Path, frame: str | None, stated: Stated, why: str, told: list[tuple[str, str]]) -> Kind:
    """What the axes of the bag's frame are; `why` says which frame that is, where the bag does not name it.

    Raises InputError where neither its name nor the user says, or they differ.
    """
    wanted, kind = named(stated.reference)
    if frame is not None and wanted is not None and wanted != frame:
        raise InputError(
            f"{path}: its attitudes refer to the frame {frame!r}, not to {wanted!r}; write --reference {frame}=icrs"
        )
    own = KINDS.get((frame or "").lower())
    if kind is None:
        if own is None:
            raise InputError(f"{path}: {f'its attitudes refer to the frame {frame!r}' if frame else why}; {STATE}")
        if (frame or "").lower() not in EXACT and own == "icrs":
            told.append(("reference", f"the frame {frame!r} is taken as the ICRS; a frame of date is 0.4 deg off by now"))
        return own
    if own is not None and own != kind:
        raise InputError(
            f"{path}: its attitudes refer to the frame {frame!r}, which is not {AXES[kind]}; leave out --reference"
        )
    if own is None:
        told.append(
            ("reference", f"{f'the frame {frame!r}' if frame else 'the reference'} is taken as {AXES[kind]}, as stated")
        )
    return kind
