"""Trade-offs of place: culling, projection, smear along a turning star's path, prediction; on
the demo's bench.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.resources import resource_path
from hilstar.basics.rotation import angle_between_rad, random_attitudes, to_matrix
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
    Predictor,
    predictors,
    slew_attitude,
    slew_sample,
)
from hilstar.instruments.study.trials import Figure, Trial, Trials
from hilstar.optics.camera import Camera
from hilstar.optics.exposure_motion import MIDDLE_S, Motion, smeared_sprites
from hilstar.optics.psf import GaussianPsf, Psf
from hilstar.optics.sprites import SPRITE_DTYPE, FrameLight, pack_sprites
from hilstar.server.bench.cameras import ideal_monitor, tracker_psf
from hilstar.server.bench.config import BenchConfig, RenderSettings, read_config
from hilstar.server.bench.star_light import bench_stars
from hilstar.sky.catalog import plain_catalog
from hilstar.sky.stars import CELL_DEG, Stars, cell_grid, make_stars

SPRITE_PSF = GaussianPsf(RenderSettings().sprite_sigma_px)
NO_LIMIT_V_MAG = 20.0  # fainter than all of Hipparcos
ATTITUDES = 60  # random fields
SEED = 1
STAR_COLUMNS = ("hip", "vectors", "v_mag", "bv_mag", "temperature_k", "electrons_per_s", "row")
CELLS_DEG = (1.0, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0)
# float64 places of 2000 px are a few steps of 2.3e-13 px off.
ROUNDING_PX = 1e-12
SAMPLE_MS = 50  # between attitudes
FRAME_HZ = 60
PREDICTIONS = 60  # attitudes that are timed as one work
RATE_DEG_S = (0.7, -0.7, 5.0)
EVENLY = (4, 8, 16, 32, 64)
GAUSS = (8, 16, 24, 32)
# 200 nodes on 28 sigmas at most: six times as many as the module's rule asks for.
EXACT_NODES = 200
# Wider than the path's own footprints, so that the steps' error is not their cut; 24 px are 21
# sigma on either side.
WIDE_PX = 24
STARS_ACROSS = 16  # of a square grid
# float32 fluxes and fractions of the sprites: 6e-8 of each.
ROUNDING_SHARE = 1e-7
MARGIN_PX = SPRITE_PSF.footprint_px / 2 + 1  # beyond the image, from where sprites reach into it


@dataclass(frozen=True, slots=True)
class CulledStars:
    """The stars in view, as places (n,) in `Stars`, and how many were tested."""

    star: IntArray
    tested: int


Finder = Callable[[Stars, FloatArray, Camera], CulledStars]
SpritesOf = Callable[[Stars], FrameLight]


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
        axes = icrs_to_image.T.astype(kind)
        turned = vectors.astype(kind, copy=False) @ axes
        x, y, z = turned.T
        focal_length_px = kind(camera.focal_length_px)
        scale = focal_length_px / z
        centre_x, centre_y = camera.principal_point_px
        x = x * scale + kind(centre_x)
        y = y * scale + kind(centre_y)
        star = np.arange(len(vectors))
        width, height = camera.resolution_px
        side_px = SPRITE_PSF.footprint_px
        if self.dtype == SPRITE_DTYPE:
            rates = np.ones(len(star))
            size_px = (width, height)
            sprites = pack_sprites(x, y, rates, star, size_px, side_px)
            return sprites.data, sprites.star
        margin = side_px / 2
        is_visible = (x > -margin) & (x < width + margin)
        is_visible &= (y > -margin) & (y < height + margin)
        data = np.empty(np.count_nonzero(is_visible), dtype=self.dtype)
        data["place_px"][:, 0] = x[is_visible]
        data["place_px"][:, 1] = y[is_visible]
        data["electrons_per_s"] = 1.0
        return data, star[is_visible]

    def places_px(
        self, vectors: FloatArray, icrs_to_image: FloatArray, camera: Camera
    ) -> npt.NDArray[np.longdouble]:
        """Places (n, 2) of the stars, px; NaN for one that is not seen."""
        data, star = self.pack(vectors, icrs_to_image, camera)
        pairs = (len(vectors), 2)
        places = np.full(pairs, np.nan, dtype=np.longdouble)
        if data.dtype == SPRITE_DTYPE:
            fraction_px = data["fraction_px"].astype(np.longdouble)
            places[star] = data["pixel"] + fraction_px
        else:
            places[star] = data["place_px"]
        return places


def _layout(place: type[np.floating[Any]]) -> np.dtype[np.void]:
    return np.dtype([("place_px", place, 2), ("electrons_per_s", "<f4")])


EXACT: Road = Road(np.longdouble, _layout(np.longdouble))
ROADS: dict[str, Road] = {
    "extended precision": EXACT,
    "float64, place in float64": Road(np.float64, _layout(np.float64)),
    "float64, place in float32": Road(np.float64, _layout(np.float32)),
    "float32 throughout": Road(np.float32, _layout(np.float32)),
    "float64, whole pixel + float32 fraction": Road(np.float64, SPRITE_DTYPE),
}


@cache
def demo_config() -> BenchConfig:
    """The bench of `hilstar demo`."""
    return read_config(resource_path("configs", "demo.toml"))


@cache
def stars_to(faintest_v_mag: float) -> Stars:
    """The demo's stars to a magnitude."""
    config = demo_config()
    sky = msgspec.structs.replace(config.sky, faintest_v_mag=faintest_v_mag)
    to_faintest = msgspec.structs.replace(config, sky=sky)
    return bench_stars(to_faintest, Path())


