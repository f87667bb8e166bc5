"""Finds the attitude that an answer is compared with: the mean of the attitudes that the display
lit during the tracker's exposure, weighted by how long each frame was lit.
"""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    propagate,
    to_rotation_vector,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.server.answers.light_times import FrameLight, lit_times_ns, on_screen, without_screen

# Frames older than this are forgotten; an answer that arrives later is not compared.
KEPT_NS = 20 * NS_PER_S
# The newest frame has no successor yet that ends it: it counts as lit for this long.
MAX_HELD_NS = NS_PER_S // 2
# Smallest share of an exposure with a sky: below it the answer is "unpaired".
MIN_LIT_SHARE = 0.5
# A larger step between two frames is a jump: an exposure across it has two skies and no mean.
MAX_STEP_RAD = np.radians(2.0)


class LitFrame(NamedTuple):
    """One displayed frame. Its light begins at `host_ns` on the host's clock and at `light_ns` on
    the sender's clock, ns; without a screen these are the moment of its attitude.

    `q` is the displayed q_icrs_to_cam (w, x, y, z), None where the frame shows no sky.
    `rate_rad_s` (3,), rad/s, camera axes, is None unless the frame is drawn in motion. `fades`: no
    screen held the frame before (see `light_times`).
    """

    number: int
    host_ns: int
    light_ns: int
    q: FloatArray | None
    rate_rad_s: FloatArray | None = None
    fades: bool = False


@dataclass(frozen=True, slots=True)
class Lit:
    """What the display lit during an exposure: the mean attitude `q` (q_icrs_to_cam, w, x, y, z),
    the rate (3,), rad/s, camera axes, and the numbers of the first and last frame.

    `light_ns` is the exposure's middle on the sender's clock.
    """

    q: FloatArray
    rate_rad_s: FloatArray
    light_ns: int
    first: int
    last: int


class LitFrames:
    """The frames of the last KEPT_NS. One thread may add frames while another calls `over`.

    `period_ns` is the refresh period. `centred`: no screen holds the frames (see `light_times`).
    `hold_s` is how long a row of the screen stays lit: a frame drawn in motion shows its mean
    attitude `hold_s` / 2 after its begin.
    """

    def __init__(self, period_ns: float, hold_s: float = 0.0, *, centred: bool = True) -> None:
        self.dark_ns = 0  # time without a sky since the start
        self._frames: deque[LitFrame] = deque(maxlen=max(16, int(KEPT_NS / period_ns)))
        self._hold_s = hold_s
        self._centred = centred
        self._early_ns = round(period_ns / 2)

    def add(self, frame: LitFrame) -> None:
        """Add the newest frame."""
        if self._frames and self._frames[-1].q is None:
            self.dark_ns += frame.host_ns - self._frames[-1].host_ns
        self._frames.append(frame)

    @property
    def newest(self) -> LitFrame | None:
        """The newest frame."""
        return self._frames[-1] if self._frames else None

    def over(self, start_ns: int, end_ns: int) -> Lit | None:
        """What the display lit from `start_ns` to `end_ns` on the host's clock.

        None where it was dark for more than half of that time, where the attitude jumped, or where
        the frames are older than KEPT_NS.
        """
        frames = list(self._frames)
        first = len(frames) - 1
        while first >= 0 and self._light(frames[first]).whole_ns > start_ns:
            first -= 1
        if first < 0:
            return None
        end_ns = max(end_ns, start_ns + 1)  # one of no length has the frames at its moment
        last = first
        while last + 1 < len(frames) and self._light(frames[last]).whole_ns < end_ns:
            last += 1
        lights = [self._light(frame) for frame in frames[first : last + 1]]
        gone_ns = lights[-1].whole_ns + MAX_HELD_NS
        lit_ns = np.rint(lit_times_ns(lights, start_ns, end_ns, gone_ns))
        kept = []
        for k in range(first, last + 1):
            if frames[k].q is not None and lit_ns[k - first]:
                kept.append(k)
        kept_ns = lit_ns[np.array(kept, dtype=np.intp) - first]
        if not kept or kept_ns.sum() < MIN_LIT_SHARE * (end_ns - start_ns):
            return None
        return self._mean(frames, kept, kept_ns, (start_ns + end_ns) // 2)

    def _light(self, frame: LitFrame) -> FrameLight:
        """When a frame is lit; one drawn in motion begins at its own moment, and is whole at that
        of its mean attitude.
        """
        if not self._centred:
            return on_screen(frame.host_ns)
        if frame.rate_rad_s is None:
            return without_screen(frame.host_ns, self._early_ns, frame.fades)
        half_hold_ns = round(self._hold_s * NS_PER_S / 2)
        return without_screen(frame.host_ns + half_hold_ns, half_hold_ns, frame.fades)

    def _mean(
        self, frames: list[LitFrame], kept: list[int], lit_ns: FloatArray, middle_ns: int
    ) -> Lit | None:
        """The mean attitude and the rate over the frames with indices `kept`, which were lit for
        `lit_ns` (n,); None across a jump. `middle_ns` is the exposure's middle, host time.
        """
        # A rate needs two frames: an exposure within one frame takes its neighbours too.
        if len(kept) > 1:
            near = kept
        else:
            near = [k for k in (kept[0] - 1, kept[0], kept[0] + 1) if 0 <= k < len(frames)]
        near = [k for k in near if frames[k].q is not None]
        q = np.array([self._shown(frames[k]) for k in near])
        turned = to_rotation_vector(multiply(q, conjugate(q[:1])))
        steps = np.linalg.norm(np.diff(turned, axis=0), axis=1)
        if len(kept) > 1 and steps.max() > MAX_STEP_RAD:
            return None
        at_s = np.array([(frames[k].host_ns - middle_ns) / NS_PER_S for k in near])
        spread_s = at_s - at_s.mean()
        power = float(spread_s @ spread_s)
        if power and (not len(steps) or steps.max() <= MAX_STEP_RAD):
            rate = -(spread_s @ turned) / power
        else:
            rate = np.zeros(3)
        inside = [near.index(k) for k in kept]
        mean = lit_ns @ turned[inside] / lit_ns.sum()
        nearest = min((frames[k] for k in kept), key=lambda frame: abs(frame.host_ns - middle_ns))
        light_ns = nearest.light_ns + middle_ns - nearest.host_ns
        q_mean = normalise(multiply(from_rotation_vector(mean), q[0]))
        return Lit(q_mean, rate, light_ns, frames[kept[0]].number, frames[kept[-1]].number)

    def _shown(self, frame: LitFrame) -> FloatArray:
        """The mean attitude q_icrs_to_cam that a frame shows; for a frame drawn in motion, the
        attitude at the middle of its light.
        """
        assert frame.q is not None
        if frame.rate_rad_s is None:
            return frame.q
        return propagate(frame.q, frame.rate_rad_s, self._hold_s / 2)


def residual_arcsec(reported: FloatArray, lit: FloatArray) -> FloatArray:
    """The rotation vector (3,), arcsec, camera axes, from the lit to the reported q_icrs_to_cam.
    `hilstar assess` has the same sign.
    """
    return np.asarray(ARCSEC_PER_RAD * to_rotation_vector(multiply(reported, conjugate(lit))))
