"""What `hilstar calibrate` does: say which patches to measure, and make a calibration file of what was measured."""

from __future__ import annotations

import datetime
import logging
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.bench.frame_files import write_codes_png
from hilstar.calibrate.fit import ChannelFit, fit_channel
from hilstar.calibrate.measurements import CHANNELS, Measurements, check_drift, read_measurements
from hilstar.errors import InputError, MachineError
from hilstar.files import make_directory, write_whole
from hilstar.monitor.calibration import load_calibration
from hilstar.monitor.calibration_file import Head, NotesTable, write_calibration
from hilstar.monitor.response import code_dtype
from hilstar.monitor.window.window import Window, WindowSettings
from hilstar.reading import read_text
from hilstar.render.presenter import Presenter, View, level_texture, window_context

PATCH_POLL_S = 0.02  # between looks at the keys
MAX_PLAN_BYTES = 100_000_000
log = logging.getLogger(__name__)
MAG_PER_RELATIVE = 2.5 / math.log(10)
DECADES = (0, 1, 2, 3)  # below white, where the error of the response is stated
FAINTEST_PLANNED = 10**-3.2  # of white: a little beyond three decades, so that nothing is extrapolated there
FAINT = 1e-2  # levels below it are planned twice as often: the black level drowns them
PATCHES_PER_REFERENCE = 8  # between two rounds of black, half and white
PATCH_SHARE = 1 / 3  # of the screen's smaller side
PRIMARIES = ("r", "g", "b")


def calibrate_photometric(
    measured: Path,
    output: Path,
    *,
    bits: int | None = None,
    who: str = "",
    when: str = "",
    instrument: str = "",
    unit: str = "",
) -> dict[str, Any]:
    """Fit a response to MEASURED.csv and write MONITOR.toml with its CSV beside it; a summary for a person and for --json.

    Raises InputError for files that cannot be read or written, and for data that are too few, saturated, falling or drifting.
    """
    data = read_measurements(measured, bits)
    fits = fit_all(data)
    drift = check_drift(data)
    columns = response_columns(fits)
    noise = max(fits[name].noise_relative for name in columns)
    head = Head(
        kind="photometric",
        who=who or "not stated",
        when=when or datetime.date.today().isoformat(),
        instrument=instrument or "not stated",
        unit=unit or "not stated",
        bits=data.bits,
        response=output.with_suffix(".csv").name,
    )
    drift_note = "not known: nothing was repeated" if math.isnan(drift) else f"{100 * drift:+.2f} % over the run"
    text = f"fitted to {measured.name}, sha256 {data.sha256}"
    if output.with_suffix(".csv").resolve() == measured.resolve():
        raise InputError(f"{output}: its response would be written over {measured}; choose another name")
    table = write_calibration(output, head, columns, noise, NotesTable(drift=drift_note, text=text))
    written = load_calibration(output, data.bits)
    return {
        "bits": data.bits,
        "channels": {name: _channel_summary(fit) for name, fit in fits.items()},
        **_channel_summary(fits[next(iter(columns))]),
        "noise_relative": noise,
        "additivity_percent": additivity_percent(fits),
        "drift_percent": None if math.isnan(drift) else 100 * drift,
        "written": [str(output), str(table)],
        "sha256": written.sha256,
    }


def fit_all(data: Measurements) -> dict[str, ChannelFit]:
    """The response of each channel that was measured. Raises InputError where it is neither w nor all of r, g and b."""
    channels = data.channels
    if "w" not in channels and channels != PRIMARIES:
        raise InputError(f"{data.source}: only channel {', '.join(channels)}; measure w, or all of r, g and b")
    if len(channels) not in {1, 3, 4}:
        raise InputError(f"{data.source}: channels {', '.join(channels)}; measure w alone, or all of r, g and b")
    return {name: fit_channel(data, name) for name in channels}


def response_columns(fits: dict[str, ChannelFit]) -> dict[str, FloatArray]:
    """Light (2^bits,) by channel as the calibration file has it: r, g and b where they are known, else w; one black for all."""
    names = PRIMARIES if "r" in fits else ("w",)
    black = float(np.mean([fits[name].black for name in names]))
    return {name: black + fits[name].white * fits[name].light for name in names}


