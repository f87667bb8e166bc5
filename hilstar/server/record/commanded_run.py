"""Reads the attitudes that a run commanded from its ledger."""

from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import NS_PER_S
from hilstar.server.record.commanded import Commanded
from hilstar.server.record.ledger_records import NO_FRAMES, frame_records

NOT_SHOWN = (np.nan,) * 4


@dataclass(frozen=True, slots=True)
class CommandedRun:
    """The commanded attitudes of a run at the moments when its frames light, in seconds after
    `zero_ns` of the sender's clock.

    `changed` counts the frames that an operator changed or a hidden window concealed: these show no
    commanded attitude. `missed` counts the refresh periods without a new frame.
    """

    commanded: Commanded
    zero_ns: int
    changed: int
    missed: int = 0

    @property
    def held(self) -> int:
        """The number of frames that stood longer than a refresh period, because later ones were
        missed.
        """
        return len(self.commanded.held_s)

    @property
    def missed_share(self) -> float:
        """The share of refresh periods without a new frame, 0 to 1."""
        return self.missed / (self.missed + len(self.commanded.t_s))

    def seconds(self, t_ns: IntArray) -> FloatArray:
        """Times (n,), ns, of the sender's clock, as seconds after `zero_ns`."""
        return np.asarray((t_ns - self.zero_ns) / NS_PER_S)


def read_commanded(ledger: Path) -> CommandedRun:
    """Read the commanded attitudes from a ledger. Raises InputError if the file is no ledger, is
    damaged, or has fewer than two frames.
    """
    light = array("q")
    shown = array("d")
    changed = 0
    missed = array("q")
    for record in frame_records(ledger):
        light.append(record.light_ns)
        missed.append(record.missed_before)
        if record.q is None:
            shown.extend(NOT_SHOWN)
        elif record.operator or record.hidden:
            changed += 1
            shown.extend(NOT_SHOWN)
        else:
            shown.extend(record.q)
    # Of several frames at one moment the last counts: `unique` keeps the first of equals, so that
    # the order is reversed.
    newest_first_ns = np.array(light, dtype=np.int64)[::-1]
    light_ns, last = np.unique(newest_first_ns, return_index=True)
    if not len(light_ns):
        raise InputError(f"{ledger}: {NO_FRAMES}")
    if len(light_ns) < 2:
        raise InputError(f"{ledger}: has one frame; give the ledger of a longer run")
    zero_ns = int(light_ns[0])
    t_s = (light_ns - zero_ns) / NS_PER_S
    q = np.array(shown).reshape(-1, 4)[::-1][last]
    missed_before = np.array(missed, dtype=np.int64)[::-1][last]
    late = np.flatnonzero(missed_before[1:] > 0) + 1
    held_s = np.stack([t_s[late - 1], t_s[late]], axis=1)
    return CommandedRun(Commanded(t_s, q, held_s), zero_ns, changed, sum(missed))
