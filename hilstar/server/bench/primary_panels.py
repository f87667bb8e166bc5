"""Primaries that are driven apart: what a bench mixes them for, and the panel of each."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from hilstar.basics.arrays import Float32Array
from hilstar.basics.errors import InputError
from hilstar.display.calibration import BUILT_IN, primary_responses
from hilstar.display.panel import Panel
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import (
    before_detector,
    bench_camera,
)
from hilstar.server.bench.colours import Colours, mixed_for
from hilstar.server.bench.config import (
    BenchConfig,
)
from hilstar.server.bench.config.bench_config import (
    drives_apart,
)
from hilstar.server.bench.monitor import bench_primaries, orientation_of
from hilstar.server.bench.star_rates import channel_rates, named_channels, star_kinds
from hilstar.sky.catalog import Catalog


def bench_colours(config: BenchConfig, folder: Path, catalog: Catalog) -> Colours | None:
    """What a bench mixes its primaries for; None where all three have one code, or stolen bits.
    Raises InputError.
    """
    if not drives_apart(config):
        return None
    primaries = bench_primaries(config.monitor, folder)
    monitor = config.monitor
    if primaries is None:
        raise InputError(
            '[tracker.detector] bayer, and [render] colour = "star" with it, need the light of the'
            ' primaries; write [monitor.primaries] file, or xy_r to xy_b; or colour = "white"'
        )
    places_px = [orientation_of(monitor).in_image(*place) for place in monitor.primaries.places_px]
    channels = named_channels(config.tracker, folder)
    rates_by = partial(channel_rates, config.sky)
    if len(channels) == 1:
        psf = before_detector(config, folder, bench_camera(config, folder))
    else:
        psf = None
    return mixed_for(
        primaries, channels, places_px, rates_by, star_kinds(config, catalog), psf
    ).for_stars(catalog)


def primary_panels(
    file: BenchFile,
    colours: Colours,
    white_e_per_s: float,
    uniformity: Float32Array | None,
    name: str | None = None,
) -> tuple[Panel, ...]:
    """The panel of each primary of a monitor, of the calibration `name` (by default the
    bench's). Raises InputError.
    """
    monitor = file.config.monitor
    name = name or monitor.calibration
    responses = primary_responses(name if name in BUILT_IN else file.folder / name, monitor.bits)
    response_shares = zip(responses, colours.of_white.tolist(), strict=True)
    return tuple(
        Panel(response, white_e_per_s * share, uniformity) for response, share in response_shares
    )
