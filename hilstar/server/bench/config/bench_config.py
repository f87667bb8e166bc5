"""The whole bench file: read, its keys checked together, and refused in one line where it is
wrong.
"""

import math
import time
import warnings
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.basics.toml_tables import Kind, Table, explained
from hilstar.basics.units import LIGHT_KM_S, MAX_SPEED_KM_S, NS_PER_S
from hilstar.server.bench.config import hardware
from hilstar.server.bench.config.alignment import AlignmentSettings, check_alignment
from hilstar.server.bench.config.answers import AnswersSettings, check_answers
from hilstar.server.bench.config.attitude import AttitudeSettings, FaultSettings, check_road
from hilstar.server.bench.config.certify import CertifySettings
from hilstar.server.bench.config.render import (
    DEFAULT_BRIGHTEST_V_MAG,
    MAX_JUDGED_FRAMES,
    RenderSettings,
)
from hilstar.server.bench.config.sensor import with_sensor
from hilstar.server.bench.config.sky import (
    GEOCENTRE,
    SOURCE,
    Background,
    SiteSettings,
    SkySettings,
    SpacecraftSettings,
)

TYPE_WORDS = {
    "float": "number",
    "int": "whole number",
    "str": "text",
    "object": "table",
    "bool": "true or false",
}
UNIX_JD, DAY_NS = 2_440_587.5, 86_400 * NS_PER_S
J2000_JD, J2000_JYEAR, JYEAR_DAYS = 2_451_545.0, 2000.0, 365.25
EPOCH_KEY = "[sky] epoch_utc ="
FROM_SOURCE, UNIX = "source", "unix"
TT_FROM_TAI_NS, TAI_FROM_GPS_NS = 32_184_000_000, 19 * NS_PER_S  # TDB is TT within 2 ms
SCALES = ("UTC", "TAI", "TT", "TDB", "GPS")
MAX_AREA_PX = 2**26  # twice an 8K monitor: half a gigabyte for each float64 image of it
HEADS = "heads"  # the key of a file that names bench files (see `HeadsFile`)


class BenchConfig(Table, frozen=True):
    """A whole bench file."""

    tracker: hardware.Tracker
    monitor: hardware.Monitor
    collimator: hardware.Collimator
    sky: SkySettings = msgspec.field(default_factory=SkySettings)
    spacecraft: SpacecraftSettings = msgspec.field(default_factory=SpacecraftSettings)
    attitude: AttitudeSettings = msgspec.field(default_factory=AttitudeSettings)
    render: RenderSettings = msgspec.field(default_factory=RenderSettings)
    background: Background = msgspec.field(default_factory=Background)
    verify: hardware.Verify = msgspec.field(default_factory=hardware.Verify)
    sync: hardware.SyncSettings = msgspec.field(default_factory=hardware.SyncSettings)
    faults: FaultSettings = msgspec.field(default_factory=FaultSettings)
    certify: CertifySettings = msgspec.field(default_factory=CertifySettings)
    alignment: AlignmentSettings | None = None
    answers: AnswersSettings | None = None
    site: SiteSettings | None = None

    @property
    def exposure_frames(self) -> int:
        """The frames of the tracker's exposure by which `temporal` is judged."""
        if self.render.cycle_frames is not None:
            return self.render.cycle_frames
        return min(
            max(1, round(self.tracker.exposure_s * self.monitor.refresh_hz)), MAX_JUDGED_FRAMES
        )


def epoch_utc_ns(config: BenchConfig) -> int | None:
    """The UTC of t = 0, ns since 1970 where every day has 86400 s; None where the file has none.
    Raises InputError.
    """
    if config.sky.epoch_utc is None:
        return None
    if config.sky.epoch_utc == UNIX:
        return 0
    if config.sky.epoch_utc == FROM_SOURCE:
        raise InputError(
            f'{EPOCH_KEY} "{FROM_SOURCE}" is for a log that has dates (replay, simulate --log,'
            " attitude LOG); write the UTC of t_ns = 0"
        )
    # importing ERFA takes 30 ms, which only a date needs
    from hilstar.attitude.logs.earth import utc_ns_of

    return utc_ns_of(config.sky.epoch_utc, EPOCH_KEY)


def sky_jd(config: BenchConfig, t_ns: int | None) -> float:
    """The Julian date of a moment of a bench that has a date (None: the start), UTC. Raises
    InputError.
    """
    if t_ns is None:
        return J2000_JD + (config.sky.epoch_jyear - J2000_JYEAR) * JYEAR_DAYS
    return UNIX_JD + ((epoch_utc_ns(config) or 0) + t_ns) / DAY_NS


