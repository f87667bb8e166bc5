"""The bench file: TOML in, checked and frozen tables out. Every key is documented in configs/README.md."""

from __future__ import annotations

import difflib
import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import Meta

from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.errors import InputError, shortened
from hilstar.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.tracker.detector import DetectorSettings

# The limits keep every product of such numbers within float64; no bench comes near them.
Positive = Annotated[float, Meta(ge=1e-6, le=1e12)]
NotNegative = Annotated[float, Meta(ge=0, le=1e12)]
Magnitude = Annotated[float, Meta(ge=-100, le=100)]
Pixels = Annotated[int, Meta(ge=1, le=32768)]
Size = tuple[Pixels, Pixels]
Sigma = tuple[Annotated[float, Meta(ge=0.05)], Annotated[float, Meta(ge=0.05)]]
Vector = tuple[float, float, float]
Rotation = tuple[float, float, float, float]

TYPE_WORDS = {"float": "number", "int": "whole number", "str": "text", "object": "table", "bool": "true or false"}
LIGHT_KM_S = 299_792.458
# White, where the file gives none. demo.toml, 200 random fields: the brightest code of 8 bits is 100 in the median (38 with
# Sirius for white), `verify` sees flux 0.065 mag off at 95 % (0.41), and 13 stars clip, one of them in 8 % of fields.
DEFAULT_BRIGHTEST_V_MAG = 1.5


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the bench file; unknown keys are refused."""


class Detector(_Table, frozen=True):
    """[tracker.detector]: the virtual tracker's sensor."""

    gain_e_per_dn: Positive = 24.0
    full_well_e: Positive = 70_000.0
    bits: Annotated[int, Meta(ge=1, le=16)] = 12
    offset_dn: NotNegative = 0.0
    read_noise_e: NotNegative = 0.0
    dark_e_per_s: NotNegative = 0.0
    dsnu_e_per_s: NotNegative = 0.0
    prnu: NotNegative = 0.0
    device_seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    fixed_pattern: Literal["ccd", "cmos"] = "ccd"
    temperature_k: Positive = 293.0
    dark_reference_temperature_k: Positive = 293.0
    dark_law: Literal["arrhenius", "ccd47-20"] = "arrhenius"
    dark_activation_ev: NotNegative = 0.56
    hot_pixel_fraction: NotNegative = 0.0
    hot_pixel_e_per_s: NotNegative = 10_000.0
    dead_pixel_fraction: NotNegative = 0.0
    column_noise_e: NotNegative = 0.0
    cosmic_rays_per_cm2_s: NotNegative = 0.0
    false_stars: Annotated[int, Meta(ge=0)] = 0
    false_star_e_per_s: NotNegative = 10_000.0
    false_star_sigma_px: Positive = 0.55
    blooming: bool = False
    quantisation_noise: bool = False


class Tracker(_Table, frozen=True):
    """[tracker]: the star tracker on the bench."""

    aperture_mm: Positive
    focal_length_mm: Positive
    pixel_pitch_um: Positive
    resolution_px: Size
    quantum_efficiency: str | float
    transmission: str | float = 1.0
    exposure_s: NotNegative = 0.1
    psf_sigma_px: Sigma = (0.55, 0.55)
    detector: Detector = msgspec.field(default_factory=Detector)


class SkySettings(_Table, frozen=True):
    """[sky]: which stars, and how bright."""

    catalogue: str = "hipparcos"
    epoch_jyear: Annotated[float, Meta(ge=-10_000, le=10_000)] = 2026.0
    faintest_v_mag: Magnitude = 7.5
    brightness: Literal["dgs", "ags"] = "dgs"
    # results/tradeoff.csv, spectrum: real spectra by V-I are 0.026 mag off (95 %), a black body 0.2.
    spectrum: Literal["blackbody", "pickles"] = "pickles"
    temperature: Literal["ballesteros2012", "wang2021"] = "ballesteros2012"
    zero_point: Literal["vega", "iau-bolometric"] = "vega"
    passband_weighting: Literal["energy", "photon"] = "energy"
    observer_velocity_km_s: Vector = (0.0, 0.0, 0.0)


class Monitor(_Table, frozen=True):
    """[monitor]: the screen behind the collimator."""

    resolution_px: Size
    pixel_pitch_um: Positive
    refresh_hz: Annotated[float, Meta(ge=0.01, le=1000)] = 60.0
    bits: Annotated[int, Meta(ge=1, le=16)] = 8
    calibration: str = "srgb"
    display: int | str = 0
    flip_x: bool = False
    flip_y: bool = False
    rotate_deg: Literal[0, 90, 180, 270] = 0
    panel_delay_ms: NotNegative = 0.0
    scanout_ms: NotNegative | None = None
    hold_ms: NotNegative | None = None
    photodiode_px: Annotated[int, Meta(ge=0, le=1000)] = 0
    photodiode: Literal["toggle", "code"] = "toggle"


