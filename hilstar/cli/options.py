"""Options that several commands share, and parsers of options that hold more than one word or
number.

A parser takes a text and returns a value. Each refusal shows the form to write.
"""

import math
import re
from collections.abc import Iterable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.files import check_outputs, files_named_in, refuse_existing, refuse_writer
from hilstar.basics.units import NS_PER_S
from hilstar.cli.completion import offered
from hilstar.cli.declare import argument, option, struct, switch

if TYPE_CHECKING:
    from hilstar.attitude.logs.entries import Stated
    from hilstar.attitude.wire.source import Mounting
    from hilstar.basics.arrays import FloatArray
    from hilstar.instruments.calibrate.scale import StarReading
    from hilstar.server.bench import bench_file
    from hilstar.server.bench.config import BenchConfig
    from hilstar.server.record.ledger import SplitLimits

CONVENTION_FORM = "scalar=last,direction=cam_to_icrs,frame=body"
MAX_SEED = 2**63 - 1  # largest number in a FITS header
LOG_HELP = (
    "CSV (t_s,qw,qx,qy,qz), JSON lines, CCSDS or CIC AEM, STK .a, MCAP (a ledger), a SPICE CK or a"
    " ROS bag."
)
SPIN_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
MAX_SPIN_RAD_S = 1e6
SPIN_FORM = (
    "--spin AXIS,DEG_PER_S, AXIS being x, y, z or three numbers (cam axes), such as --spin z,0.5"
)
SPEED_FORM = "write --speed realtime, max, or a number such as 2 or 0.5"
SPLIT_FORM = "write a size or a time, such as 1GB, 200MB, 1h or 30min; 1 MB or 10 s at minimum"
SPLIT_UNITS = {"kB": 1e3, "MB": 1e6, "GB": 1e9, "s": 1.0, "min": 60.0, "h": 3600.0}
READING_FORM = (
    "write --reading HIP,DN or HIP,DN,SIGMA: a star's Hipparcos number, the sum of its DN over the"
    " background, and its noise"
)
MIN_SPLIT_BYTES, MIN_SPLIT_S = 1e6, 10.0
MAX_SIZE_PX = 32768
MAX_AT_S = 1e10
# What may follow --console and --scpi.
ADDRESS = re.compile(r"(\[?[0-9A-Za-z.:-]*\]?:)?\d{1,6}|localhost|\d+(\.\d+){3}|\[[0-9A-Fa-f:.]+\]")
SHARE_OPTIONS = ("--lose", "--corrupt", "--reorder")  # may stand alone
USUAL_SHARE = "5%"
USUAL_ADDRESSES = {
    "--console": "127.0.0.1:8765",
    "--scpi": "127.0.0.1:5025",
    "--camera": "127.0.0.2",
}


def checked_seed(seed: int) -> int:
    """The seed of an option. Raises InputError where it is too large."""
    if seed > MAX_SEED:
        raise InputError(f"--seed {shortened(str(seed))}: write 0 to {MAX_SEED}")
    return seed


def bench_argument() -> Any:
    """The argument of a bench file."""
    return argument("BENCH.toml", "The bench file (docs: Bench file).")


def ledger_argument() -> Any:
    """The argument of a run's ledger."""
    return argument("RUN.mcap", "The ledger of serve or replay.")


def output_option(value: str, meaning: str, **settings: Any) -> Any:
    """The option of a command's output, -o."""
    return option(value, meaning, "-o", "--output", **settings)


def json_option() -> Any:
    """The switch of a command's answer as JSON."""
    return switch("Print one JSON object on stdout, and nothing else there.", "--json")


def overwrite_option() -> Any:
    """The switch that allows an output in place of a file."""
    return switch("Replace an existing file that could not be made again.")


def explain_option() -> Any:
    """The switch that explains a scene's choices."""
    return switch(
        "Explain on stderr what was chosen for this scene, with its error and its saving."
    )


def at_option() -> Any:
    """The option of a frame's moment."""
    return option("SECONDS", "Seconds after sky.epoch_utc, or of a scenario; 0 by default.")


def scenario_option() -> Any:
    """The option of a scenario."""
    return option("FILE.toml", "Faults on request: what is wrong in the sky, and when.")


def windowed_option() -> Any:
    """The switch of a window."""
    return switch("A window on the desktop instead of the full display.")


def force_option() -> Any:
    """The switch that shows on a display that the checks refuse."""
    return switch(
        "Show on a display that the start-up checks refuse, or on a monitor that the bench's files"
        " were not measured on; status, page and ledger go on saying so."
    )


