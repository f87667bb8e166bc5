"""What the readers of all formats give: each attitude, or why there is none, with where it stands in the file."""

from __future__ import annotations

from typing import NamedTuple

from hilstar.attitude.wire.packet import AttitudeSample, Refusal

MAX_QUOTED_CHARACTERS = 80


class Entry(NamedTuple):
    """`where` is a line (":12"), an epoch or a count, as it follows the file's name in a message."""

    where: str
    event: AttitudeSample | Refusal
