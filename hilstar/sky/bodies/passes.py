"""Satellites that can be in view at a moment: their directions and their light at any time about
it.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.units import LIGHT_KM_S, NS_PER_S, magnitude
from hilstar.sky.air import SiteAir
from hilstar.sky.bodies.kernel import NS_PER_DAY
from hilstar.sky.bodies.orbit import Orbit, TleOrbit
from hilstar.sky.bodies.satellites import (
    MAX_PHASE_FACTOR,
    STANDARD_KM,
    Brightness,
    Satellite,
    Swarm,
    in_front,
    phase_factor,
    reflected_share,
    sunlit_share,
)
from hilstar.sky.stars import Stars, aberrate

log = logging.getLogger(__name__)

EARTH_GM_KM3_S2 = 398_600.4418  # IERS Conventions 2010
FASTEST_KM_S = 11.2  # escape speed: whatever stays about the Earth is slower
OWN_KM = 5.0  # what is nearer is taken for the observer itself; elements are off by 1 to 3 km a day
OLD_DAYS = 14.0
# Those that can come near the axis within this time, or before it turns by this angle, are looked
# for at once: 1 ms for 20 000.
WATCH_S, WATCH_RAD = 3.0, np.radians(3.0)
COS_WATCH = np.cos(WATCH_RAD)
HIDDEN_KM = 1.0  # in 3 s an arc is 40 m off a straight line
JUMP_KM = 10.0  # an observer that is elsewhere by more has jumped
MOST_SUN = 1.04  # sunlight over that at 1 au: the Earth is at most 1.7 % nearer
STEEPEST_PHASE = 1.82  # steepest slope of the phase factor, per radian
SHIFT_RAD = 4e-4  # aberration of what the Earth's motion shifts, and light time


@dataclass(frozen=True, slots=True)
class Circumstances:
    """Vectors (3,), ICRS axes: from the Earth to the Sun, km, and the Earth's velocity about the
    barycentre, km/s.
    """

    sun_km: FloatArray
    earth_km_s: FloatArray


@dataclass(frozen=True, slots=True)
class SkyAt:
    """A moment of the sky: its UTC, the circumstances (computed on demand), and the velocity that
    aberrates its bodies.

    `place_km` and `velocity_km_s` (3,) are the observer's about the Earth where the orbit does not
    say it, else None.
    """

    utc_ns: int
    now: Callable[[], Circumstances]
    fixed_km_s: FloatArray
    velocity_km_s: FloatArray | None = None
    place_km: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Cone:
    """A search for satellites of at least `faintest_e_per_s` within `radius_rad` of `axis` (3,),
    within `half_s` of a time.
    """

    axis: FloatArray
    radius_rad: float
    half_s: float
    faintest_e_per_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """Satellites that can be in view: `index` (n,), their places in the list; seconds of its
    methods count from its moment.

    Cubics in time, coefficients first (4, n, 3): `seen_km` from the observer to where each sent
    what arrives, `place_km` that about the Earth, and `observer_km` (4, 3). `since_s` is the moment
    after `epoch_utc`, `fixed_km_s` (3,) the observer's velocity at the start of the sky.
    """

    index: IntArray
    brightness: Brightness
    seen_km: FloatArray
    place_km: FloatArray
    observer_km: FloatArray
    since_s: float
    now: Circumstances
    fixed_km_s: FloatArray

    def __len__(self) -> int:
        return len(self.index)

    def only(self, which: IntArray) -> "Pass":
        """Only the satellites at places `which` (k,)."""
        return replace(
            self,
            index=self.index[which],
            seen_km=self.seen_km[:, which],
            place_km=self.place_km[:, which],
        )

    def through(self, air: SiteAir, utc_ns: int) -> Self:
        """The same through the air at a UTC: bent, and with the light that comes through, none
        below the horizon.
        """
        range_km = np.linalg.norm(self.seen_km[0], axis=1)[:, None]
        towards = self.seen_km[0] / range_km
        above = air.above(utc_ns)
        seen_km = self.seen_km.copy()
        seen_km[0] = above.bent(towards) * range_km
        altitude_rad = above.altitude_rad(towards)
        sunlight = np.full(len(self), -1)
        share = air.shares(sunlight, altitude_rad).mean(axis=0)
        standard = self.brightness.standard_e_per_s.copy()
        standard[self.index] *= share * (altitude_rad > 0)
        brightness = replace(self.brightness, standard_e_per_s=standard)
        return replace(self, seen_km=seen_km, brightness=brightness)

    def directions(
        self, which: IntArray | slice, seconds: FloatArray, velocity_km_s: FloatArray | None = None
    ) -> FloatArray:
        """Unit vectors (k, 3), ICRS, of satellites at places `which` (k,), aberrated as bodies are
        by `fixed_km_s`.

        A velocity (3,) adds to that, within 1 mas.
        """
        if velocity_km_s is None:
            velocity = self.fixed_km_s
        else:
            velocity = self.fixed_km_s + velocity_km_s
        from_observer_km = _at(self.seen_km[:, which], seconds[:, None])
        range_km = _lengths(from_observer_km)
        return aberrate(from_observer_km / range_km[:, None], velocity)

    def vectors_km(self, seconds: FloatArray) -> FloatArray:
        """Vectors (n, 3), km, from the observer to the satellites, each at its own of `seconds`
        (n,), light time included.
        """
        return _at(self.seen_km, seconds[:, None])

    def speeds_rad_s(self) -> FloatArray:
        """How fast each is at its nearest in view (n,): its speed over its distance."""
        distance_km = _lengths(self.seen_km[0])
        speed_km_s = _lengths(self.seen_km[1])
        return np.asarray(speed_km_s / distance_km)

    def rates_e_per_s(self, which: IntArray, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
        """Mean electron rates (k,) between two times.

        Distance, phase and shadow are those of the middle time; the satellite's own variation is
        averaged in closed form.
        """
        middle_s = ((begin_s + end_s) / 2)[:, None]
        listed = self.index[which]
        place = _at(self.place_km[:, which], middle_s)
        seen_km = _at(self.seen_km[:, which], middle_s)
        observer_km = _at(self.observer_km[:, None], middle_s)
        share = reflected_share(seen_km, place, self.now.sun_km)
        share = share * in_front(observer_km, place)
        varied = self.brightness.variation(listed, self.since_s + begin_s, self.since_s + end_s)
        return np.asarray(self.brightness.standard_e_per_s[listed] * share * varied)


def _at(cubic: FloatArray, s: FloatArray | np.float64) -> FloatArray:
    """A cubic, coefficients first, at a time in seconds."""
    a, b, c, d = cubic
    return np.asarray(a + s * (b + s * (c + s * d)))


def _lengths(vectors: FloatArray) -> FloatArray:
    """The lengths (n,) of vectors (n, 3)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