def feed_option() -> Any:
    """The option of an endpoint that gives the frames to others."""
    return option(
        "ENDPOINT",
        "Send each frame's codes to whoever watches there, such as tcp://127.0.0.1:5570 (hilstar"
        " tracker).",
    )


def seed_option(meaning: str, default: int = 0) -> Any:
    """The option of a seed, a whole number from 0 to MAX_SEED."""
    return option("SEED", meaning, default=default, min=0, callback=checked_seed)


def check_files(
    inputs: Iterable[Path | None],
    outputs: Iterable[Path | None],
    file: "bench_file.BenchFile | None" = None,
    kept: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Refuse (InputError) outputs that are inputs or one and the same file, and `kept` if it
    exists, before anything is done.

    The bench file and all files that it names count as inputs; `kept` is an output that cannot be
    made again.
    """
    if file is None:
        named = []
    else:
        named = files_named_in(file.path, file.text)
    check_outputs([*inputs, *named], [*outputs, kept])
    if kept is not None:
        refuse_writer(kept)
    refuse_existing(kept, overwrite)


def with_values(words: list[str]) -> list[str]:
    """The command line with the values that may be left out: a share after a fault option, and an
    address after --console, --scpi and --camera. --darks stands before each of its files.
    """
    complete: list[str] = []
    several = False  # --darks takes files up to the next option
    for k, word in enumerate(words):
        following = "".join(words[k + 1 : k + 2])
        several = word == "--darks" or (several and not word.startswith("-"))
        if several and word != "--darks" and words[k - 1] != "--darks":
            complete.append("--darks")
        complete.append(word)
        if word in SHARE_OPTIONS and not re.match(r"[\d.]+%?$", following):
            complete.append(USUAL_SHARE)
        if word in USUAL_ADDRESSES and not ADDRESS.fullmatch(following):
            complete.append(USUAL_ADDRESSES[word])
    return complete


def parse_at(
    command: str, at_s: float | None, config: "BenchConfig", timed: bool = False
) -> int | None:
    """The moment of a frame, ns after `epoch_utc`, None for that one. Raises InputError where
    nothing changes with time.
    """
    from hilstar.server.bench.config.bench_config import has_observer

    if at_s is None:
        return None
    if not abs(at_s) <= MAX_AT_S:
        raise InputError(f"{command} --at {at_s:g}: write seconds, 1e10 at most")
    if not timed and not has_observer(config):
        raise InputError(
            f"{command} --at {at_s:g}: nothing moves in this sky; write [sky.bodies] or"
            " [spacecraft], give a --scenario, or leave it out"
        )
    return round(at_s * NS_PER_S)


def parse_numbers(text: str, count: int, option: str, form: str) -> list[float]:
    """`count` finite numbers with commas between them. Raises InputError that shows `form`."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        apart = text.replace(",", " ").split()
        if len(apart) == count:
            form = f"{form}, with commas and without spaces"
        raise InputError(f"{option} {text}: write {form}") from error
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise InputError(f"{option} {text}: write {count} finite numbers, {form}")
    return numbers


def parse_resolution(text: str, example: str = "1920,1080") -> tuple[int, int]:
    """Width and height in pixels from `--resolution`. Raises InputError."""
    form = f"--resolution W,H in pixels, such as {example}"
    width, height = parse_numbers(text, 2, "--resolution", form)
    if not (1 <= width <= MAX_SIZE_PX and 1 <= height <= MAX_SIZE_PX):
        raise InputError(f"--resolution {text}: write {form}")
    return round(width), round(height)


def parse_spin(text: str) -> "FloatArray":
    """The rate in rad/s, cam components (3,), from "AXIS,DEG_PER_S". Raises InputError."""
    import numpy as np

    *axis, rate_text = [part.strip() for part in text.split(",")]
    try:
        rate = math.radians(float(rate_text))
        if len(axis) == 1:
            vector = np.array(SPIN_AXES[axis[0].lower()])
        else:
            vector = np.array([float(part) for part in axis])
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"--spin {text}: write {SPIN_FORM}") from error
    length = math.hypot(*vector)
    if len(vector) != 3 or not (abs(rate) <= MAX_SPIN_RAD_S and 0 < length < math.inf):
        raise InputError(f"--spin {text}: write {SPIN_FORM}")
    return np.asarray(vector / length * rate)


