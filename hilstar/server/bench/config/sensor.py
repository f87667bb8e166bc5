"""A bench's sensor by its name: the sheet's figures under the keys of the bench file."""

from typing import Any, NamedTuple

from hilstar.basics.errors import InputError
from hilstar.tracker.sensors import Sensor, sensor_named
from hilstar.tracker.settings import DetectorSettings

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
# Keys of the detector that are of its use, its surroundings or the model, and stay with another
# sensor.
OF_USE = (
    "temperature_k",
    "device_seed",
    "noise_version",
    "solver_image",
    "quantisation_noise",
    "cosmic_rays_per_cm2_s",
    "false_stars",
    "false_star_e_per_s",
    "false_star_sigma_px",
)
# Keys without which a figure of the detector means something else: where a sheet lacks the figure
# and the bench's stands, they are the bench's, too, as written or by default.
WITH_FIGURE = {
    "dark_e_per_s": (
        "dark_quantiles",
        "dark_distribution",
        "dsnu_e_per_s",
        "dark_reference_temperature_k",
        "dark_law",
        "dark_depletion_share",
        "dark_gap_ev",
        "dark_activation_ev",
    ),
    "read_noise_e": (
        "read_noise_table",
        "readout_hz",
        "read_noise_reference_hz",
        "read_noise_corner_hz",
    ),
}
# The same of the quantum efficiency: a mosaic has one for each colour.
WITH_EFFICIENCY = ("bayer", "fill_factor")
DEFAULTS = DetectorSettings()


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


class OtherSensor(NamedTuple):
    """A bench with another sensor: its tables, and keys of [tracker] and its detector.

    `kept` are figures that the other's sheet lacks and that stay the bench's, `beside` what belongs
    to them, and `dropped` the keys of the old sensor that nothing replaces.
    """

    tables: dict[str, Any]
    kept: list[str]
    beside: list[str]
    dropped: list[str]


def other_sensor(tables: dict[str, Any], name: str) -> OtherSensor:
    """A bench file's tables with another sensor in the place of its own.

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
    unchanged = [key for key in (*EFFICIENCIES, *TRACKER_KEYS[1:]) if key in optics]
    beside: list[str] = []
    if EFFICIENCY not in sensor.tracker:
        beside += [key for key in WITH_EFFICIENCY if key in before]
        detector.update({key: before[key] for key in beside})
    for figure in DETECTOR_KEYS:
        stated = _as_stated(figure, before)
        if figure in sensor.detector or not stated:
            continue
        unchanged.append(f"{DETECTOR}.{list(stated)[-1]}")
        belonging = _belonging(figure, before)
        beside += [key for key in belonging if key in before or key in sensor.detector]
        detector.update(belonging | stated)
    beside = [key for key in beside if f"{DETECTOR}.{key}" not in unchanged]
    replaced = {*detector, *sensor.detector}
    lost = [key for key in before if key not in replaced]
    dropped = [key for key in ("principal_point_px",) if key in tracker and key not in optics]
    dropped += [f"{DETECTOR}.{key}" for key in lost if _matters(key, before)]
    changed = {**optics, SENSOR: sensor.name, DETECTOR: detector}
    of_detector = [f"{DETECTOR}.{key}" for key in beside]
    return OtherSensor({**tables, "tracker": changed}, unchanged, of_detector, dropped)


def _as_stated(figure: str, detector: dict[str, Any]) -> dict[str, Any]:
    """A figure of a detector by the keys that state it."""
    keys = (figure, INSTEAD.get(figure, figure))
    return {key: detector[key] for key in keys if key in detector}


def _belonging(figure: str, detector: dict[str, Any]) -> dict[str, Any]:
    """What a figure of a detector means something else without, as written or by default."""
    keys = WITH_FIGURE.get(figure, ())
    return {key: detector.get(key, getattr(DEFAULTS, key)) for key in keys}


def _matters(key: str, detector: dict[str, Any]) -> bool:
    """Whether a key is more than its default written out."""
    return bool(detector[key] != getattr(DEFAULTS, key, None))