class Satellites:
    """A list of satellites seen from an orbit; t_ns = 0 is the UTC `zero_ns`, sunlight of V = 0
    gives `v0_e_per_s`.

    The observer's own, by catalogue number where the orbit has one, is left out, and what is within
    OWN_KM of it at a moment.
    """

    def __init__(
        self,
        satellites: Sequence[Satellite],
        brightness: Brightness,
        v0_e_per_s: float,
        orbit: Orbit,
        zero_ns: int,
    ) -> None:
        if isinstance(orbit, TleOrbit):
            own_number = orbit.number
        else:
            own_number = None
        self._v0_e_per_s = v0_e_per_s
        self.names = tuple(satellite.name for satellite in satellites)
        self.brightness = brightness
        self._satellites = satellites
        self._orbit = orbit
        self._zero_ns = zero_ns
        self._swarm = Swarm([satellite.satrec for satellite in satellites])
        self._numbers = np.array([satellite.number for satellite in satellites])
        self._other = np.ones(len(satellites), dtype=np.bool_)
        if own_number is not None:
            self._other = self._numbers != own_number
        self._watch: _Watch | None = None
        self._lost_told = False
        self._own_told = False
        self._age_told = False
        self._epoch_age_days = np.array([satellite.age_days(0) for satellite in satellites])
        self.file = "satellites"  # what they are called in a line about their age
        self._lost = 0
        self.listed = 0  # in the table of magnitudes
        self.sized = bool(brightness.size_m.any())

    def __len__(self) -> int:
        return len(self.names)

    def near(self, cone: Cone, sky: SkyAt) -> Pass | None:
        """The satellites in a cone at a moment, and some more; None for none."""
        self.place(sky.utc_ns)
        observer = self._observer(sky)
        in_cone = self._watched(cone, sky, observer)
        if not len(in_cone):
            return None
        from_observer_km = self._swarm.places_km(in_cone, sky.utc_ns) - observer[0]
        range_km = _lengths(from_observer_km)
        reach_km = _reach_km(observer, cone.half_s)
        now = sky.now()
        along_km = from_observer_km @ cone.axis
        near = _within(along_km, range_km, cone.radius_rad + SHIFT_RAD, reach_km)
        near &= range_km > OWN_KM
        brightest = self._brightest(in_cone, from_observer_km, range_km, reach_km, now)
        near &= brightest >= cone.faintest_e_per_s
        which = in_cone[near]
        if not len(which):
            return None
        motion_km = self._swarm.motion_km(which, sky.utc_ns)
        place, from_observer_km = _light_cubics(motion_km, observer, now.earth_km_s)
        since_s = (sky.utc_ns - self._zero_ns) / NS_PER_S
        return Pass(
            which, self.brightness, from_observer_km, place, observer, since_s, now, sky.fixed_km_s
        )

    def _observer(self, sky: SkyAt) -> FloatArray:
        """The cubic (4, 3) of the observer's places about the Earth, seconds after the moment."""
        place_km, velocity_km_s = self._orbit.state(sky.utc_ns)
        if sky.place_km is not None:
            place_km = place_km + sky.place_km
            if sky.velocity_km_s is not None:
                velocity_km_s = velocity_km_s + sky.velocity_km_s
        # It falls about the Earth; at rest where it is the Earth's centre.
        distance = float(np.linalg.norm(place_km))
        if distance > 0:
            pull = -EARTH_GM_KM3_S2 / distance**3
        else:
            pull = 0.0
        return np.stack([place_km, velocity_km_s, pull / 2 * place_km, pull / 6 * velocity_km_s])

    def _watched(self, cone: Cone, sky: SkyAt, observer: FloatArray) -> IntArray:
        """The satellites that can be in a cone, from the list that is kept for some time."""
        watch = self._watch
        if watch is None or not watch.covers(cone, sky.utc_ns, observer[0]):
            found = self._search(cone, sky, observer)
            watch = _Watch(cone, sky.utc_ns, observer, found)
            self._watch = watch
        return watch.found

    def _search(self, cone: Cone, sky: SkyAt, observer: FloatArray) -> IntArray:
        """The satellites of the whole list that can be in a cone, or in one near it, within WATCH_S
        of a moment, but the observer's own.
        """
        every = slice(None)
        from_observer_km = self._swarm.places_km(every, sky.utc_ns) - observer[0]
        range_km = _lengths(from_observer_km)
        self._tell_own(range_km)
        half_s = WATCH_S + cone.half_s
        reach_km = _reach_km(observer, half_s) + JUMP_KM
        radius_rad = cone.radius_rad + WATCH_RAD + SHIFT_RAD
        near = _within(from_observer_km @ cone.axis, range_km, radius_rad, reach_km)
        candidates = np.flatnonzero(near & self._other)
        brightest = self._brightest(
            candidates, from_observer_km[candidates], range_km[candidates], reach_km, sky.now()
        )
        candidates = candidates[brightest >= cone.faintest_e_per_s]
        # What is in the shadow, or well behind the Earth, at both ends of an arc that is nearly
        # straight is so between them.
        lit = np.zeros(len(candidates))
        sun_km = sky.now().sun_km
        for seconds in np.array([-half_s, half_s]):
            place = self._swarm.places_km(candidates, sky.utc_ns, seconds)
            observer_then = _at(observer, seconds)[None]
            is_seen = in_front(observer_then, place, HIDDEN_KM)
            lit += sunlit_share(place, sun_km) * is_seen
        return np.asarray(candidates[lit > 0])

    def _brightest(
        self,
        which: IntArray,
        seen_km: FloatArray,
        range_km: FloatArray,
        reach_km: float,
        now: Circumstances,
    ) -> FloatArray:
        """Upper bounds (n,) of the electron rates of satellites while they move by up to
        `reach_km`: outside the Earth's shadow, and in a flash.
        """
        range_km = np.maximum(range_km, OWN_KM)
        closest_km = np.maximum(range_km - reach_km, OWN_KM)
        to_sun = now.sun_km / np.linalg.norm(now.sun_km)
        cos_phase = np.clip(-(seen_km @ to_sun) / range_km, -1.0, 1.0)
        steepest = STEEPEST_PHASE * reach_km / closest_km
        diffuse = np.minimum(phase_factor(cos_phase) + steepest, MAX_PHASE_FACTOR)
        share = MOST_SUN * diffuse * (STANDARD_KM / closest_km) ** 2
        standard_e_per_s = self.brightness.standard_e_per_s[which]
        return np.asarray(standard_e_per_s * self.brightness.most(which) * share)

    def write(
        self, stars: Stars, index: IntArray, vectors: FloatArray, electrons_per_s: FloatArray
    ) -> None:
        """Put satellites (k,) into the arrays of stars that were made with this list: unit
        vectors (k, 3) and rates (k,).
        """
        place = len(stars) - len(stars.bodies) + index
        stars.vectors[place] = vectors
        stars.electrons_per_s[place] = electrons_per_s
        stars.v_mag[place] = magnitude(electrons_per_s / self._v0_e_per_s)

    def place(self, utc_ns: int) -> int:
        """Prepare the places for a UTC and return how many satellites have one; log the others
        once, in one line.
        """
        if self._swarm.move_to(utc_ns):
            self.warn_of_age(utc_ns)
            self._lost = int(np.count_nonzero(self._swarm.error))
            self._tell_lost()
        return len(self) - self._lost

    def warn_of_age(self, utc_ns: int) -> None:
        """One line, once, where elements are more than OLD_DAYS from a UTC."""
        if self._age_told:
            return
        ages = np.abs(self._epoch_age_days + utc_ns / NS_PER_DAY)
        old = int((ages > OLD_DAYS).sum())
        if old:
            self._age_told = True
            log.warning(
                "%s: the elements of %d of %d satellites are more than %.0f days from the sky's"
                " date (%.0f at most); a low orbit is off by 1 to 3 km a day",
                self.file,
                old,
                len(ages),
                OLD_DAYS,
                ages.max(),
            )

    def _tell_lost(self) -> None:
        """One line, once, of the satellites that have no place."""
        if self._lost_told or not self._lost:
            return
        from sgp4.api import SGP4_ERRORS

        self._lost_told = True
        lost = np.flatnonzero(self._swarm.error)
        first = int(lost[0])
        reason = SGP4_ERRORS.get(int(self._swarm.error[first]), "no number")
        log.warning(
            "%d of %d satellites have no place by their elements at this time and are left out,"
            " such as %s: %s",
            len(lost),
            len(self),
            self.names[first],
            reason,
        )

    def _tell_own(self, range_km: FloatArray) -> None:
        """One line, once, of a satellite that is the observer itself."""
        if self._own_told:
            return
        own_indices = np.flatnonzero(~self._other | (range_km < OWN_KM))
        if len(own_indices):
            self._own_told = True
            log.warning(
                "%s is the observer itself, or within %g km of it, and is not drawn",
                self.names[int(own_indices[0])],
                OWN_KM,
            )


