"""Benches whose truth is planted by code of its own, and their readings, of each kind that
certificates have to hold.

Nothing here goes through certify's fits, hilstar's lens or its response: a pixel's direction is a
polynomial of its own, light a table by code, and errors are drawn here. A star's place and pixels
alone are the certificate's: it certifies them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from hilstar.instruments.certify.bench_readings import BesideRatio, DotReadings, LightReadings

if TYPE_CHECKING:
    from collections.abc import Callable

    from hilstar.instruments.certify.model import ReferenceStar

ARCSEC = 180 / math.pi * 3600
SIZE_PX = (1920, 1080)
FOCAL_PX = 350e3 / 57.65
TRACKER_FOCAL_PX = 70e3 / 13
TRACKER_MIDDLE_PX = (1024 - 1) / 2
WHITE_E_PER_S = 2.6e6
DELAY_MS = 8.0
EDGES, EDGE_NOISE_MS = 120, 0.1
WAVES = 300  # cosines of a random field: its fourth moment is within 1 % of a Gaussian's
TAILS_DOF = 3.0
BESIDE_CODE, BESIDE_PAIRS = 140, 16
SEEN_TANGENT = 512 / TRACKER_FOCAL_PX  # half of the tracker's field


class SmoothField:
    """A random field of unit variance whose correlation falls as exp(-d^2 / 2 L^2), by random
    cosines.
    """

    def __init__(self, length_px: float, rng: np.random.Generator) -> None:
        self._wave = rng.standard_normal((2, WAVES)) / length_px
        self._phase = rng.uniform(0, 2 * math.pi, WAVES)
        self._size = rng.standard_normal(WAVES) * math.sqrt(2 / WAVES)

    def __call__(self, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        return (
            np.cos(np.outer(x_px, self._wave[0]) + np.outer(y_px, self._wave[1]) + self._phase)
            @ self._size
        )


def nothing(x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
    """A field that is zero."""
    return np.zeros(len(x_px))


@dataclass(frozen=True)
class Truth:
    """A bench as it is: light (codes,) above black relative to white, and how its readings err."""

    light: np.ndarray
    black: float
    white: float
    fall: tuple[float, float]
    bent: tuple[float, float]
    tilt: tuple[float, float]
    mount_arcsec: tuple[float, float, float]
    focal: float
    delay_ms: float
    drift_per_h: float
    reading_noise: float
    dot_noise_px: float
    uneven: Callable[[np.ndarray, np.ndarray], np.ndarray] = nothing
    dots_off: tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], ...] = (nothing, nothing)
    tracker_k1: float = 0.0
    lens_off_arcsec: tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], ...] = (nothing, nothing)
    warms: float = 0.0
    warm_s: float = 1.0
    talk: float = 0.0
    talk_of_left: float = 0.0
    tails: bool = False
    lasts_readings: float = 0.0

    def even(self, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        """Light at places relative to a screen that is even."""
        u, v = (
            (at - (side - 1) / 2) / (side / 2)
            for at, side in zip((x_px, y_px), SIZE_PX, strict=True)
        )
        return (1 - self.fall[0] * u**2 - self.fall[1] * v**2) * (1 + self.uneven(x_px, y_px))

    def panel_light(self, codes: np.ndarray) -> np.ndarray:
        """Light (..., h, w) above black of pixels by their codes and those of their neighbours;
        beyond the edge are black ones.

        By `talk` a pixel is brighter by that share of the mean code of the eight around it, relative
        to white; by `talk_of_left` its code is that much nearer to that of the one at its left.
        """
        flat = [(0, 0)] * (codes.ndim - 2)
        padded = np.pad(codes.astype(float), [*flat, (1, 1), (1, 1)])
        height, width = codes.shape[-2:]
        around = np.zeros(codes.shape)
        for down in range(3):
            for right in range(3):
                around += padded[..., down : down + height, right : right + width]
        around -= codes
        left = padded[..., 1 : 1 + height, :width]
        driven = codes + self.talk_of_left * (left - codes)
        light = np.interp(driven, np.arange(256), self.light)
        return light * (1 + self.talk * around / 8 / 255)

    def lone_light(self) -> np.ndarray:
        """Light (256,) of one lit pixel of each code on a black screen, with what it does to its
        neighbours.
        """
        screens = np.zeros((256, 3, 3), dtype=int)
        screens[:, 1, 1] = np.arange(256)
        return self.panel_light(screens).sum(axis=(1, 2))

    def tangents(self, x_px: np.ndarray, y_px: np.ndarray) -> np.ndarray:
        """True directions (n, 2) of pixels, tangents in cam."""
        u, v = (
            (at - (side - 1) / 2) / FOCAL_PX / (1 + self.focal)
            for at, side in zip((x_px, y_px), SIZE_PX, strict=True)
        )
        deep = 1 + self.tilt[0] * u + self.tilt[1] * v
        u, v = u / deep, v / deep
        round_ = u**2 + v**2
        more = 1 + self.bent[0] * round_ + self.bent[1] * round_**2
        u, v = u * more, v * more
        a, b, c = (angle / ARCSEC for angle in self.mount_arcsec)
        axis = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        turn = np.eye(3) + axis + axis @ axis / 2 + axis @ axis @ axis / 6
        seen = np.stack([u, v, np.ones_like(u)], axis=1) @ turn.T
        return seen[:, :2] / seen[:, 2:]


def supposed(rng: np.random.Generator) -> Truth:
    """A bench whose errors are those that the certificate's fits suppose."""
    code = np.arange(256) / 255
    wave = rng.normal(0, 0.03)
    light = code ** rng.uniform(1.9, 2.5) * (1 + wave * np.sin(4 * code)) / (1 + wave * math.sin(4))
    return Truth(
        light=light,
        black=rng.uniform(0, 0.002),
        white=WHITE_E_PER_S * math.exp(rng.normal(0, 0.1)),
        fall=(rng.uniform(0, 0.15), rng.uniform(0, 0.05)),
        bent=(rng.normal(0, 0.05), rng.normal(0, 0.2)),
        tilt=(rng.normal(0, 0.017), rng.normal(0, 0.017)),
        mount_arcsec=tuple(rng.normal(0, 60, 3)),
        focal=rng.normal(0, 0.003),
        delay_ms=rng.uniform(2, 20),
        drift_per_h=rng.normal(0, 0.02),
        reading_noise=rng.uniform(0.001, 0.004),
        dot_noise_px=rng.uniform(0.01, 0.04),
    )


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """A number at random, evenly in its logarithm."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def tails(rng: np.random.Generator) -> Truth:
    """Readings and dots whose noise is Student's t of three degrees."""
    return replace(supposed(rng), tails=True)


