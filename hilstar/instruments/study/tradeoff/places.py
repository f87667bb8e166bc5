"""Trade-offs of place: culling, projection, smear along a turning star's path, prediction; on
the demo's bench.
"""

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import angle_between_rad, normalise, to_matrix
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.geometry import monitor_camera
from hilstar.display.phases import measure
from hilstar.display.render.reference import linear_image
from hilstar.display.render.target import Target
from hilstar.display.render.variants import SplatVariant, VariantRenderer
from hilstar.instruments.study.predictors import (
    JITTER,
    NEAR,
    ORION,
    SLEW_DEG,
    SLEW_S,
    AttitudeAt,
    predictors,
    slew_attitude,
    slew_sample,
)
from hilstar.instruments.study.trials import Figure, Trial, Trials
from hilstar.optics.camera import Camera
from hilstar.optics.exposure_motion import MIDDLE_S, Motion, smeared_sprites
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight, pack_sprites
from hilstar.server.bench.cameras import ideal_monitor, tracker_psf
from hilstar.server.bench.config import BenchConfig, RenderSettings, read_config
from hilstar.server.bench.star_light import bench_stars
from hilstar.sky.catalog import plain_catalog
from hilstar.sky.stars import CELL_DEG, Stars, cell_grid, make_stars

SPRITE_PSF = GaussianPsf(RenderSettings().sprite_sigma_px)
NO_LIMIT_V_MAG = 20.0
ATTITUDES = 60
SEED = 1
STAR_COLUMNS = ("hip", "vectors", "v_mag", "bv_mag", "temperature_k", "electrons_per_s", "row")
CELLS_DEG = (1.0, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)
# float64 places of 2000 px are a few steps of 2.3e-13 px off.
ROUNDING_PX = 1e-12
SAMPLE_MS = 50
FRAME_HZ = 60
PREDICTIONS = 60
RATE_DEG_S = (0.7, -0.7, 5.0)
EVENLY = (4, 8, 16, 32, 64)
GAUSS = (8, 16, 24, 32)
# 200 nodes on 28 sigmas at most: six times as many as the module's rule asks for.
EXACT_NODES = 200
# Wider than the path's own footprints, so that the steps' error is not their cut; 24 px are 21
# sigma on either side.
WIDE_PX = 24
STARS_ACROSS = 16
# float32 fluxes and fractions of the sprites: 6e-8 of each.
ROUNDING_SHARE = 1e-7


@cache
def demo_config() -> BenchConfig:
    """The bench of `hilstar demo`."""
    return read_config(resource_path("configs", "demo.toml"))


@cache
def stars_to(faintest_v_mag: float) -> Stars:
    """The demo's stars to a magnitude."""
    config = demo_config()
    sky = msgspec.structs.replace(config.sky, faintest_v_mag=faintest_v_mag)
    return bench_stars(msgspec.structs.replace(config, sky=sky), Path())


def turn_to_image(q: FloatArray, camera: Camera) -> FloatArray:
    """ICRS to image axes, (3, 3), at an attitude."""
    return np.asarray(camera.cam_to_image @ to_matrix(q))


def random_turns(count: int, camera: Camera) -> list[FloatArray]:
    """ICRS to image axes, (3, 3) each, at attitudes of which any is as likely as any other;
    ORION is the first.
    """
    drawn = normalise(np.random.default_rng(SEED).normal(size=(count - 1, 4)))
    return [turn_to_image(q, camera) for q in (ORION, *drawn)]


def culling(stack: ExitStack, quick: bool) -> Trials:
    """How the stars in view are found among all: stars missed over ATTITUDES fields, and stars
    tested that are not in view.
    """
    del stack
    camera = ideal_monitor(demo_config())
    stars = stars_to(NO_LIMIT_V_MAG)
    turns = random_turns(10 if quick else ATTITUDES, camera)

    def by_angle(stars: Stars, turn: FloatArray, camera: Camera) -> tuple[IntArray, int]:
        radius_rad = camera.field_radius_rad(SPRITE_PSF.footprint_px / 2 + 1)
        return _project(
            stars, np.flatnonzero(stars.vectors @ turn[2] >= np.cos(radius_rad)), turn, camera
        ), len(stars)

    in_view = [set(stars.hip[_scan(stars, turn, camera)[0]].tolist()) for turn in turns]
    finders: dict[str, tuple[Stars, Finder]] = {
        "scan, every star projected": (stars, _scan),
        "scan of angles": (stars, by_angle),
        **{
            f"cells of {deg:g} deg": (in_cells(stars, deg), _by_cells)
            for deg in sorted({*CELLS_DEG, CELL_DEG})
        },
        "cells of 10 deg, by centres only": (in_cells(stars, 10.0, by_centres=True), _by_cells),
    }
    trials = []
    for name, (sorted_stars, finder) in finders.items():
        missed = 0
        vain = 0
        for turn, wanted in zip(turns, in_view, strict=True):
            visible, looked_at = finder(sorted_stars, turn, camera)
            shown = set(sorted_stars.hip[visible].tolist())
            missed += len(wanted - shown)
            vain += looked_at - len(wanted & shown)
        work = partial(finder, sorted_stars, turns[0], camera)
        is_own = name == f"cells of {CELL_DEG:g} deg"
        trials.append(Trial(name, missed, vain / len(turns), work, is_own, finder is _scan))
    return Trials(
        "culling",
        f"{len(stars)} stars to the {len(in_view[0])} sprites of Orion",
        Figure(f"stars missed in {len(turns)} fields", "stars", 0.1),
        Figure("tested but not in view, mean", "stars"),
        "a smaller cell passes on fewer stars in a rich field, a larger one costs less in a"
        " sparse one",
        trials,
    )


