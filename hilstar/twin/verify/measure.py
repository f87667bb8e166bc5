"""The comparison: each star of a field against itself in the image of the sky."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.bench.moving import wide_bodies
from hilstar.tracker.centroiders import FAMILY, Centroider
from hilstar.tracker.centroids import Centroids, estimate_background, find_stars, noisiest_background
from hilstar.twin.bench_geometry import BenchGeometry, Mirror
from hilstar.twin.verify.blends import with_blends_as_one
from hilstar.twin.verify.displacement import Displaced
from hilstar.twin.verify.light import true_calibration
from hilstar.twin.verify.measured import Glow, Measured, Star, Tally
from hilstar.twin.verify.star_finder import (
    WING_SIGMAS,
    Matched,
    StarFinder,
    crowded,
    faintest_e_per_s,
    nearest,
    shared,
    star_finder,
)
from hilstar.twin.verify.twin import Field, Twin
from hilstar.units import magnitude

# The glow that a missing black level adds is noticed at this share of the faintest drawn star's light, per pixel of its disc.
BLACK_SHARE = 0.1
MIRRORS: tuple[Mirror, ...] = ("x", "y", "swap")


class Comparison:
    """The stars of a twin's fields, compared one field after the other."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        self.finder: StarFinder = star_finder(twin.bench, twin.monitor_px_per_px)
        self.tally = Tally()
        self.field_count = 0

    def add(self, seen: Field, rng: np.random.Generator) -> None:
        """Compare the stars of one field; the generator is for the detector's noise."""
        self.field_count += 1
        tally, stars_listed = self.tally, len(seen.truth)
        seen = with_blends_as_one(seen, self.finder.sigma_px)
        tally.summed += stars_listed - len(seen.truth)
        windowed = [self.finder.find(image_e, seen.x_px, seen.y_px) for image_e in (seen.sky_e, seen.shown_e)]
        each = {kind: self._placed(seen, windowed, kind) for kind in FAMILY}
        sky, shown = each[self.finder.centroider]
        assumed = shown if seen.assumed_e is seen.shown_e else self.finder.match(seen.assumed_e, seen.x_px, seen.y_px)
        inside, drawn, clipped = self._inside(seen), seen.truth["drawn"], seen.truth["clipped"]
        tally.at_edge += int((self._on_detector(seen, 0.0) & ~inside).sum())
        tally.not_shown += int((inside & ~drawn).sum())
        tally.clipped += int((inside & drawn & clipped).sum())
        whole, blended = inside & drawn & ~clipped, self._blended(seen, sky)
        tally.blended += int((whole & blended).sum())
        wanted = whole & ~blended
        found = wanted & (sky.index >= 0) & (shown.index >= 0)
        for k in np.flatnonzero(wanted):
            (tally.stars if found[k] else tally.lost).append(self._star(seen, int(k), sky, shown, assumed))
        for kind, (there, here) in each.items():
            tally.off_px[kind] += [math.hypot(*here.against(there, int(k))[1:]) for k in np.flatnonzero(found)]
        tally.vanished += len(sky.found) - len(shown.found)
        self._follow(seen, shown.found, wanted)
        self._count_mirrored(seen, shown.found, wanted)
        self._measure_noisy(seen, self.twin.detected_e(seen, rng), wanted)

    def measured(self) -> Measured:
        """All that was measured so far, with what a verdict has to know of the bench. Raises InputError (see `true_panel`)."""
        bench, name = self.twin.bench, self.twin.config.verify.true_calibration
        return Measured(
            field_count=self.field_count,
            tally=self.tally,
            config=self.twin.config,
            camera=self.twin.camera,
            glow=self._glow(),
            calibration=bench.calibration,
            true_calibration=None if name is None else true_calibration(bench, name),
            gl_renderer=bench.renderer.gl_renderer,
            wide_bodies=wide_bodies(bench.moving, bench.camera),
        )

    def _glow(self) -> Glow:
        given = self.twin.config.verify.black_e_per_s_px
        sigma_x, sigma_y = self.finder.sigma_px
        disc_px = 4 * math.pi * sigma_x * sigma_y
        return Glow(
            assumed_e_per_s_px=on_screen_median(self.twin.sky_optics.glow_e_per_s(self.twin.bench.panel)),
            seen_e_per_s_px=on_screen_median(self.twin.glow_e_per_s),
            limit_e_per_s_px=BLACK_SHARE * faintest_e_per_s(self.twin.bench) / disc_px if given is None else given,
        )

    def _star(self, seen: Field, k: int, sky: Matched, shown: Matched, assumed: Matched) -> Star:
        row, truth = seen.truth[k], self._catalogue(seen)
        flux_mag, dx_px, dy_px = shown.against(sky, k)
        codes_mag, *codes_px = assumed.against(sky, k)
        floor_mag, *floor_px = sky.against(truth, k)
        return Star(
            hip=int(row["hip"]),
            v_mag=float(row["v_mag"]),
            x_px=float(seen.x_px[k]),
            y_px=float(seen.y_px[k]),
            flux_mag=flux_mag,
            dx_px=dx_px,
            dy_px=dy_px,
            codes_mag=codes_mag,
            codes_px=math.hypot(*codes_px),
            floor_mag=floor_mag,
            floor_px=math.hypot(*floor_px),
            name=str(row["name"]),
        )

    def _placed(self, seen: Field, windowed: list[Matched], kind: Centroider) -> list[Matched]:
        """The stars of the sky's image and of the display's where a centroider finds them."""
        images_e = seen.sky_e, seen.shown_e
        true_px = seen.x_px, seen.y_px
        return [self.finder.placed(of, image_e, true_px, kind) for of, image_e in zip(windowed, images_e, strict=True)]

    def _catalogue(self, seen: Field) -> Matched:
        """The catalogue as if it had been found in an image."""
        flux_e, count = seen.truth["electrons_per_s"] * self.twin.config.tracker.exposure_s, len(seen.truth)
        ones = np.ones(count, dtype=np.intp)
        return Matched(Centroids(seen.x_px, seen.y_px, flux_e, flux_e, ones, ones < 1), np.arange(count, dtype=np.intp))

    def _blended(self, seen: Field, sky: Matched) -> npt.NDArray[np.bool_]:
        flux, radius_px = seen.truth["electrons_per_s"], self.finder.settings.radius_px
        by_disc = seen.near_disc(self.twin.camera, radius_px + WING_SIGMAS * max(self.finder.sigma_px))
        return np.asarray(shared(sky.index) | crowded(seen.x_px, seen.y_px, flux, radius_px, self.finder.sigma_px) | by_disc)

    def _follow(self, seen: Field, shown: Centroids, wanted: npt.NDArray[np.bool_]) -> None:
        """Find each star where the true lens shows it, and note how far that is from where the sky has it."""
        geometry = BenchGeometry(self.twin.true_camera, self.twin.camera)
        match = nearest(shown, *geometry.to_tracker(seen.truth["x_px"], seen.truth["y_px"]))
        for k in np.flatnonzero(wanted & (match >= 0) & ~shared(match)):
            x_px, y_px = float(seen.x_px[k]), float(seen.y_px[k])
            off_px = float(shown.x_px[match[k]]) - x_px, float(shown.y_px[match[k]]) - y_px
            self.tally.displaced.append(Displaced(x_px, y_px, *off_px))

    def _count_mirrored(self, seen: Field, shown: Centroids, wanted: npt.NDArray[np.bool_]) -> None:
        """Count the stars that are where a mirrored screen would have them."""
        for mirror in MIRRORS if self.twin.differs else ():
            geometry = BenchGeometry(self.twin.true_camera, self.twin.camera, mirror)
            places = geometry.to_tracker(seen.truth["x_px"], seen.truth["y_px"])
            self.tally.mirrored[mirror] += int((wanted & (nearest(shown, *places) >= 0)).sum())

    def _measure_noisy(self, seen: Field, detected_e: FloatArray, wanted: npt.NDArray[np.bool_]) -> None:
        """The same stars in a noisy exposure (h, w), electrons: what the tracker itself adds."""
        step_e = self.twin.config.tracker.detector.gain_e_per_dn
        under = estimate_background(detected_e, step_e)
        if under.noise <= step_e / math.sqrt(12):  # rounding's: most of the image may be clipped at 0 DN, beside a glow
            under = noisiest_background(detected_e, step_e)
        windowed = find_stars(detected_e, self.finder.settings, under)
        match, true_px = nearest(windowed, seen.x_px, seen.y_px), (seen.x_px, seen.y_px)
        matched = Matched(windowed, match)
        found = self.finder.placed(matched, detected_e - under.level, true_px, self.finder.centroider).found
        expected_e = seen.truth["electrons_per_s"] * self.twin.config.tracker.exposure_s
        for k in np.flatnonzero(wanted & (match >= 0)):
            flux_e = float(found.flux[match[k]])
            if flux_e > 0:
                self.tally.noisy_mag.append(magnitude(flux_e / float(expected_e[k])))
                off_px = found.x_px[match[k]] - seen.x_px[k], found.y_px[match[k]] - seen.y_px[k]
                self.tally.noisy_px.append(math.hypot(*off_px))

    def _inside(self, seen: Field) -> npt.NDArray[np.bool_]:
        """Stars whose window is whole on the detector and whose sprite is whole on the monitor."""
        margin = self.finder.settings.radius_px + 1.5
        bench = self.twin.bench
        reach = bench.renderer.footprint_px / 2 + margin * self.twin.monitor_px_per_px
        width, height = bench.camera.resolution_px
        x, y = seen.truth["x_px"], seen.truth["y_px"]
        inside = (x >= reach) & (x < width - 1 - reach) & (y >= reach) & (y < height - 1 - reach)
        return np.asarray(inside & self._on_detector(seen, margin))

    def _on_detector(self, seen: Field, margin_px: float) -> npt.NDArray[np.bool_]:
        """Stars on the detector, `margin_px` or farther from its edge; one at NaN is not on it."""
        width, height = self.twin.camera.resolution_px
        inside = (seen.x_px >= margin_px - 0.5) & (seen.x_px < width - 0.5 - margin_px)
        return np.asarray(inside & (seen.y_px >= margin_px - 0.5) & (seen.y_px < height - 0.5 - margin_px))


def on_screen_median(glow_e_per_s: FloatArray) -> float:
    """The median over the detector's pixels that see the screen; 0 where the screen's black has no light."""
    lit = glow_e_per_s[glow_e_per_s > 0]
    return float(np.median(lit)) if len(lit) else 0.0