def in_time(rng: np.random.Generator) -> Truth:
    """Readings, and edges of the photodiode, whose noise lasts for 1 to 60 readings."""
    return replace(supposed(rng), lasts_readings=_between(rng, 1, 60))


def in_place(rng: np.random.Generator, length_px: float = 0.0, share: float = 0.0) -> Truth:
    """Dots whose errors have a smooth part, of 30 to 300 px and 1 to 50 % of the noise's
    variance.
    """
    one = supposed(rng)
    length_px, share = length_px or _between(rng, 30, 300), share or _between(rng, 0.01, 0.5)
    size = one.dot_noise_px * math.sqrt(share)
    fields = [SmoothField(length_px, rng) for _ in range(2)]
    return replace(one, dots_off=tuple(lambda x, y, f=field: size * f(x, y) for field in fields))


def uneven(rng: np.random.Generator, length_px: float = 0.0, size: float = 0.0) -> Truth:
    """A screen whose light is uneven by 0.1 to 1 %, over 30 to 500 px."""
    field = SmoothField(length_px or _between(rng, 30, 500), rng)
    size = size or _between(rng, 0.001, 0.01)
    return replace(supposed(rng), uneven=lambda x, y: size * field(x, y))


TRACKER_K1 = 0.02
LENS_ARCSEC = 2.0
HALF_FIELD_PX = 512


def own_lens(rng: np.random.Generator) -> Truth:
    """A tracker whose distortion is not that of its bench file."""
    return replace(supposed(rng), tracker_k1=rng.normal(0, TRACKER_K1))


def own_directions(rng: np.random.Generator) -> Truth:
    """A tracker whose directions are off by a smooth field, over a quarter of its field to all of
    it.
    """
    length_px = HALF_FIELD_PX * _between(rng, 0.5, 2)
    fields = [SmoothField(length_px, rng) for _ in range(2)]
    off = tuple(lambda x, y, f=field: LENS_ARCSEC * f(x, y) for field in fields)
    return replace(supposed(rng), lens_off_arcsec=off)