# Which stars (places in `Stars`) are in view, and how many were tested.
Finder = Callable[[Stars, FloatArray, Camera], tuple[IntArray, int]]


def in_cells(stars: Stars, cell_deg: float, by_centres: bool = False) -> Stars:
    """The stars in cells of another size; `by_centres` takes a cell for a point."""
    grid = cell_grid(stars.vectors, cell_deg)
    columns = {name: getattr(stars, name)[grid.order] for name in STAR_COLUMNS}
    if by_centres:
        grid = replace(
            grid,
            cos_radius=np.ones_like(grid.cos_radius),
            sin_radius=np.zeros_like(grid.sin_radius),
        )
    return replace(stars, **columns, grid=grid)


def _by_cells(stars: Stars, turn: FloatArray, camera: Camera) -> tuple[IntArray, int]:
    """As `make_sprites` finds them."""
    margin_px = SPRITE_PSF.footprint_px / 2 + 1
    near = stars.grid.near(
        turn[2], camera.field_radius_rad(margin_px), camera.edges(margin_px) @ turn
    )
    return _project(stars, near, turn, camera), len(near)


def _scan(stars: Stars, turn: FloatArray, camera: Camera) -> tuple[IntArray, int]:
    return _project(stars, np.arange(len(stars)), turn, camera), len(stars)


def _project(stars: Stars, near: IntArray, turn: FloatArray, camera: Camera) -> IntArray:
    x_px, y_px = camera.project(stars.vectors[near] @ turn.T)
    return pack_sprites(
        x_px, y_px, stars.electrons_per_s[near], near, camera.resolution_px, SPRITE_PSF.footprint_px
    ).star


def projection(stack: ExitStack, quick: bool) -> Trials:
    """Errors of star places, px, by the number format in which they are computed: the largest and
    the rms over the stars of ATTITUDES random fields.
    """
    del stack
    camera = ideal_monitor(demo_config())
    stars = stars_to(NO_LIMIT_V_MAG)
    turns = random_turns(6 if quick else ATTITUDES, camera)
    near = [stars.vectors[stars.grid.near(turn[2], camera.field_radius_rad(0.0))] for turn in turns]
    truths = [
        _places(EXACT, vectors, turn, camera) for vectors, turn in zip(near, turns, strict=True)
    ]
    trials = []
    for name, road in ROADS.items():
        places = [
            _places(road, vectors, turn, camera) for vectors, turn in zip(near, turns, strict=True)
        ]
        error = np.hypot(*(np.concatenate(places) - np.concatenate(truths)).T).astype(np.float64)
        error = error[np.isfinite(error)]
        work = partial(road.pack, near[0], turns[0], camera)
        # The sprites' own layout says which of them the renderer is handed.
        figures = float(error.max()), float(np.sqrt(np.mean(error**2)))
        trials.append(Trial(name, *figures, work, road.dtype == SPRITE_DTYPE, road is EXACT))
    return Trials(
        "projection",
        f"{len(near[0])} stars near the field to sprites, {camera.resolution_px[0]} x"
        f" {camera.resolution_px[1]}",
        Figure("position error, worst star", "px", ROUNDING_PX),
        Figure("rms", "px"),
        "OpenGL 3.3 takes no float64, and the error of a float32 position grows with the monitor",
        trials,
    )