class Collimator(_Table, frozen=True):
    """[collimator]: the lens between monitor and tracker, and the tracker's alignment to it."""

    focal_length_mm: Positive
    q_cam_to_mon: Rotation = (1.0, 0.0, 0.0, 0.0)
    principal_point_px: tuple[float, float] | None = None


class AttitudeSettings(_Table, frozen=True):
    """[attitude]: where the attitude comes from, and what is shown when it does not."""

    source: Literal["zmq", "serial"] = "zmq"
    endpoint: str = "tcp://127.0.0.1:5560"
    bind: bool | None = None
    lockstep: bool = False
    curve_secret_key: str | None = None
    curve_server_key: str | None = None
    allowed_clients: str | None = None
    port: str = ""
    baud: Annotated[int, Meta(gt=0, le=12_000_000)] = 115_200
    status_hz: Annotated[float, Meta(ge=0, le=1000)] = 10.0
    time_requests: bool = True
    clock: Literal["estimated", "shared"] = "estimated"
    stale_after_ms: NotNegative = 250.0
    max_extrapolation_ms: NotNegative = 250.0
    on_stale: Literal["hold", "blank"] = "hold"
    max_rate_deg_s: Annotated[float, Meta(ge=1e-3, le=1e9)] = 60.0


class RenderSettings(_Table, frozen=True):
    """[render]: from electrons to codes."""

    # results/tradeoff.csv, quantisation: the quickest, and code by code what anyone expects; exact is 9 times as right.
    quantisation: Literal["round", "dither", "temporal", "exact", "auto"] = "round"
    bit_stealing: bool = False
    cycle_frames: Literal[1, 2, 4, 8, 16, 32, 64, 128, 256] = 8
    sprite_sigma_px: Sigma = (0.85, 0.85)
    flux_at_white_e_per_s: Positive | None = None
    brightest_v_mag: Magnitude | None = None
    effort: Literal["full", "auto"] = "full"
    tolerance_mag: Positive = 0.02
    tolerance_px: Positive = 0.02
    # results/timing.csv: 69 arcsec at 2 deg/s without, 0.1 with it.
    motion: Literal["auto", "on", "off"] = "auto"
    motion_above_px: NotNegative = 0.01


class Background(_Table, frozen=True):
    """[background]: light between the stars, seen by the virtual tracker only."""

    electrons_per_px: NotNegative | None = None
    zodiacal_v_mag_arcsec2: Magnitude | None = None
    gradient_electrons_across: tuple[float, float] = (0.0, 0.0)


class Verify(_Table, frozen=True):
    """[verify]: the digital twin, and the limits within which it says that the bench passes."""

    true_calibration: str | None = None
    true_flux_at_white_e_per_s: Positive | None = None
    true_focal_length_mm: Positive | None = None
    true_pixel_pitch_um: Positive | None = None
    true_q_cam_to_mon: Rotation | None = None
    true_mirror: Literal["none", "x", "y", "swap"] = "none"
    flux_mag: Positive = 0.05
    centroid_px: Positive = 0.1
    lost_share: NotNegative = 0.02
    black_e_per_s_px: NotNegative | None = None


class BenchConfig(_Table, frozen=True):
    """A whole bench file."""

    tracker: Tracker
    monitor: Monitor
    collimator: Collimator
    sky: SkySettings = msgspec.field(default_factory=SkySettings)
    attitude: AttitudeSettings = msgspec.field(default_factory=AttitudeSettings)
    render: RenderSettings = msgspec.field(default_factory=RenderSettings)
    background: Background = msgspec.field(default_factory=Background)
    verify: Verify = msgspec.field(default_factory=Verify)


def detector_settings(tracker: Tracker) -> DetectorSettings:
    """The detector in the virtual tracker's own terms. Raises InputError for what no sensor has."""
    return DetectorSettings(**msgspec.structs.asdict(tracker.detector), pixel_pitch_um=tracker.pixel_pitch_um)


def read_config(path: Path) -> BenchConfig:
    """Read and check a bench file. Raises InputError: file, key, what is wrong and what to write."""
    tables = parse_toml(path, read_text(path, "give the path of a bench file", MAX_TOML_BYTES))
    try:
        config = msgspec.convert(_finite(tables, path), BenchConfig)
    except RecursionError as error:
        raise InputError(f"{path}: its tables are nested too deep; see configs/README.md") from error
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {_explained(str(error), tables)}") from error
    _check_meaning(config, path)
    return _with_white(config)


