"""The virtual tracker before the display: each frame shown during an exposure, through the twin,
to DN.
"""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import propagate
from hilstar.basics.units import NS_PER_S
from hilstar.display.quantise import primary_lights
from hilstar.instruments.simulate.optics import DisplayColours, TwinOptics, seen_primaries
from hilstar.instruments.simulate.shutter import rolled, rolling_light
from hilstar.instruments.simulate.simulator import (
    Exposure,
    TrackerBackground,
    detector_canvas,
    exposure_truth,
)
from hilstar.instruments.simulate.twin import true_geometry, true_panel
from hilstar.optics.layers.layers import Sources, light_of, sky_layers
from hilstar.optics.layers.truth import with_errors
from hilstar.optics.layers.view import View
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import before_detector, tracker_camera
from hilstar.server.bench.config import GAUSSIAN, BenchConfig
from hilstar.tracker.detector import Detector
from hilstar.tracker.mosaic import uneven_dark_dn

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky


class DisplayTracker:
    """The bench's tracker before the bench's true display (`[verify] true_*`). Free it with
    `close`.

    Frames follow one another at `[monitor] refresh_hz`, and each is held until the next. An
    exposure is the mean of the frames that it spans, each at the attitude in the middle of its
    time. At rest one frame is drawn for all of them, unless they are dithered in time or have
    satellites. Behind a rolling shutter the screen's scan-out, `hold_ms` and phase count as well.
    The phase is random for a free tracker. Triggered, or without noise, the middle rows of screen
    and tracker begin together.
    """

    def __init__(self, file: BenchFile) -> None:
        self.file = file
        self.config = file.config
        self._bench = open_bench(file)
        self._load()
        self._load_optics()

    @property
    def gl_renderer(self) -> str:
        """The name of the GL renderer, as the driver gives it."""
        return self._bench.renderer.gl_renderer

    @property
    def moving(self) -> "MovingSky | None":
        """The bodies and the observer; None where the sky stands still."""
        return self._bench.moving

    def change(self, file: BenchFile) -> None:
        """Switch to another bench file of the same folder, rebuilding only what changed."""
        if file.config == self.config:
            return
        before = self.config
        psf = self.canvas.psf
        self.file = file
        self.config = file.config
        if _shown_keys(before) != _shown_keys(self.config) or self._bench.moving is not None:
            self._bench.close()
            self._bench = open_bench(file)
        else:  # the quantisation chosen for the tolerance stays
            config = msgspec.structs.replace(file.config, render=self._bench.config.render)
            self._bench = replace(self._bench, file=file, config=config)
        self._load()
        if _optics_keys(before) != _optics_keys(self.config) or psf != self.canvas.psf:
            self._optics.close()
            self._load_optics()
        else:
            self._glow_e_per_s = self._optics.glow_e_per_s(self._panel)

    def _load(self) -> None:
        tracker = self.config.tracker
        self.camera, self.stars = tracker_camera(tracker, self.file.folder), self._bench.stars
        self.canvas = detector_canvas(self.file, self.camera)
        self._panel, self._primaries = true_panel(self._bench), seen_primaries(self._bench)
        self._colours = DisplayColours.of(self._bench)
        self._background = TrackerBackground(
            self.config, self.file.folder, self.camera, moving=self._bench.moving
        )
        self._detector = Detector(tracker.detector, tracker.resolution_px, tracker.pixel_pitch_um)

    def _load_optics(self) -> None:
        self._optics = TwinOptics(
            true_geometry(self._bench, self.camera),
            before_detector(self.config, self.file.folder, self._bench.camera),
        )
        self._glow_e_per_s = self._optics.glow_e_per_s(self._panel)

    def dark_dn(self, exposure_s: float) -> FloatArray | None:
        """What a black screen is in the software's image (h, w), DN; None where that is even."""
        glow_e = self._colours.grey(self._glow_e_per_s) * exposure_s
        return uneven_dark_dn(glow_e + self._background.steady_e, self.config.tracker.detector)

    def expose(self, view: View, rng: np.random.Generator | None) -> Exposure:
        """One exposure of the display, without noise if there is no generator. Raises InputError
        as the detector does.
        """
        exposure_s = view.exposure_s
        view = rolled(view, self.config.tracker)
        if view.scan.scanout_s and exposure_s:
            shown, glow_e_per_s = self._rolling_e_per_s(view, rng)
        else:
            shown = self._light_e_per_s(view)
            glow_e_per_s = self._glow_e_per_s
        shown_e_per_s = self._colours.shown(self._optics.images_e_per_s(shown, self._primaries))
        glow_e = self._colours.grey(glow_e_per_s) * exposure_s
        mean_e = shown_e_per_s * exposure_s + glow_e + self._background.of_view_e(view)
        if rng is None:
            dn = self._detector.expose_noiseless(mean_e, exposure_s)
        else:
            dn = self._detector.expose(mean_e, exposure_s, rng)
        stars = self._bench.seen(self._bench.stars, view)
        light = light_of(
            self.canvas,
            sky_layers(self.canvas, Sources(self._bench.moving), paths=False),
            stars,
            view,
        )
        truth = exposure_truth(self.canvas, view, stars, light, mean_e)
        truth["drawn"] = truth["electrons_per_s"] >= self._bench.faintest_shown_e_per_s
        epoch_jyear = self.config.sky.epoch_jyear
        errors = partial(with_errors, catalog=stars.catalog, epoch_jyear=epoch_jyear)
        return Exposure(view, dn, mean_e, truth, errors=errors)

    def _light_e_per_s(self, view: View) -> FloatArray:
        """The mean light (primaries, H, W) of the display over the exposure."""
        count = max(1, round(view.exposure_s * self.config.monitor.refresh_hz))
        moving = self._bench.moving
        streaks = moving is not None and moving.satellites is not None
        if not streaks and not view.turn.rate_cam_rad_s.any():
            count = len(self._bench.quantiser.exposure(0, count))
        total: FloatArray | None = None
        for frame in range(count):
            seconds = ((frame + 0.5) / count - 0.5) * view.exposure_s
            q = propagate(view.q_icrs_to_cam, view.turn.rate_cam_rad_s, seconds)
            t_ns = view.t_ns
            if streaks and t_ns is not None:
                t_ns += round(seconds * NS_PER_S)
            light = np.array(
                primary_lights(self._bench.draw(q, frame, t_ns=t_ns).levels, self._panel)
            )
            total = light if total is None else total + light
        if total is None:
            return np.zeros((0, 0, 0))
        return total / count

    def _rolling_e_per_s(
        self, view: View, rng: np.random.Generator | None
    ) -> tuple[FloatArray, FloatArray]:
        """The mean light (primaries, H, W) of the display over each place's own exposure, and
        that of the glow (h, w).
        """
        period_s = 1 / self.config.monitor.refresh_hz
        free = self.config.tracker.trigger == "free" and rng is not None
        if free and rng is not None:
            phase_s = rng.uniform(0, period_s)
        else:
            phase_s = -view.exposure_s / 2
        light, glow = rolling_light(self._bench, self._optics.geometry, self._panel, view, phase_s)
        return light, self._glow_e_per_s * glow

    def close(self) -> None:
        """Free the GL contexts."""
        self._bench.close()
        self._optics.close()