@dataclass(frozen=True, slots=True)
class Road:
    """From directions to sprites: the precision of the mathematics, and the layout of the
    sprites.
    """

    kind: type[np.floating[Any]]
    dtype: np.dtype[np.void]

    def pack(
        self, vectors: FloatArray, icrs_to_image: FloatArray, camera: Camera
    ) -> tuple[npt.NDArray[np.void], IntArray]:
        """Sprites of stars of one electron per second, in the layout, and which of `vectors`
        (n, 3) they are.
        """
        kind = self.kind
        x, y, z = (vectors.astype(kind, copy=False) @ icrs_to_image.T.astype(kind)).T
        scale = kind(camera.focal_length_px) / z
        cx, cy = (kind(c) for c in camera.principal_point_px)
        x = x * scale + cx
        y = y * scale + cy
        star, (width, height), side = (
            np.arange(len(vectors)),
            camera.resolution_px,
            SPRITE_PSF.footprint_px,
        )
        if self.dtype == SPRITE_DTYPE:
            sprites = pack_sprites(x, y, np.ones(len(star)), star, (width, height), side)
            return sprites.data, sprites.star
        margin = side / 2
        is_visible = (x > -margin) & (x < width + margin) & (y > -margin) & (y < height + margin)
        data = np.empty(np.count_nonzero(is_visible), dtype=self.dtype)
        data["place_px"][:, 0], data["place_px"][:, 1] = x[is_visible], y[is_visible]
        data["electrons_per_s"] = 1.0
        return data, star[is_visible]


def _layout(place: type[np.floating[Any]]) -> np.dtype[np.void]:
    return np.dtype([("place_px", place, 2), ("electrons_per_s", "<f4")])


EXACT = Road(np.longdouble, _layout(np.longdouble))
ROADS = {
    "extended precision": EXACT,
    "float64, place in float64": Road(np.float64, _layout(np.float64)),
    "float64, place in float32": Road(np.float64, _layout(np.float32)),
    "float32 throughout": Road(np.float32, _layout(np.float32)),
    "float64, whole pixel + float32 fraction": Road(np.float64, SPRITE_DTYPE),
}


def _places(
    road: Road, vectors: FloatArray, icrs_to_image: FloatArray, camera: Camera
) -> npt.NDArray[np.longdouble]:
    """Places (n, 2), px; NaN for a star that is not seen."""
    data, star = road.pack(vectors, icrs_to_image, camera)
    places = np.full((len(vectors), 2), np.nan, dtype=np.longdouble)
    split = data.dtype == SPRITE_DTYPE
    places[star] = (
        data["pixel"] + data["fraction_px"].astype(np.longdouble) if split else data["place_px"]
    )
    return places


TRACKER = demo_config().tracker
TRACKER_PSF = tracker_psf(TRACKER, Path())
CAMERA = monitor_camera(
    TRACKER.resolution_px, TRACKER.pixel_pitch_um, TRACKER.focal_length_mm, np.array([1.0, 0, 0, 0])
)
SIZE_PX = CAMERA.resolution_px[0]


SpritesOf = Callable[[Stars], FrameLight]