def warming(rng: np.random.Generator) -> Truth:
    """A monitor that was switched on just before: its light rises by 0.2 to 2 %, to a third in 0.5
    to 20 minutes.
    """
    rises, warm_s = _between(rng, 0.002, 0.02), 60 * _between(rng, 0.5, 20)
    return replace(supposed(rng), warms=rises, warm_s=warm_s)


def s_curve(rng: np.random.Generator) -> Truth:
    """A panel whose light follows a logistic curve of the code."""
    steep, middle = rng.uniform(4, 10), rng.uniform(0.4, 0.8)
    rising = 1 / (1 + np.exp(-steep * (np.arange(256) / 255 - middle)))
    light = (rising - rising[0]) / (rising[-1] - rising[0])
    return replace(supposed(rng), light=light)


def talking(rng: np.random.Generator) -> Truth:
    """A panel whose pixels are brighter or darker by 0.5 to 3 % among white ones, or have codes
    that are 0.5 to 3 % nearer to those at their left.
    """
    one, size = supposed(rng), _between(rng, 0.005, 0.03)
    if rng.integers(2):
        return replace(one, talk_of_left=size)
    return replace(one, talk=size * rng.choice([-1, 1]))


def own_response(rng: np.random.Generator) -> Truth:
    """A response with a knee, ripples or codes that are each off by themselves."""
    one = supposed(rng)
    code, light = np.arange(256) / 255, one.light
    match rng.integers(3):
        case 0:  # a knee: another exponent above a code
            at = rng.uniform(0.15, 0.9)
            light = np.where(
                code > at, light * (np.maximum(code, at) / at) ** rng.normal(0, 0.1), light
            )
        case 1:  # ripples of 6 to 60 codes
            size, period = _between(rng, 0.001, 0.01), _between(rng, 6, 60) / 255
            light = light * (1 + size * np.sin(2 * math.pi * code / period + rng.uniform(0, 6.3)))
        case _:  # each code by itself
            light = light * (1 + _between(rng, 0.0005, 0.005) * rng.standard_normal(256))
    return replace(one, light=light / light[-1])


KINDS: dict[str, Callable[[np.random.Generator], Truth]] = {
    "as supposed": supposed,
    "heavy tails": tails,
    "correlated in time": in_time,
    "correlated in place": in_place,
    "uneven light": uneven,
    "tracker's own lens": own_lens,
    "tracker's own directions": own_directions,
    "other response": own_response,
    "S-curve": s_curve,
    "warming up": warming,
    "pixels that talk": talking,
}


