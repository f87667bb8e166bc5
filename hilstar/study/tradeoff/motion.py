"""Trade-offs of motion: sprites along a star's path, and the attitude between the last sample and the light."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.interpolate import CubicSpline

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.bench.config import AttitudeSettings
from hilstar.monitor.geometry import monitor_camera
from hilstar.monitor.phases import measure
from hilstar.render.reference import linear_image
from hilstar.render.renderer import Target
from hilstar.render.variants import SplatVariant, VariantRenderer
from hilstar.rotation import angle_between_rad, multiply, propagate, rate_between_rad_s
from hilstar.scene.exposure_motion import MIDDLE_S, Motion, smeared_sprites
from hilstar.scene.psf import footprint_px
from hilstar.scene.sprites import Sprites, pack_sprites
from hilstar.sky.cells import cell_grid
from hilstar.sky.stars import Stars
from hilstar.study.tradeoff.sky import ORION, demo_config
from hilstar.study.tradeoff.table import Figure, Trial, Trials
from hilstar.units import NS_PER_MS, NS_PER_S

TRACKER = demo_config().tracker
CAMERA = monitor_camera(TRACKER.resolution_px, TRACKER.pixel_pitch_um, TRACKER.focal_length_mm, np.array([1.0, 0, 0, 0]))
SIZE_PX = CAMERA.resolution_px[0]
RATE_DEG_S = (0.7, -0.7, 5.0)
EVENLY = (4, 8, 16, 32, 64)
GAUSS = (8, 16, 24, 32)
# 200 nodes on 28 sigmas at most: six times what the module's rule asks for.
EXACT_NODES = 200
# Wider than the path's own footprints, so that the steps' error is not their cut; 24 px are 21 sigma on either side.
WIDE_PX = 24
STARS_ACROSS = 16
# float32 fluxes and fractions of the sprites: 6e-8 of each.
ROUNDING_SHARE = 1e-7

SAMPLE_MS = 50
FRAME_HZ = 60
SLEW_DEG, SLEW_S = 3.0, 20.0
# Of each axis: amplitude, arcsec, and frequency, Hz, as wheels and structure shake a small satellite.
JITTER = ((2.0, 3.1), (1.0, 11.0), (0.3, 37.0))
PREDICTIONS = 60
RATE_STEP_NS = 100_000
NEAR = 4


def smear(stack: ExitStack, quick: bool) -> Trials:
    """Sprites on a turning star's path: worst pixel, share of the star's flux, and centroid, px, over a grid of stars."""
    across = STARS_ACROSS // 2 if quick else STARS_ACROSS
    motion = Motion(ORION, np.radians(np.array(RATE_DEG_S)), TRACKER.exposure_s)
    few, many = grid_stars(across, motion), grid_stars(STARS_ACROSS, motion)
    renderer = stack.enter_context(VariantRenderer(Target(TRACKER.resolution_px, TRACKER.psf_sigma_px), SplatVariant()))
    exact = _image(gauss_sprites(EXACT_NODES, few, motion))
    trials = []
    for name, sprites_of in smear_methods(few, motion).items():
        image = _image(sprites_of(few, motion))
        off_px = measure(exact, image, len(exact) // across).centroid_max_px
        work = partial(_draw_path, renderer, sprites_of, many, motion)
        worst, is_exact = float(np.abs(image - exact).max()), name == gauss_name(EXACT_NODES)
        trials.append(Trial(name, worst, off_px, work, sprites_of is own_sprites, is_exact))
    paths = path_lengths_px(many, motion)
    return Trials(
        "smear",
        f"linear image of {len(many)} stars, paths of {paths.min():.0f} to {paths.max():.0f} px, {SIZE_PX} px squared",
        Figure("worst pixel's error, share of its star", "1", ROUNDING_SHARE),
        Figure("centroid error, worst", "px"),
        "it keeps its error on paths of any length, where a fixed number does not",
        trials,
    )


SpritesOf = Callable[[Stars, Motion], Sprites]


def smear_methods(stars: Stars, motion: Motion) -> dict[str, SpritesOf]:
    """Every way by name: sprites of stars over an exposure."""
    mean = len(own_sprites(stars, motion)) / len(stars)
    methods: dict[str, SpritesOf] = {f"Gauss-Legendre by length, {mean:.0f} in the mean": own_sprites}
    methods |= {gauss_name(count): partial(gauss_sprites, count) for count in (*GAUSS, EXACT_NODES)}
    return methods | {f"evenly in time, {count}": partial(even_sprites, count) for count in EVENLY}


def gauss_name(count: int) -> str:
    """What so many nodes for every star are called."""
    return f"Gauss-Legendre, {count}"


def grid_stars(across: int, motion: Motion) -> Stars:
    """Stars of one electron per second, across^2 of them evenly over the detector in the middle of the exposure."""
    place = (np.arange(across) + 0.5) * SIZE_PX / across - 0.5
    x_px, y_px = (axis.ravel() - (SIZE_PX - 1) / 2 for axis in np.meshgrid(place, place))
    image = np.column_stack([x_px, y_px, np.full(across**2, CAMERA.focal_length_px)])
    vectors = image / np.linalg.norm(image, axis=1, keepdims=True) @ motion.icrs_to_image(MIDDLE_S, CAMERA)[0]
    grid = cell_grid(vectors)
    zero = np.zeros(across**2)
    return Stars(np.arange(across**2, dtype=np.int32), vectors[grid.order], zero, zero, zero, zero + 1, grid)


def path_lengths_px(stars: Stars, motion: Motion) -> FloatArray:
    """How far each star moves over the exposure, px (n,), by its two ends."""
    x_px, y_px = _places_px(stars, motion, np.array([-0.5, 0.5]))
    return np.asarray(np.hypot(np.diff(x_px, axis=0), np.diff(y_px, axis=0))[0])


def own_sprites(stars: Stars, motion: Motion) -> Sprites:
    """Those of scene/smear.py."""
    return smeared_sprites(stars, motion, CAMERA, footprint_px(TRACKER.psf_sigma_px), TRACKER.psf_sigma_px)


def gauss_sprites(count: int, stars: Stars, motion: Motion) -> Sprites:
    """As many for each star, at the nodes of Gauss and Legendre."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return _chain(stars, motion, nodes / 2, weights / 2)