def additivity_percent(fits: dict[str, ChannelFit]) -> float | None:
    """How far r + g + b is from w at white, both above black, in % of w; None where they were not all measured."""
    if len(fits) < len(CHANNELS):
        return None
    return 100 * (sum(fits[name].white for name in PRIMARIES) / fits["w"].white - 1)


def _channel_summary(fit: ChannelFit) -> dict[str, Any]:
    count = fit.levels.count
    places = {
        decade: int(np.argmin(np.abs(np.log(np.maximum(fit.light, 1e-12)) + decade * math.log(10)))) for decade in DECADES
    }
    return {
        "codes": len(count),
        "repeats": {"min": int(count.min()), "max": int(count.max())},
        "black_level": {"relative": fit.black / fit.white, "unit": fit.black},
        "noise_relative": fit.noise_relative,
        "shape": fit.shape,
        "parameters": fit.parameters,
        "error_percent": {f"1e-{decade}": 100 * float(fit.error[place]) for decade, place in places.items()},
        "holdout": holdout(fit),
    }


def holdout(fit: ChannelFit) -> dict[str, float]:
    """What levels left out of the fit have left, of light above black: down to three decades below white."""
    shown = fit.light[fit.levels.code[1:]] >= 10.0 ** -DECADES[-1]
    residual = np.abs(fit.residual[shown])
    rms, p95, largest = float(np.sqrt((residual**2).mean())), float(np.percentile(residual, 95)), float(residual.max())
    return {
        "rms_percent": 100 * rms,
        "p95_percent": 100 * p95,
        "max_percent": 100 * largest,
        "rms_mag": MAG_PER_RELATIVE * rms,
        "max_mag": MAG_PER_RELATIVE * largest,
    }


def plan(
    bits: int,
    output: Path,
    *,
    seed: int,
    levels: int = 32,
    repeats: int = 3,
    channels: str = "w",
    patches: Path | None = None,
    resolution_px: tuple[int, int] | None = None,
) -> dict[str, Any]:
    """Write PLAN.csv (order,code,channel,value with value left empty) and, with both `patches` and a resolution, the images.

    Levels run from black to white by equal steps of log light; each comes `repeats` times, those below 1 % of white
    twice as often, in random order, with black, half and white between every eight as a reference for drift.
    Raises InputError for a plan that cannot be measured or written.
    """
    if not 1 <= bits <= 16 or not 2 <= levels <= 2**bits or not 1 <= repeats <= 1000:
        raise InputError(
            f"plan of {levels} levels, {repeats} repeats, {bits} bits: 2 to 2^bits levels, 1 to 1000 repeats, 1 to 16 bits"
        )
    if not channels or set(channels) - set(CHANNELS) or len(set(channels)) < len(channels):
        raise InputError(f"channels = {channels}; some of w, r, g and b are wanted, each once")
    steps = planned_patches(bits, levels, repeats, channels, np.random.default_rng(seed))
    lines = ["order,code,channel,value", *(f"{order},{code},{name}," for order, (code, name) in enumerate(steps, start=1))]
    write_whole(output, "\n".join(lines) + "\n")
    written = [str(output)]
    if patches is not None and resolution_px is not None:
        written += _write_patches(make_directory(patches), sorted(set(steps)), resolution_px, bits)
    return {
        "steps": steps,
        "bits": bits,
        "patches": len(steps),
        "codes": len({code for code, _ in steps}),
        "seed": seed,
        "written": written,
    }


def is_filled_in(path: Path) -> bool:
    """Whether somebody has written measurements into a plan."""
    try:
        lines = read_text(path, "", MAX_PLAN_BYTES).splitlines()
    except InputError:
        return path.is_file()
    return any(line.strip() and not line.rstrip().endswith(",") for line in lines[1:])


def planned_codes(bits: int, levels: int) -> list[int]:
    """Black, and codes by equal steps of the log light of an sRGB monitor, from 3.2 decades below white up to white."""
    white = 2**bits - 1
    light = np.geomspace(FAINTEST_PLANNED, 1, levels - 1)
    signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)  # IEC 61966-2-1
    codes = [0]
    for place, code in enumerate(np.rint(signal * white).astype(int)):
        room = white - (levels - 2 - place)  # for those that follow
        codes.append(int(min(max(code, codes[-1] + 1), room)))
    codes[-1] = white
    return codes


