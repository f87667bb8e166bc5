"""Basilisk's Vizard stream as a source of attitudes: live (Basilisk waits for each frame) or
broadcast (it waits for nobody).

Basilisk's sigma_BN = e tan(Phi/4) stands for the matrix [BN], which turns components of its
inertial frame N into those of the body B (Schaub and Junkins, Analytical Mechanics of Space
Systems, section 3.5). N is taken as ICRS.

Live: Basilisk's REQ socket connects, and hilstar's REP socket takes Vizard's place. Basilisk asks
and waits: PING until somebody answers, then for each step SIM_UPDATE (four parts: the word, two
empty ones, a VizMessage), REQUEST_INPUT where it shows a display, and REQUEST_IMAGE_<id> for each
camera whose time has come. Every request has exactly one answer, and Basilisk stops where a
SIM_UPDATE is not answered with OK.

Broadcast: Basilisk's PUB socket binds, and hilstar's SUB socket connects.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Literal, Unpack

import numpy as np

from hilstar.attitude.wire import packet as wire
from hilstar.attitude.wire.endpoint import parse_endpoint
from hilstar.attitude.wire.links import Arrival, Decoder, LockstepLink, Pictures, TrackerCamera
from hilstar.attitude.wire.roads import RawMessage
from hilstar.attitude.wire.source import Conventions, Mounting
from hilstar.attitude.wire.vizard_message import (
    Components,
    SimUpdate,
    VizBody,
    VizCamera,
    WireFormatError,
    decode_update,
)
from hilstar.attitude.wire.zmq_links import ZmqReceiver
from hilstar.attitude.wire.zmq_socket import SocketOptions, ZmqReply
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, printable, shortened
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.rotation import angle_between_rad, conjugate, multiply, rate_between_rad_s
from hilstar.basics.units import ARCSEC_PER_RAD, MAX_SPEED_KM_S, NS_PER_S

SIM_UPDATE = b"SIM_UPDATE"
# settings, models and maps of a large scenario go along with its spacecraft
MAX_UPDATE_BYTES = 1 << 22
MAX_NAMES = 8  # spacecraft named in a refusal
# Basilisk turns its camera (+z boresight, x right, y down, as `cam`) into Unity's before it sends
# it: sigma_CuC.
SIGMA_CAM_TO_UNITY = (1 / 3, 1 / 3, -1 / 3)
MAX_TURN_ARCSEC = 1.0
# relative difference of the fields of view: Basilisk's camera has no distortion
MAX_FIELD_SHARE = 0.01
M_PER_KM = 1000.0
EARTHS = ("earth", "earth_planet_data")  # as gravBodyFactory and its SPICE messages name it
REQUEST_IMAGE, MAX_DIGITS = b"REQUEST_IMAGE_", 20
# What is the same at every request: a pulse, and what a person has typed into Vizard (an empty
# VizInput: nothing).
PLAIN_ANSWERS = {b"PING": [b"PONG"], b"REQUEST_INPUT": [b"VIZARD_INPUT", b""]}
OK, ERROR = b"OK", b"ERROR"
HELD = 2
MAX_HELD_NS = NS_PER_S // 4
TURNS = (
    "sigma_BN turns components of Basilisk's inertial frame N, taken as ICRS (J2000), into body"
    " components"
)
VELOCITY = "the spacecraft's velocity, added to [sky] observer_velocity_km_s, aberrates the stars"
PLACE = (
    "its place and velocity about the Earth (at N's origin, where the message has none) are those"
    " of the observer"
)


def update_of(parts: list[bytes]) -> bytes | None:
    """The VizMessage of a SIM_UPDATE: its last part, with nothing but empty ones between; None
    where it is not that.
    """
    whole = len(parts) > 1 and parts[0] == SIM_UPDATE and not any(parts[1:-1])
    return parts[-1] if whole else None


def check_loopback(endpoint: str) -> None:
    """Refuse (InputError) an endpoint that other machines reach: Basilisk has no keys."""
    place = parse_endpoint(endpoint)
    if place.loopback:
        return
    port = place.address.rpartition(":")[2]
    forward = f"ssh -L {port}:127.0.0.1:{port} HOST"
    raise InputError(
        f"{endpoint}: not an address of this machine alone, and Basilisk knows no keys; forward its"
        f" port ({forward}) and write tcp://127.0.0.1:{port}"
    )


def quaternion_of_mrp(sigma: tuple[float, ...]) -> tuple[float, float, float, float]:
    """The quaternion (w, x, y, z) that turns N's components into the body's; an MRP and its
    shadow give q and -q.
    """
    x, y, z = sigma
    square = x * x + y * y + z * z
    share = -2.0 / (1.0 + square)  # 0 where the square overflows: then the shadow is 0
    if math.isfinite(square):
        w = (1.0 - square) / (1.0 + square)
    else:
        w = -1.0
    return w, share * x, share * y, share * z


def _written(q: FloatArray) -> str:
    """A body's attitude as Basilisk has it: the MRP of at most length 1."""
    if q[0] >= 0:
        sigma = -q[1:] / (1.0 + q[0])
    else:
        sigma = q[1:] / (1.0 - q[0])
    return f"sigma_BN = ({', '.join(f'{c:.7f}' for c in sigma)})"


