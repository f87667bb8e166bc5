"""SPICE kernels written for tests by the CSPICE of spiceypy: C-kernels of all types, and the
text kernels that they need.
"""

from __future__ import annotations

import contextlib
import ctypes

import numpy as np
import spiceypy
from scipy.spatial.transform import Rotation
from spiceypy.utils import libspicehelper

CLOCK, BODY = -82, -82000
TICKS_PER_S = 65536
START_S = 6.0e8  # ephemeris time of tick 0: a double there resolves 0.12 us
# naif0012.tls: the constants of TDB - TT, and the leap seconds of 1999 and later.
LEAP_SECONDS = r"""KPL/LSK
\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K         = 1.657D-3
DELTET/EB        = 1.671D-2
DELTET/M         = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT  = ( 32, @1999-JAN-1 33, @2006-JAN-1 34, @2009-JAN-1 35, @2012-JUL-1 36, @2015-JUL-1 37, @2017-JAN-1 )
\begintext
"""


def clock_kernel(system=1, start_s=START_S, clock=CLOCK):
    """An SCLK kernel of a clock of 65536 ticks a second; system 1 is TDB, 2 is TT."""
    name = str(-clock)
    return rf"""KPL/SCLK
\begindata
SCLK_KERNEL_ID           = ( @2020-01-01/00:00 )
SCLK_DATA_TYPE_{name}        = ( 1 )
SCLK01_TIME_SYSTEM_{name}    = ( {system} )
SCLK01_N_FIELDS_{name}       = ( 2 )
SCLK01_MODULI_{name}         = ( 4294967296 {TICKS_PER_S} )
SCLK01_OFFSETS_{name}        = ( 0 0 )
SCLK01_OUTPUT_DELIM_{name}   = ( 1 )
SCLK_PARTITION_START_{name}  = ( 0.0 )
SCLK_PARTITION_END_{name}    = ( 2.8147497671065E+14 )
SCLK01_COEFFICIENTS_{name}   = ( 0.0 {start_s!r} 1.0 )
\begintext
"""


def frame_kernel(name="PROBE_BUS", number=BODY):
    """A frame kernel that names a structure, and a fixed frame PROBE_TABLE, 30 degrees about z
    from J2000.
    """
    return rf"""KPL/FK
\begindata
FRAME_{name}          = {number}
FRAME_{number}_NAME     = '{name}'
FRAME_{number}_CLASS    = 3
FRAME_{number}_CLASS_ID = {number}
FRAME_{number}_CENTER   = {CLOCK}
CK_{number}_SCLK        = {CLOCK}
CK_{number}_SPK         = {CLOCK}
FRAME_PROBE_TABLE       = 1400077
FRAME_1400077_NAME      = 'PROBE_TABLE'
FRAME_1400077_CLASS     = 4
FRAME_1400077_CLASS_ID  = 1400077
FRAME_1400077_CENTER    = 0
TKFRAME_1400077_SPEC     = 'ANGLES'
TKFRAME_1400077_RELATIVE = 'J2000'
TKFRAME_1400077_ANGLES   = ( 0.0, 0.0, -30.0 )
TKFRAME_1400077_AXES     = ( 1, 2, 3 )
TKFRAME_1400077_UNITS    = 'DEGREES'
\begintext
"""


# IAU_EARTH of pck00010.tpc: pole and prime meridian.
EARTH = r"""KPL/PCK
\begindata
BODY399_POLE_RA  = ( 0.0 -0.641 0.0 )
BODY399_POLE_DEC = ( 90.0 -0.557 0.0 )
BODY399_PM       = ( 190.147 360.9856235 0.0 )
\begintext
"""


class Motion:
    """A smooth attitude: `turn(seconds)` turns the structure's components into the reference's."""

    def __init__(self, rng):
        self._first = Rotation.random(random_state=rng)
        self._axis = Rotation.random(random_state=rng)
        self._swing_rad, self._swing_rad_s = 0.2, 0.35
        self._spin_rad_s = 0.02

    def turn(self, seconds):
        swing = Rotation.from_rotvec(
            self._swing_rad * np.sin(self._swing_rad_s * seconds) * np.array([1.0, 0.0, 0.0])
        )
        spin = Rotation.from_rotvec(self._spin_rad_s * seconds * np.array([0.0, 0.6, 0.8]))
        return self._first * swing * self._axis * spin

    def rate(self, seconds, h=1e-3):
        """rad/s in the structure's components, by a difference of fourth order: h^4 w^5 / 30 =
        1e-15, rounding 1e-13.
        """
        one, two = (
            (self.turn(seconds - n * h).inv() * self.turn(seconds + n * h)).as_rotvec()
            / (2 * n * h)
            for n in (1, 2)
        )
        return (4 * one - two) / 3

    def quaternion(self, seconds):
        """As SPICE has it: scalar first, of the C-matrix."""
        x, y, z, w = self.turn(seconds).inv().as_quat()
        return np.array([w, x, y, z])

    def reference_rate(self, seconds):
        """As a CK holds it: in components of the reference frame."""
        return self.turn(seconds).apply(self.rate(seconds))


