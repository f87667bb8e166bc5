"""The steps in which a sender rounds its quaternions: three decimals are 0.06 degrees. No I/O.

A sample's quaternion has been scaled to unit length, so that its components are no multiples of the
step any more; but times one unknown norm, within half a step of 1, they are again. Exact numbers
need no such norm, and are not rounded.
"""

import math
from collections.abc import Callable, Sequence

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.units import ARCSEC_PER_RAD

COARSE = "coarse-quaternions"
LOOKED_AT = 60  # samples; a sender does not change its format later
MIN_EVIDENCE = 3  # components beyond the one by which each norm is found
# Decimals, and what fixed-point numbers and half floats have. Finer steps than MIN_ARCSEC are not
# looked for.
STEPS = (*(10.0**-k for k in range(1, 7)), *(2.0**-k for k in range(6, 19)), 1 / 127, 1 / 32767)
MIN_ARCSEC = 1.0
FIT = 1e-5  # of a step
NOT_EXACT = 1e-4  # of a step: by how much a norm differs from 1 where components are rounded


class Resolution:
    """Looks at the first samples of a stream, and tells of their steps."""

    def __init__(self, tell: Callable[[str, str], None]) -> None:
        self._say = tell
        self._left = LOOKED_AT
        self._evidence = dict.fromkeys(
            (step for step in STEPS if step * ARCSEC_PER_RAD >= MIN_ARCSEC), 0
        )
        self._last: list[float] = []

    def see(self, sample: AttitudeSample) -> None:
        """Take the next sample; nothing after the first LOOKED_AT."""
        if not self._left:
            return
        self._left -= 1
        q = sample.q_icrs_to_cam.tolist()
        if q != self._last:
            self._last = q
            for step in [*self._evidence]:
                evidence = _evidence(q, step)
                if evidence is None:
                    del self._evidence[step]
                else:
                    self._evidence[step] += evidence
        if not self._left or not self._evidence:
            self.decide()

    def decide(self) -> None:
        """No more samples come: tell of their steps, where they show any."""
        self._left = 0
        # Thousandths are ten-thousandths, too: the coarsest that holds is the sender's.
        steps = [step for step, evidence in self._evidence.items() if evidence >= MIN_EVIDENCE]
        if not steps:
            return
        step = max(steps)
        # Each component is off by step / sqrt(12) rms, and the attitude by twice that about each of
        # three axes.
        arcsec = 2 * math.sqrt(3 / 12) * step * ARCSEC_PER_RAD
        line = (
            f"the quaternions come in steps of {step:.3g}: each attitude is off by {arcsec:.3g}"
            " arcsec rms"
        )
        self._say(COARSE, f"{line}; send all their digits")


def coarse_lines(samples: Sequence[AttitudeSample]) -> list[tuple[str, str]]:
    """Kind and line of the notice where a log's quaternions are rounded coarsely; [] where they
    are not.
    """
    notices: list[tuple[str, str]] = []
    resolution = Resolution(lambda kind, line: notices.append((kind, line)))
    for sample in samples[:LOOKED_AT]:
        resolution.see(sample)
    if len(samples) < LOOKED_AT:
        resolution.decide()
    return notices


def _evidence(q: list[float], step: float) -> int | None:
    """How many components show that a unit quaternion was rounded to steps; 0 for an exact one,
    None where it was not.

    Components of one size show as much as one of them, and the largest shows only the norm.
    """
    largest = max(map(abs, q))
    count = round(largest / step)
    for near in (count - 1, count, count + 1):
        norm = near * step / largest
        if abs(norm - 1) > min(2 * step, NORM_TOLERANCE):
            continue
        steps = [abs(part) * norm / step for part in q]
        if all(abs(multiple - round(multiple)) < FIT for multiple in steps):
            exact = abs(norm - 1) < NOT_EXACT * step
            if exact:
                return 0
            return len({round(multiple) for multiple in steps} - {0}) - 1
    return None