def even_sprites(count: int, stars: Stars, motion: Motion) -> Sprites:
    """As many for each star, in the middles of equal times, all of one weight."""
    return _chain(stars, motion, (np.arange(count) + 0.5) / count - 0.5, np.full(count, 1 / count))


def _chain(stars: Stars, motion: Motion, at: FloatArray, share: FloatArray) -> Sprites:
    x_px, y_px = _places_px(stars, motion, at)
    light = np.outer(share, stars.electrons_per_s)
    star = np.broadcast_to(np.arange(len(stars)), x_px.shape)
    side = footprint_px(TRACKER.psf_sigma_px)
    return pack_sprites(x_px.ravel(), y_px.ravel(), light.ravel(), star.ravel(), CAMERA.resolution_px, side)


def _places_px(stars: Stars, motion: Motion, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (k, n), px, at the parts `at` (k,) of the exposure, 0 its middle."""
    seen = stars.vectors @ motion.icrs_to_image(at * motion.exposure_s, CAMERA).transpose(0, 2, 1)
    x_px, y_px = CAMERA.project(seen.reshape(-1, 3))
    return x_px.reshape(len(at), -1), y_px.reshape(len(at), -1)


def _image(sprites: Sprites) -> FloatArray:
    return linear_image(sprites, CAMERA.resolution_px, TRACKER.psf_sigma_px, WIDE_PX)


def _draw_path(renderer: VariantRenderer, sprites_of: SpritesOf, stars: Stars, motion: Motion) -> None:
    renderer.draw_and_wait(sprites_of(stars, motion))


def prediction(stack: ExitStack, quick: bool) -> Trials:
    """Where the camera points when the light comes, past the newest sample: worst and rms error, arcsec, on a shaken slew."""
    del stack
    samples = [slew_sample(k * SAMPLE_MS * NS_PER_MS) for k in range((10 if quick else 60) * 1000 // SAMPLE_MS)]
    frames_ns = np.linspace(0, SAMPLE_MS * NS_PER_MS, PREDICTIONS, dtype=np.int64) + samples[-2].t_ns
    trials = []
    for guess in guesses():
        error = prediction_errors_arcsec(guess, samples)
        attitude_at = guess.load(samples[-1 - NEAR : len(samples) if guess.waits else -1])
        work = partial(_all_of, attitude_at, frames_ns.tolist())
        trials.append(Trial(guess.name, float(error.max()), float(np.sqrt(np.mean(error**2))), work, guess.is_default))
    shaken = ", ".join(f"{size:g} arcsec at {hz:g} Hz" for size, hz in JITTER)
    return Trials(
        "prediction",
        f"{PREDICTIONS} attitudes, samples every {SAMPLE_MS} ms",
        Figure("attitude error, worst", "arcsec"),
        Figure("rms", "arcsec"),
        "it asks for nothing but the newest sample",
        trials,
        f"a swing of {SLEW_DEG:g} degrees in {SLEW_S:g} s, shaken on each axis by {shaken};"
        f" to wait for a sample makes the attitude {SAMPLE_MS} ms older;"
        " hold, the linear ones and the blend go through the timeline that threads share, the two others are bare",
    )


# From the last samples to the attitude at a time, ns.
AttitudeAt = Callable[[int], FloatArray]


@dataclass(frozen=True, slots=True)
class Guess:
    """A way to the attitude at a time: `load` takes the last samples, which for one that `waits` end after that time."""

    name: str
    load: Callable[[Sequence[AttitudeSample]], AttitudeAt]
    is_default: bool = False
    waits: bool = False


def guesses() -> tuple[Guess, ...]:
    """Every way; the default is hilstar's timeline as a bench file that says nothing sets it, fed with rates."""
    settings = AttitudeSettings()
    own = Policy(round(settings.max_extrapolation_ms * NS_PER_MS), round(settings.stale_after_ms * NS_PER_MS))
    hold = Policy(0, own.stale_after_ns)
    return (
        Guess("hold", partial(_timeline, hold)),
        Guess("linear, by the sample's rate", partial(_timeline, own), is_default=own.max_extrapolation_ns > 0),
        Guess("linear, by the last two samples", lambda near: _timeline(own, [replace(s, rate_cam_rad_s=None) for s in near])),
        Guess("rate and acceleration", _accelerated),
        Guess(f"cubic spline through {NEAR} samples", _spline),
        Guess("C2 blend, a sample later", partial(_timeline, own), waits=True),
    )


def slew_attitude(t_ns: int) -> FloatArray:
    """The true q_icrs_to_cam: three turns about the camera's axes on ORION, each a slow swing and a fast jitter."""
    t_s, q = t_ns / NS_PER_S, ORION
    for axis in range(3):
        angle = math.radians(SLEW_DEG) * math.sin(2 * math.pi * t_s / SLEW_S + axis)
        for size_arcsec, hz in JITTER:
            angle += math.radians(size_arcsec / 3600) * math.sin(2 * math.pi * hz * t_s + 2 * axis * hz)
        turn = np.zeros(4)
        turn[0], turn[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
        q = multiply(turn, q)
    return q


def slew_sample(t_ns: int) -> AttitudeSample:
    """The attitude with its rate, from 0.1 ms on both sides: 0.006 arcsec/s off at 37 Hz, 0.0003 arcsec in a prediction."""
    before, after = slew_attitude(t_ns - RATE_STEP_NS), slew_attitude(t_ns + RATE_STEP_NS)
    return AttitudeSample(t_ns, slew_attitude(t_ns), rate_between_rad_s(before, after, 2 * RATE_STEP_NS / NS_PER_S))


def prediction_errors_arcsec(guess: Guess, samples: Sequence[AttitudeSample]) -> FloatArray:
    """The error at each frame, once NEAR samples are there."""
    frame_ns, errors = NS_PER_S / FRAME_HZ, []
    for after in range(NEAR, len(samples)):
        attitude_at = guess.load(samples[after - NEAR : after + 1 if guess.waits else after])
        first, last = (math.ceil(samples[k].t_ns / frame_ns) for k in (after - 1, after))
        for t_ns in (round(k * frame_ns) for k in range(first, last)):
            errors.append(angle_between_rad(slew_attitude(t_ns), attitude_at(t_ns)) * math.degrees(3600))
    return np.array(errors)


def _all_of(attitude_at: AttitudeAt, frames_ns: Sequence[int]) -> None:
    for t_ns in frames_ns:
        attitude_at(t_ns)


def _timeline(policy: Policy, near: Sequence[AttitudeSample]) -> AttitudeAt:
    timeline = Timeline(policy)
    for sample in near:
        timeline.add(sample)

    def attitude_at(t_ns: int) -> FloatArray:
        attitude = timeline.at(t_ns)
        if attitude is None:
            raise AssertionError("a timeline with samples has an attitude")
        return attitude.q_icrs_to_cam

    return attitude_at


def _accelerated(near: Sequence[AttitudeSample]) -> AttitudeAt:
    """The newest sample's rate, and the change since the one before it carried on."""
    before, newest = near[-2:]

    def attitude_at(t_ns: int) -> FloatArray:
        ahead_s, gap_s = (t_ns - newest.t_ns) / NS_PER_S, (newest.t_ns - before.t_ns) / NS_PER_S
        bend = (_rate(newest) - _rate(before)) / gap_s
        return propagate(newest.q_icrs_to_cam, _rate(newest) + 0.5 * ahead_s * bend, ahead_s)

    return attitude_at


def _rate(sample: AttitudeSample) -> FloatArray:
    if sample.rate_cam_rad_s is None:
        raise AssertionError("the slew's samples have rates")
    return sample.rate_cam_rad_s


def _spline(near: Sequence[AttitudeSample]) -> AttitudeAt:
    """The samples' turns from the newest one, as a cubic carried on past it."""
    newest = near[-1]

    def attitude_at(t_ns: int) -> FloatArray:
        seconds = [(s.t_ns - newest.t_ns) / NS_PER_S for s in near]
        turns = [rate_between_rad_s(newest.q_icrs_to_cam, s.q_icrs_to_cam, 1.0) for s in near]
        turn = CubicSpline(seconds, turns)((t_ns - newest.t_ns) / NS_PER_S)
        return propagate(newest.q_icrs_to_cam, np.asarray(turn), 1.0)

    return attitude_at