# what is used of a message, besides the attitude
StateUse = Literal["attitude", "velocity", "state"]
TOLD: dict[StateUse, tuple[str, ...]] = {"attitude": (), "velocity": (VELOCITY,), "state": (PLACE,)}

CONVENTIONS = Conventions(
    "Basilisk's Vizard stream",
    TURNS,
    "modified Rodrigues parameters; the shadow set is the same attitude",
    "nanoseconds since the simulation began; it has no date",
    of_body=True,
    written=_written,
)


class DifferenceRates:
    """The rate and the acceleration at each sample from the attitudes of the last three.

    The mean rates of the last two intervals, carried on linearly to the newest sample: for steps h
    and a rate whose second derivative is j, the rate is short of the true one by j h^2 / 3 and the
    acceleration by j h. (The mean of the last interval alone would lag by half a step's change.)
    None for the first two of a row; a row ends where time goes back or stands, where a step is
    longer than `max_step_ns`, and where the turn exceeds `max_rate_rad_s`, which is a jump.
    """

    def __init__(self, max_step_ns: int, max_rate_rad_s: float) -> None:
        self._max_step_ns = max_step_ns
        self._max_rate_rad_s = max_rate_rad_s
        self._last: wire.AttitudeSample | None = None
        self._mean: tuple[FloatArray, float] | None = None

    def moving(self, sample: wire.AttitudeSample) -> wire.AttitudeSample:
        """The sample with its rate (3,), rad/s, and acceleration (3,), rad/s^2, in the
        components of its own frame.
        """
        before = self._last
        self._last = sample
        earlier = self._mean
        self._mean = None
        if before is None or not 0 < sample.t_ns - before.t_ns <= self._max_step_ns:
            return sample
        step_s = (sample.t_ns - before.t_ns) / NS_PER_S
        mean = rate_between_rad_s(before.q_icrs_to_cam, sample.q_icrs_to_cam, step_s)
        if math.hypot(*mean) > self._max_rate_rad_s:
            return sample
        self._mean = mean, step_s
        if earlier is None:
            return sample
        earlier_mean, earlier_s = earlier
        acceleration = (mean - earlier_mean) / ((step_s + earlier_s) / 2)
        rate = mean + acceleration * (step_s / 2)
        # the means are slow enough, but carried on to the end of the step they are not
        if math.hypot(*rate) > self._max_rate_rad_s:
            return sample
        return replace(sample, rate_cam_rad_s=rate, acceleration_cam_rad_s2=acceleration)


