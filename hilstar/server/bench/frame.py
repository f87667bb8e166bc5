"""From an attitude to a frame: sprites, the linear image, code values; and the lines about a
bench's light at a run's start.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import normalise, propagate
from hilstar.basics.units import magnitude
from hilstar.display.calibration import Calibration
from hilstar.display.footprints import FootprintMap, star_losses_mag
from hilstar.display.panel import Panel
from hilstar.display.quantise import Quantiser, shown_light
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.backend import Backend, linear_light
from hilstar.display.response import Codes, Levels, code_dtype
from hilstar.optics.camera import Camera
from hilstar.optics.extended import LightMap
from hilstar.optics.layers.bodies import BodyLayer, disc_stars
from hilstar.optics.layers.layers import NO_SOURCES, Sources, light_of, seen_in, sky_layers
from hilstar.optics.layers.truth import (
    clipped_in,
    designations,
    sprite_names,
    sprite_truth,
    truth_table,
    with_errors,
    without_errors,
)
from hilstar.optics.layers.view import STILL, Canvas, Layer, View
from hilstar.optics.psf import Psf
from hilstar.optics.scan import Scan
from hilstar.optics.sprites import (
    CLIP_TOLERANCE,
    FrameLight,
    by_primary,
    clipped_sprites,
    without_stars,
)
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.colours import Colours
from hilstar.server.bench.config import BenchConfig, Vector
from hilstar.server.bench.drawn import Drawn
from hilstar.server.bench.effort import Effort
from hilstar.server.bench.least_psf import Choice
from hilstar.sky.stars import Stars, split_by_rate

if TYPE_CHECKING:
    from hilstar.optics.layers.faults import FaultLayer
    from hilstar.sky.bodies.disc import Disc
    from hilstar.sky.bodies.moving import MovingSky
from hilstar.display.render.aids import AidLevels

WARM_UP_ATTITUDE = np.array([1.0, 0.0, 0.0, 0.0])
WARM_UP_RATE_RAD_S = np.array([0.1, 0.0, 0.0])
MOST = 0.5  # a pixel is a disc's if more than this share of its light is the disc's
NAMED_STARS = 5


@dataclass(frozen=True)
class Frame:
    """One frame: what each monitor pixel should cause, the codes that ask for it, and the stars
    behind it.

    `light` is float32 (channels, height, width), electrons per second, and `linear` (height, width)
    all channels together; `levels`, uint8 or uint16 (height, width), are indices into the
    response's table; `codes` are the code values, the same array or with bit stealing (height,
    width, 3). Where the primaries are driven apart, levels and codes are one array (height, width,
    3). `rows` is a structured array of TRUTH_DTYPE, a row for each star whose
    sprite touches the monitor, and `star` (n,) the places of the same stars in the bench's,
    negative for light that a fault adds. `t_ns` is the moment for which bodies were placed. `truth`
    is `rows` with the errors of the stars, which `errors` reads when they are first asked for, or
    when the frame is pickled.
    """

    q_icrs_to_cam: FloatArray
    light: Float32Array
    levels: Levels
    codes: Codes
    rows: npt.NDArray[np.void]
    star: IntArray
    t_ns: int | None = None
    errors: Callable[[npt.NDArray[np.void]], npt.NDArray[np.void]] = without_errors

    @cached_property
    def truth(self) -> npt.NDArray[np.void]:
        """The truth table of the frame, as `hilstar frame --truth` writes it: TRUTH_DTYPE,
        brightest first.
        """
        return self.errors(self.rows)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"truth": self.truth, "errors": without_errors}

    @property
    def linear(self) -> Float32Array:
        """The light of all channels together, float32 (height, width), electrons per second."""
        return self.light[0] if len(self.light) == 1 else np.asarray(self.light.sum(axis=0))


@dataclass(frozen=True, eq=False, kw_only=True)
class Bench:
    """A bench, assembled (see `build`): stars, geometry, light and a renderer. Free it with
    `close`.

    `config` is that of `file` with everything chosen that the file left to its tolerance, by
    `effort`. Of `stars` those from `faintest_shown_e_per_s` on can light a pixel: `shown_stars`;
    the others are `faint_stars`. `uniformity`, float32 (height, width), is each pixel's share of
    white, None where that is 1 everywhere, and `darkest` its minimum. `tracker_psf` is how
    collimator and tracker spread a monitor's point. `drawn` says which PSF stars are drawn by where
    the display brings the tracker's; `spectra` are their shares of its wavelengths, by place.
    `sources` are the sky's light beside stars, whose bodies have places among `stars` and
    `shown_stars`. `output` says how the display's output is set that its frames are shown on; {}
    without one. `panel` is the monitor's light by its levels. Where its primaries are driven apart,
    `colours` says what for, and stars have the light of each.
    """

    file: BenchFile
    config: BenchConfig
    effort: Effort
    camera: Camera
    scan: Scan
    calibration: Calibration
    uniformity: Float32Array | None
    darkest: float
    flux_at_white_e_per_s: float
    faintest_shown_e_per_s: float
    stars: Stars
    shown_stars: Stars
    faint_stars: Stars
    tracker_psf: Psf
    renderer: Backend
    panel: Panel
    colours: Colours | None = None
    spectra: Callable[[Stars, IntArray], FloatArray] | None = None
    drawn: Choice | None = None
    sources: Sources = NO_SOURCES
    output: dict[str, object] = field(default_factory=dict, repr=False)

    def with_stars(self, stars: Stars) -> Bench:
        """The bench with the same renderer and other stars, all of which are shown."""
        shown, none = split_by_rate(stars if self.colours is None else self.colours.on(stars), 0.0)
        return replace(self, stars=stars, shown_stars=shown, faint_stars=none, sources=NO_SOURCES)

    @property
    def moving(self) -> MovingSky | None:
        """The bodies, the satellites and the observer; None where the sky stands still."""
        return self.sources.moving

    @cached_property
    def drive(self) -> FloatArray | float:
        """How much of white each of `stars` asks for by its colour, relative to a white star as
        bright; 1 for all in grey.
        """
        if self.colours is None:
            return 1.0
        return self.colours.drive(self.colours.shares_of(self.stars, np.arange(len(self.stars))))

    @property
    def quantiser(self) -> type[Quantiser]:
        """The quantisation of its levels."""
        return QUANTISERS[self.renderer.target.quantisation]

    @property
    def psf(self) -> Psf:
        """How a star is drawn on the monitor."""
        return self.renderer.target.psf

    @cached_property
    def canvas(self) -> Canvas:
        """The monitor as layers draw on it; white is that of its darkest pixel."""
        white_e_per_s = self.flux_at_white_e_per_s * self.darkest
        first_step = float(self.calibration.response.threshold[0])
        return Canvas(
            self.camera, self.psf, white_e_per_s, first_step_e_per_s=first_step * white_e_per_s
        )

    @cached_property
    def layers(self) -> tuple[Layer, ...]:
        """The layers of what the monitor can show: `shown_stars`, bodies, and satellites as
        bright.
        """
        return sky_layers(self.canvas, self.sources, self.faintest_shown_e_per_s, self.shown_stars)

    @cached_property
    def _all_layers(self) -> tuple[Layer, ...]:
        return sky_layers(self.canvas, self.sources)

    @cached_property
    def _bodies(self) -> BodyLayer | None:
        return next((layer for layer in self.layers if isinstance(layer, BodyLayer)), None)

    def view(
        self,
        q_icrs_to_cam: FloatArray,
        rate_cam_rad_s: Vector | FloatArray | None = None,
        t_ns: int | None = None,
        velocity_km_s: FloatArray | None = None,
        place_km: FloatArray | None = None,
    ) -> View:
        """The view of a frame (see `View`), as the monitor's rows light up.

        A rate that moves no star by more than `[render] motion_above_px` is 0 in it, and the
        attitude that at the middle of the middle row's light.
        """
        if rate_cam_rad_s is None:
            rate = None
        else:
            rate = np.asarray(rate_cam_rad_s, dtype=np.float64)
        if rate is not None:
            motion_px = float(np.linalg.norm(rate)) * self.scan.longest_s * self._px_per_rad
            if 0 < motion_px <= self.config.render.motion_above_px:
                q_icrs_to_cam = propagate(q_icrs_to_cam, rate, self.scan.hold_s / 2)
                rate = STILL
        return View(q_icrs_to_cam, rate, t_ns, velocity_km_s, place_km, self.scan)

    @cached_property
    def _px_per_rad(self) -> float:
        return self.camera.scales_px_rad()[1]

    def seen(self, stars: Stars, view: View) -> Stars:
        """`stars` or `shown_stars` as a view has them, bodies among them."""
        return seen_in(view, stars, self.moving)

    def light(self, view: View, faults: FaultLayer | None = None) -> FrameLight:
        """The light of a frame as the monitor can show it, before anything is drawn."""
        return self._light(self.layers, self.shown_stars, view, faults)

    def _light(
        self, layers: tuple[Layer, ...], stars: Stars, view: View, faults: FaultLayer | None
    ) -> FrameLight:
        layers = layers if faults is None else (*layers, faults)
        return self._coloured(
            light_of(self.canvas, layers, seen_in(view, stars, self.moving), view), stars
        )

    def _coloured(self, sprites: FrameLight, stars: Stars) -> FrameLight:
        if self.spectra is None:
            return sprites
        return replace(sprites, spectra=self.spectra(stars, sprites.star))

    def sprites(self, q_icrs_to_cam: FloatArray, stars: Stars | None = None) -> FrameLight:
        """The sprites of `stars` (by default those bright enough to show) as points, at an
        attitude (unit quaternion).
        """
        stars = self.shown_stars if stars is None else stars
        return self._coloured(
            light_of(self.canvas, self.layers[:1], stars, View(q_icrs_to_cam)), stars
        )

    def draw(
        self,
        q_icrs_to_cam: FloatArray | None,
        frame: int = 0,
        rate_cam_rad_s: Vector | FloatArray | None = None,
        t_ns: int | None = None,
    ) -> Drawn:
        """Draw the levels for an attitude; None gives a blank frame. The frame path: no copy, no
        table.

        `frame` counts the frames shown, for `temporal`: a number not above the last one's begins
        anew. With a rate the attitude is that at the middle row's first light; one that moves stars
        by more than `[render] motion_above_px` draws each along its path while its row is lit.
        Bodies are where they are at `t_ns`, by default at the start; without a rate satellites'
        paths have their middle there.
        """
        if q_icrs_to_cam is None:
            light = None
        else:
            light = self.light(self.view(q_icrs_to_cam, rate_cam_rad_s, t_ns))
        return self.draw_sprites(light, frame)

    def discs(self, view: View) -> list[Disc]:
        """The bodies and satellites on the image that are drawn as discs, at rest: bodies
        nearest first, after satellites.
        """
        from hilstar.optics.layers.satellites import SatelliteLayer  # no other frame needs it

        discs: list[Disc] = []
        for layer in reversed(self.layers):
            if isinstance(layer, SatelliteLayer):
                discs += layer.discs(self.seen(self.stars, view), view)
            elif isinstance(layer, BodyLayer):
                discs += layer.on_image(view)
        return discs

    def draw_sprites(self, sprites: FrameLight | None, frame: int = 0) -> Drawn:
        """Draw the levels of a frame's sprites."""
        sprites = self._driven(sprites, self.shown_stars)
        self.renderer.draw(sprites, frame)
        if sprites is None:
            clipped = None
        else:
            clipped = self._clipped(sprites)
        if sprites is None or clipped is None or not len(clipped):
            return Drawn(self.renderer, sprites, () if sprites is None else sprites.over_white)
        return Drawn(
            self.renderer,
            sprites,
            (*designations(self.shown_stars, sprites, clipped), *sprites.over_white),
        )

    def _driven(self, sprites: FrameLight | None, stars: Stars) -> FrameLight | None:
        """Sprites with the light of each primary, where those are driven apart; `sprites.star`
        has places among `stars`.
        """
        if sprites is None or self.colours is None:
            return sprites
        return self.colours.driven(sprites, stars)

    def count_faint(self, q_icrs_to_cam: FloatArray) -> int:
        """How many stars in view at an attitude are too faint for the monitor."""
        if len(self.faint_stars):
            return len(self.sprites(q_icrs_to_cam, self.faint_stars))
        return 0

    def warm_up(self) -> None:
        """Draw once with paths, with stars and with none: a driver compiles its shaders at first
        use, 60 ms on llvmpipe.
        """
        lights = () if self._bodies is None else self._bodies.drawing.any_lights()
        if self.sources.diffuse:
            lights = (*lights, LightMap(np.zeros((1, 1), dtype=np.float32), lasting=False))
        if lights:
            sprites = replace(self.sprites(WARM_UP_ATTITUDE), extended=lights)
            self.renderer.draw(self._driven(sprites, self.shown_stars))
        for q, rate in (
            (WARM_UP_ATTITUDE, WARM_UP_RATE_RAD_S),
            (WARM_UP_ATTITUDE, None),
            (None, None),
        ):
            _ = self.draw(q, 0, rate).levels
        self.renderer.begin_anew()

    def frame(
        self,
        q_icrs_to_cam: Sequence[float] | FloatArray,
        number: int = 0,
        t_ns: int | None = None,
        faults: FaultLayer | None = None,
    ) -> Frame:
        """Draw one frame and read all of it back; the arrays are copies.

        Stars too faint for the monitor are in the linear image and the truth, and not drawn.
        `number` counts frames; with `temporal` this is the first frame of a sequence. Bodies are
        where they are at `t_ns`. Raises InputError for a quaternion that is not unit within 1e-3.
        """
        view = self.view(checked_quaternion(q_icrs_to_cam), None, t_ns)
        view = view if faults is None else faults.turned(view)
        sprites = self._light(self._all_layers, self.stars, view, faults)
        shown = self.light(view, faults)
        self.renderer.begin_anew()
        self.renderer.draw(self._driven(shown, self.shown_stars), number)
        levels = Levels(self.renderer.levels().copy())
        drawn = len(sprites) == len(shown) and not (
            len(self.faint_stars) or self.renderer.target.sides
        )
        drawn &= self.colours is None
        light = linear_light(self.renderer, sprites, self.stars, drawn)
        if self.colours is None:
            driven = sprites
        else:
            driven = self.colours.driven(sprites, self.stars)
        apparent = self.seen(self.stars, view)
        truth, star = sprite_truth(apparent, sprites, self._clipped(driven))
        if sprites.discs:
            discs = [disc for disc in self.discs(view) if disc.name in sprites.discs]
            disc_rows = disc_stars(self.stars, (disc.name for disc in discs))
            middles = (
                np.array([disc.direction for disc in discs]) @ view.icrs_to_image(self.camera).T
            )
            rows = truth_table(apparent, disc_rows, *self.camera.project(middles))
            rows["clipped"] = np.isin(rows["name"], sprites.over_white)
            truth = np.append(truth, rows)
            star = np.append(star, disc_rows)
        drive: FloatArray | float = 1.0
        if self.colours is not None:
            truth = self.colours.on_truth(truth, self.stars, star)
            drive = self.colours.drive(self.colours.shares_of(self.stars, star))
        truth["drawn"] = truth["electrons_per_s"] * drive >= self.faintest_shown_e_per_s
        order = np.argsort(truth["v_mag"], kind="stable")
        codes = self.code_values(levels)
        return Frame(
            view.q_icrs_to_cam,
            light,
            levels,
            codes,
            truth[order],
            star[order],
            t_ns,
            self._with_errors,
        )

    def _with_errors(self, rows: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
        return with_errors(rows, self.stars.catalog, self.config.sky.epoch_jyear)

    def losses_mag(self, frame: Frame, faults: FaultLayer | None = None) -> dict[int | str, float]:
        """For each clipped star of a frame (by HIP number, or a body's name), how many magnitudes
        too faint it is.

        That is summed over its own pixels. `faults` are those of the frame.
        """
        clipped = clipped_in(frame.rows)
        if not clipped:
            return {}
        view = self.view(frame.q_icrs_to_cam, None, frame.t_ns)
        sprites = self.light(view, faults)
        footprints = FootprintMap(self.camera.resolution_px, self.psf)
        loss_mag = star_losses_mag(sprites, self.panel, footprints, frame.levels)
        names = sprite_names(self.shown_stars, sprites)
        losses = dict(zip(names, loss_mag.tolist(), strict=True))
        wanted = frame.linear
        shown = shown_light(frame.levels, self.panel)
        for disc in self.discs(view) if sprites.over_white else ():
            # Of a disc brighter than white, in the pixels of which it has most of the light
            if disc.name in sprites.over_white and self._bodies is not None:
                alone = self._bodies.drawing.alone(disc, view)
                self.renderer.draw_linear(replace(without_stars(sprites), extended=alone))
                is_lit = self.renderer.linear() > MOST * wanted
                if is_lit.any():
                    losses[disc.name] = float(
                        magnitude(shown[is_lit].sum() / wanted[is_lit].sum(dtype=np.float64))
                    )
        return {name: losses[name] for name in clipped if name in losses}

    def code_values(self, levels: Levels) -> Codes:
        """The monitor's code values of levels (height, width): the same, or (height, width, 3)
        with bit stealing.
        """
        rgb = self.calibration.response.rgb
        if rgb is None:  # codes of primaries that are driven apart are their levels, too
            return levels
        return np.asarray(rgb[levels], dtype=code_dtype(self.calibration.response.bits))

    def _clipped(self, sprites: FrameLight) -> IntArray:
        """Places of the sprites that are over white: of light as a whole, or of any primary."""
        psf = self.psf
        spectra = sprites.spectra
        # as bright as the mean PSF's stars with the same peaks
        if psf.by_colour and spectra is not None:
            data = sprites.data.copy()
            half_white = 0.5 * self.flux_at_white_e_per_s * self.darkest
            bright = np.flatnonzero(
                data["electrons_per_s"] * (sprites.per_star * psf.peak_share) > half_white
            )
            x_px = sprites.x_px[bright]
            y_px = sprites.y_px[bright]
            rate = data["electrons_per_s"][bright]
            stamps = psf.stamps_at(
                x_px, y_px, spectra[bright] if spectra.ndim == 2 else spectra, rate
            )
            data["electrons_per_s"][bright] = stamps.max(axis=(1, 2)) / psf.shares(
                np.rint(x_px) - x_px, np.rint(y_px) - y_px
            )
            sprites = replace(sprites, data=data)
        screen = self.camera.resolution_px, self.uniformity, self.darkest
        if sprites.primaries is None:
            return clipped_sprites(sprites, psf, self.flux_at_white_e_per_s, *screen)
        over = [np.empty(0, dtype=np.intp)]
        places_px = self.renderer.target.places_px
        most_e_per_s = sprites.primaries.max(axis=0, initial=0.0) * (
            sprites.per_star * psf.peak_share
        )
        for k, primary in enumerate(self.panel.primaries):
            # as in `clipped_sprites`
            if most_e_per_s[k] > 0.5 * primary.flux_at_white_e_per_s * self.darkest:
                over.append(
                    clipped_sprites(
                        by_primary(sprites, places_px, k),
                        psf,
                        primary.flux_at_white_e_per_s,
                        *screen,
                    )
                )
        return np.unique(np.concatenate(over))

    def close(self) -> None:
        """Free the GL context."""
        self.renderer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def checked_quaternion(q: Sequence[float] | FloatArray) -> FloatArray:
    """`q` (w, x, y, z) as a float64 unit array. Raises InputError where it is not unit within
    1e-3.
    """
    array = np.asarray(q, dtype=np.float64)
    if array.shape != (4,):
        raise InputError(f"quaternion of shape {array.shape}: write four numbers w, x, y, z")
    norm = math.hypot(*array)  # without NumPy's warning where it overflows
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        raise InputError(
            f"quaternion {array.tolist()}: its norm is {norm:.6g}; write a unit quaternion w, x,"
            " y, z"
        )
    return normalise(array)


def clipping_hip(bench: Bench) -> list[int | str]:
    """Stars and bodies that clip when centred on the darkest pixel, brightest first: HIP
    numbers, and names of bodies.
    """
    peak_e_per_s = bench.stars.electrons_per_s * bench.psf.peak_share * bench.drive
    order = np.argsort(-peak_e_per_s, kind="stable")
    clips = peak_e_per_s[order] > bench.flux_at_white_e_per_s * bench.darkest * (1 + CLIP_TOLERANCE)
    return bench.stars.designations(order[clips])


def named(found: list[int | str], count: int) -> str:
    """ "Moon, HIP 32349, 27989 and 3 more", or "none"."""
    if not found:
        return "none"
    bodies = [designation for designation in found if isinstance(designation, str)]
    hips = [designation for designation in found if isinstance(designation, int)]
    parts = [*bodies, *map(str, hips)]
    if hips:
        parts[len(bodies)] = f"HIP {hips[0]}"
    text = ", ".join(parts[:count])
    if len(parts) > count:
        text += f" and {len(parts) - count} more"
    return text


def clipping_line(bench: Bench) -> str | None:
    """One line that names the stars that clip, for the start of a run; None if none does."""
    clipped = clipping_hip(bench)
    render = bench.config.render
    if not clipped:
        return None
    bodies = bool(bench.stars.bodies)
    singular, many = ("star or body", "stars and bodies") if bodies else ("star", "stars")
    if len(clipped) == 1:
        stars = f"1 {singular} of the sky is"
    else:
        stars = f"{len(clipped)} {many} of the sky are"
    if render.brightest_v_mag is None:
        key = "flux_at_white_e_per_s"
    else:
        key = f"brightest_v_mag = {render.brightest_v_mag:g}"
    return (
        f"{stars} brighter than white and clip in view: {named(clipped, NAMED_STARS)} ([render]"
        f" {key})"
    )


def drawn_line(bench: Bench) -> str | None:
    """One line on the PSF by which stars are drawn, where the display brings the tracker's;
    otherwise None.
    """
    if bench.drawn is None:
        return None
    return f"[render] {bench.drawn.line()}"


def shares_line(bench: Bench) -> str | None:
    """One line where bit stealing weighs the primaries by a formula's shares of white, not the
    tracker's; otherwise None.
    """
    calibration = bench.calibration
    if (
        not bench.config.render.bit_stealing
        or not calibration.is_formula
        or calibration.weights is None
    ):
        return None
    shares = ", ".join(f"{share:g}" for share in calibration.weights)
    return (
        f'[render] bit_stealing with calibration = "{calibration.name}" assumes that the tracker'
        f" sees white as {shares} of red, green and blue, as a photometer does; measure it (hilstar"
        " first-light), or write a calibration file with [weights]"
    )


def colour_line(bench: Bench) -> str | None:
    """One line where the primaries' spectra are guessed from their chromaticities; otherwise
    None.
    """
    if bench.colours is None or bench.config.monitor.primaries.xy_r is None:
        return None
    return (
        "[monitor.primaries] xy_r, xy_g and xy_b: the primaries' spectra are Gaussians of about"
        " those chromaticities, so all colours are approximate; measure the spectra, and write file"
    )


def aid_levels_of(bench: Bench) -> AidLevels:
    """The aids' levels on a bench."""
    x_px, y_px = bench.camera.boresight_px
    return AidLevels(
        bench.calibration.response, bench.config.monitor.bits, (round(x_px), round(y_px))
    )