def turn_to_image(q: FloatArray, camera: Camera) -> FloatArray:
    """ICRS to image axes, (3, 3), at an attitude."""
    return np.asarray(camera.cam_to_image @ to_matrix(q))


def random_turns(count: int, camera: Camera) -> list[FloatArray]:
    """Rotations from ICRS to image axes, (3, 3) each: ORION's, then uniformly random ones."""
    rng = np.random.default_rng(SEED)
    turns = []
    for q in (ORION, *random_attitudes(count - 1, rng)):
        turns.append(turn_to_image(q, camera))
    return turns


def in_cells(stars: Stars, cell_deg: float, by_centres: bool = False) -> Stars:
    """The stars in cells of another size; `by_centres` takes a cell for a point."""
    grid = cell_grid(stars.vectors, cell_deg)
    columns = {}
    for name in STAR_COLUMNS:
        columns[name] = getattr(stars, name)[grid.order]
    if by_centres:
        cosine = np.ones_like(grid.cos_radius)
        sine = np.zeros_like(grid.sin_radius)
        grid = replace(grid, cos_radius=cosine, sin_radius=sine)
    return replace(stars, **columns, grid=grid)


def scan(stars: Stars, turn: FloatArray, camera: Camera) -> CulledStars:
    """Every star projected."""
    every = np.arange(len(stars))
    star = projected(stars, every, turn, camera)
    return CulledStars(star, len(stars))


def by_angle(stars: Stars, turn: FloatArray, camera: Camera) -> CulledStars:
    """The stars within a circle about the boresight, by the angles of all stars."""
    radius_rad = camera.field_radius_rad(MARGIN_PX)
    cosines = stars.vectors @ turn[2]
    in_circle = cosines >= np.cos(radius_rad)
    near = np.flatnonzero(in_circle)
    star = projected(stars, near, turn, camera)
    return CulledStars(star, len(stars))


def by_cells(stars: Stars, turn: FloatArray, camera: Camera) -> CulledStars:
    """As `make_sprites` finds them."""
    radius_rad = camera.field_radius_rad(MARGIN_PX)
    edges = camera.edges(MARGIN_PX) @ turn
    near = stars.grid.near(turn[2], radius_rad, edges)
    star = projected(stars, near, turn, camera)
    return CulledStars(star, len(near))


