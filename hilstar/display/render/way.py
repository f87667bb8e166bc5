"""Which way of drawing stars HILSTAR_DRAW wants. Nothing here imports moderngl."""

import os
from typing import Literal

from hilstar.basics.errors import InputError

WAY_VARIABLE = "HILSTAR_DRAW"
Way = Literal["gl", "cpu"]
WAYS: tuple[Way, ...] = ("gl", "cpu")


def wanted_way() -> Way | None:
    """The way of drawing stars that HILSTAR_DRAW wants, None for the machine's own. InputError for
    another word.
    """
    wanted = os.environ.get(WAY_VARIABLE, "")
    if not wanted:
        return None
    for way in WAYS:
        if wanted == way:
            return way
    raise InputError(f"{WAY_VARIABLE}={wanted}: no way to draw stars; write {' or '.join(WAYS)}")