@dataclass
class PlantedReader:
    """Readings of a planted bench."""

    is_so: Truth
    rng: np.random.Generator
    monitor: None = None
    truth: None = None
    centroid_px: float = 0.0
    identity: str = "planted"

    def _noise(self, size: tuple[int, ...]) -> np.ndarray:
        if not self.is_so.tails:
            return self.rng.standard_normal(size)
        return self.rng.standard_t(TAILS_DOF, size) / math.sqrt(TAILS_DOF / (TAILS_DOF - 2))

    def _series(self, count: int) -> np.ndarray:
        """Noise (n,) of readings one after the other."""
        new = self._noise((count,))
        if not self.is_so.lasts_readings:
            return new
        stays = math.exp(-1 / self.is_so.lasts_readings)
        for k in range(1, count):
            new[k] = stays * new[k - 1] + math.sqrt(1 - stays**2) * new[k]
        return new

    def light(self, codes: np.ndarray) -> LightReadings:
        """Light of the middle of the screen, a second a reading."""
        one, t_s = self.is_so, np.arange(len(codes), dtype=np.float64)
        here = one.even(*(np.array([side // 2]) for side in SIZE_PX))[0]
        warmth = 1 + one.drift_per_h * t_s / 3600
        warmth += one.warms * (1 - np.exp(-t_s / one.warm_s))
        lone = one.lone_light()
        level = (lone[codes] + one.black) * one.white * here * warmth
        read = level * (1 + one.reading_noise * self._series(len(codes)))
        return LightReadings(codes, read, t_s, beside=self._beside(lone))

    def _beside(self, lone: np.ndarray) -> BesideRatio:
        """A lattice of neighbouring pixels against single ones, in pairs of readings."""
        one = self.is_so
        screen = np.full((5, 5), BESIDE_CODE)
        ratio = one.panel_light(screen)[2, 2] / lone[BESIDE_CODE]
        error = one.reading_noise * math.sqrt(2 / BESIDE_PAIRS)
        noise = one.reading_noise * self._noise((BESIDE_PAIRS, 2)).mean(axis=0)
        return BesideRatio(ratio * (1 + noise[0] - noise[1]), error)

    def dots(self, x_px: np.ndarray, y_px: np.ndarray, images: int) -> DotReadings:
        """Dots through the true lens and the tracker's own, of the mean of some images."""
        one, less = self.is_so, 1 / math.sqrt(images)
        x, y = x_px.astype(float), y_px.astype(float)
        seen = one.tangents(x, y)
        seen = seen * (1 + one.tracker_k1 * (seen**2).sum(axis=1, keepdims=True))
        off = np.stack(
            [part(x, y) for part in one.dots_off], axis=1
        ) + one.dot_noise_px * self._noise((len(x), 2))
        at = TRACKER_FOCAL_PX * seen + TRACKER_MIDDLE_PX
        lens_off = np.stack([part(at[:, 0], at[:, 1]) for part in one.lens_off_arcsec], axis=1)
        at += TRACKER_FOCAL_PX * lens_off / ARCSEC + less * off
        light = one.even(x, y) * (1 + less * one.reading_noise * self._noise((len(x),)))
        return DotReadings(x, y, at[:, 0], at[:, 1], light, 0.55, 0.001)

    def delays_ms(self) -> np.ndarray:
        """Edges that a photodiode saw."""
        return self.is_so.delay_ms + EDGE_NOISE_MS * self._series(EDGES)


def true_figures(one: Truth, stars: list[ReferenceStar]) -> dict[tuple[str, int | None], float]:
    """The figures of a bench with `calibration = "srgb"`, an ideal lens and a delay of DELAY_MS,
    by quantity and star.
    """
    signal = np.arange(256) / 255
    expected = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    found: dict[tuple[str, int | None], float] = {}
    rows, moved, rays = [], [], []
    for star in stars:
        code = np.array(
            [int(np.argmin(np.abs(expected - math.exp(light)))) for light in star.log_light]
        )
        x, y = np.array([star.x_px]), np.array([star.y_px])
        # Evenness is that at the star's middle: a field of 30 px changes by 0.1 % of itself over a
        # star's sigma.
        here = one.white / WHITE_E_PER_S * one.even(np.rint(x), np.rint(y))[0]
        row, column = (star.pixel_px - star.pixel_px.min(axis=0)).T
        screen = np.zeros((row.max() + 3, column.max() + 3), dtype=int)
        screen[row + 1, column + 1] = code
        light = one.panel_light(screen).sum() / expected[code].sum()
        found["flux", star.hip] = -2.5 * math.log10(here * float(light))
        wanted = np.array(
            [(x[0] - (SIZE_PX[0] - 1) / 2) / FOCAL_PX, (y[0] - (SIZE_PX[1] - 1) / 2) / FOCAL_PX]
        )
        seen = one.tangents(x, y)[0]
        found["place_along", star.hip], found["place_across", star.hip] = (
            (seen - wanted) * ARCSEC
        ).tolist()
        ray, true = np.append(wanted, 1.0), np.append(seen, 1.0)
        ray, true = ray / np.linalg.norm(ray), true / np.linalg.norm(true)
        a, b, c = ray
        # the cross product turn x ray, by the turn
        rows.append(np.array([[0, c, -b], [-c, 0, a], [b, -a, 0]]))
        moved.append(true)
        rays.append(ray)
    # The rotation that brings the commanded rays nearest to the true ones, by Gauss and Newton.
    turn = np.eye(3)
    for _ in range(5):
        now = np.array(rays) @ turn.T
        rows = [np.array([[0, c, -b], [-c, 0, a], [b, -a, 0]]) for a, b, c in now]
        step = np.linalg.lstsq(
            np.concatenate(rows),
            np.concatenate([t - n for t, n in zip(moved, now, strict=True)]),
            rcond=None,
        )[0]
        a, b, c = step
        axis = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        turn = (np.eye(3) + axis + axis @ axis / 2 + axis @ axis @ axis / 6) @ turn
    angle = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    for name, value in zip("xyz", angle, strict=True):
        found[f"attitude_{name}", None] = value / 2 * ARCSEC
    found["latency", None] = one.delay_ms
    return found
