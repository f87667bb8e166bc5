"""The steps of a session, as steps.toml has them.

Apart from what does them, which takes 0.6 s to import: a shell's Tab asks for their names.
"""

from pathlib import Path

import msgspec

STEPS_FILE = Path(__file__).with_name("steps.toml")


class SessionStep(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One step of steps.toml: what it measures, and what to do where it fails; what it shows, and
    what it wants back.

    `tables` are those of the bench file that it depends on; `writes` has the keys that it may set,
    `needs` the steps before it. Those of `unless_failed` may be skipped: what the bench file says
    stands in for them.
    """

    measures: str
    cure: str
    wants: str
    shows: str = ""
    needs: tuple[str, ...] = ()
    unless_failed: tuple[str, ...] = ()
    tables: tuple[str, ...] = ("monitor", "collimator", "tracker")
    writes: tuple[str, ...] = ()
    name: str = ""


STEPS = tuple(
    msgspec.structs.replace(step, name=name)
    for name, step in msgspec.toml.decode(
        STEPS_FILE.read_bytes(), type=dict[str, SessionStep]
    ).items()
)
NAMES = tuple(step.name for step in STEPS)