def projected(stars: Stars, near: IntArray, turn: FloatArray, camera: Camera) -> IntArray:
    """The stars of `near` (n,) that are in view."""
    directions = stars.vectors[near] @ turn.T
    x_px, y_px = camera.project(directions)
    rates = stars.electrons_per_s[near]
    side_px = SPRITE_PSF.footprint_px
    sprites = pack_sprites(x_px, y_px, rates, near, camera.resolution_px, side_px)
    return sprites.star


def stars_in_view(stars: Stars, turns: Sequence[FloatArray], camera: Camera) -> list[set[int]]:
    """The Hipparcos numbers of the stars in view of each turn."""
    in_view = []
    for turn in turns:
        star = scan(stars, turn, camera).star
        in_view.append(set(stars.hip[star].tolist()))
    return in_view


def path_words(bench: "SmearBench", stars: Stars) -> str:
    """The lengths of stars' paths, shortest to longest, in words."""
    ends = np.array([-0.5, 0.5])
    x_px, y_px = bench.places_px(stars, ends)
    across_px = np.diff(x_px, axis=0)
    down_px = np.diff(y_px, axis=0)
    paths_px = np.hypot(across_px, down_px)
    return f"{paths_px.min():.0f} to {paths_px.max():.0f} px"


def worst_and_rms_px(off_px: npt.NDArray[np.longdouble]) -> tuple[float, float]:
    """The largest and the rms distance of offsets (n, 2), px; NaN is a star that is not seen."""
    off_x, off_y = off_px.T
    distance_px = np.hypot(off_x, off_y)
    error = distance_px.astype(np.float64)
    error = error[np.isfinite(error)]
    mean_square = np.mean(error**2)
    return float(error.max()), float(np.sqrt(mean_square))


def places_in_fields(
    road: Road, fields: Sequence[FloatArray], turns: Sequence[FloatArray], camera: Camera
) -> npt.NDArray[np.longdouble]:
    """Places (n, 2), px, of the stars of all fields, whose directions are (k, 3) each."""
    of_fields = []
    for vectors, turn in zip(fields, turns, strict=True):
        of_fields.append(road.places_px(vectors, turn, camera))
    return np.concatenate(of_fields)


def culling(stack: ExitStack, quick: bool) -> Trials:
    """How the stars in view are found: stars missed over ATTITUDES fields, and stars tested in
    vain.
    """
    del stack
    camera = ideal_monitor(demo_config())
    stars = stars_to(NO_LIMIT_V_MAG)
    field_count = 10 if quick else ATTITUDES
    turns = random_turns(field_count, camera)
    in_view = stars_in_view(stars, turns, camera)
    methods: dict[str, tuple[Stars, Finder]] = {
        "scan, every star projected": (stars, scan),
        "scan of angles": (stars, by_angle),
    }
    cells_deg = sorted({*CELLS_DEG, CELL_DEG})
    for cell_deg in cells_deg:
        methods[f"cells of {cell_deg:g} deg"] = in_cells(stars, cell_deg), by_cells
    by_centres = in_cells(stars, 10.0, by_centres=True)
    methods["cells of 10 deg, by centres only"] = by_centres, by_cells
    trials = []
    for name, (sorted_stars, finder) in methods.items():
        missed = 0
        vain = 0
        for turn, wanted in zip(turns, in_view, strict=True):
            culled = finder(sorted_stars, turn, camera)
            shown = set(sorted_stars.hip[culled.star].tolist())
            missed += len(wanted - shown)
            vain += culled.tested - len(wanted & shown)
        work = partial(finder, sorted_stars, turns[0], camera)
        is_default = name == f"cells of {CELL_DEG:g} deg"
        mean_vain = vain / len(turns)
        trial = Trial(name, missed, mean_vain, work, is_default, finder is scan)
        trials.append(trial)
    missed_figure = Figure(f"stars missed in {len(turns)} fields", "stars", 0.1)
    tested_figure = Figure("tested but not in view, mean", "stars")
    scene = f"{len(stars)} stars to the {len(in_view[0])} sprites of Orion"
    why = (
        "a smaller cell passes on fewer stars in a rich field, a larger one costs less in a"
        " sparse one"
    )
    return Trials(
        "culling",
        scene,
        missed_figure,
        tested_figure,
        why,
        trials,
    )


