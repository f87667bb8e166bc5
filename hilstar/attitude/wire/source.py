"""What a source of attitudes means by its numbers, and how they become the attitude of the camera.

Two steps, in this order, each of which may be the identity:
1. The convention: a quaternion as it was sent becomes the Hamilton one, scalar first, that turns
   ICRS components into those of the sender's frame. Rates are of that frame with respect to the
   ICRS, in its own components, whatever the convention.
2. The mounting: an attitude and a rate of the body become the camera's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from hilstar.basics.toml_tables import Table

# NumPy takes 70 ms, and a process that only stamps packets needs none; a bench file needs no
# packets
if TYPE_CHECKING:
    from hilstar.attitude.wire.packet import AttitudeSample, Event
    from hilstar.basics.arrays import FloatArray

Components = tuple[float, float, float, float]
IDENTITY: Components = (1.0, 0.0, 0.0, 0.0)
# by places: a tenth of what numpy.roll takes
SCALAR_FROM_LAST, SCALAR_TO_LAST = [3, 0, 1, 2], [1, 2, 3, 0]
# Orion's belt at roll 0, which everybody finds: the star is Alnilam (HIP 26311), 15 arcsec from the
# boresight.
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
        """Whether a quaternion is sent as hilstar has it, of whichever frame."""
        return self.scalar == "first" and self.direction == "icrs_to_cam"

    def q_icrs_to_frame(self, sent: FloatArray) -> FloatArray:
        """The Hamilton quaternion (4,), scalar first, of a unit quaternion (4,) in the order in
        which it was sent.
        """
        from hilstar.basics.rotation import conjugate

        if self.scalar == "first":
            q = sent
        else:
            q = sent[SCALAR_FROM_LAST]
        if self.direction == "cam_to_icrs":
            return conjugate(q)
        return q

    def as_sent(self, q_icrs_to_frame: FloatArray) -> FloatArray:
        """What a sender of this convention sends for an attitude (4,) of its frame."""
        from hilstar.basics.rotation import conjugate

        if self.direction == "cam_to_icrs":
            q = conjugate(q_icrs_to_frame)
        else:
            q = q_icrs_to_frame
        return q if self.scalar == "first" else q[SCALAR_TO_LAST]

    def sample(self, sent: AttitudeSample) -> AttitudeSample:
        """The sample with its quaternion from ICRS to its frame; its rate is what it was."""
        if self.is_hilstars:
            return sent
        return replace(sent, q_icrs_to_cam=self.q_icrs_to_frame(sent.q_icrs_to_cam))

    def __str__(self) -> str:
        """As a bench file has it."""
        return (
            f'{{ scalar = "{self.scalar}", direction = "{self.direction}", frame ='
            f' "{self.frame}" }}'
        )


HILSTARS = Convention()


class Mounting:
    """How the camera sits in the body: `q_body_to_cam`, which turns body components into camera
    components.

    None where nobody has said: the camera's axes are then taken as the body's, and `told` says so.
    `by_option`: the command line says it (`--mounting`), which is refused where the source is not
    the body's.
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
        """The camera's attitude and motion of a sample that holds the body's: q_icrs_to_body,
        rate in body components.
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
        """Camera components (3,) of a vector in body components (3,)."""
        return self._matrix @ in_body

    def q_icrs_to_body(self, q_icrs_to_cam: FloatArray) -> FloatArray:
        """The body's attitude of the camera's."""
        from hilstar.basics.rotation import conjugate, multiply

        return multiply(conjugate(self.q_body_to_cam), q_icrs_to_cam)


@dataclass(frozen=True, slots=True)
class Conventions:
    """What a source means by its numbers: `--explain` shows it, and the documentation says the
    same.

    `turns` says from which frame to which; `scalar` the order of the components; `time` the scale
    and the zero of its times; `of_body` whether `[tracker] q_body_to_cam` applies; `written` gives
    an attitude in the source's own words; `scale` is the time scale (UTC, TAI, TT, TDB, GPS) whose
    ns since 1970-01-01T00:00:00 its times are, in days of 86400 s; None for others. `of_packets`: a
    `Convention` says what its quaternions are, and its times are plain numbers (of
    `time_unit` in a log).
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
        """What the user must know of the mounting: that nobody stated one, or that one is stated
        and not used.
        """
        if self.of_body:
            return mounting.told
        if self.of_packets and not mounting.is_identity:
            return [("mounting", UNUSED)]
        return []

    def lines(self, mounting: Mounting) -> list[str]:
        """The conventions, and the self-check, for a person."""
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
    """Components as text with seven digits, in the order given."""
    return "(" + ", ".join(f"{c:.7f}" for c in q) + ")"


class SentAttitudes:
    """The way from what a sender sends to the camera's attitude: its convention, then the mounting
    where that is the body's.

    Links hand it their decoders, so that whoever reads a link sees the camera's attitudes, and the
    bytes as they came.
    """

    def __init__(self, convention: Convention = HILSTARS, mounting: Mounting | None = None) -> None:
        self.convention = convention
        self.conventions = packet_conventions(convention)
        turns = convention.frame == "body" and mounting is not None and not mounting.is_identity
        self._mounting = mounting if turns else None

    def q_icrs_to_cam(self, sent: FloatArray) -> FloatArray:
        """The camera's attitude of a unit quaternion (4,) in the order in which it was sent."""
        from hilstar.basics.rotation import multiply

        q = self.convention.q_icrs_to_frame(sent)
        if self._mounting is None:
            return q
        return multiply(self._mounting.q_body_to_cam, q)

    def as_sent(self, q_icrs_to_cam: FloatArray) -> FloatArray:
        """What the sender sends for an attitude (4,) of the camera."""
        if self._mounting is None:
            q = q_icrs_to_cam
        else:
            q = self._mounting.q_icrs_to_body(q_icrs_to_cam)
        return self.convention.as_sent(q)

    def sample(self, sent: AttitudeSample) -> AttitudeSample:
        """The camera's attitude and motion of a sample as it was sent."""
        sample = self.convention.sample(sent)
        if self._mounting is None:
            return sample
        return self._mounting.sample(sample)

    def decoder(self, decode: Callable[[bytes], Event]) -> Callable[[bytes], Event]:
        """A decoder whose samples are the camera's; `decode` itself where they are already, which
        costs nothing.
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
    """The conventions of packets, JSON and the logs that are written like them; `reference` is what
    attitudes refer to.
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