def parse_place(text: str | None) -> tuple[float, float, float] | None:
    """Latitude and longitude in degrees, and height in metres. Raises InputError."""
    if text is None:
        return None
    latitude_deg, longitude_deg, height_m = parse_numbers(
        text, 3, "--place", "LAT,LON,HEIGHT in degrees and metres"
    )
    if not (-90 <= latitude_deg <= 90 and -180 <= longitude_deg <= 360):
        raise InputError(
            f"--place {text}: write a latitude from -90 to 90 and a longitude from -180 to 360"
        )
    return latitude_deg, longitude_deg, height_m


def parse_mounting(text: str) -> "Mounting":
    """The mounting of `--mounting`. Raises InputError."""
    from hilstar.attitude.wire.protocol import NORM_TOLERANCE
    from hilstar.attitude.wire.source import Mounting

    w, x, y, z = parse_numbers(text, 4, "--mounting", "W,X,Y,Z")
    if abs(math.hypot(w, x, y, z) - 1) > NORM_TOLERANCE:
        raise InputError(
            f"--mounting {text}: its norm is {math.hypot(w, x, y, z):.6g}; write a unit quaternion"
            " W,X,Y,Z"
        )
    return Mounting((w, x, y, z), by_option=True)


def parse_convention(text: str) -> dict[str, str]:
    """The keys of `[attitude] convention` that "scalar=last,frame=body" names, and their values.
    Raises InputError.
    """
    from typing import get_args, get_type_hints

    from hilstar.attitude.wire.source import Convention

    choices = {name: get_args(hint) for name, hint in get_type_hints(Convention).items()}
    named: dict[str, str] = {}
    for part in text.split(","):
        key, equals, value = (word.strip() for word in part.partition("="))
        if key not in choices or not equals or key in named:
            raise InputError(
                f"--convention {text}: write {CONVENTION_FORM}, each key once, or some of them"
            )
        if value not in choices[key]:
            raise InputError(
                f"--convention {text}: {key} is {' or '.join(choices[key])}; write"
                f" {CONVENTION_FORM}"
            )
        named[key] = value
    return named


unstated = partial(option, rich_help_panel="What the log itself does not say")


@struct
class LogStatements:
    """What the command line states of a log, as it was typed."""

    kernel: list[Path] | None = unstated("FILE", "A SPICE kernel; may be repeated.")
    topic: str | None = unstated("NAME", "The topic, where a bag has several.")
    body: str | None = unstated("NAME", "The body or frame, where a log has several.")
    reference: str | None = unstated(
        "FRAME",
        "The frame that attitudes refer to, or what its axes are: icrs, enu, ned.",
        autocompletion=offered(("icrs", "enu", "ned")),
    )
    epoch_utc: str | None = unstated("TIME", "The UTC at the log's time zero.")
    place: str | None = unstated(
        "LAT,LON,HEIGHT",
        "Where the vehicle is: degrees and metres, WGS84.",
    )
    mounting: str | None = unstated("W,X,Y,Z", "q_body_to_cam, for a log of the body's attitude.")
    convention: str | None = unstated(
        CONVENTION_FORM,
        "What the quaternions of a CSV, JSON lines or an MCAP are, in place of [attitude]"
        " convention.",
    )

    def stated(self, config: "BenchConfig | None" = None) -> "Stated":
        """The same for a log's reader, in place of what the bench file states. Raises InputError,
        also for contradictions.
        """
        from hilstar.attitude.logs.entries import Stated
        from hilstar.attitude.wire.source import Convention
        from hilstar.server.bench.bench_file import stated_in

        if config is None:
            by_file = Stated()
        else:
            by_file = stated_in(config)
        stated = replace(
            by_file, kernels=tuple(self.kernel or ()), topic=self.topic, body=self.body
        )
        stated = replace(stated, reference=self.reference, epoch_utc=self.epoch_utc)
        stated = replace(stated, place=parse_place(self.place))
        if self.mounting is not None:
            stated = replace(stated, mounting=parse_mounting(self.mounting))
        if self.convention is not None:
            named = parse_convention(self.convention)
            if self.mounting is not None and named.get("frame") == "cam":
                raise InputError(
                    f"--mounting {self.mounting}: --convention {self.convention} says that the"
                    " attitudes are the camera's; write frame=body, or leave out --mounting"
                )
            stated = replace(stated, convention=Convention(**named), convention_by="--convention")  # type: ignore[arg-type]
        return stated

    def refuse(self, why: str) -> None:
        """Refuse (InputError) each statement where there is no log."""
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None:
                shown = value[0] if isinstance(value, list) else value
                raise InputError(f"--{field.name.replace('_', '-')} {shown}: {why}")