class Follower:
    """The attitudes of one spacecraft from messages: the one with the `name`, or the only one there
    is.

    With `taken` "velocity" each has the spacecraft's velocity against N's origin, with "state" its
    place and velocity about the Earth.
    """

    def __init__(
        self,
        name: str | None,
        mounting: Mounting,
        rates: DifferenceRates,
        taken: StateUse = "attitude",
    ) -> None:
        self._name = name
        self._mounting = mounting
        self._rates = rates
        self._taken = taken
        self.conventions = replace(CONVENTIONS, turns="; ".join((TURNS, *TOLD[taken])))

    def take(self, message: bytes) -> tuple[wire.AttitudeSample | wire.Refusal, SimUpdate | None]:
        """The camera's attitude in a VizMessage, or why there is none; and the message itself
        where it is one.
        """
        try:
            update = decode_update(message)
        except WireFormatError as error:
            return wire.Refusal("format", f"not Basilisk's VizMessage: {error}"), None
        chosen = self._chosen(update.spacecraft)
        if isinstance(chosen, wire.Refusal):
            return chosen, update
        if len(chosen.sigma_bn) != 3:
            what = (
                f"spacecraft {named(chosen)}: {len(chosen.sigma_bn)} components of its rotation"
                " (sigma_BN), not 3"
            )
            return wire.Refusal("format", what), update
        sample = wire.checked_sample(
            update.t_ns, quaternion_of_mrp(chosen.sigma_bn), None, update.frame % wire.U32
        )
        state = self._state(update, chosen)
        if isinstance(state, wire.Refusal):
            return state, update
        if isinstance(sample, wire.AttitudeSample):
            sample = replace(sample, place_km=state[0], velocity_km_s=state[1])
            sample = self._mounting.sample(self._rates.moving(sample))
        return sample, update

    def _state(
        self, update: SimUpdate, craft: VizBody
    ) -> tuple[FloatArray | None, FloatArray | None] | wire.Refusal:
        """Place (3,), km, and velocity (3,), km/s, as far as they are taken, or why they are not.

        A "state" is about the Earth's centre: where the message has it, else at N's origin. A
        "velocity" is against N's origin.
        """
        if self._taken == "attitude":
            return None, None
        place_m = craft.position_m
        velocity_m_s = craft.velocity_m_s
        if self._taken == "state":
            earth = next((body for body in update.bodies if body.name.lower() in EARTHS), VizBody())
            place_m = _against(place_m, earth.position_m)
            velocity_m_s = _against(velocity_m_s, earth.velocity_m_s)
        speed_m_s = math.hypot(*velocity_m_s)
        far_km = math.hypot(*place_m) / M_PER_KM
        if len(velocity_m_s) != 3 or not speed_m_s <= MAX_SPEED_KM_S * M_PER_KM:
            if velocity_m_s:
                state_text = f"{speed_m_s:.3g} m/s"
            else:
                state_text = "nothing"
            advice = (
                f"it is {MAX_SPEED_KM_S:g} km/s at most; [attitude] use_velocity = false leaves"
                " it out"
            )
            return wire.Refusal(
                "format", f"spacecraft {named(craft)}: its velocity is {state_text}, and {advice}"
            )
        velocity = np.array(velocity_m_s) / M_PER_KM
        if self._taken == "velocity":
            return None, velocity
        if len(place_m) == 3 and wire.MIN_PLACE_KM < far_km < wire.MAX_PLACE_KM:
            return np.array(place_m) / M_PER_KM, velocity
        if place_m:
            state_text = f"{far_km:.4g} km from the Earth's centre"
        else:
            state_text = "nowhere"
        advice = (
            f'[spacecraft] orbit = "source" takes {wire.MIN_PLACE_KM:g} to {wire.MAX_PLACE_KM:g} km'
        )
        return wire.Refusal(
            "format", f"spacecraft {named(craft)}: it is {state_text}, and {advice}"
        )

    def _chosen(self, spacecraft: tuple[VizBody, ...]) -> VizBody | wire.Refusal:
        """The spacecraft that is followed; parts of others (a parent is named) are taken only by
        their own name.
        """
        if self._name is None:
            candidates = [craft for craft in spacecraft if craft.parent in {"", craft.name}]
        else:
            candidates = [craft for craft in spacecraft if craft.name == self._name]
        if len(candidates) == 1:
            return candidates[0]
        names = (
            ", ".join(map(named, (candidates if self._name is None else spacecraft)[:MAX_NAMES]))
            or "none"
        )
        if self._name is None:
            return wire.Refusal(
                "format",
                f'spacecraft: {names}; write the one that is meant, [attitude] spacecraft = "NAME"',
            )
        wanted = shortened(printable(self._name))
        return wire.Refusal(
            "format",
            f"[attitude] spacecraft = {wanted}: {len(candidates)} have that name; there: {names}",
        )