def smear(stack: ExitStack, quick: bool) -> Trials:
    """Sprites on a turning star's path: worst pixel, share of the star's flux, and centroid, px,
    over a grid of stars.
    """
    across = STARS_ACROSS // 2 if quick else STARS_ACROSS
    motion = Motion(ORION, np.radians(np.array(RATE_DEG_S)), TRACKER.exposure_s)
    few = grid_stars(across, motion)
    many = grid_stars(STARS_ACROSS, motion)
    renderer = stack.enter_context(
        VariantRenderer(Target(TRACKER.resolution_px, TRACKER_PSF), SplatVariant())
    )

    def own(stars: Stars) -> FrameLight:
        return smeared_sprites(stars, motion, CAMERA, TRACKER_PSF)

    def gauss(count: int, stars: Stars) -> FrameLight:
        nodes, weights = np.polynomial.legendre.leggauss(count)
        return _chain(stars, motion, nodes / 2, weights / 2)

    def evenly(count: int, stars: Stars) -> FrameLight:
        return _chain(
            stars, motion, (np.arange(count) + 0.5) / count - 0.5, np.full(count, 1 / count)
        )

    def image(sprites: FrameLight) -> FloatArray:
        return linear_image(sprites, CAMERA.resolution_px, TRACKER_PSF, WIDE_PX)

    def draw(sprites_of: SpritesOf) -> None:
        renderer.draw_and_wait(sprites_of(many))

    names = {count: f"Gauss-Legendre, {count}" for count in (*GAUSS, EXACT_NODES)}
    methods: dict[str, SpritesOf] = {
        f"Gauss-Legendre by length, {len(own(few)) / len(few):.0f} on average": own
    }
    methods |= {name: partial(gauss, count) for count, name in names.items()}
    methods |= {f"evenly in time, {count}": partial(evenly, count) for count in EVENLY}
    exact = image(gauss(EXACT_NODES, few))
    trials = []
    for name, sprites_of in methods.items():
        drawn = image(sprites_of(few))
        worst = float(np.abs(drawn - exact).max())
        off_px = measure(exact, drawn, len(exact) // across).centroid_max_px
        trials.append(
            Trial(
                name,
                worst,
                off_px,
                partial(draw, sprites_of),
                sprites_of is own,
                name == names[EXACT_NODES],
            )
        )
    x_px, y_px = _places_px(many, motion, np.array([-0.5, 0.5]))
    paths_px = np.hypot(np.diff(x_px, axis=0), np.diff(y_px, axis=0))
    return Trials(
        "smear",
        f"linear image of {len(many)} stars, paths of {paths_px.min():.0f} to {paths_px.max():.0f}"
        f" px, {SIZE_PX} px squared",
        Figure("largest pixel error, share of its star", "1", ROUNDING_SHARE),
        Figure("centre of gravity, worst", "px"),
        "its error does not grow with the path, as that of a fixed number does",
        trials,
    )


def grid_stars(across: int, motion: Motion) -> Stars:
    """Stars of one electron per second, across^2 of them evenly over the detector in the middle
    of the exposure.
    """
    place = (np.arange(across) + 0.5) * SIZE_PX / across - 0.5
    x_px, y_px = (axis.ravel() - (SIZE_PX - 1) / 2 for axis in np.meshgrid(place, place))
    image = np.column_stack([x_px, y_px, np.full(across**2, CAMERA.focal_length_px)])
    vectors = (
        image
        / np.linalg.norm(image, axis=1, keepdims=True)
        @ motion.icrs_to_image(MIDDLE_S, CAMERA)[0]
    )
    zero = np.zeros(across**2)
    catalog = plain_catalog("star", across**2, {"v_mag": zero, "ra_deg": zero, "dec_deg": zero})
    return make_stars(catalog, vectors, zero, zero + 1)


def _chain(stars: Stars, motion: Motion, at: FloatArray, share: FloatArray) -> FrameLight:
    x_px, y_px = _places_px(stars, motion, at)
    light = np.outer(share, stars.electrons_per_s)
    star = np.broadcast_to(np.arange(len(stars)), x_px.shape)
    side = TRACKER_PSF.footprint_px
    return pack_sprites(
        x_px.ravel(), y_px.ravel(), light.ravel(), star.ravel(), CAMERA.resolution_px, side
    )


def _places_px(stars: Stars, motion: Motion, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (k, n), px, at the parts `at` (k,) of the exposure, 0 its middle."""
    image_directions = stars.vectors @ motion.icrs_to_image(
        at * motion.exposure_s, CAMERA
    ).transpose(0, 2, 1)
    x_px, y_px = CAMERA.project(image_directions.reshape(-1, 3))
    return x_px.reshape(len(at), -1), y_px.reshape(len(at), -1)


def prediction(stack: ExitStack, quick: bool) -> Trials:
    """The attitude at the moment of light, after the newest sample: worst and rms error, arcsec,
    on a shaken slew.
    """
    del stack
    samples = [
        slew_sample(k * SAMPLE_MS * NS_PER_MS)
        for k in range((10 if quick else 60) * 1000 // SAMPLE_MS)
    ]
    frames_ns = (
        np.linspace(0, SAMPLE_MS * NS_PER_MS, PREDICTIONS, dtype=np.int64) + samples[-2].t_ns
    ).tolist()
    frame_ns = NS_PER_S / FRAME_HZ
    trials = []
    for predictor in predictors():
        errors = []
        for after in range(NEAR, len(samples)):
            attitude_at = predictor.load(
                samples[after - NEAR : after + 1 if predictor.waits else after]
            )
            first, last = (math.ceil(samples[k].t_ns / frame_ns) for k in (after - 1, after))
            for t_ns in (round(k * frame_ns) for k in range(first, last)):
                errors.append(
                    angle_between_rad(slew_attitude(t_ns), attitude_at(t_ns)) * math.degrees(3600)
                )

        def work(attitude_at: AttitudeAt) -> None:
            for t_ns in frames_ns:
                attitude_at(t_ns)

        timed = partial(
            work, predictor.load(samples[-1 - NEAR : len(samples) if predictor.waits else -1])
        )
        rms_arcsec = float(np.sqrt(np.mean(np.square(errors))))
        trials.append(Trial(predictor.name, max(errors), rms_arcsec, timed, predictor.is_default))
    shaken = ", ".join(f"{size:g} arcsec at {hz:g} Hz" for size, hz in JITTER)
    return Trials(
        "prediction",
        f"{PREDICTIONS} attitudes, samples every {SAMPLE_MS} ms",
        Figure("attitude error, worst", "arcsec"),
        Figure("rms", "arcsec"),
        "it needs nothing but the newest sample",
        trials,
        f"a swing of {SLEW_DEG:g} degrees in {SLEW_S:g} s, shaken on each axis by {shaken}; waiting"
        f" for a sample makes the attitude {SAMPLE_MS} ms older; the times of hold, of the linear"
        " predictors and of the blend include the timeline, those of the other two do not",
    )
