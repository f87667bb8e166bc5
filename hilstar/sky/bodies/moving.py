"""The part of a bench's sky that moves: bodies, and with the observer's velocity the aberration of
all stars.

What is costly is computed seldom: places by the ephemeris once in three hours, with cubics between
them; apparent places and magnitudes at steps of the observer's orbit, the places with straight
lines between them. All of it depends on the time alone, so a replay draws the same light. For an
observer whose place comes with each frame it is all computed with each frame.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import ARCSEC_PER_RAD, LIGHT_KM_S, NS_PER_S, flux_ratio
from hilstar.sky.air import SiteAir
from hilstar.sky.bodies.disc import Disc
from hilstar.sky.bodies.earth_disc import (
    DARK_V_MAG,
    apparent_cone,
    at_centre,
    earth_disc,
    earth_light,
)
from hilstar.sky.bodies.kernel import (
    DAY_S,
    UNIX_JD,
    Kernel,
    Viewpoint,
    apparent_bodies,
    apparent_stars,
    tdb_of_utc,
)
from hilstar.sky.bodies.light import SUN_BV_MAG, body_v_mag, phase_angle_deg
from hilstar.sky.bodies.orbit import Orbit
from hilstar.sky.bodies.passes import Circumstances, Cone, Pass, Satellites, SkyAt
from hilstar.sky.bodies.shapes import (
    EARTH,
    LAWS,
    NORTH,
    POLAR_RADII_KM,
    RADII_KM,
    lunar_share,
    pole,
)
from hilstar.sky.stars import Stars, aberrate, with_bodies

log = logging.getLogger(__name__)

PLANETS = ("Mercury", "Venus", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune")
# The ephemeris takes 3 ms for all bodies at the ends of this time and twice between; cubics through
# them are within 0.1 mas.
SPAN_S = 3 * 3600
SPAN_NS, MINUTE_NS = SPAN_S * NS_PER_S, 60 * NS_PER_S
YEAR_NS = 31_557_600 * NS_PER_S
EDGE_DAYS = 1.0  # light time, and the cubics
# A change of velocity that is left out, as aberrating all stars in view anew takes as long as their
# projection: 0.02 arcsec, which the Earth takes an hour and a half to reach.
UNSEEN_KM_S = 0.03
EXPONENTS = np.arange(4)
CUBIC_AT = np.linspace(0.0, 1.0, 4)
CUBIC = np.linalg.inv(np.vander(CUBIC_AT, increasing=True))
J2000_JD, YEAR_DAYS = 2_451_545.0, 365.25


@dataclass(frozen=True, slots=True)
class Span:
    """Cubics over SPAN_S, coefficients first: vectors (4, n, 3) to bodies as seen from the
    Earth, its place and velocity.
    """

    seen_km: FloatArray
    earth_km: FloatArray
    earth_km_s: FloatArray


@dataclass(frozen=True, slots=True)
class SkyMoment:
    """A time since the start, and the observer's state about the Earth, km and km/s, where it
    comes with the frame.
    """

    since_ns: int
    state: tuple[float, float, float, float, float, float] | None = None


START = SkyMoment(0)


@dataclass(frozen=True, slots=True)
class Sight:
    """Bodies as an observer sees them at a moment: vectors `seen_km` (n, 3), unit vectors (n, 3),
    and the viewpoint.

    From the Earth's own centre the direction to the Earth means nothing. `place_km` and
    `about_earth_km_s` (3,) are the observer's place and velocity about that centre.
    """

    seen_km: FloatArray
    view: Viewpoint
    directions: FloatArray
    place_km: FloatArray
    about_earth_km_s: FloatArray


@dataclass(frozen=True, slots=True)
class BodyLight:
    """Bodies by name, their B-V (n,) and their electron rates at V = 0 (n,).

    `colours` (n, channels) and those of `sunlight` (channels,) are shares of electrons, as in
    `Stars`.
    """

    names: tuple[str, ...]
    bv_mag: FloatArray
    v0_e_per_s: FloatArray
    colours: FloatArray | None = None
    sunlight: FloatArray | None = None


NOTHING = BodyLight((), np.empty(0), np.empty(0))


class MovingSky:
    """Bodies seen from an orbit; t_ns = 0 is the UTC `utc_ns`, and stars are placed for t_ns =
    `start_ns`.

    Times that its methods call `since_ns` count from `start_ns`. Where t_ns is `unix` time, every
    UTC day has 86400 s of it, leap seconds or not, and `start_ns` is the beginning of one.

    Raises InputError where the ephemeris ends before that date, or the orbit does.
    """

    def __init__(
        self,
        kernel: Kernel,
        orbit: Orbit,
        utc_ns: int,
        bodies: BodyLight = NOTHING,
        start_ns: int = 0,
        unix: bool = False,
    ) -> None:
        self.names = names = bodies.names
        self._kernel = kernel
        self._orbit = orbit
        self._utc_ns = utc_ns + start_ns
        self._start_ns = start_ns
        self._bodies = bodies
        self._unix = unix
        self._epoch = tdb_of_utc(self._utc_ns)
        self._tracked = ("Sun", *(name for name in names if name != "Sun"))
        self._drawn = [self._tracked.index(name) for name in names]
        self._earth = names.index(EARTH) if EARTH in names else None
        self._radii_km = np.array([RADII_KM[name] for name in names])
        self._limits_ns = self._limits()
        self._step_ns = round(orbit.step_s * NS_PER_S)
        self._span: Callable[[int], Span] = lru_cache(maxsize=2)(self._compute_span)
        self._node: Callable[[SkyMoment], FloatArray] = lru_cache(maxsize=2)(self._compute_node)
        self._light: Callable[[SkyMoment], tuple[FloatArray, FloatArray]] = lru_cache(maxsize=1)(
            self._compute_light
        )
        self._face: Callable[[SkyMoment, int], Disc] = lru_cache(maxsize=len(names) + 1)(
            self._compute_face
        )
        self._circumstances: Callable[[int], Circumstances] = lru_cache(maxsize=2)(
            self._compute_circumstances
        )
        self.satellites: Satellites | None = None
        self.air: SiteAir | None = None  # over an observer on the ground
        self._told = False
        self._fixed_km_s = self._seen_from(START).view.velocity_km_s

    def stars_seen(self, directions: FloatArray, parallax_mas: FloatArray) -> FloatArray:
        """Unit vectors (n, 3) of stars in directions (n, 3) from the barycentre, as they are
        seen at the start.
        """
        return apparent_stars(directions, parallax_mas, self._seen_from(START).view)

    def among(self, stars: Stars) -> Stars:
        """The stars with the bodies among them at the start, in arrays of their own, which `seen`
        changes.

        Satellites have places in the arrays, which whoever draws them fills (see `passing`).
        """
        if self.satellites is not None:
            colour = np.full(len(self.satellites), SUN_BV_MAG)
            stars = with_bodies(
                stars, self.satellites.names, colour, found=False, colours=self._bodies.sunlight
            )
        both = with_bodies(stars, self.names, self._bodies.bv_mag, colours=self._bodies.colours)
        self.seen(both)  # which writes the bodies into the arrays
        return both

    def seen(
        self,
        stars: Stars,
        t_ns: int | None = None,
        velocity_km_s: FloatArray | None = None,
        place_km: FloatArray | None = None,
    ) -> Stars:
        """Stars made by `among` as they are seen at a moment (None: the start): bodies are moved
        there, in the arrays.

        A velocity (3,), ICRS, adds to that of this sky's observer, and a place (3,), from the
        Earth's centre, to its place.
        """
        moment = self._moment(t_ns, velocity_km_s, place_km)
        now = self._at(moment)
        count = len(self.names)
        velocity = _against_start(now, velocity_km_s)
        if count:
            vectors = now[:count, :3].copy()
            if self._earth is not None and velocity is not None:
                # its aberration is its own
                vectors[[self._earth]] = aberrate(vectors[[self._earth]], -velocity)
            stars.vectors[-count:] = vectors
            stars.grid.centre[-count:] = vectors
            v_mag, rates = self._light(self._step(moment))
            stars.v_mag[-count:] = v_mag
            stars.electrons_per_s[-count:] = rates
        apparent = stars.seen_at(velocity)
        if self.air is None:
            return apparent
        utc_ns = self._utc_ns + moment.since_ns
        circumstances = self._circumstances(moment.since_ns // MINUTE_NS)
        self.air.check_sun(circumstances.sun_km, utc_ns)
        return self.air.over(apparent, utc_ns)

    def utc_ns(self, t_ns: int | None) -> int:
        """The UTC of a moment (None: the start), ns since 1970, held within the ephemeris."""
        return self._utc_ns + self._within(t_ns)

    def passing(
        self, cone: Cone, t_ns: int | None = None, *velocity_and_place: FloatArray | None
    ) -> Pass | None:
        """The satellites that can be in a cone at a moment; None for none; the observer's
        velocity and place as in `seen`.
        """
        if self.satellites is None:
            return None
        since_ns = self._within(t_ns)
        now = partial(self._circumstances, since_ns // MINUTE_NS)
        utc_ns = self._utc_ns + since_ns
        sky = SkyAt(utc_ns, now, self._fixed_km_s, *velocity_and_place)
        satellite_pass = self.satellites.near(cone, sky)
        if satellite_pass is None or self.air is None:
            return satellite_pass
        return satellite_pass.through(self.air, utc_ns)

    def satellites_placed(self, t_ns: int | None) -> int:
        """How many of the satellites have a place by their elements at a moment."""
        if self.satellites is None:
            return 0
        return self.satellites.place(self._utc_ns + self._within(t_ns))

    def _compute_circumstances(self, minute: int) -> Circumstances:
        """The Sun and the Earth's velocity at a minute: 2.5 arcsec of the Sun, 0.4 m/s."""
        since_ns = minute * MINUTE_NS
        cubics = self._span(since_ns // SPAN_NS)
        share = since_ns % SPAN_NS / SPAN_NS
        powers = share**EXPONENTS
        seen_km = np.tensordot(powers, cubics.seen_km, 1)
        return Circumstances(seen_km[0], powers @ cubics.earth_km_s)

    def discs(
        self,
        axis: FloatArray,
        reach_rad: float,
        wider_than_rad: float = 0.0,
        t_ns: int | None = None,
        velocity_km_s: FloatArray | None = None,
        place_km: FloatArray | None = None,
    ) -> list[Disc]:
        """The bodies wider than that, any part of which is within `reach_rad` of `axis` (3,),
        nearest first; else as `seen`.

        Places and sizes are the moment's, light and the Sun's direction those of the last step of
        the orbit.
        """
        if not self.names:
            return []
        moment = self._moment(t_ns, velocity_km_s, place_km)
        now = self._at(moment)
        radius_rad = now[:-1, 4]
        farthest_rad = np.minimum(reach_rad + radius_rad, np.pi)
        near = now[:-1, :3] @ axis > np.cos(farthest_rad)
        near &= 2 * radius_rad > wider_than_rad
        if not near.any():
            return []
        directions = now[:-1, :3].copy()
        velocity = _against_start(now, velocity_km_s)
        if self._earth is None:
            others = near
        else:
            others = near & (np.arange(len(near)) != self._earth)
        if velocity is not None:
            directions[others] = aberrate(directions[others], velocity)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        step = self._step(moment)
        discs = []
        for i in np.flatnonzero(near).tolist():
            face = self._face(step, i)
            distance_km = float(now[i, 3])
            discs.append(_moved(face, directions[i], distance_km))
        if self.air is not None:
            discs = _through(self.air, discs, self._utc_ns + moment.since_ns)
        return sorted(discs, key=lambda disc: disc.distance_km)

    def distances_km(
        self,
        t_ns: int | None = None,
        velocity_km_s: FloatArray | None = None,
        place_km: FloatArray | None = None,
    ) -> FloatArray:
        """How far the bodies (n,) are, in the order of `names`; else as `seen`."""
        now = self._at(self._moment(t_ns, velocity_km_s, place_km))
        return now[:-1, 3]

    def _moment(
        self, t_ns: int | None, velocity_km_s: FloatArray | None, place_km: FloatArray | None
    ) -> SkyMoment:
        """A time since the start, held within the ephemeris, with the observer's state about the
        Earth where it is given.
        """
        since_ns = self._within(t_ns)
        if place_km is None:
            return SkyMoment(since_ns)
        if velocity_km_s is None:
            velocity_km_s = np.zeros(3)
        x, y, z = place_km.tolist()
        u, v, w = velocity_km_s.tolist()
        return SkyMoment(since_ns, (x, y, z, u, v, w))

    def _step(self, moment: SkyMoment) -> SkyMoment:
        """The last step of the orbit; where the observer's state comes with the frame, the
        moment itself.
        """
        if moment.state is None:
            return SkyMoment(moment.since_ns // self._step_ns * self._step_ns)
        return moment

    def _at(self, moment: SkyMoment) -> FloatArray:
        """A node's rows (see `_compute_node`) at any moment."""
        if moment.state is not None:
            return self._node(moment)
        first = self._step(moment)
        last = SkyMoment(first.since_ns + self._step_ns)
        node = self._node(first)
        change = self._node(last) - node
        share = (moment.since_ns - first.since_ns) / self._step_ns
        return node + change * share

    def sight(self, since_ns: int) -> Sight:
        """The bodies at a moment, aberrated by the observer's velocity at the start; the Sun
        first.
        """
        return self._sight(SkyMoment(since_ns))

    def _sight(self, moment: SkyMoment) -> Sight:
        """As `sight`, of an observer whose state may come with the moment."""
        sight = self._seen_from(moment)
        start_view = replace(sight.view, velocity_km_s=self._fixed_km_s)
        return replace(sight, directions=apparent_bodies(sight.seen_km, start_view))

    def _seen_from(self, moment: SkyMoment) -> Sight:
        """The bodies at a moment, without their directions."""
        span, rest_ns = divmod(moment.since_ns, SPAN_NS)
        cubics = self._span(span)
        share = rest_ns / SPAN_NS
        powers = share**EXPONENTS
        lowered = np.maximum(EXPONENTS - 1, 0)
        slopes = EXPONENTS * share**lowered / SPAN_S
        place_km, about_km_s = self._orbit.state(self._utc_ns + moment.since_ns)
        from_earth_km = np.tensordot(powers, cubics.seen_km, 1)
        earth_km_s = powers @ cubics.earth_km_s
        velocity_km_s = earth_km_s + about_km_s
        if moment.state is not None:
            place_km = np.array(moment.state[:3])
            about_km_s = np.array(moment.state[3:])
        seen_km = from_earth_km - place_km
        # Light takes another time to the observer than to the Earth's centre: 22 ms at most in a
        # low orbit, 700 m of the Moon
        farther_km = np.linalg.norm(seen_km, axis=1) - np.linalg.norm(from_earth_km, axis=1)
        later_s = farther_km / LIGHT_KM_S
        own_km_s = np.tensordot(slopes, cubics.seen_km, 1) + earth_km_s
        seen_km -= own_km_s * later_s[:, None]
        if EARTH in self._tracked and at_centre(place_km):
            seen_km[self._tracked.index(EARTH)] = NORTH
        observer_km = powers @ cubics.earth_km + place_km
        view = Viewpoint(observer_km, velocity_km_s, -seen_km[0])
        return Sight(seen_km, view, np.empty((0, 3)), place_km, about_km_s)

    def diameters_arcsec(self, t_ns: int | None = None) -> dict[str, float]:
        """The apparent equatorial diameter of each body, arcsec."""
        sight = self.sight(self._within(t_ns))
        distance_km = np.linalg.norm(sight.seen_km[self._drawn], axis=1)
        diameters = {}
        for name, body_km in zip(self.names, distance_km, strict=True):
            # from its centre the Earth has no diameter
            if name == EARTH and at_centre(sight.place_km):
                continue
            radius_rad = float(np.arcsin(min(1.0, RADII_KM[name] / body_km)))
            diameters[name] = 2 * radius_rad * ARCSEC_PER_RAD
        return diameters

    def _compute_span(self, span: int) -> Span:
        """The cubics of a span, through four places of each body and of the Earth."""
        if self._unix:
            date = tdb_of_utc(self._utc_ns + span * SPAN_NS)
        else:
            date = self._epoch.after(span * SPAN_S)
        part = date.part + CUBIC_AT * SPAN_S / DAY_S
        earth_km, earth_km_s = self._kernel.earth(date.whole, part)
        seen_km = []
        for name in self._tracked:
            seen_km.append(self._kernel.seen_km(name, date.whole, part, earth_km))
        seen_cubics = np.tensordot(CUBIC, np.stack(seen_km, axis=1), 1)
        return Span(seen_cubics, CUBIC @ earth_km, CUBIC @ earth_km_s)

    def _compute_node(self, moment: SkyMoment) -> FloatArray:
        """Rows of the bodies' unit vectors, distances, km, and radii, rad; last the change of the
        observer's velocity.

        The Earth's is its disc's middle as it is seen, all aberration included.
        """
        sight = self._sight(moment)
        node = np.zeros((len(self.names) + 1, 5))
        node[:-1, :3] = sight.directions[self._drawn]
        node[:-1, 3] = np.linalg.norm(sight.seen_km[self._drawn], axis=1)
        if self._earth is not None and at_centre(sight.place_km):
            node[self._earth] = np.nan  # nowhere in view
        elif self._earth is not None:
            middle, distance_km = apparent_cone(-sight.place_km, sight.about_earth_km_s)
            node[self._earth, :3] = middle
            node[self._earth, 3] = distance_km
        sine = np.minimum(1.0, self._radii_km / node[:-1, 3])
        node[:-1, 4] = np.arcsin(sine)
        node[-1, :3] = sight.view.velocity_km_s - self._fixed_km_s
        return node

    def _compute_face(self, moment: SkyMoment, i: int) -> Disc:
        """The disc of a drawn body, with its light."""
        sight = self._sight(moment)
        name = self.names[i]
        if name == EARTH:
            return self._earth_disc(sight)
        row = self._drawn[i]
        seen_km = sight.seen_km[row]
        if name == "Sun":
            sun = NORTH  # its light comes from itself
            phase_deg = 0.0
        else:
            sun_km = sight.seen_km[0] - seen_km
            sun = sun_km / np.linalg.norm(sun_km)
            phase_deg = phase_angle_deg(-sun_km, seen_km)
        disc = Disc(
            name=name,
            direction=sight.directions[row],
            distance_km=float(np.linalg.norm(seen_km)),
            equator_km=RADII_KM[name],
            polar_km=POLAR_RADII_KM.get(name, RADII_KM[name]),
            pole=pole(name),
            sun=sun,
            law=LAWS.get(name, "lambert"),
            lunar_share=lunar_share(phase_deg) if name == "Moon" else 1.0,
        )
        _, rates = self._light(moment)
        return disc.of_rate(float(rates[i]))

    def _earth_disc(self, sight: Sight) -> Disc:
        """The Earth's disc as seen, with its light."""
        earth = self.names.index(EARTH)
        v0_e_per_s = float(self._bodies.v0_e_per_s[earth])
        from_sun_km = sight.view.from_sun_km - sight.place_km
        return earth_disc(-sight.place_km, from_sun_km, sight.about_earth_km_s, v0_e_per_s)

    def _compute_light(self, moment: SkyMoment) -> tuple[FloatArray, FloatArray]:
        """V and electrons per second (n,) of the bodies at a moment."""
        sight = self._sight(moment)
        jyear = self._jyear(moment.since_ns / NS_PER_S)
        from_sun_km = sight.seen_km + sight.view.from_sun_km
        v_mag = np.full(len(self.names), DARK_V_MAG)
        for body, (row, name) in enumerate(zip(self._drawn, self.names, strict=True)):
            # the Earth's light is that of its disc, below
            if name != EARTH:
                v_mag[body] = body_v_mag(name, from_sun_km[row], sight.seen_km[row], jyear)
        rates = self._bodies.v0_e_per_s * flux_ratio(v_mag)
        if self._earth is not None and not at_centre(sight.place_km):
            disc = self._earth_disc(sight)
            v0_e_per_s = float(self._bodies.v0_e_per_s[self._earth])
            earth_v_mag, earth_rate = earth_light(disc, v0_e_per_s)
            v_mag[self._earth] = earth_v_mag
            rates[self._earth] = earth_rate
        return v_mag, rates

    def _jyear(self, seconds: float) -> float:
        """The Julian year, TDB, at seconds since the start."""
        date = self._epoch.after(seconds)
        return 2000.0 + (date.whole - J2000_JD + date.part) / YEAR_DAYS

    def _limits(self) -> tuple[int, int]:
        """The first and the last time since the start in the ephemeris. Raises InputError where
        the start is beyond it.
        """
        first = self._kernel.first_jd + EDGE_DAYS
        last = self._kernel.last_jd - EDGE_DAYS
        first_ns = self._since_ns(first)
        last_ns = self._since_ns(last)
        if not first_ns <= 0 <= last_ns:
            raise InputError(
                f"[sky] epoch_utc: the ephemeris covers {_date(first)} to {_date(last)}; write a"
                " date between them"
            )
        return first_ns, last_ns

    def _since_ns(self, jd: float) -> int:
        """The time from the start to a Julian date, ns."""
        days = jd - self._epoch.whole - self._epoch.part
        return round(days * DAY_S * NS_PER_S)

    def _within(self, t_ns: int | None) -> int:
        """A time since the start, held within the ephemeris; a far one is told once, as it is
        most likely meant otherwise.
        """
        since_ns = 0 if t_ns is None else t_ns - self._start_ns
        if abs(since_ns) > YEAR_NS and not self._told:
            self._told = True
            log.warning(
                "t_ns = %d is %.1f years from the date of the stars, whose proper motion and"
                ' parallax stay: [sky] epoch_utc is the UTC of t_ns = 0, or "unix" where t_ns'
                " counts from 1970",
                t_ns,
                since_ns / YEAR_NS,
            )
        first_ns, last_ns = self._limits_ns
        return min(max(since_ns, first_ns), last_ns)


def _date(jd: float) -> str:
    """The day of a Julian date."""
    unix_s = round((jd - UNIX_JD) * DAY_S)
    return str(np.datetime64(unix_s, "s").astype("datetime64[D]"))


def _against_start(now: FloatArray, velocity_km_s: FloatArray | None) -> FloatArray | None:
    """The observer's velocity (3,), km/s, relative to that of the start, by which directions are
    aberrated; None where that moves nothing.
    """
    change = now[-1, :3]
    if velocity_km_s is not None:
        return np.asarray(change + velocity_km_s)
    if change @ change < UNSEEN_KM_S**2:
        return None
    return change


def _through(air: SiteAir, discs: list[Disc], utc_ns: int) -> list[Disc]:
    """Discs as the air shows them, those below the horizon left out; how it flattens them is
    left out too.
    """
    above = air.above(utc_ns)
    sunlight = np.array([-1])
    above_horizon = []
    for disc in discs:
        direction = disc.direction[None]
        altitude_rad = above.altitude_rad(direction)
        if altitude_rad[0] > -disc.radius_rad:
            share = float(air.shares(sunlight, altitude_rad).mean())
            light = disc.normal_e_per_s_sr * share
            bent = above.bent(direction)[0]
            above_horizon.append(replace(disc, direction=bent, normal_e_per_s_sr=light))
    return above_horizon


def _moved(face: Disc, direction: FloatArray, distance_km: float) -> Disc:
    """A disc elsewhere: its radiance does not depend on its distance."""
    return replace(face, direction=direction, distance_km=distance_km)