def stars_near(stars: Stars, turns: Sequence[FloatArray], radius_rad: float) -> list[FloatArray]:
    """The directions (k, 3) of the stars near each boresight."""
    near = []
    for turn in turns:
        star = stars.grid.near(turn[2], radius_rad)
        near.append(stars.vectors[star])
    return near


def projection(stack: ExitStack, quick: bool) -> Trials:
    """Errors of star places, px, by number format: largest and rms over the stars of ATTITUDES
    fields.
    """
    del stack
    camera = ideal_monitor(demo_config())
    stars = stars_to(NO_LIMIT_V_MAG)
    field_count = 6 if quick else ATTITUDES
    turns = random_turns(field_count, camera)
    near = stars_near(stars, turns, camera.field_radius_rad(0.0))
    truth = places_in_fields(EXACT, near, turns, camera)
    trials = []
    for name, road in ROADS.items():
        off_px = places_in_fields(road, near, turns, camera) - truth
        worst_px, rms_px = worst_and_rms_px(off_px)
        work = partial(road.pack, near[0], turns[0], camera)
        # The sprites' own layout says which of them the renderer is handed.
        is_default = road.dtype == SPRITE_DTYPE
        trial = Trial(name, worst_px, rms_px, work, is_default, road is EXACT)
        trials.append(trial)
    width, height = camera.resolution_px
    scene = f"{len(near[0])} stars near the field to sprites, {width} x {height}"
    worst_figure = Figure("position error, worst star", "px", ROUNDING_PX)
    rms_figure = Figure("rms", "px")
    return Trials(
        "projection",
        scene,
        worst_figure,
        rms_figure,
        "OpenGL 3.3 takes no float64, and the error of a float32 position grows with the monitor",
        trials,
    )


