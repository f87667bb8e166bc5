"""A bench file from disk: read, checked, and refused in one line where it is wrong."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import msgspec

from hilstar.attitude.wire.packet import MAX_SPEED_KM_S
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.bench.config.bench import TYPE_WORDS, BenchConfig
from hilstar.bench.config.render import DEFAULT_BRIGHTEST_V_MAG
from hilstar.bench.config.stream.road import check_road
from hilstar.bench.config.sync import check_sync
from hilstar.bench.config.when import with_epoch
from hilstar.errors import InputError, shortened
from hilstar.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.toml_tables import Kind, explained
from hilstar.units import LIGHT_KM_S

MAX_AREA_PX = 2**26  # twice an 8K monitor: half a gigabyte for each float64 image of it
HEADS = "heads"  # the key of a file that names bench files (see `bench.heads_file`)
KIND = Kind(BenchConfig, "configs/README.md", TYPE_WORDS)


def read_config(path: Path) -> BenchConfig:
    """Read and check a bench file. Raises InputError: file, key, what is wrong and what to write."""
    return parse_config(path, read_text(path, "give the path of a bench file", MAX_TOML_BYTES))


def parse_config(path: Path, text: str) -> BenchConfig:
    """Parse and check the text of the bench file `path`. Raises InputError: file, key, what is wrong and what to write."""
    return config_of(path, parse_toml(path, text))


def config_of(path: Path, tables: dict[str, Any]) -> BenchConfig:
    """Check the tables of the bench file `path`, as TOML gives them. Raises InputError as `parse_config` does."""
    if HEADS in tables:
        raise InputError(f"{path}: names several heads, and one bench file is wanted here; give one of its heads' files")
    _check_finite(tables, path)
    try:
        config = msgspec.convert(tables, BenchConfig)
    except InputError as error:  # what the detector's keys mean together
        raise InputError(f"{path}: [tracker.detector] {error}") from error
    except RecursionError as error:
        raise InputError(f"{path}: its tables are nested too deep; see {KIND.reference}") from error
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {explained(str(error), tables, KIND)}") from error
    _check_meaning(config, path)
    return with_epoch(_with_white(config), path, tables)


def _with_white(config: BenchConfig) -> BenchConfig:
    """The same with the default white where the file gives none: a bench's hash covers it."""
    render = config.render
    if render.flux_at_white_e_per_s is not None or render.brightest_v_mag is not None:
        return config
    return msgspec.structs.replace(config, render=msgspec.structs.replace(render, brightest_v_mag=DEFAULT_BRIGHTEST_V_MAG))


def _check_finite(value: Any, path: Path, where: str = "") -> None:
    """Refuse (InputError) nan and inf, which TOML allows and no key here does."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _check_finite(inner, path, f"{where}.{key}" if where else key)
    elif isinstance(value, list):
        for inner in value:
            _check_finite(inner, path, where)
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{path}: {shortened(where)} = {value}; a finite number is wanted")


def _check_meaning(config: BenchConfig, path: Path) -> None:
    """What a type cannot say."""
    _check_unit(path, "[collimator] q_cam_to_mon", config.collimator.q_cam_to_mon)
    if config.tracker.q_body_to_cam is not None:
        _check_unit(path, "[tracker] q_body_to_cam", config.tracker.q_body_to_cam)
    _check_areas(path, config)
    room_km_s = MAX_SPEED_KM_S if config.attitude.source == "vizard" else 0.0
    if math.hypot(*config.sky.observer_velocity_km_s) + room_km_s >= LIGHT_KM_S:
        raise InputError(f"{path}: [sky] observer_velocity_km_s is not slower than light; write km/s, ICRS x, y, z")
    if config.background.electrons_per_px is not None and config.background.zodiacal_v_mag_arcsec2 is not None:
        raise InputError(f"{path}: [background] has electrons_per_px and zodiacal_v_mag_arcsec2; write one of them")
    if config.render.flux_at_white_e_per_s is not None and config.render.brightest_v_mag is not None:
        raise InputError(f"{path}: [render] has flux_at_white_e_per_s and brightest_v_mag; write one of them")
    ideal = [
        name
        for name in ("true_focal_length_mm", "true_pixel_pitch_um", "true_q_cam_to_mon")
        if getattr(config.verify, name) is not None
    ]
    if config.verify.true_geometry is not None and ideal:
        raise InputError(f"{path}: [verify] true_geometry takes the place of {ideal[0]}; leave one of them out")
    if config.faults.endpoint is not None and config.faults.endpoint == config.attitude.address:
        raise InputError(
            f"{path}: [faults] endpoint = {config.faults.endpoint}: the attitude comes from there; write another port"
        )
    try:
        check_sync(config.sync, config.tracker, config.monitor, config.attitude)
    except InputError as error:  # it names the tables itself
        raise InputError(f"{path}: {error}") from error
    try:
        check_road(config.attitude)
    except InputError as error:
        raise InputError(f"{path}: [attitude] {error}") from error


def _check_areas(path: Path, config: BenchConfig) -> None:
    for table, (width, height) in (("tracker", config.tracker.resolution_px), ("monitor", config.monitor.resolution_px)):
        if width * height > MAX_AREA_PX:
            raise InputError(
                f"{path}: [{table}] resolution_px = [{width}, {height}]: {width * height / 1e6:.0f} million pixels; write"
                f" {MAX_AREA_PX / 1e6:.0f} million at most, such as [8192, 8192]"
            )


def _check_unit(path: Path, where: str, q: tuple[float, ...]) -> None:
    norm = math.hypot(*q)
    if abs(norm - 1) > NORM_TOLERANCE:
        raise InputError(f"{path}: {where}: its norm is {norm:.6g}; write a unit quaternion w, x, y, z")