def q_body_to_cam(camera: VizCamera) -> FloatArray | None:
    """How Basilisk has mounted a camera: its sigma_CB as a quaternion from body to camera; None
    where it is not said.
    """
    if len(camera.sigma) != 3 or not all(map(math.isfinite, camera.sigma)):
        return None
    cam_to_unity, body_to_unity = (
        np.array(quaternion_of_mrp(s)) for s in (SIGMA_CAM_TO_UNITY, camera.sigma)
    )
    return multiply(conjugate(cam_to_unity), body_to_unity)


def disagreement(camera: VizCamera, tracker: TrackerCamera) -> str | None:
    """A line about where Basilisk's camera is not the bench's tracker; None where they are the
    same.
    """
    differences = []
    mounted = q_body_to_cam(camera)
    if mounted is not None:
        turn_arcsec = angle_between_rad(mounted, tracker.q_body_to_cam) * ARCSEC_PER_RAD
        if turn_arcsec > MAX_TURN_ARCSEC:
            q = ", ".join(f"{c:.7f}" for c in mounted)
            differences.append(
                f"its sigma_CB is q_body_to_cam = ({q}), {turn_arcsec / 3600:.4g} deg from the"
                " bench's"
            )
    if camera.resolution_px and camera.resolution_px != tracker.resolution_px:
        differences.append(
            "it has {} x {} px, not {} x {}".format(
                *(*camera.resolution_px, 0)[:2], *tracker.resolution_px
            )
        )
    field_deg = camera.field_of_view_deg
    if abs(field_deg - tracker.field_of_view_deg) > MAX_FIELD_SHARE * tracker.field_of_view_deg:
        differences.append(
            f"its field along y is {field_deg:.4g} deg, not {tracker.field_of_view_deg:.4g}"
        )
    if not differences:
        return None
    return (
        f"Basilisk's camera {camera.identity} is not the bench's [tracker], whose pictures it gets:"
        f" {'; '.join(differences)}"
    )


def named(craft: VizBody) -> str:
    """A spacecraft's name for a person."""
    return shortened(printable(craft.name)) or "one without a name"


def _against(own: Components, other: Components) -> Components:
    if len(own) == len(other) == 3:
        return tuple(a - b for a, b in zip(own, other, strict=True))
    return own


class VizardLive(LockstepLink):
    """A REP socket in Vizard's place; it binds, or connects with `bind=False`. Pictures of
    cameras are answered here.
    """

    asks_for_pictures = True
    _road: ZmqReply

    def __init__(self, endpoint: str, follower: Follower, **options: Unpack[SocketOptions]) -> None:
        check_loopback(endpoint)
        options["max_part_bytes"] = MAX_UPDATE_BYTES
        super().__init__(ZmqReply(endpoint, **options), follower.conventions)
        self._follower = follower
        self._tracker: TrackerCamera | None = None
        self._pictures: Pictures | None = None
        self._sample: wire.AttitudeSample | None = None  # at the last step
        self._described: dict[int, VizCamera] = {}
        self._compared: set[int] = set()

    def show_camera(self, tracker: TrackerCamera, pictures: Pictures | None) -> None:
        """What to answer for the pictures of Basilisk's cameras: those of the tracker at the
        last step, or none.
        """
        self._tracker = tracker
        self._pictures = pictures

    def receive(self, timeout_ms: int) -> Arrival[wire.Event] | None:
        """The next step, or None; it must be answered before the next request can arrive."""
        request = self._road.request(timeout_ms)
        if request is None:
            return None
        parts = list(request.parts)
        word = parts[0]
        if word == SIM_UPDATE:
            return self._step(request.host_ns, parts)
        number = word.removeprefix(REQUEST_IMAGE)[:MAX_DIGITS]
        if word.startswith(REQUEST_IMAGE) and number.isdigit():
            image = self._picture(int(number))
            # the length goes ahead, big-endian; 0 where there is none
            self._road.put_parts([len(image).to_bytes(4, "big"), image])
            return None
        if word not in PLAIN_ANSWERS:
            self._notices.tell(
                "unknown-request", f"{shortened(repr(word[:40]))} is none of Basilisk's requests"
            )
        self._road.put_parts(PLAIN_ANSWERS.get(word, [ERROR]))
        return None

    def _step(self, host_ns: int, parts: list[bytes]) -> Arrival[wire.Event]:
        self._sample = None
        message = update_of(parts)
        if message is None:
            return Arrival(
                host_ns,
                wire.Refusal("format", f"SIM_UPDATE of {len(parts)} parts; Basilisk sends four"),
                parts[-1],
            )
        event, update = self._follower.take(message)
        self._sample = event if isinstance(event, wire.AttitudeSample) else None
        if update is not None:
            self._described |= {camera.identity: camera for camera in update.cameras}
        return Arrival(host_ns, event, message)

    def _picture(self, camera: int) -> bytes:
        """The tracker's picture at the last step, for a camera's number; empty where there is
        none.
        """
        if camera in self._described and camera not in self._compared and self._tracker is not None:
            self._compared.add(camera)
            trouble = disagreement(self._described[camera], self._tracker)
            if trouble is not None:
                self._notices.tell("other-camera", trouble)
        if self._sample is None or self._pictures is None:
            return b""
        return self._pictures(self._sample)

    def answer(self, status: wire.Status, shown_ns: int, refusal: wire.Refusal | None) -> None:
        """Let the simulation go on; or, where its step was refused, end it."""
        self._road.put_parts([OK if refusal is None else ERROR])