@dataclass(frozen=True, slots=True)
class SmearBench:
    """The demo's tracker as a display of its own pixels, and a turn of its camera."""

    camera: Camera
    psf: Psf
    motion: Motion

    @property
    def side_px(self) -> int:
        """The side of the detector."""
        return self.camera.resolution_px[0]

    def path_sprites(self, stars: Stars) -> FrameLight:
        """Stars along their paths, as hilstar draws them."""
        return smeared_sprites(stars, self.motion, self.camera, self.psf)

    def chain(self, at: FloatArray, share: FloatArray, stars: Stars) -> FrameLight:
        """Stars at the parts `at` (k,) of the exposure with shares (k,) of their light; 0 is its
        middle.
        """
        x_px, y_px = self.places_px(stars, at)
        lights = np.outer(share, stars.electrons_per_s)
        light = lights.ravel()
        numbers = np.arange(len(stars))
        star = np.tile(numbers, len(at))
        size_px = self.camera.resolution_px
        side_px = self.psf.footprint_px
        return pack_sprites(x_px.ravel(), y_px.ravel(), light, star, size_px, side_px)

    def places_px(self, stars: Stars, at: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (k, n), px, at the parts `at` (k,) of the exposure; 0 is its middle."""
        turns = self.motion.icrs_to_image(at * self.motion.exposure_s, self.camera)
        directions = stars.vectors @ turns.transpose(0, 2, 1)
        x_px, y_px = self.camera.project(directions.reshape(-1, 3))
        return x_px.reshape(len(at), -1), y_px.reshape(len(at), -1)

    def image(self, sprites: FrameLight) -> FloatArray:
        """The exact linear image (h, w)."""
        return linear_image(sprites, self.camera.resolution_px, self.psf, WIDE_PX)

    def grid_stars(self, across: int) -> Stars:
        """Stars of one electron per second, across^2 of them evenly over the detector in the middle
        of the exposure.
        """
        count = across**2
        number = np.arange(across) + 0.5
        place = number * self.side_px / across - 0.5
        columns, rows = np.meshgrid(place, place)
        middle_px = (self.side_px - 1) / 2
        x_px = columns.ravel() - middle_px
        y_px = rows.ravel() - middle_px
        focal_px = np.full(count, self.camera.focal_length_px)
        image = np.column_stack([x_px, y_px, focal_px])
        length = np.linalg.norm(image, axis=1, keepdims=True)
        directions = image / length
        turn = self.motion.icrs_to_image(MIDDLE_S, self.camera)[0]
        vectors = directions @ turn
        zero = np.zeros(count)
        catalog = plain_catalog("star", count, {"v_mag": zero, "ra_deg": zero, "dec_deg": zero})
        return make_stars(catalog, vectors, zero, zero + 1)


def smear_bench() -> SmearBench:
    """The demo's tracker at RATE_DEG_S."""
    tracker = demo_config().tracker
    aligned = np.array([1.0, 0, 0, 0])
    camera = monitor_camera(
        tracker.resolution_px, tracker.pixel_pitch_um, tracker.focal_length_mm, aligned
    )
    rate_rad_s = np.radians(np.array(RATE_DEG_S))
    motion = Motion(ORION, rate_rad_s, tracker.exposure_s)
    psf = tracker_psf(tracker, Path())
    return SmearBench(camera, psf, motion)


def smear_methods(bench: SmearBench) -> dict[str, SpritesOf]:
    """Every fixed number of sprites on a path, by Gauss-Legendre quadrature and evenly in time."""
    methods: dict[str, SpritesOf] = {}
    for name, (at, share) in path_nodes().items():
        methods[name] = partial(bench.chain, at, share)
    return methods


def path_nodes() -> dict[str, tuple[FloatArray, FloatArray]]:
    """Where the sprites of each method stand on a path from -1/2 to 1/2 (n,), and their shares of
    its light.
    """
    placed = {}
    for count in (*GAUSS, EXACT_NODES):
        nodes, weights = np.polynomial.legendre.leggauss(count)
        placed[gauss_name(count)] = nodes / 2, weights / 2
    for count in EVENLY:
        number = np.arange(count) + 0.5
        placed[f"evenly in time, {count}"] = number / count - 0.5, np.full(count, 1 / count)
    return placed


def gauss_name(count: int) -> str:
    """The name of so many nodes of quadrature."""
    return f"Gauss-Legendre, {count}"


def smear(stack: ExitStack, quick: bool) -> Trials:
    """Sprites on a turning star's path: worst pixel, share of the star's flux, and centroid, px,
    over a grid of stars.
    """
    across = STARS_ACROSS // 2 if quick else STARS_ACROSS
    bench = smear_bench()
    few = bench.grid_stars(across)
    many = bench.grid_stars(STARS_ACROSS)
    target = Target(bench.camera.resolution_px, bench.psf)
    renderer = stack.enter_context(VariantRenderer(target, SplatVariant()))

    def draw(sprites_of: SpritesOf) -> None:
        renderer.draw_and_wait(sprites_of(many))

    mean_count = len(bench.path_sprites(few)) / len(few)
    default = f"Gauss-Legendre by length, {mean_count:.0f} on average"
    methods = {default: bench.path_sprites, **smear_methods(bench)}
    exact_method = methods[gauss_name(EXACT_NODES)]
    exact = bench.image(exact_method(few))
    trials = []
    for name, sprites_of in methods.items():
        drawn = bench.image(sprites_of(few))
        worst = float(np.abs(drawn - exact).max())
        off_px = measure(exact, drawn, len(exact) // across).centroid_max_px
        work = partial(draw, sprites_of)
        is_exact = name == gauss_name(EXACT_NODES)
        trial = Trial(name, worst, off_px, work, name == default, is_exact)
        trials.append(trial)
    extent = path_words(bench, many)
    scene = f"linear image of {len(many)} stars, paths of {extent}, {bench.side_px} px squared"
    pixel_figure = Figure("largest pixel error, share of its star", "1", ROUNDING_SHARE)
    centre_figure = Figure("centre of gravity, worst", "px")
    return Trials(
        "smear",
        scene,
        pixel_figure,
        centre_figure,
        "its error does not grow with the path, as that of a fixed number does",
        trials,
    )


def prediction_errors(predictor: Predictor, samples: Sequence[AttitudeSample]) -> list[float]:
    """The errors of a predictor in every frame between its samples, arcsec."""
    frame_ns = NS_PER_S / FRAME_HZ
    errors = []
    for after in range(NEAR, len(samples)):
        # One that waits has the sample after the frame, too.
        end = after + 1 if predictor.waits else after
        ready = samples[after - NEAR : end]
        attitude_at = predictor.load(ready)
        first = math.ceil(samples[after - 1].t_ns / frame_ns)
        last = math.ceil(samples[after].t_ns / frame_ns)
        for number in range(first, last):
            t_ns = round(number * frame_ns)
            true_q = slew_attitude(t_ns)
            predicted_q = attitude_at(t_ns)
            off_rad = angle_between_rad(true_q, predicted_q)
            errors.append(off_rad * math.degrees(3600))
    return errors


def attitudes_at(attitude_at: AttitudeAt, times_ns: Sequence[int]) -> None:
    """The work that is timed."""
    for t_ns in times_ns:
        attitude_at(t_ns)


def moments_ns(samples: Sequence[AttitudeSample]) -> list[int]:
    """The moments whose attitudes are timed: from the last sample but one to the last."""
    after_ns = np.linspace(0, SAMPLE_MS * NS_PER_MS, PREDICTIONS, dtype=np.int64)
    return list(map(int, after_ns + samples[-2].t_ns))


def prediction(stack: ExitStack, quick: bool) -> Trials:
    """The attitude at the moment of light, after the newest sample: worst and rms error, arcsec,
    on a shaken slew.
    """
    del stack
    seconds = 10 if quick else 60
    count = seconds * 1000 // SAMPLE_MS
    samples = []
    for number in range(count):
        t_ns = number * SAMPLE_MS * NS_PER_MS
        samples.append(slew_sample(t_ns))
    times_ns = moments_ns(samples)
    trials = []
    for predictor in predictors():
        errors = prediction_errors(predictor, samples)
        end = len(samples) if predictor.waits else -1
        ready = samples[-1 - NEAR : end]
        attitude_at = predictor.load(ready)
        work = partial(attitudes_at, attitude_at, times_ns)
        mean_square = np.mean(np.square(errors))
        rms_arcsec = float(np.sqrt(mean_square))
        trial = Trial(predictor.name, max(errors), rms_arcsec, work, predictor.is_default)
        trials.append(trial)
    shaken = ", ".join(f"{size:g} arcsec at {hz:g} Hz" for size, hz in JITTER)
    worst_figure = Figure("attitude error, worst", "arcsec")
    rms_figure = Figure("rms", "arcsec")
    scene = f"{PREDICTIONS} attitudes, samples every {SAMPLE_MS} ms"
    return Trials(
        "prediction",
        scene,
        worst_figure,
        rms_figure,
        "it needs nothing but the newest sample",
        trials,
        f"a swing of {SLEW_DEG:g} degrees in {SLEW_S:g} s, shaken on each axis by {shaken}; waiting"
        f" for a sample makes the attitude {SAMPLE_MS} ms older; the times of hold, of the linear"
        " predictors and of the blend include the timeline, those of the other two do not",
    )
