"""What a source of attitudes means by its numbers, and how they become the attitude of the camera.

There are two steps, in this order, each of which may change nothing:
1. The convention: a quaternion as it was sent becomes the Hamilton quaternion, scalar first, that
   turns ICRS components into components of the sender's frame. Whatever the convention, rates are
   of that frame with respect to the ICRS, in components of that frame.
2. The mounting: an attitude and a rate of the spacecraft's body become those of the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from hilstar.basics.toml_tables import Table

# Importing NumPy takes 70 ms, which a process that only stamps packets saves; and reading a bench
# file needs no packets.
if TYPE_CHECKING:
    from hilstar.attitude.wire.packet import AttitudeSample, Event
    from hilstar.basics.arrays import FloatArray

Components = tuple[float, float, float, float]
IDENTITY: Components = (1.0, 0.0, 0.0, 0.0)
# Indices that move the scalar to the other end: a tenth of the time that numpy.roll takes.
SCALAR_FROM_LAST, SCALAR_TO_LAST = [3, 0, 1, 2], [1, 2, 3, 0]
# The self-check looks at Orion's belt at roll 0, which everybody recognises. The star in the middle
# is Alnilam (HIP 26311), 15 arcsec from the boresight.
CHECK_RADEC_DEG, CHECK_STAR = (84.057, -1.200), "Alnilam"
UNSTATED = (
    "the source holds the body's attitude, and the tracker's axes are taken as the body's; "
    "write [tracker] q_body_to_cam (without a bench file: --mounting W,X,Y,Z)"
)
UNUSED = (
    "[tracker] q_body_to_cam does not turn these attitudes: they are taken as the camera's; if they"
    ' are the body\'s, write [attitude] convention = { frame = "body" }'
)


class Convention(Table, frozen=True):
    """What a quaternion turns into what, and the order of its components (see
    [conventions](attitude-in.md#conventions)).
    """

    #: Where the scalar stands among the four numbers. `"first"`: w, x, y, z. `"last"`: x, y, z, w.
    scalar: Literal["first", "last"] = "first"
    #: `"icrs_to_cam"`: it turns ICRS components into the frame's (with `frame = "body"`: the
    #: body's). `"cam_to_icrs"`: the other way round.
    direction: Literal["icrs_to_cam", "cam_to_icrs"] = "icrs_to_cam"
    #: Whose attitude it is. `"cam"`: the camera's. `"body"`: the spacecraft's, which
    #: `[tracker] q_body_to_cam` makes the camera's; rates are then the body's, too.
    frame: Literal["cam", "body"] = "cam"

    @property
    def is_hilstars(self) -> bool:
        """Whether a quaternion is sent in hilstar's own order and direction; its frame may be
        either.
        """
        return self.scalar == "first" and self.direction == "icrs_to_cam"

    def q_icrs_to_frame(self, sent: FloatArray) -> FloatArray:
        """The Hamilton quaternions (..., 4), scalar first, that turn ICRS components into those of
        `frame`, from unit quaternions (..., 4) as they were sent.
        """
        from hilstar.basics.rotation import conjugate

        if self.scalar == "first":
            q = sent
        else:
            q = sent[..., SCALAR_FROM_LAST]
        if self.direction == "cam_to_icrs":
            return conjugate(q)
        return q

    def as_sent(self, q_icrs_to_frame: FloatArray) -> FloatArray:
        """The quaternions (..., 4) that a sender with this convention sends for attitudes (..., 4)
        of its frame; the inverse of `q_icrs_to_frame`.
        """
        from hilstar.basics.rotation import conjugate

        if self.direction == "cam_to_icrs":
            q = conjugate(q_icrs_to_frame)
        else:
            q = q_icrs_to_frame
        return q if self.scalar == "first" else q[..., SCALAR_TO_LAST]

    def sample(self, sent: AttitudeSample) -> AttitudeSample:
        """The sample with its quaternion turned into q_icrs_to_frame, scalar first; its rate is
        unchanged. In the result `q_icrs_to_cam` and the rate are those of `frame`.
        """
        if self.is_hilstars:
            return sent
        return replace(sent, q_icrs_to_cam=self.q_icrs_to_frame(sent.q_icrs_to_cam))

    def __str__(self) -> str:
        """The convention as a bench file writes it: an inline table of TOML."""
        return (
            f'{{ scalar = "{self.scalar}", direction = "{self.direction}", frame ='
            f' "{self.frame}" }}'
        )


HILSTARS = Convention()


class Mounting:
    """How the camera is mounted in the body: `q_body_to_cam` (w, x, y, z), normalised here, turns
    body components into camera components.

    Where the user states none (None), the camera's axes are taken as the body's, and the notices
    `told` say so. `by_option`: the command line states it (`--mounting`), which is refused where
    the source does not give the body's attitude.
    """

    def __init__(self, q_body_to_cam: Components | None = None, *, by_option: bool = False) -> None:
        import numpy as np

        from hilstar.basics.rotation import normalise, to_matrix

        self.q_body_to_cam = normalise(np.array(q_body_to_cam or IDENTITY, dtype=np.float64))
        self.told = [] if q_body_to_cam else [("mounting", UNSTATED)]
        self.by_option = by_option
        self._matrix = to_matrix(self.q_body_to_cam)
        self.is_identity = q_body_to_cam in {None, IDENTITY}

    def sample(self, body: AttitudeSample) -> AttitudeSample:
        """The sample with the camera's attitude, rate and acceleration, from one with the body's:
        q_icrs_to_body, and a rate and an acceleration in body components.
        """
        if self.is_identity:
            return body
        from hilstar.basics.rotation import multiply

        rate = body.rate_cam_rad_s
        acceleration = body.acceleration_cam_rad_s2
        return replace(
            body,
            q_icrs_to_cam=multiply(self.q_body_to_cam, body.q_icrs_to_cam),
            rate_cam_rad_s=None if rate is None else self.in_cam(rate),
            acceleration_cam_rad_s2=None if acceleration is None else self.in_cam(acceleration),
        )

    def in_cam(self, in_body: FloatArray) -> FloatArray:
        """The camera components (3,) of a vector given in body components (3,)."""
        return self._matrix @ in_body

    def q_icrs_to_body(self, q_icrs_to_cam: FloatArray) -> FloatArray:
        """The body's attitude q_icrs_to_body (4,) for an attitude (4,) of the camera."""
        from hilstar.basics.rotation import conjugate, multiply

        return multiply(conjugate(self.q_body_to_cam), q_icrs_to_cam)


@dataclass(frozen=True, slots=True)
class Conventions:
    """What a source means by its numbers, as `--explain` shows it and the documentation says it.

    These are texts: `source` names the source; `turns` says from which frame to which a quaternion
    turns, `scalar` the order of its components, `time` the scale and the zero of its times.
    `of_body`: the attitudes are the body's, so that `[tracker] q_body_to_cam` applies. `written`
    gives the text by which the source writes an attitude (4,). `scale` is the time scale (UTC, TAI,
    TT, TDB, GPS) of its times, which are ns since 1970-01-01T00:00:00 in days of 86400 s; None for
    other times. `of_packets`: a `Convention` says what its quaternions mean, and its times are
    plain numbers (of `time_unit` in a log).
    """

    source: str
    turns: str
    scalar: str
    time: str
    of_body: bool
    written: Callable[[FloatArray], str]
    scale: str | None = None
    of_packets: bool = False
    time_unit: str = "ns"

    def mounting_notices(self, mounting: Mounting) -> list[tuple[str, str]]:
        """Notices (kind, line) about the mounting: that none is stated where one is needed, or that
        one is stated and not used.
        """
        if self.of_body:
            return mounting.told
        if self.of_packets and not mounting.is_identity:
            return [("mounting", UNUSED)]
        return []

    def lines(self, mounting: Mounting) -> list[str]:
        """The lines that explain the conventions to a person, and a self-check as the last: what
        the source writes for the camera at `CHECK_RADEC_DEG`, roll 0.
        """
        from hilstar.basics.rotation import from_radec_roll_deg

        q = from_radec_roll_deg(*CHECK_RADEC_DEG, 0.0)
        own_q = mounting.q_icrs_to_body(q) if self.of_body else q
        ra_deg, dec_deg = CHECK_RADEC_DEG
        mounted = (
            f"it is the body's; [tracker] q_body_to_cam = {components(mounting.q_body_to_cam)}"
            " makes it the camera's"
        )
        check_text = f"{CHECK_STAR} (RA {ra_deg:g}, Dec {dec_deg:g}) is in the middle, north up"
        if self.of_body:
            meaning = mounted
        else:
            meaning = "it is the camera itself; q_body_to_cam is not used"
        return [
            f"{self.source}: {self.turns}; {self.scalar}",
            f"attitude: {meaning}",
            f"time: {self.time}",
            f"self-check: at {self.written(own_q)} {check_text}; yours should be too",
        ]


def components(q: FloatArray) -> str:
    """The components of a quaternion or vector as text, in their order, with seven decimals."""
    return "(" + ", ".join(f"{c:.7f}" for c in q) + ")"


class SentAttitudes:
    """Turns what a sender sends into the camera's attitude: by its convention, and then by the
    mounting where the sender gives the body's attitude.

    Links wrap their decoders with it (`decoder`). So whoever reads a link gets the camera's
    attitudes, and beside them the bytes as they came.
    """

    def __init__(self, convention: Convention = HILSTARS, mounting: Mounting | None = None) -> None:
        self.convention = convention
        self.conventions = packet_conventions(convention)
        turns = convention.frame == "body" and mounting is not None and not mounting.is_identity
        self._mounting = mounting if turns else None

    def q_icrs_to_cam(self, sent: FloatArray) -> FloatArray:
        """The camera's attitude (4,), scalar first, from a unit quaternion (4,) as it was sent."""
        from hilstar.basics.rotation import multiply

        q = self.convention.q_icrs_to_frame(sent)
        if self._mounting is None:
            return q
        return multiply(self._mounting.q_body_to_cam, q)

    def as_sent(self, q_icrs_to_cam: FloatArray) -> FloatArray:
        """The quaternion (4,) that the sender sends for an attitude (4,) of the camera."""
        if self._mounting is None:
            q = q_icrs_to_cam
        else:
            q = self._mounting.q_icrs_to_body(q_icrs_to_cam)
        return self.convention.as_sent(q)

    def sample(self, sent: AttitudeSample) -> AttitudeSample:
        """The sample with the camera's attitude and motion, from one as it was sent."""
        sample = self.convention.sample(sent)
        if self._mounting is None:
            return sample
        return self._mounting.sample(sample)

    def decoder(self, decode: Callable[[bytes], Event]) -> Callable[[bytes], Event]:
        """A decoder whose samples are the camera's, made from `decode`; `decode` itself, at no cost
        for each message, where its samples are the camera's already.
        """
        if self._mounting is None and self.convention.is_hilstars:
            return decode
        from hilstar.attitude.wire.packet import AttitudeSample

        def decoded(message: bytes) -> Event:
            event = decode(message)
            if isinstance(event, AttitudeSample):
                return self.sample(event)
            return event

        return decoded


def packet_conventions(
    convention: Convention, source: str = "hilstar's packets and logs", reference: str = "ICRS"
) -> Conventions:
    """The conventions of packets, JSON and the logs that are written like them, for `--explain`.
    `reference` names the frame that attitudes refer to.
    """
    frames = [
        f"{reference} components",
        "body components" if convention.frame == "body" else "camera components",
    ]
    names = ["icrs" if reference == "ICRS" else "reference", convention.frame]
    if convention.direction == "cam_to_icrs":
        frames = frames[::-1]
        names = names[::-1]
    if convention.scalar == "first":
        order = "(w, x, y, z)"
    else:
        order = "(x, y, z, w)"
    return Conventions(
        source,
        f"q_{names[0]}_to_{names[1]} turns {frames[0]} into {frames[1]}",
        f"scalar {convention.scalar} {order}, Hamilton",
        "the sender's own clock, of any zero",
        of_body=convention.frame == "body",
        written=lambda q: f"q = {components(convention.as_sent(q))}",
        of_packets=True,
    )


PACKETS = packet_conventions(HILSTARS)
AS_SENT = SentAttitudes()