def parse_diode(text: str) -> tuple[str, int]:
    """The port and the baud rate of `--diode`. Raises InputError."""
    from hilstar.attitude.wire.serial_link import serial_target

    port = serial_target(text)
    if port is None:
        raise InputError(
            f"--diode {text}: write serial:/dev/ttyX@BAUD, such as serial:/dev/ttyACM0@115200"
        )
    return port


def parse_share(text: str, option: str) -> float:
    """A fraction, 0 to 1, from "5%" or "0.05". Raises InputError."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(%?)\s*", text)
    if match:
        share = float(match[1]) / (100.0 if match[2] else 1.0)
    else:
        share = 2.0
    if share > 1.0:
        raise InputError(f"{option} {text}: write a fraction of the packets, such as 5% or 0.05")
    return share


def parse_speed(text: str) -> float:
    """The factor of real time of `--speed`: 1 for realtime, infinite for max. Raises InputError."""
    named = {"realtime": 1.0, "max": math.inf}
    if text in named:
        return named[text]
    try:
        factor = float(text)
    except ValueError as error:
        raise InputError(f"--speed {text}: {did_you_mean(text, named)}{SPEED_FORM}") from error
    if not 1e-3 <= factor <= 1e3:
        raise InputError(f"--speed {text}: {SPEED_FORM}, from 0.001 to 1000")
    return factor


def parse_split(text: str | None) -> "SplitLimits":
    """The size or time at which a ledger is split, from "1GB" or "1h". Raises InputError."""
    from hilstar.server.record.ledger import NO_SPLIT, SplitLimits

    if text is None:
        return NO_SPLIT
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?)\s*(kB|MB|GB|s|min|h)", text.strip())
    if match:
        value = float(match[1]) * SPLIT_UNITS[match[2]]
    else:
        value = 0.0
    if match is None or value < (MIN_SPLIT_BYTES if match[2].endswith("B") else MIN_SPLIT_S):
        raise InputError(f"--ledger-split {text}: {SPLIT_FORM}")
    if match[2].endswith("B"):
        return SplitLimits(bytes=value)
    return SplitLimits(seconds=value)


def parse_memory(text: str) -> int:
    """Bytes, from "4GB" or "500 MB". Raises InputError."""
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?)\s*(MB|GB)", text.strip())
    if match is None or float(match[1]) <= 0:
        raise InputError(f"--memory {text}: write a size such as 4GB or 500MB")
    return round(float(match[1]) * SPLIT_UNITS[match[2]])


def parse_reading(text: str) -> "StarReading":
    """A reading from "HIP,DN" or "HIP,DN,SIGMA_DN". Raises InputError."""
    from hilstar.instruments.calibrate.scale import StarReading

    parts = text.split(",")
    try:
        reading = StarReading(int(parts[0]), *map(float, parts[1:]))
    except (ValueError, TypeError) as error:
        raise InputError(f"--reading {text}: {READING_FORM}") from error
    if not 0 < reading.dn < math.inf or not 0 <= reading.sigma_dn < math.inf:
        raise InputError(f"--reading {text}: {READING_FORM}")
    return reading


def parse_counts(text: str, most: int) -> tuple[int, ...]:
    """Star counts, each once, from "100,1000". Raises InputError."""
    parts = text.split(",")
    if not all(re.fullmatch(r"[1-9]\d{0,8}", part) and int(part) <= most for part in parts):
        raise InputError(
            f"--stars {text}: write whole numbers from 1 to {most} with commas between them, such"
            " as 100,1000"
        )
    return tuple(dict.fromkeys(map(int, parts)))


def parse_sizes(text: str) -> tuple[tuple[int, int], ...]:
    """Image sizes, each once, from "640x480,1920x1080". Raises InputError."""
    size_matches = [
        re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", part) for part in text.split(",")
    ]
    if not all(
        match and max(int(match[1]), int(match[2])) <= MAX_SIZE_PX for match in size_matches
    ):
        raise InputError(
            f"--sizes {text}: write WIDTHxHEIGHT, up to {MAX_SIZE_PX} px, with commas between them,"
            " such as 640x480,1920x1080"
        )
    return tuple(dict.fromkeys((int(match[1]), int(match[2])) for match in size_matches if match))
