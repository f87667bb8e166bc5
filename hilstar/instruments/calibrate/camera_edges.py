"""A camera in the place of a photodiode: when the display's square changed, from images of it.

A frame's level is the share of its exposure in which the square was lit, so that a change within an
exposure is known better than the exposure is long. One between two exposures is taken to be in the
middle between them.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from hilstar.attitude.clock.sender_clock import OneWayFilter
from hilstar.basics.arrays import BoolArray, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.instruments.calibrate.latency import MIN_EDGES, Edges
from hilstar.server.genicam.camera import Film, GenicamCamera
from hilstar.server.genicam.pixels import FORMAT

LOOK_S, CHUNK_S = 1.0, 4.0
# of a refresh: as many exposures lie within one as tell its level and both its ends
EXPOSURE_REFRESHES = 0.2
HALF = 0.5  # of the largest change of a pixel: the square's pixels change by more
MIN_CHANGE_DN, NOISE_TIMES = 8.0, 4.0
DARK, LIT = 0.1, 0.9  # shares of an exposure: between them the square changed in it


@dataclass(frozen=True, slots=True)
class Square:
    """Where a camera sees the display's square: its rows (first, after the last), and which pixels
    (rows, columns) of them it is.
    """

    rows: tuple[int, int]
    pixels: BoolArray


def film_edges(
    camera: GenicamCamera, seconds: float, exposure_s: float | None, refresh_hz: float
) -> Edges:
    """When the square changed within `seconds`, host time, by a camera that sees it.

    The camera's own delay, from the end of an exposure to its first byte here, stays in the times.
    Raises InputError where nothing blinks or the camera is too slow, MachineError.
    """
    camera.set({"PixelFormat": format_of_fewest_bits(camera.about["formats"])})
    if exposure_s is None:
        exposure_s = EXPOSURE_REFRESHES / refresh_hz
    square = find_square(camera.film(exposure_s, LOOK_S))
    host_ns = []
    levels = []
    end_s = time.monotonic() + seconds
    while True:
        rest_s = end_s - time.monotonic()
        if rest_s <= 0:
            break
        to_host_ns = time.monotonic_ns() - time.time_ns()
        film = camera.film(exposure_s, min(rest_s, CHUNK_S), square.rows)
        begin_ns = begin_on_host(film, to_host_ns)
        check_rate(begin_ns, film.exposure_s, refresh_hz)
        signal_dn = film.dn[:, square.pixels].mean(axis=1)
        edges = edges_in(begin_ns, film.exposure_s, signal_dn)
        host_ns.append(edges.host_ns)
        levels.append(edges.level)
    edges_ns = np.concatenate(host_ns)
    if len(edges_ns) < MIN_EDGES:
        raise InputError(
            f"{len(edges_ns)} changes of the square came, and at least {MIN_EDGES} are needed;"
            " write a longer --duration"
        )
    return Edges(edges_ns, np.concatenate(levels))


def format_of_fewest_bits(names: Sequence[str]) -> str:
    """Of a camera's pixel formats the one of whole bytes with the fewest bits. Raises InputError
    where there is none.
    """
    formats = [name for name in names if _is_plain(name)]
    if not formats:
        raise InputError(
            f"the camera has no format of whole bytes of grey or Bayer: {', '.join(names)}"
        )
    return min(formats, key=_bits_of)


def _is_plain(name: str) -> bool:
    """Whether a pixel format is of whole bytes."""
    match = FORMAT.fullmatch(name)
    return match is not None and match[3] is None


def _bits_of(name: str) -> int:
    """The bits of a pixel of a format."""
    match = FORMAT.fullmatch(name)
    assert match is not None
    return int(match[2])


def find_square(film: Film) -> Square:
    """The largest patch of pixels that change the most. Raises InputError where nothing does."""
    low = np.full(film.dn.shape[1:], np.inf)
    high = np.full(film.dn.shape[1:], -np.inf)
    for image in film.dn:
        np.minimum(low, image, out=low)
        np.maximum(high, image, out=high)
    change = high - low
    # some 20 pixels of a square are seen even where it is small
    quantile = 1 - 20 / max(change.size, 21)
    largest = float(np.quantile(change, quantile))
    if largest < max(MIN_CHANGE_DN, NOISE_TIMES * float(np.median(change))):
        raise InputError(
            f"nothing blinks in the camera's images: pixels change by {largest:.0f} DN at most;"
            " point it at the square ([monitor] photodiode_px), while serve runs"
        )
    patches, count = ndimage.label(change > HALF * largest)
    sizes = np.bincount(patches.ravel(), minlength=count + 1)[1:]
    is_square = patches == 1 + int(sizes.argmax())
    rows = np.flatnonzero(is_square.any(axis=1))
    first, last = int(rows[0]), int(rows[-1]) + 1
    return Square((first, last), is_square[first:last])


def begin_on_host(film: Film, to_host_ns: int) -> IntArray:
    """When each exposure began (n,), host time: an exposure before its first byte came.

    The camera's clock says how far apart they are; of its offset the smallest counts, as some bytes
    wait. `to_host_ns` is the host's monotonic time less its UTC.
    """
    exposure_ns = round(film.exposure_s * NS_PER_S)
    ended_ns = film.arrived_utc_ns + to_host_ns
    if len(film.stamp_ns) > 1 and not (np.diff(film.stamp_ns) > 0).all():
        return ended_ns - exposure_ns  # a camera without a clock
    clock = OneWayFilter()
    for arrival_ns, stamp_ns in zip(ended_ns.tolist(), film.stamp_ns.tolist(), strict=True):
        clock.observe(arrival_ns, arrival_ns - stamp_ns)
    assert clock.line is not None
    offset_ns = [round(clock.line.at(arrival_ns)) for arrival_ns in ended_ns.tolist()]
    return film.stamp_ns + np.array(offset_ns, dtype=np.int64) - exposure_ns


def check_rate(begin_ns: IntArray, exposure_s: float, refresh_hz: float) -> None:
    """Refuse (InputError) exposures of which none lies within one refresh for sure."""
    period_s = np.inf
    if len(begin_ns) > 1:
        period_s = float(np.median(np.diff(begin_ns))) / NS_PER_S
    if period_s + exposure_s > 1 / refresh_hz:
        exposure_ms = exposure_s * NS_PER_S / NS_PER_MS
        period_ms = period_s * NS_PER_S / NS_PER_MS
        refresh_ms = 1 / refresh_hz * NS_PER_S / NS_PER_MS
        raise InputError(
            f"the camera exposes for {exposure_ms:.3g} ms every {period_ms:.3g} ms, and the square"
            f" may change every {refresh_ms:.3g} ms; write a shorter --exposure, or a higher"
            " AcquisitionFrameRate or a smaller Height in [tracker.camera] features"
        )


def edges_in(begin_ns: IntArray, exposure_s: float, levels: FloatArray) -> Edges:
    """The changes of a light that is on or off, by exposures that begin at `begin_ns` (n,) and
    their signals (n,).
    """
    middle = (levels.min() + levels.max()) / 2
    dark = float(np.median(levels[levels <= middle]))
    lit = float(np.median(levels[levels >= middle]))
    share = np.clip((levels - dark) / max(lit - dark, 1e-9), 0.0, 1.0)
    exposure_ns = exposure_s * NS_PER_S
    sure = np.flatnonzero((share < DARK) | (share > LIT))
    is_lit = share[sure] > HALF
    host_ns = []
    edge_levels = []
    for k in np.flatnonzero(np.diff(is_lit)):
        before = int(sure[k])
        after = int(sure[k + 1])
        level = int(is_lit[k + 1])
        if after == before + 1:
            ended_ns = float(begin_ns[before]) + exposure_ns
            edge_ns = (ended_ns + float(begin_ns[after])) / 2
        elif after == before + 2:
            # the light had its old level until then
            old_share = share[before + 1]
            if level:
                old_share = 1 - old_share
            edge_ns = float(begin_ns[before + 1]) + old_share * exposure_ns
        else:
            continue  # the light changed more than once, or images are missing
        host_ns.append(round(edge_ns))
        edge_levels.append(level)
    return Edges(np.array(host_ns, dtype=np.int64), np.array(edge_levels, dtype=np.int64))