def has_observer(config: BenchConfig) -> bool:
    """Whether the sky is seen from a known place: a spacecraft's, or for its bodies the Earth's
    centre.
    """
    bodies = config.sky.bodies
    shown = (
        bodies.planets or bodies.moon or bodies.sun or bodies.earth or bodies.satellites is not None
    )
    return shown or config.spacecraft.orbit is not None or config.site is not None


def drives_apart(config: BenchConfig) -> bool:
    """Whether the codes of the primaries are each its own, for the colours of stars."""
    if config.render.colour is not None or config.render.bit_stealing:
        return config.render.colour == "star"
    return config.tracker.detector.bayer is not None


def from_source(config: BenchConfig) -> bool:
    """Whether the source of the attitudes says where the spacecraft is."""
    return config.spacecraft.orbit == SOURCE


def with_dates(config: BenchConfig, scale: str | None, first_ns: int) -> BenchConfig:
    """The configuration for a source that gives the dates: its first time, ns since 1970 on a time
    scale (see `Conventions`).

    `epoch_utc` is then the UTC of its t_ns = 0 by the leap seconds of that day, and `epoch_jyear`
    the beginning of the day: for it stars are placed. Unchanged where the file has a date of its
    own. Raises InputError for a source without dates, and for one whose times are none of Unix
    where the file says that they are.
    """
    if config.sky.epoch_utc == UNIX:
        if scale in SCALES and scale != "UTC":
            raise InputError(
                f'{EPOCH_KEY} "{UNIX}": the times of this log are {scale}; write "{FROM_SOURCE}"'
            )
        return _on_day(config, UNIX, first_ns)
    if config.sky.epoch_utc != FROM_SOURCE:
        return config
    if scale not in SCALES:
        raise InputError(
            f'{EPOCH_KEY} "{FROM_SOURCE}": the times of this log are no dates in'
            f" {', '.join(SCALES[:-1])} or {SCALES[-1]}; write the UTC of t_ns = 0"
        )
    if scale == "UTC":
        return _on_day(config, UNIX, first_ns)
    ahead_ns = _ahead_of_utc_ns(scale, first_ns)
    return _on_day(config, str(np.datetime64(-ahead_ns, "ns")), first_ns - ahead_ns)


def today(config: BenchConfig) -> BenchConfig:
    """The configuration with stars of the present day, by this machine's clock, where t_ns
    counts from 1970.
    """
    if config.sky.epoch_utc == UNIX:
        return _on_day(config, UNIX, time.time_ns())
    return config