def quaternions(motion, times):
    """Of one sign, as interpolating types need them."""
    q = np.array([motion.quaternion(t) for t in times])
    for k in range(1, len(q)):
        q[k] *= np.sign(q[k] @ q[k - 1]) or 1.0
    return q


@contextlib.contextmanager
def new_ck(path):
    """The handle of a new CK; it is closed afterwards."""
    handle = spiceypy.ckopn(str(path), "made by a test", 0)
    try:
        yield handle
    finally:
        spiceypy.ckcls(handle)


def write_segment(
    handle, kind, motion, times, body=BODY, reference="J2000", rates=True, starts=None, subtype=1
):
    """One segment of a type at times in seconds; `starts` are those of the intervals that it
    interpolates in.
    """
    ticks = np.asarray(times, dtype=float) * TICKS_PER_S
    head = (handle, ticks[0], ticks[-1], body, reference)
    q = quaternions(motion, times)
    rate = np.array([motion.reference_rate(t) for t in times])
    begin = np.asarray([times[0]] if starts is None else starts, dtype=float) * TICKS_PER_S
    if kind == 1:
        spiceypy.ckw01(*head, rates, "made by a test", len(q), ticks, q, rate)
    elif kind == 3:
        spiceypy.ckw03(*head, rates, "made by a test", len(q), ticks, q, rate, len(begin), begin)
    elif kind == 5:
        # The packets of each subtype: q and dq/dt, q alone, q with dq/dt and w with dw/dt, q and w.
        packets = packets_of(motion, times, subtype)
        spiceypy.ckw05(
            handle, subtype, 3, ticks[0], ticks[-1], body, reference, rates, "made by a test",
            ticks, packets, 1.0 / TICKS_PER_S, len(begin), begin,
        )  # fmt: skip
    else:
        raise ValueError(kind)


def packets_of(motion, times, subtype):
    """The packets of types 5 and 6."""
    q, h = quaternions(motion, times), 1e-3
    q_dot = np.array([(motion.quaternion(t + h) * _sign(motion, t + h, p) - motion.quaternion(t - h) * _sign(motion, t - h, p))
                      / (2 * h) for t, p in zip(times, q, strict=True)])  # fmt: skip
    rate = np.array([motion.reference_rate(t) for t in times])
    bend = np.array(
        [(motion.reference_rate(t + h) - motion.reference_rate(t - h)) / (2 * h) for t in times]
    )
    return {
        0: np.hstack([q, q_dot]),
        1: q,
        2: np.hstack([q, q_dot, rate, bend]),
        3: np.hstack([q, rate]),
    }[subtype]


def _sign(motion, t, q):
    return np.sign(motion.quaternion(t) @ q)


def write_type_2(handle, steps, body=BODY, reference="J2000"):
    """Intervals (start s, stop s, turn to the reference at the start, rate in the reference's
    components).
    """
    starts, stops = (np.array([step[k] for step in steps]) * TICKS_PER_S for k in (0, 1))
    q = np.array([np.roll(step[2].inv().as_quat(), 1) for step in steps])
    rate = np.array([step[3] for step in steps])
    s_per_tick = np.full(len(steps), 1.0 / TICKS_PER_S)
    spiceypy.ckw02(
        handle,
        starts[0],
        stops[-1],
        body,
        reference,
        "made by a test",
        len(steps),
        starts,
        stops,
        q,
        rate,
        s_per_tick,
    )


def write_type_6(handle, motion, spans, body=BODY, reference="J2000", rates=True, subtype=3):
    """Mini-segments over spans (arrays of times in s), by CSPICE's own Fortran routine, which
    spiceypy does not wrap.
    """
    ticks = [np.asarray(span) * TICKS_PER_S for span in spans]
    packets = np.ascontiguousarray(np.vstack([packets_of(motion, span, subtype) for span in spans]))
    bounds = np.array([span[0] for span in ticks] + [ticks[-1][-1]])
    every = np.concatenate(ticks)

    def ints(values):
        return (ctypes.c_int * len(values))(*values)

    def doubles(values):
        values = np.ascontiguousarray(values, dtype=np.float64).ravel()
        return (ctypes.c_double * values.size)(*values)

    count = len(spans)
    frame, name = reference.encode(), b"made by a test"
    libspicehelper.libspice.ckw06_(
        ints([handle]), ints([body]), frame, ints([int(rates)]), doubles(bounds[:1]), doubles(bounds[-1:]), name, ints([count]),
        ints([len(span) for span in ticks]), ints([subtype] * count), ints([3] * count), doubles(packets),
        doubles([1.0 / TICKS_PER_S] * count), doubles(every), doubles(bounds), ints([1]),
        ctypes.c_int(len(frame)), ctypes.c_int(len(name)),
    )  # fmt: skip
    spiceypy.spiceypy.check_for_spice_error(None)


def write_texts(folder, **texts):
    """Text kernels beside a CK: leap seconds and the clock, unless `texts` (file stem to text)
    says otherwise.
    """
    files = {"leap.tls": LEAP_SECONDS, "clock.tsc": clock_kernel()} | {
        name.replace("_", "."): t for name, t in texts.items()
    }
    for name, text in files.items():
        if text is not None:
            (folder / name).write_text(text)