class Opening:
    """Holds the very first two attitudes back until a third says how they turn: shown alone they
    would stand still.

    For MAX_HELD_NS at most. Where another simulation begins later, `clock.jumps` is in doubt about
    its first ones anyway.
    """

    def __init__(self) -> None:
        self._held: list[Arrival[wire.Event]] = []
        self._opens = True

    def passed(self, arrivals: list[Arrival[wire.Event]], now_ns: int) -> list[Arrival[wire.Event]]:
        """The messages to pass on now, of those that arrived and those held back."""
        out: list[Arrival[wire.Event]] = []
        for arrival in arrivals:
            sample = arrival.event
            if not isinstance(sample, wire.AttitudeSample):
                out.append(arrival)
                continue
            if self._opens and sample.rate_cam_rad_s is None and len(self._held) < HELD:
                self._held.append(arrival)
            else:
                out += [*self._released(), arrival]
        if self._held and now_ns - self._held[0].host_ns > MAX_HELD_NS:
            out += self._released()
        return out

    def _released(self) -> list[Arrival[wire.Event]]:
        released = self._held
        self._held = []
        self._opens = False
        return released


class BroadcastDecoder(Decoder):
    """What SIM_UPDATE messages mean; the very first ones are held back for a moment."""

    def __init__(self, follower: Follower, clock: HostClock = HOST_CLOCK) -> None:
        self._follower = follower
        self.conventions = follower.conventions
        self._clock = clock
        self._opening = Opening()

    def arrivals(self, messages: Iterable[RawMessage]) -> list[Arrival[wire.Event]]:
        """The decoded messages, with those that were held back before."""
        return self._opening.passed(super().arrivals(messages), self._clock.now_ns())

    def _arrival(self, message: RawMessage) -> Arrival[wire.Event]:
        parts = list(message.parts)
        update = update_of(parts)
        if update is None:
            refusal = wire.Refusal(
                "format",
                f"a message of {len(parts)} parts; Basilisk sends SIM_UPDATE and a VizMessage",
            )
            return Arrival(message.host_ns, refusal, parts[-1], message.waited_ns)
        return Arrival(message.host_ns, self.event(update), update, message.waited_ns)

    def event(self, message: bytes) -> wire.Event:
        """See `Decoder.event`."""
        return self._follower.take(message)[0]


def vizard_broadcast(
    endpoint: str, follower: Follower, *, bind: bool = False, notices: Notices | None = None
) -> ZmqReceiver:
    """A SUB socket for SIM_UPDATE messages; other topics (SYNC_SETTINGS) do not arrive. It
    connects, or binds with `bind`.
    """
    check_loopback(endpoint)
    decoder = BroadcastDecoder(follower)
    return ZmqReceiver(
        endpoint,
        bind=bind,
        notices=notices,
        topic=SIM_UPDATE,
        max_part_bytes=MAX_UPDATE_BYTES,
        decoder=decoder,
    )
