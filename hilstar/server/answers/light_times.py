"""How long each frame of a display is lit during an exposure: its weight in the mean of what a
tracker saw. Judge and virtual tracker both ask here.

**With a screen** a frame is lit from its own beginning until the next one's.

**Without a screen** nothing holds a frame: it is a sample of the sky at one moment. Light passes
evenly from each frame to the next, between their two moments. So the mean attitude of an exposure
under a constant rate is that of its middle, wherever the frames stand: wakened late, or frames
apart because some were missed. Held until the next one, each would be late by half of what its gap
is over a refresh period, and that would be taken for an error of the tracker's stamps.

Where a fault dropped a frame, the one before stands in its place, as on a screen. A simulation in
lockstep draws a frame when it asks for it: that frame stands until the next one, too.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hilstar.basics.arrays import FloatArray


class FrameLight(NamedTuple):
    """When a frame is lit, host time, ns.

    Its light is whole at `whole_ns`; it begins at `begin_ns`, at once, or, where it `fades`, evenly
    from the moment at which the frame before is whole.
    """

    begin_ns: int
    whole_ns: int
    fades: bool = False


def on_screen(begin_ns: int) -> FrameLight:
    """A frame on a screen, which lights at once."""
    return FrameLight(begin_ns, begin_ns)


def without_screen(moment_ns: int, half_period_ns: int, fades: bool) -> FrameLight:
    """A frame without a screen, which samples the sky at a moment. One that does not fade stands
    for half a refresh period before it, too.
    """
    return FrameLight(moment_ns - half_period_ns, moment_ns, fades)


def lit_times_ns(
    frames: Sequence[FrameLight], begin_ns: int, end_ns: int, gone_ns: int
) -> FloatArray:
    """How long, ns, each of n frames (n,) is lit from `begin_ns` to `end_ns`, in which light that
    passes from one to the next counts by its share.

    `frames` rise in time, and the last one's light ends at `gone_ns`. What is before the first one
    counts for none.
    """
    rows = np.array([(frame.begin_ns, frame.whole_ns) for frame in frames], dtype=np.int64)
    begins, wholes = np.clip(rows - begin_ns, -_FAR_NS, _FAR_NS).astype(np.float64).T
    length_ns = float(end_ns - begin_ns)
    from_ns = np.clip(wholes, 0.0, length_ns)
    ends = np.append(wholes[1:], float(gone_ns - begin_ns))
    until_ns = np.clip(ends, from_ns, length_ns)
    lit_ns = until_ns - from_ns
    if len(frames) == 1:
        return np.asarray(lit_ns)
    fades = np.array([frame.fades for frame in frames[1:]])
    ramp_begins = np.where(fades, wholes[:-1], begins[1:])
    ramp_ends = np.where(fades, wholes[1:], begins[1:])
    passed_ns = _risen_ns(until_ns[:-1], ramp_begins, ramp_ends)
    passed_ns -= _risen_ns(from_ns[:-1], ramp_begins, ramp_ends)
    lit_ns[:-1] -= passed_ns
    lit_ns[1:] += passed_ns
    return np.asarray(lit_ns)


_FAR_NS = 10**15  # 12 days: further frames weigh nothing, and differences of these are exact


def _risen_ns(t_ns: FloatArray, begins_ns: FloatArray, ends_ns: FloatArray) -> FloatArray:
    """The integral until t of a share that rises evenly from 0 to 1."""
    inside_ns = np.clip(t_ns, begins_ns, ends_ns) - begins_ns
    width_ns = np.maximum(ends_ns - begins_ns, 1.0)
    after_ns = np.maximum(t_ns - ends_ns, 0.0)
    return np.asarray(inside_ns**2 / (2.0 * width_ns) + after_ns)