def planned_patches(bits: int, levels: int, repeats: int, channels: str, rng: np.random.Generator) -> list[tuple[int, str]]:
    """Code and channel of each patch, in the order of measurement."""
    codes, white = planned_codes(bits, levels), 2**bits - 1
    light = (np.array(codes) / white) ** 2.2
    often = [code for code, faint in zip(codes, light < FAINT, strict=True) if faint]
    drawn = [(code, name) for name in channels for code in [*codes, *often] for _ in range(repeats)]
    shuffled = [drawn[place] for place in rng.permutation(len(drawn))]
    references = [(code, name) for name in channels for code in (0, white // 2, white)]
    steps: list[tuple[int, str]] = []
    for start in range(0, len(shuffled), PATCHES_PER_REFERENCE * len(channels)):
        steps += [*references, *shuffled[start : start + PATCHES_PER_REFERENCE * len(channels)]]
    return [*steps, *references]


def patch_image(code: int, channel: str, resolution_px: tuple[int, int], bits: int) -> npt.NDArray[np.uint8 | np.uint16]:
    """A square patch in the middle of a black screen: (height, width) for w, (height, width, 3) for one primary."""
    width, height = resolution_px
    side = max(1, round(min(width, height) * PATCH_SHARE))
    top, left = (height - side) // 2, (width - side) // 2
    grey = np.zeros((height, width), dtype=code_dtype(bits))
    grey[top : top + side, left : left + side] = code
    if channel == "w":
        return grey
    image = np.zeros((height, width, 3), dtype=grey.dtype)
    image[..., PRIMARIES.index(channel)] = grey
    return image


def show_patches(steps: Sequence[tuple[int, str]], bits: int, display: int | str, seconds: float | None) -> int:
    """Show each patch on a display until space is pressed, or for so many seconds; q ends it. How many were shown.

    Raises MachineError without a display or where that goes away, InputError for one that is not there.
    """
    with Window(WindowSettings((640, 480), bits, display)) as window:
        size_px = window.size_px
        square = (patch_image(1, "w", size_px, 8) > 0).astype(np.uint8)
        nothing = np.zeros((2, 3), dtype=np.uint16)
        view = View(size_px, size_px, bits, triples=nothing)
        presenter = Presenter(level_texture(window_context(), square), view)
        for shown, (code, channel) in enumerate(steps):
            triples = nothing.copy()
            triples[1, [PRIMARIES.index(channel)] if channel in PRIMARIES else [0, 1, 2]] = code
            presenter.set_triples(triples)
            log.warning("patch %d of %d: code %d, channel %s", shown + 1, len(steps), code, channel)
            if not _patch_stays(window, presenter, seconds):
                return shown
    return len(steps)


def _patch_stays(window: Window, presenter: Presenter, seconds: float | None) -> bool:
    """Until the next patch is wanted; False when the whole is to end."""
    end_s = math.inf if seconds is None else time.monotonic() + seconds
    while time.monotonic() < end_s:
        presenter.present()
        window.swap()
        window.look_at_events()
        while window.keys:
            key = window.keys.popleft()
            if key in {"q", "escape"}:
                return False
            if key == "space":
                return True
        if window.gone is not None:
            raise MachineError(window.gone)
        if window.closing:
            return False
        time.sleep(PATCH_POLL_S)
    return True


def _write_patches(folder: Path, steps: Sequence[tuple[int, str]], resolution_px: tuple[int, int], bits: int) -> list[str]:
    if bits > 8 and any(name != "w" for _, name in steps):
        raise InputError(
            "patches of r, g or b as PNG are for 8 bits at most; leave the directory out, and show the codes of the plan"
        )
    paths = [folder / f"{name}-{code:05d}.png" for code, name in steps]
    for path, (code, name) in zip(paths, steps, strict=True):
        write_codes_png(path, patch_image(code, name, resolution_px, bits), bits)
    return [str(folder)]
