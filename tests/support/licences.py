"""The licences of installed distributions, as their metadata state them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib import metadata

from packaging.requirements import Requirement

# A package under the MIT licence pulls nothing that asks more of whoever passes it on. The LGPL is
# refused as well: nothing is under it today, and a bench's frozen image would have to keep such a
# library exchangeable.
COPYLEFT = re.compile(
    r"\b[AL]?GPL|GNU (Affero |Lesser |Library (or Lesser )?)?General Public", re.IGNORECASE
)
UNKNOWN = "states no licence"
# the field `License` holds a name, or the whole text, whose beginning names it
MAX_NAME_CHARACTERS = 100


def licence_of(package: metadata.Distribution) -> str:
    """What a distribution states: its SPDX expression, else its classifiers, else the beginning
    of its field `License`.
    """
    said = package.metadata
    if expression := said.get("License-Expression"):
        return str(expression)
    classifiers = [
        each
        for each in said.get_all("Classifier", [])
        if each.startswith("License :: OSI Approved ::")
    ]
    return (
        "; ".join(classifiers)
        or (said.get("License") or "")[:MAX_NAME_CHARACTERS].strip()
        or UNKNOWN
    )


def is_copyleft(licence: str) -> bool:
    """Whether every choice that a licence leaves is one of the GPL's family."""
    return all(COPYLEFT.search(choice) for choice in re.split(r"\s+OR\s+", licence))


def pulled_by(requirements: Iterable[str]) -> dict[str, str]:
    """The licence of each distribution that requirements install here, and of all that those
    require, by name.
    """
    found: dict[str, str] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [(Requirement(text), "") for text in requirements]
    while waiting:
        wanted, asked_by = waiting.pop()
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": asked_by}):
            continue
        package = metadata.distribution(wanted.name)
        found[package.metadata["Name"]] = licence_of(package)
        for extra in ("", *wanted.extras):
            if (wanted.name, extra) not in seen:
                seen.add((wanted.name, extra))
                waiting += [(Requirement(text), extra) for text in package.requires or ()]
    return found
