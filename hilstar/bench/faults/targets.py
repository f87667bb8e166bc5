"""The star that a fault is about: by its HIP number, by the name that the truth table gives it, or by a bright star's own."""

from __future__ import annotations

import re

import numpy as np

from hilstar.arrays import IntArray
from hilstar.bench.faults.kinds import Fault, Flash, StarGone
from hilstar.errors import InputError
from hilstar.sky.catalog import star_names
from hilstar.sky.stars import Stars

MAX_KEPT = 512  # a stream may ask for any star


class Targets:
    """Places of stars in a bench's arrays; found once for each of them, which keep their order for a whole run."""

    def __init__(self) -> None:
        self._found: dict[tuple[int, int | str], tuple[object, IntArray]] = {}

    def find(self, stars: Stars, fault: Fault) -> IntArray:
        """Where a fault's star is in `stars`; empty where it is not among them."""
        if not isinstance(fault, Flash | StarGone):
            return np.empty(0, dtype=np.intp)
        wanted = fault.hip if fault.hip is not None else fault.star
        if wanted is None:
            return np.empty(0, dtype=np.intp)
        key = (id(stars.hip), wanted)
        known = self._found.get(key)
        if known is None or known[0] is not stars.hip:  # the array is kept, so that no other one has its id
            if len(self._found) >= MAX_KEPT:
                self._found.clear()
            known = self._found[key] = (stars.hip, _places(stars, wanted))
        return known[1]

    def check(self, stars: Stars, fault: Fault) -> None:
        """Refuse (InputError) a star that the bench does not have."""
        if not isinstance(fault, Flash | StarGone) or (fault.hip is None and fault.star is None):
            return
        if not len(self.find(stars, fault)):
            said = f"hip = {fault.hip}" if fault.hip is not None else f'star = "{fault.star}"'
            raise InputError(
                f"{said}: not among the {len(stars)} stars and bodies of this bench; write one that is, or look at"
                " [sky] faintest_v_mag"
            )


def _places(stars: Stars, wanted: int | str) -> IntArray:
    if isinstance(wanted, int):
        return np.flatnonzero(stars.hip == wanted)
    first = len(stars) - len(stars.bodies)
    if wanted in stars.bodies:
        return np.array([first + stars.bodies.index(wanted)])
    number = re.fullmatch(r"HIP (\d{1,9})", wanted)
    if number is not None:
        return np.flatnonzero(stars.hip == int(number[1]))
    hip = next((hip for hip, names in star_names().items() if wanted in (names.name, names.designation)), None)
    if hip is not None:
        return np.flatnonzero(stars.hip == hip)
    identifier = stars.catalog.identifier_of(wanted)
    if identifier is None:
        return np.empty(0, dtype=np.intp)
    nameless = np.flatnonzero(stars.hip[:first] == 0)
    return np.asarray(nameless[stars.catalog.identifier[stars.row[nameless]] == identifier], dtype=np.intp)