def _shown_keys(config: BenchConfig) -> tuple[object, ...]:
    """The keys that decide the bench's frames; of the tracker those of its light gathering and
    exposure, and of how it sees a pixel, by which codes are chosen together (`seen_by`).
    """
    tracker = config.tracker
    gathers = (
        tracker.aperture_mm,
        tracker.quantum_efficiencies,
        tracker.transmission,
        tracker.exposure_s,
    )
    sees = (
        tracker.focal_length_mm,
        tracker.pixel_pitch_um,
        tracker.psf_sigma_px,
        tracker.optics,
    )
    open_part = tracker.detector.fill_factor
    drawn = None if config.render.psf == GAUSSIAN else _optics_keys(config)
    return (
        config.sky,
        config.spacecraft,
        config.monitor,
        config.collimator,
        config.render,
        gathers,
        sees,
        open_part,
        drawn,
    )


def _optics_keys(config: BenchConfig) -> tuple[object, ...]:
    """The keys that decide where the display's light falls onto the detector."""
    tracker = config.tracker
    lens = (
        tracker.focal_length_mm,
        tracker.pixel_pitch_um,
        tracker.resolution_px,
        tracker.principal_point_px,
        tracker.distortion,
        tracker.optics,
        tracker.psf_sigma_px,
    )
    return config.monitor, config.collimator, config.verify, lens
