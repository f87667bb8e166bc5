"""A bench's sensor by its name: the sheet's figures under the keys of the bench file."""

from typing import Any

from hilstar.basics.errors import InputError
from hilstar.tracker.sensors import Sensor, sensor_named

SENSOR, DETECTOR = "sensor", "detector"
EFFICIENCY = "quantum_efficiency"
EFFICIENCIES = (EFFICIENCY, *(f"{EFFICIENCY}_{channel}" for channel in "rgb"))
# Keys that a sensor's name stands for. Those of the detector have defaults, which are of another
# sensor: with a name they have to be stated.
TRACKER_KEYS = (EFFICIENCY, "pixel_pitch_um", "resolution_px")
DETECTOR_KEYS = ("gain_e_per_dn", "bits", "full_well_e", "read_noise_e", "dark_e_per_s")
# Another key that states the same.
INSTEAD = {"read_noise_e": "read_noise_table", "dark_e_per_s": "dark_quantiles"}
# A dark current of the file's own is at the file's own reference temperature.
DARK, OF_DARK = ("dark_e_per_s", "dark_quantiles"), ("dark_reference_temperature_k", "dsnu_e_per_s")
# Keys of the detector that are of how it is used, and stay with another sensor.
OF_USE = ("temperature_k", "device_seed", "noise_version", "solver_image")


def with_sensor(tables: dict[str, Any]) -> dict[str, Any]:
    """The tables of a bench file with the figures of `[tracker] sensor` where they have none of
    their own.

    Unchanged without that key. Raises InputError for a name that is not known, and for figures
    that neither its sheet nor the file states.
    """
    tracker = tables.get("tracker")
    name = tracker.get(SENSOR) if isinstance(tracker, dict) else None
    if not (isinstance(tracker, dict) and isinstance(name, str)):
        return tables
    stated = tracker.get(DETECTOR, {})
    # what is no table is refused with all other types
    if not isinstance(stated, dict):
        return tables
    sensor = sensor_named(name, f"[tracker] {SENSOR} =")
    optics = dict(sensor.tracker)
    if any(key in tracker for key in EFFICIENCIES):
        optics.pop(EFFICIENCY, None)
    figures = dict(sensor.detector)
    if any(key in stated for key in DARK):
        for key in OF_DARK:
            figures.pop(key, None)
    merged = {**optics, **tracker, DETECTOR: {**figures, **stated}}
    missing = missing_keys(merged)
    if missing:
        raise InputError(_asked(sensor, missing))
    return {**tables, "tracker": merged}


def missing_keys(tracker: dict[str, Any]) -> list[str]:
    """The figures of a sensor that a table [tracker] lacks: keys, with `detector.` before those
    of its table.
    """
    detector = tracker.get(DETECTOR, {})
    missing = [key for key in TRACKER_KEYS[1:] if key not in tracker]
    if not any(key in tracker for key in EFFICIENCIES):
        missing.insert(0, EFFICIENCY)
    for key in DETECTOR_KEYS:
        if key not in detector and INSTEAD.get(key) not in detector:
            missing.append(f"{DETECTOR}.{key}")
    return missing


def named_keys(keys: list[str]) -> str:
    """Keys of [tracker], those of its detector under the name of their table."""
    optics = [key for key in keys if "." not in key]
    detector = [key.partition(".")[2] for key in keys if "." in key]
    of_detector = [f"[tracker.{DETECTOR}] {', '.join(detector)}"] if detector else []
    return " and ".join([*([", ".join(optics)] if optics else []), *of_detector])


def lacking(sensor: Sensor, keys: list[str]) -> str:
    """The keys that a sensor's sheet lacks, and what it says of its efficiency."""
    text = named_keys(keys)
    if EFFICIENCY in keys and sensor.efficiency:
        points = ", ".join(f"{share:g} at {nm:g} nm" for nm, share in sensor.efficiency)
        text += f" ({EFFICIENCY} is known as {points} alone)"
    return text


def _asked(sensor: Sensor, missing: list[str]) -> str:
    text = f'[tracker] {SENSOR} = "{sensor.name}": its sheet has no {lacking(sensor, missing)}'
    return f"{text}; write {'it' if len(missing) == 1 else 'them'}"


def other_sensor(tables: dict[str, Any], name: str) -> tuple[dict[str, Any], list[str]]:
    """The tables of a bench file with another sensor in the place of its own, and the keys that
    stay the file's because the other's sheet lacks them.

    The optics, the exposure and the detector's temperature stay. Raises InputError as
    `with_sensor` does.
    """
    sensor = sensor_named(name, "--sensor")
    tracker = with_sensor(tables)["tracker"]
    before = tracker.get(DETECTOR, {})
    gone = {SENSOR, DETECTOR, *sensor.tracker}
    if EFFICIENCY in sensor.tracker:
        gone.update(EFFICIENCIES)
    # where the boresight meets the detector is of the old one's pixels
    if gone & {"pixel_pitch_um", "resolution_px"}:
        gone.add("principal_point_px")
    optics = {key: value for key, value in tracker.items() if key not in gone}
    detector = {key: before[key] for key in OF_USE if key in before}
    # a mosaic goes with the efficiencies of its colours
    if EFFICIENCY not in sensor.tracker and "bayer" in before:
        detector["bayer"] = before["bayer"]
    kept = [key for key in (*EFFICIENCIES, *TRACKER_KEYS[1:]) if key in optics]
    for key in DETECTOR_KEYS:
        stated = [other for other in (key, INSTEAD.get(key, key)) if other in before]
        if key not in sensor.detector and stated:
            detector[stated[-1]] = before[stated[-1]]
            kept.append(f"{DETECTOR}.{stated[-1]}")
    changed = {**optics, SENSOR: sensor.name, DETECTOR: detector}
    return {**tables, "tracker": changed}, kept
