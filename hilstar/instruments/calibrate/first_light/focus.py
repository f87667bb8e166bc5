"""The step `focus`: how sharp the tracker sees dots, by its PSF's sigma and the side of a dot,
fitted together to their pixels.

A dot is a square of light, turned as the screen is turned before the tracker. Where a monitor pixel
is wide for the tracker its edges say how sharp the tracker is; where the PSF is wide the whole
width does, and the side has to be known. So both are fitted, with the side as well known as the
step `orientation` leaves it, and the error says how well the two can be told apart.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import chart
from hilstar.basics.errors import InputError
from hilstar.basics.units import MAD_TO_SIGMA
from hilstar.instruments.calibrate.effective_psf import (
    Found,
    are_alone,
    dots_of_image,
    draw_effective,
    fit_effective,
)
from hilstar.instruments.calibrate.first_light.context import (
    DarkSubtracted,
    Figure,
    FittedFigure,
    StepContext,
    StepNumber,
    StepOutcome,
    Verdict,
)
from hilstar.instruments.calibrate.first_light.image_sources import Pattern
from hilstar.instruments.calibrate.geometric.dots import (
    DOT_PX,
    DotPlan,
    SeenScreen,
    dot_image,
    lit_for,
    plan_seen_dots,
)
from hilstar.tracker.centroids import CentroidSettings, find_stars, noisiest_background
from hilstar.tracker.settings import DetectorSettings

THRESHOLD_SIGMA = 8.0
# of which the brightest are fitted: 40 leave 0.2 % of error where a dot leaves 1 %
MIN_DOTS, MAX_DOTS = 5, 40
# with fewer alone, a dot's square of pixels is made smaller, to so much about its side
MIN_ALONE_DOTS, MIN_WINGS_PX = 8, 2.0
MAX_ALL_POINTS = 24_000  # of all dots together: fewer dots where each has many points
SIGMAS_PX = (0.1, 12.0)  # ends of the model
STARTS_PX = np.geomspace(0.2, 8.0, 12)
# of a dot's wings in its square of pixels, beside its own half side
START_SIGMAS, MIN_HALF_PX, MAX_HALF_PX = 4.0, 5, 40
# along a dot's side: 2.5 in a sigma make its edge softer by 0.7 %
POINTS_A_SIGMA, MIN_POINTS, MAX_POINTS = 2.5, 5, 48
ROUNDS, FIRST_DAMPING, SETTLED = 40, 1e-3, 1e-4
SIDE_SHARE = 0.01  # sigma of a dot's side: lens and tilt change it so much over the field
# What the model leaves, relative to the PSF's sigma: a pixel is no even square, and the points are
# not infinitely many.
MODEL_SHARE = 0.01
# Sigma of the PSF by an edge that is softer than a square's, relative to a dot's side: of 19.5 px
# it was 0.019 px off.
EDGE_SHARE = 3.5e-4
FLUX_FLOOR = 1e-9
# a dot whose own sigma is so far from the others' has a neighbour, dust or a dead pixel
WILD_SIGMAS = 5.0
PLAN_SEED = 0
FIRST_FRAMES = 8  # of dots where the figure of `orientation` says that the tracker looks
FIRST_LIT_DOTS = 18  # in a frame: 48 dots, of 56 codes of three frames in eight
OVERSAMPLING = 4  # for the effective PSF
# times the bench file's sigma, and px: less is no reason to turn the focus
BLURRED, BLURRED_BY_PX = 1.3, 0.1
# Relative to the tracker's range: the brightest of a few dots. Of a thousand, one stands on a
# pixel's middle where the screen is brightest, and later steps refuse what is over MAX_FILL.
DOT_FILL = 0.6
# of the PSF's sigma: with a larger error it cannot be told from the pixel's own width
MAX_ERROR_SHARE = 0.2
# A dot's side over that of its pixels as `orientation` saw them: of 79 benches by chance it was
# 1.007 at most.
MAX_PIXEL_SHARE, WIDER_SIGMAS = 1.03, 4.0


@dataclass(frozen=True, slots=True)
class DotNoise:
    """What the tracker's detector adds to a dot's pixels beside the noise of the background:
    gain and PRNU.
    """

    gain_e_per_dn: float = math.inf
    prnu: float = 0.0


@dataclass(frozen=True, slots=True)
class Sharpness:
    """Dots in the tracker's image: places (n,), the PSF's sigma by each (n,), and by all together
    with its error, tracker px.

    `dot_side_px` is the side that was fitted with it, with its error. Where the fit did not settle
    `has_settled` is False.
    """

    x_px: FloatArray
    y_px: FloatArray
    each_psf_sigma_px: FloatArray
    psf_sigma_px: float
    psf_sigma_error_px: float
    dot_side_px: float
    dot_side_error_px: float
    has_settled: bool = True


class _Dots(NamedTuple):
    """Squares of pixels (n, k, k), DN, about dots, and the dots' first places (n,), px.

    A square reaches `half_px` from its middle pixel to each side.
    """

    values: FloatArray
    x_px: FloatArray
    y_px: FloatArray
    half_px: int


class _Shape(NamedTuple):
    """A dot's points (p, 2) of a side of 1, turned; and what is common to all dots: the PSF's
    sigma and the side, px.
    """

    points: FloatArray
    sigma_px: float
    side_px: float


class _Fitted(NamedTuple):
    """The shape common to all dots, their places (n, 2), and the standard errors of the PSF's
    sigma and of the side.
    """

    shape: _Shape
    places: FloatArray
    sigma_error_px: float
    side_error_px: float
    has_settled: bool


def sharpness(
    image: FloatArray, dot_side_px: float, turn_deg: float = 0.0, noise: DotNoise | None = None
) -> Sharpness:
    """Measure the sharpness of dots in an image (h, w) above its dark frame.

    A dot is a square of about `dot_side_px` tracker px, turned by `turn_deg` in the image. Raises
    InputError where too few dots are there, or none stands alone.
    """
    background = noisiest_background(image)
    settings = CentroidSettings(
        threshold_sigma=THRESHOLD_SIGMA, minimum_pixels=2, window_sigma_px=1.5
    )
    centroids = find_stars(image, settings, background)
    if len(centroids) < MIN_DOTS:
        raise InputError(
            f"{len(centroids)} dots are in the image and {MIN_DOTS} are needed; expose longer, or"
            " look at the focus"
        )
    turn = math.radians(turn_deg)
    # of the upright square that holds a turned one
    widening = abs(math.cos(turn)) + abs(math.sin(turn))
    half_side = dot_side_px / 2 * widening
    # The wings of a first look at the dots: the blob's pixels are those above the threshold.
    blob_px = math.sqrt(float(np.median(centroids.pixels)) / math.pi)
    reach_px = max(half_side + START_SIGMAS, 1.5 * blob_px + 2)
    half = int(np.clip(math.ceil(reach_px), MIN_HALF_PX, MAX_HALF_PX))
    # Where dots stand closer together, smaller squares hold less of the wings and the fit's error
    # says so.
    smallest = math.ceil(half_side + MIN_WINGS_PX)
    while True:
        dots = _alone(image, background.level, centroids.x_px, centroids.y_px, half)
        if len(dots.values) >= MIN_ALONE_DOTS or half <= smallest:
            break
        half -= 1
    if len(dots.values) < MIN_DOTS:
        raise InputError(
            f"{len(dots.values)} dots stand alone and whole in the image and {MIN_DOTS} are needed;"
            " look at the focus"
        )
    noise = noise or DotNoise()
    shape = _started(dots, dot_side_px, turn)
    dots = _first(dots, max(MAX_ALL_POINTS // len(shape.points), MIN_DOTS + 3))
    fit = _fitted(dots, shape, dot_side_px, background.noise, noise)
    dot_sigmas, usable = _each_sigma(dots, fit.shape, fit.places, background.noise, noise)
    if usable.sum() >= MIN_DOTS and not usable.all():
        dots = _Dots(dots.values[usable], dots.x_px[usable], dots.y_px[usable], half)
        fit = _fitted(dots, fit.shape, dot_side_px, background.noise, noise)
        dot_sigmas, _ = _each_sigma(dots, fit.shape, fit.places, background.noise, noise)
    sigma_px = fit.shape.sigma_px
    by_scatter = float(np.std(dot_sigmas)) / math.sqrt(len(dot_sigmas))
    by_model = math.hypot(MODEL_SHARE * sigma_px, EDGE_SHARE * fit.shape.side_px)
    error_px = math.hypot(max(fit.sigma_error_px, by_scatter), by_model)
    # a place of the fit is from the middle of its dot's pixel
    x_px = np.rint(dots.x_px) + fit.places[:, 0]
    y_px = np.rint(dots.y_px) + fit.places[:, 1]
    return Sharpness(
        x_px=x_px,
        y_px=y_px,
        each_psf_sigma_px=dot_sigmas,
        psf_sigma_px=sigma_px,
        psf_sigma_error_px=error_px,
        dot_side_px=fit.shape.side_px,
        dot_side_error_px=fit.side_error_px,
        has_settled=fit.has_settled,
    )


def _alone(image: FloatArray, level: float, x_px: FloatArray, y_px: FloatArray, half: int) -> _Dots:
    """The brightest dots whose square of pixels has no other dot's middle and is within the
    image.
    """
    height, width = image.shape
    column = np.rint(x_px).astype(np.intp)
    row = np.rint(y_px).astype(np.intp)
    is_whole = (column >= half) & (column < width - half)
    is_whole &= (row >= half) & (row < height - half)
    chosen = np.flatnonzero(is_whole & are_alone(x_px, y_px, half))[:MAX_DOTS]
    steps = np.arange(-half, half + 1)
    rows = row[chosen, None] + steps
    columns = column[chosen, None] + steps
    values = image[rows[:, :, None], columns[:, None, :]] - level
    return _Dots(np.asarray(values, dtype=np.float64), x_px[chosen], y_px[chosen], half)


def _points(sigma_px: float, side_px: float, turn: float) -> FloatArray:
    """Points (p, 2) spread evenly over a square of side 1 that is turned by `turn` rad."""
    count = int(np.clip(math.ceil(POINTS_A_SIGMA * side_px / sigma_px), MIN_POINTS, MAX_POINTS))
    along = (np.arange(count) + 0.5) / count - 0.5
    grid_x, grid_y = np.meshgrid(along, along)
    x = grid_x.ravel()
    y = grid_y.ravel()
    cos = math.cos(turn)
    sin = math.sin(turn)
    turned_x = cos * x - sin * y
    turned_y = sin * x + cos * y
    return np.column_stack([turned_x, turned_y])


def _started(dots: _Dots, side_px: float, turn: float) -> _Shape:
    """The shape with the PSF's sigma, of STARTS_PX, that leaves the smallest squares."""
    few = _first(dots, MIN_DOTS)
    misfits = []
    for sigma_px in STARTS_PX.tolist():
        shape = _Shape(_points(sigma_px, side_px, turn), sigma_px, side_px)
        model = _slopes(shape, _first_places(few), few.half_px)[0]
        flux, level = _amplitudes(model, few.values)
        off = few.values - flux * model - level
        misfits.append(float((off**2).sum()))
    best = float(STARTS_PX[int(np.argmin(misfits))])
    # points for half of it, as the fit may become narrower
    return _Shape(_points(best / 2, side_px, turn), best, side_px)