def _on_day(config: BenchConfig, epoch_utc: str, utc_ns: int) -> BenchConfig:
    """The configuration with this `epoch_utc`, and stars placed for the beginning of a UTC's
    day.
    """
    day = jyear(utc_ns // DAY_NS * DAY_NS)
    return msgspec.structs.replace(
        config, sky=msgspec.structs.replace(config.sky, epoch_utc=epoch_utc, epoch_jyear=day)
    )


def jyear(utc_ns: int) -> float:
    """The Julian year of a UTC."""
    import erfa

    return float(erfa.epj(UNIX_JD, utc_ns / DAY_NS))


def _ahead_of_utc_ns(scale: str, t_ns: int) -> int:
    """How far a time scale is ahead of UTC at a time of it, ns since 1970."""
    import erfa

    tai_from_ns = {"TAI": 0, "GPS": -TAI_FROM_GPS_NS}.get(scale, TT_FROM_TAI_NS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # years after the last known leap second
        tai = UNIX_JD, (t_ns - tai_from_ns) / DAY_NS
        utc = erfa.taiutc(*tai)
        year, month, day, _ = erfa.jd2cal(*utc)
        return tai_from_ns + round(float(erfa.dat(year, month, day, 0.0)) * NS_PER_S)


KIND = Kind(BenchConfig, "configs/README.md", TYPE_WORDS)


def read_config(path: Path) -> BenchConfig:
    """Read and check a bench file. Raises InputError: file, key, what is wrong and what to
    write.
    """
    return parse_config(path, read_text(path, "give the path of a bench file", MAX_TOML_BYTES))


def parse_config(path: Path, text: str) -> BenchConfig:
    """Parse and check the text of the bench file `path`. Raises InputError: file, key, what is
    wrong and what to write.
    """
    return config_of(path, parse_toml(path, text))


def config_of(path: Path, tables: dict[str, Any]) -> BenchConfig:
    """Check the tables of the bench file `path`, as TOML gives them. Raises InputError as
    `parse_config` does.
    """
    if HEADS in tables:
        raise InputError(
            f"{path}: names several heads, and one bench file is wanted here; give one of its"
            " heads' files"
        )
    try:
        _check_finite(tables)
        tables = with_sensor(tables)
        config = _converted(tables)
        _check_meaning(config)
        _check_sky(config, tables)
        render = config.render
        sky = config.sky
        # A bench's hash covers the default white, and the Julian year of `epoch_utc`.
        if render.flux_at_white_e_per_s is None and render.brightest_v_mag is None:
            render = msgspec.structs.replace(render, brightest_v_mag=DEFAULT_BRIGHTEST_V_MAG)
        if render.colour == "depth":
            render = msgspec.structs.replace(render, bit_stealing=True)
        if sky.epoch_utc not in {FROM_SOURCE, UNIX}:
            utc_ns = epoch_utc_ns(config)
            if utc_ns is not None:
                sky = msgspec.structs.replace(sky, epoch_jyear=jyear(utc_ns))
        return msgspec.structs.replace(config, render=render, sky=sky)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _converted(tables: dict[str, Any]) -> BenchConfig:
    try:
        return msgspec.convert(tables, BenchConfig)
    except InputError as error:  # what the detector's keys mean together
        raise InputError(f"[tracker.detector] {error}") from error
    except RecursionError as error:
        raise InputError(f"its tables are nested too deep; see {KIND.reference}") from error
    except msgspec.ValidationError as error:
        raise InputError(explained(str(error), tables, KIND)) from error


def _check_finite(value: Any, where: str = "") -> None:
    """Refuse (InputError) nan and inf, which TOML allows and no key here does."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _check_finite(inner, f"{where}.{key}" if where else key)
    elif isinstance(value, list):
        for inner in value:
            _check_finite(inner, where)
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{shortened(where)} = {value}; a finite number is wanted")


def _check_meaning(config: BenchConfig) -> None:
    for where, q in (
        ("[collimator] q_cam_to_mon", config.collimator.q_cam_to_mon),
        ("[tracker] q_body_to_cam", config.tracker.q_body_to_cam),
    ):
        if q is not None and abs(math.hypot(*q) - 1) > NORM_TOLERANCE:
            raise InputError(
                f"{where}: its norm is {math.hypot(*q):.6g}; write a unit quaternion w, x, y, z"
            )
    for table, (width, height) in (
        ("tracker", config.tracker.resolution_px),
        ("monitor", config.monitor.resolution_px),
    ):
        if width * height > MAX_AREA_PX:
            raise InputError(
                f"[{table}] resolution_px = [{width}, {height}]: {width * height / 1e6:.0f} million"
                f" pixels; write {MAX_AREA_PX / 1e6:.0f} million at most, such as [8192, 8192]"
            )
    render = config.render
    faults = config.faults
    if render.flux_at_white_e_per_s is not None and render.brightest_v_mag is not None:
        raise InputError(
            "[render] has flux_at_white_e_per_s and brightest_v_mag; write one of them"
        )
    ideal = ("true_focal_length_mm", "true_pixel_pitch_um", "true_q_cam_to_mon")
    beside = next((name for name in ideal if getattr(config.verify, name) is not None), None)
    if config.verify.true_geometry is not None and beside is not None:
        raise InputError(
            f"[verify] true_geometry takes the place of {beside}; leave one of them out"
        )
    if faults.endpoint is not None and faults.endpoint == config.attitude.address:
        raise InputError(
            f"[faults] endpoint = {faults.endpoint}: the attitude comes from there; write another"
            " port"
        )
    hardware.check_channels(config.tracker)
    hardware.check_primaries(config.monitor.primaries)
    _check_colour(config)
    if config.alignment is not None:
        check_alignment(config.alignment)
    hardware.check_sync(config.sync, config.tracker, config.monitor, config.attitude)
    try:
        check_road(config.attitude)
    except InputError as error:
        raise InputError(f"[attitude] {error}") from error
    _check_answers(config)
    _check_frames(config)


def _check_colour(config: BenchConfig) -> None:
    render = config.render
    if render.bit_stealing and render.colour not in (None, "depth"):
        raise InputError(
            f'[render] colour = "{render.colour}" and bit_stealing: the codes of r, g and b serve'
            " one; write one of them"
        )
    if render.colour == "star" and not config.monitor.primaries.known:
        raise InputError(
            '[render] colour = "star" needs the light of the primaries; write [monitor.primaries]'
            " file, or xy_r to _b"
        )


def _check_answers(config: BenchConfig) -> None:
    if config.answers is None:
        return
    try:
        check_answers(config.answers)
    except InputError as error:
        raise InputError(f"[answers] {error}") from error


def _check_frames(config: BenchConfig) -> None:
    """Refuse (InputError) attitudes or answers of a body in which nobody says how the camera
    sits.
    """
    for name, settings in (("attitude", config.attitude), ("answers", config.answers)):
        of_body = settings is not None and settings.convention.frame == "body"
        if of_body and config.tracker.q_body_to_cam is None:
            needs = f'[{name}] convention = {{ frame = "body" }} needs [tracker] q_body_to_cam'
            raise InputError(f"{needs}; write how the camera sits")


def _check_sky(config: BenchConfig, tables: dict[str, Any]) -> None:
    sky = config.sky
    background = config.background
    attitude = config.attitude
    if attitude.source == "vizard":
        room_km_s = MAX_SPEED_KM_S
    else:
        room_km_s = 0.0
    if math.hypot(*sky.observer_velocity_km_s) + room_km_s >= LIGHT_KM_S:
        raise InputError(
            "[sky] observer_velocity_km_s is not slower than light; write km/s, ICRS x, y, z"
        )
    levels = ("electrons_per_px", "zodiacal_v_mag_arcsec2", "zodiacal")
    given = [name for name in levels if getattr(background, name) is not None]
    if len(given) > 1:
        raise InputError(f"[background] has {given[0]} and {given[1]}; write one of them")
    if sky.epoch_utc is not None and "epoch_jyear" in tables.get("sky", {}):
        raise InputError("[sky] has epoch_utc and epoch_jyear; write one of them")
    if sky.bodies.satellite_magnitudes is not None and sky.bodies.satellites is None:
        raise InputError(
            "[sky.bodies] satellite_magnitudes is of no satellites; write satellites ="
            ' "tles.txt" too'
        )
    for needs, what in (
        (background.zodiacal is not None, "[background] zodiacal needs"),
        (config.site is not None, "[site] needs"),
        (has_observer(config), "[sky.bodies] and [spacecraft] need"),
        (sky.variables == "phase", '[sky] variables = "phase" needs'),
    ):
        if needs and sky.epoch_utc is None:
            raise InputError(f'{what} a date; write [sky] epoch_utc = "2026-11-21T00:00:00Z"')
    if has_observer(config) and any(sky.observer_velocity_km_s):
        raise InputError(
            "[sky] observer_velocity_km_s: with [sky.bodies], [spacecraft] or [site] the velocity"
            " follows from the ephemeris; leave it out"
        )
    _check_site(config)
    _check_orbit(config)


def _check_site(config: BenchConfig) -> None:
    if config.site is None:
        return
    if config.spacecraft.orbit is not None or config.sky.bodies.earth:
        if config.spacecraft.orbit is None:
            other = "[sky.bodies] earth"
        else:
            other = "[spacecraft] orbit"
        raise InputError(
            f"[site] is a place on the ground, and {other} is seen from above it; leave one of"
            " them out"
        )
    if config.attitude.source == "vizard" and config.attitude.use_velocity:
        raise InputError(
            '[site] is a place on the ground, and [attitude] source = "vizard" sends a'
            " spacecraft's velocity; write use_velocity = false"
        )


def _check_orbit(config: BenchConfig) -> None:
    attitude = config.attitude
    orbit = config.spacecraft.orbit
    if config.sky.bodies.earth and orbit in {None, GEOCENTRE}:
        raise InputError(
            "[sky.bodies] earth = true: from its centre no Earth is seen; write [spacecraft] orbit"
            " = the path of a TLE or an"
            f' OEM, or "{SOURCE}"'
        )
    if orbit == SOURCE and attitude.source != "vizard":
        raise InputError(
            f'[spacecraft] orbit = "{SOURCE}": of the sources of attitudes only "vizard" (Basilisk)'
            f' sends the spacecraft\'s place, and [attitude] source = "{attitude.source}"; write'
            " the path of a TLE or an OEM"
        )
    if orbit == SOURCE and not attitude.use_velocity:
        raise InputError(
            f'[attitude] use_velocity = false, and [spacecraft] orbit = "{SOURCE}" takes the'
            " source's place and velocity; leave use_velocity out"
        )
    if (
        orbit not in {None, GEOCENTRE, SOURCE}
        and attitude.source == "vizard"
        and attitude.use_velocity
    ):
        raise InputError(
            "[attitude] use_velocity = true adds Basilisk's velocity to that of [spacecraft]"
            ' orbit; write use_velocity = false, or orbit = "geocentre"'
        )