@dataclass(frozen=True, slots=True, eq=False)
class _Watch:
    """The satellites that can be in a cone, or in one near it, within WATCH_S of a moment; of
    the observer's path then.
    """

    cone: Cone
    utc_ns: int
    observer_km: FloatArray
    found: IntArray

    def covers(self, cone: Cone, utc_ns: int, observer_km: FloatArray) -> bool:
        """Whether the satellites that were looked up include all that can be in this cone."""
        seconds = (utc_ns - self.utc_ns) / NS_PER_S
        if abs(seconds) > WATCH_S or float(cone.axis @ self.cone.axis) < COS_WATCH:
            return False
        kept = self.cone
        is_wider = cone.radius_rad > kept.radius_rad or cone.half_s > kept.half_s
        if is_wider or cone.faintest_e_per_s < kept.faintest_e_per_s:
            return False
        jump = observer_km - _at(self.observer_km, np.float64(seconds))
        return float(jump @ jump) < JUMP_KM**2


def _reach_km(observer: FloatArray, half_s: float) -> float:
    """How far a satellite can move against the observer, by its cubic (4, 3)."""
    return half_s * (FASTEST_KM_S + float(np.linalg.norm(observer[1])))


def _within(
    along_km: FloatArray, range_km: FloatArray, radius_rad: float, reach_km: float
) -> BoolArray:
    """Whether vectors (n,), of lengths `range_km` and with parts `along_km` along an axis, can come
    within `radius_rad` of the axis when their ends move by up to `reach_km`.
    """
    held_km = np.maximum(range_km, reach_km + OWN_KM)
    moved = np.arcsin(np.minimum(1.0, reach_km / held_km))
    limit = np.cos(np.minimum(np.pi, radius_rad + moved))
    return np.asarray((along_km >= limit * range_km) | (range_km <= reach_km))


def _light_cubics(
    place_km: FloatArray, observer_km: FloatArray, earth_km_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Cubics (4, n, 3) of where satellites sent what arrives, about the Earth and from the
    observer, by their places.
    """
    from_observer_km = place_km - observer_km[:, None]
    towards_km = from_observer_km[0]
    distance_km = _lengths(towards_km)
    late_s = (distance_km / LIGHT_KM_S)[:, None]
    outward_km2_s = np.einsum("ij,ij->i", towards_km, from_observer_km[1])
    receding = (outward_km2_s / distance_km / LIGHT_KM_S)[:, None]
    _, velocity, bend, _ = place_km
    sent = place_km.copy()
    sent[0] -= late_s * (velocity - late_s * bend)
    sent[1] -= receding * velocity + 2 * late_s * bend
    from_observer_km = sent - observer_km[:, None]
    # Meanwhile the Earth, and what is about it, has moved on: that undoes the aberration by its
    # velocity.
    from_observer_km[0] -= late_s * earth_km_s
    from_observer_km[1] -= receding * earth_km_s
    return sent, from_observer_km