def _first(dots: _Dots, count: int) -> _Dots:
    """The first, which are the brightest, of the dots."""
    return _Dots(dots.values[:count], dots.x_px[:count], dots.y_px[:count], dots.half_px)


def _first_places(dots: _Dots) -> FloatArray:
    """Places (n, 2) of dots from the middles of their middle pixels, px."""
    x_px = dots.x_px - np.rint(dots.x_px)
    y_px = dots.y_px - np.rint(dots.y_px)
    return np.column_stack([x_px, y_px])


def _amplitudes(model: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Light and background (n, 1, 1) of dots with a model (n, k, k), by least squares."""
    model_mean = model.mean(axis=(1, 2), keepdims=True)
    flat = model - model_mean
    product = (flat * values).sum(axis=(1, 2), keepdims=True)
    square = (flat**2).sum(axis=(1, 2), keepdims=True)
    flux = np.maximum(product / np.maximum(square, 1e-300), FLUX_FLOOR)
    level = values.mean(axis=(1, 2), keepdims=True) - flux * model_mean
    return flux, level


def _slopes(shape: _Shape, places: FloatArray, half: int) -> tuple[FloatArray, ...]:
    """Shares of dots' light in pixels (n, k, k), and their derivatives by x, y, the PSF's sigma
    and the side's logarithm.
    """
    share_x, by_x, sigma_x, side_x = _along(shape, places[:, 0], shape.points[:, 0], half)
    share_y, by_y, sigma_y, side_y = _along(shape, places[:, 1], shape.points[:, 1], half)
    weight = 1 / len(shape.points)

    def together(of_y: FloatArray, of_x: FloatArray) -> FloatArray:
        """The mean over the points (n, rows, columns) of a product of both axes."""
        return np.asarray(of_y.transpose(0, 2, 1) @ of_x * weight)

    share = together(share_y, share_x)
    by_place_x = together(share_y, by_x)
    by_place_y = together(by_y, share_x)
    by_sigma = together(sigma_y, share_x) + together(share_y, sigma_x)
    by_side = together(side_y, share_x) + together(share_y, side_x)
    return share, by_place_x, by_place_y, by_sigma, by_side


def _along(
    shape: _Shape, place: FloatArray, points: FloatArray, half: int
) -> tuple[FloatArray, ...]:
    """Along one axis, of each point's light in each pixel (n, p, k): the share, and its
    derivatives as in `_slopes`.
    """
    edges = np.arange(2 * half + 2) - half - 0.5
    middle = place[:, None] + shape.side_px * points
    reach = (edges - middle[:, :, None]) / shape.sigma_px
    norm = math.sqrt(2 * math.pi) * shape.sigma_px
    density = np.exp(-0.5 * reach**2) / norm
    share = np.diff(ndtr(reach), axis=2)
    by_place = -np.diff(density, axis=2)
    by_sigma = -np.diff(density * reach, axis=2)
    by_side = by_place * (shape.side_px * points)[:, None]
    return share, by_place, by_sigma, by_side


def _weights(model: FloatArray, flux: FloatArray, noise_dn: float, noise: DotNoise) -> FloatArray:
    """One over the sigma of each pixel (n, k, k), by the model's light."""
    light = np.maximum(flux * model, 0.0)
    photon_dn2 = light / noise.gain_e_per_dn
    response_dn2 = (noise.prnu * light) ** 2
    return np.asarray(1 / np.sqrt(noise_dn**2 + photon_dn2 + response_dn2))


class _NormalEquations(NamedTuple):
    """Normal equations of each dot: matrices (n, m, m) and right sides (n, m, 1); the sum of the
    squares of all residuals, in sigmas, and their number.
    """

    normal: FloatArray
    right: FloatArray
    square: float
    pixels: int

    @classmethod
    def of(
        cls,
        dots: _Dots,
        shape: _Shape,
        places: FloatArray,
        noise_dn: float,
        noise: DotNoise,
        *,
        with_side: bool,
    ) -> "_NormalEquations":
        """Those of light, background, x, y, the PSF's sigma, and the side's logarithm where it is
        wanted.
        """
        model, *slopes = _slopes(shape, places, dots.half_px)
        if not with_side:
            slopes = slopes[:-1]
        flux, level = _amplitudes(model, dots.values)
        weight = _weights(model, flux, noise_dn, noise)
        off = (dots.values - flux * model - level) * weight
        derivatives = [model, np.ones_like(model)]
        for slope in slopes:
            derivatives.append(flux * slope)
        columns = np.stack(derivatives, axis=1) * weight[:, None]
        columns = columns.reshape(len(model), len(derivatives), -1)
        right = columns @ off.reshape(len(model), -1, 1)
        normal = columns @ columns.transpose(0, 2, 1)
        diagonal = np.einsum("nkk->nk", normal)[:, :, None]
        normal += 1e-12 * diagonal * np.eye(len(derivatives))
        return cls(normal, right, float((off**2).sum()), off.size)


def _fitted(
    dots: _Dots, start: _Shape, side_px: float, noise_dn: float, noise: DotNoise
) -> _Fitted:
    """The shape common to all dots and their places, fitted to their pixels.

    Levenberg and Marquardt's steps; each dot's own light, background and place are eliminated from
    the normal equations.
    """
    shape = start
    places = _first_places(dots)
    damping = FIRST_DAMPING
    value = math.inf
    settled = False
    for _ in range(ROUNDS):
        equations = _NormalEquations.of(dots, shape, places, noise_dn, noise, with_side=True)
        normal, right, square, pixels = equations
        # a dot's light, background and place, and what is common to all dots
        dot_part = slice(0, 4)
        common_part = slice(4, 6)
        couplings = normal[:, common_part, dot_part]
        own_right = np.concatenate([normal[:, dot_part, common_part], right[:, dot_part]], axis=2)
        by_own = np.linalg.solve(normal[:, dot_part, dot_part], own_right)
        own_by_common = by_own[:, :, :2]
        own_alone = by_own[:, :, 2:]
        dot_normals = normal[:, common_part, common_part] - couplings @ own_by_common
        dot_aims = right[:, common_part] - couplings @ own_alone
        common = dot_normals.sum(axis=0)
        aim = dot_aims.sum(axis=0)[:, 0]
        freedom = max(pixels - 4 * len(normal), 1)
        chi2 = max(square / freedom, 1.0)
        # The side is known beforehand to SIDE_SHARE; its weight grows with the misfit as the
        # pixels' own does.
        known = chi2 / SIDE_SHARE**2
        common[1, 1] += known
        aim[1] += known * math.log(side_px / shape.side_px)
        step = np.linalg.solve(common + damping * np.diag(np.diag(common)), aim)
        moved = own_alone[:, 2:4, 0] - own_by_common[:, 2:4] @ step
        places = places + np.clip(moved, -0.5, 0.5)
        before_px = shape.sigma_px
        shape = _stepped(shape, step)
        is_sigma_settled = abs(shape.sigma_px - before_px) < SETTLED * shape.sigma_px
        settled = bool(is_sigma_settled and abs(step[1]) < SETTLED)
        if square <= value:
            damping = damping / 3
        else:
            damping = damping * 5
        value = square
        if settled:
            break
    covariance = np.linalg.inv(common) * chi2
    sigma_error_px = math.sqrt(covariance[0, 0])
    side_error_px = shape.side_px * math.sqrt(covariance[1, 1])
    return _Fitted(shape, places, sigma_error_px, side_error_px, settled)


def _stepped(shape: _Shape, step: FloatArray) -> _Shape:
    """The shape after a step of the PSF's sigma and of the side's logarithm, both limited."""
    before_px = shape.sigma_px
    limited_px = float(np.clip(before_px + step[0], 0.5 * before_px, 2 * before_px))
    sigma_px = float(np.clip(limited_px, *SIGMAS_PX))
    side_px = shape.side_px * math.exp(float(np.clip(step[1], -0.05, 0.05)))
    # by the diagonal of the points, which is turned by 45 degrees more
    x, y = shape.points[-1] - shape.points[0]
    turn = math.atan2(y, x) - math.pi / 4
    return _Shape(_points(sigma_px, side_px, turn), sigma_px, side_px)


def _each_sigma(
    dots: _Dots, shape: _Shape, places: FloatArray, noise_dn: float, noise: DotNoise
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """The PSF's sigma by each dot (n,), with the side of all, and which dots agree with the
    others (n,).
    """
    equations = _NormalEquations.of(dots, shape, places, noise_dn, noise, with_side=False)
    steps = np.linalg.solve(equations.normal, equations.right)[:, 4, 0]
    dot_sigmas = np.clip(shape.sigma_px + steps, *SIGMAS_PX)
    far = np.abs(dot_sigmas - np.median(dot_sigmas))
    spread_px = max(float(np.median(far)), 1e-3 * shape.sigma_px)
    return dot_sigmas, far <= WILD_SIGMAS * MAD_TO_SIGMA * spread_px


class SharpDots(NamedTuple):
    """The brightest code that does not saturate the tracker, how sharp dots of it are, and their
    image.
    """

    code: int
    sharpness: Sharpness
    looked: DarkSubtracted


def focus(context: StepContext) -> StepOutcome:
    """Measure the PSF by dots of the brightest code that does not saturate the tracker. Raises
    InputError.
    """
    code, sharp, looked = sharp_dots(context)
    stated_px = float(np.hypot(*context.tracker_psf.width_px) / np.sqrt(2))
    sigma_px = sharp.psf_sigma_px
    error_px = sharp.psf_sigma_error_px
    pixel_px = sharp.dot_side_px / DOT_PX
    picture = context.session / "focus.svg"
    _draw_dots(picture, sharp, stated_px)
    figures: dict[str, Figure] = {
        "psf_sigma_px": sigma_px,
        "psf_sigma_error_px": error_px,
        "monitor_pixel_px": pixel_px,
        "monitor_pixel_error_px": sharp.dot_side_error_px / DOT_PX,
        "dots": len(sharp.x_px),
        "dot_code": code,
    }
    files: tuple[Path, ...] = looked.path, picture
    pictures: tuple[Path, ...] = (picture,)
    line = (
        f"PSF sigma {sigma_px:.3f} +- {error_px:.3f} px, the bench file says {stated_px:.4g}; dots"
        f" at code {code}, a monitor pixel is {pixel_px:.3f} px"
    )
    effective = _effective(looked, sharp)
    if effective is not None:
        drawn = context.session / "psf.svg"
        draw_effective(drawn, effective)
        files = (*files, drawn)
        pictures = (picture, drawn)
        figures["effective_psf_rms"] = effective.chosen.rms
        if effective.asks_for_more:
            line += "; more than a Gaussian over the field"
        else:
            line += "; no more than a Gaussian over the field"
    number = StepNumber(sigma_px, error_px, "px", f"PSF sigma; the bench file says {stated_px:.4g}")
    verdict: Verdict = "done"
    failure = why_blurred(sharp, stated_px, context.seen_screen.tracker_px_a_monitor_px)
    if failure:
        line = f"{line}: {failure}"
        verdict = "failed"
    fitted = (FittedFigure("PSF sigma", sigma_px, *SIGMAS_PX),)
    return StepOutcome(verdict, line, figures, files, pictures, number=number, fitted=fitted)


def why_blurred(sharp: Sharpness, stated_px: float, seen_pixel_px: float) -> str:
    """What is wrong with the focus, or with its figure, and what to do; empty if nothing is.

    `seen_pixel_px` is how large the orientation saw a monitor pixel.
    """
    if not sharp.has_settled:
        return (
            f"the fit of the dots has not settled in {ROUNDS} rounds: look at the dots' image, and"
            " at the focal lengths"
        )
    # Gaps between subpixels make dots narrower than their pixels, but nothing makes them wider.
    pixel_px = sharp.dot_side_px / DOT_PX
    widest_px = MAX_PIXEL_SHARE * seen_pixel_px + WIDER_SIGMAS * sharp.dot_side_error_px / DOT_PX
    if pixel_px > widest_px:
        return (
            f"dots are as wide as monitor pixels of {pixel_px:.3f} px, and those are"
            f" {seen_pixel_px:.3f} px: where dots saturate the tracker they look so; write"
            " [tracker.detector] full_well_e and gain_e_per_dn as they are, or expose shorter"
        )
    if sharp.psf_sigma_error_px > MAX_ERROR_SHARE * sharp.psf_sigma_px:
        return (
            f"the PSF cannot be told from a monitor pixel of {sharp.dot_side_px / DOT_PX:.2f} px:"
            " take a longer [tracker] exposure_s"
        )
    if sharp.psf_sigma_px > BLURRED * stated_px + BLURRED_BY_PX:
        return (
            "turn the focus until this figure is smallest (--again focus), or write [tracker]"
            " psf_sigma_px as it is"
        )
    return ""


def _draw_dots(picture: Path, sharp: Sharpness, stated_px: float) -> None:
    """Draw the PSF's sigma by each dot over the tracker's image."""
    finding = (
        f"PSF sigma {sharp.psf_sigma_px:.3f} px (by {len(sharp.x_px)} dots), the bench file has"
        f" {stated_px:.4g}"
    )
    with chart(picture, finding, height_inch=6.0) as (axes,):
        dots = axes.scatter(sharp.x_px, sharp.y_px, c=sharp.each_psf_sigma_px, cmap="viridis", s=60)
        axes.figure.colorbar(dots, ax=axes, label="PSF sigma [tracker px]")
        axes.set(aspect="equal", xlabel="tracker x [px]", ylabel="tracker y [px]")
        axes.invert_yaxis()


def _effective(looked: DarkSubtracted, found: Sharpness) -> Found | None:
    """The effective PSF by the dots of one image; None where too few stand alone, and the width
    alone is known.
    """
    try:
        dots = dots_of_image(looked.image, found.x_px, found.y_px, found.dot_side_px)
        return fit_effective(dots, OVERSAMPLING)
    except InputError:
        return None


def sharp_dots(context: StepContext) -> SharpDots:
    """Lower the dots' code until they do not saturate the tracker, and measure them. Raises
    InputError.
    """
    seen_screen = context.seen_screen
    code = context.white
    plan = first_dots(seen_screen)
    dark = context.read(context.dark())
    for number in range(context.monitor.bits * 2):
        codes = dot_image(plan, 0, context.resolution_px, code)
        looked = context.look(Pattern(f"dots_{number:03}", codes), dark)
        # a dot that saturates the detector looks wider than it is
        if looked.raw_peak < DOT_FILL * context.full_dn:
            break
        code = context.darker(code)
    detector = context.detector
    return SharpDots(code, seen_sharpness(looked.image, seen_screen, detector), looked)


def seen_sharpness(
    image: FloatArray, seen: SeenScreen, detector: DetectorSettings, images: int = 1
) -> Sharpness:
    """Measure the sharpness of dots of DOT_PX in the mean (h, w) of some images, above their dark
    frame.

    The squares are as large, and turned, as `seen` has the screen's pixels. Raises InputError as
    `sharpness` does.
    """
    noise = DotNoise(images * detector.gain_e_per_dn, detector.prnu)
    return sharpness(image, DOT_PX * seen.tracker_px_a_monitor_px, seen.turn_deg, noise)


def dot_code(context: StepContext) -> int:
    """The brightest code whose dots do not saturate the tracker. Raises InputError."""
    return int(context.known.get("focus.dot_code", 0)) or sharp_dots(context).code


def first_dots(seen: SeenScreen) -> DotPlan:
    """The dots of the first frames: where the figure says that the tracker looks. Raises
    InputError.
    """
    lit = min(lit_for(seen), FIRST_LIT_DOTS)
    return plan_seen_dots(seen, FIRST_FRAMES, lit, np.random.default_rng(PLAN_SEED))