def _with_white(config: BenchConfig) -> BenchConfig:
    """The same with the default white where the file gives none: a bench's hash covers it."""
    render = config.render
    if render.flux_at_white_e_per_s is not None or render.brightest_v_mag is not None:
        return config
    return msgspec.structs.replace(config, render=msgspec.structs.replace(render, brightest_v_mag=DEFAULT_BRIGHTEST_V_MAG))


def _finite(value: Any, path: Path, where: str = "") -> Any:
    """`value` itself; TOML allows nan and inf, no key here does."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _finite(inner, path, f"{where}.{key}" if where else key)
    elif isinstance(value, list):
        for inner in value:
            _finite(inner, path, where)
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{path}: {shortened(where)} = {value}; a finite number is wanted")
    return value


def _explained(message: str, tables: dict[str, Any]) -> str:
    try:
        return _explain(message, tables)
    except (LookupError, TypeError, ValueError):  # a key of the user's own with brackets or quotes in it
        return f"{shortened(message)}; see configs/README.md"


def _explain(message: str, tables: dict[str, Any]) -> str:
    """msgspec's message ("... - at `$.tracker`") as table, key, value and advice."""
    fault, _, place = message.partition(" - at `$")
    names = [name for name in re.split(r"[.\[\]`]+", place) if name]
    unknown = re.search(r"unknown field `(.*)`", fault)
    if unknown:
        known = [field.name for field in _fields(names)]
        close = difflib.get_close_matches(unknown[1], known, n=1)
        advice = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
        return f"{_place(names)}unknown key {shortened(unknown[1])}; {advice}"
    missing = re.search(r"missing required field `(.*)`", fault)
    if missing:
        name = f"key {missing[1]}" if names else f"table [{missing[1]}]"
        return f"{_place(names)}the {name} is missing; add it (see configs/README.md)"
    wanted = fault.removeprefix("Expected ").replace("`", "").split(", got ")[0]
    for type_name, word in TYPE_WORDS.items():
        wanted = re.sub(rf"\b{type_name}\b", word, wanted)
    table, key = [n for n in names if not n.isdigit()][:-1], [n for n in names if not n.isdigit()][-1]
    if fault.startswith("Invalid enum"):
        wanted = " or ".join(f'"{choice}"' for choice in _choices(table, key))
    value: Any = tables
    for name in (*table, key):
        value = value[name]
    return f"{_place(table)}{key} = {_toml(value)}; {wanted} is wanted"


def _toml(value: Any) -> str:
    try:
        return shortened(msgspec.json.encode(value, enc_hook=str).decode())
    except (ValueError, OverflowError, TypeError, RecursionError):  # a whole number of more than 64 bits
        return shortened(value)


def _choices(table: list[str], key: str) -> tuple[str, ...]:
    kinds = {field.name: field.type for field in _fields(table)}
    return get_args(kinds[key])


def _place(names: list[str]) -> str:
    return f"[{'.'.join(names)}] " if names else ""


def _fields(names: list[str]) -> tuple[msgspec.structs.FieldInfo, ...]:
    table: Any = BenchConfig
    for name in names:
        table = {field.name: field.type for field in msgspec.structs.fields(table)}[name]
    return msgspec.structs.fields(table)


def _check_meaning(config: BenchConfig, path: Path) -> None:
    """What a type cannot say."""
    norm = math.hypot(*config.collimator.q_cam_to_mon)
    if abs(norm - 1) > NORM_TOLERANCE:
        raise InputError(f"{path}: [collimator] q_cam_to_mon: its norm is {norm:.6g}; write a unit quaternion w, x, y, z")
    if math.hypot(*config.sky.observer_velocity_km_s) >= LIGHT_KM_S:
        raise InputError(f"{path}: [sky] observer_velocity_km_s is not slower than light; write km/s, ICRS x, y, z")
    if config.background.electrons_per_px is not None and config.background.zodiacal_v_mag_arcsec2 is not None:
        raise InputError(f"{path}: [background] has electrons_per_px and zodiacal_v_mag_arcsec2; write one of them")
    if config.render.flux_at_white_e_per_s is not None and config.render.brightest_v_mag is not None:
        raise InputError(f"{path}: [render] has flux_at_white_e_per_s and brightest_v_mag; write one of them")
    if config.attitude.source == "serial" and not config.attitude.port:
        raise InputError(f'{path}: [attitude] source = "serial" needs port; write port = "/dev/ttyUSB0" or the like')
    if config.attitude.source == "serial" and config.attitude.lockstep:
        raise InputError(f'{path}: [attitude] lockstep = true is for source = "zmq"; leave one of them out')
    try:
        detector_settings(config.tracker)
    except InputError as error:
        raise InputError(f"{path}: [tracker.detector] {error}") from error
