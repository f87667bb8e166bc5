"""A virtual bench: what a tracker would see of each pattern on the bench that TRUTH.toml describes."""

from __future__ import annotations

import zlib
from functools import cached_property
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from hilstar.arrays import FloatArray
from hilstar.bench.bench_file import BenchFile
from hilstar.bench.build import open_bench, orientation_of
from hilstar.bench.cameras import tracker_camera, tracker_psf
from hilstar.calibrate.first_light.image_sources import (
    KIND,
    CodeImage,
    DiodeRecording,
    ImageSource,
    Pattern,
    off_screen,
    on_screen,
)
from hilstar.calibrate.latency import Edges, edges_of, swap_to_square_ms
from hilstar.errors import InputError
from hilstar.files import written
from hilstar.monitor.calibration import BUILT_IN, primary_lights
from hilstar.run.screen.screen import marker_light
from hilstar.tracker.detector import Detector
from hilstar.twin.optics import BenchGeometry, TwinOptics
from hilstar.twin.simulator import background_e
from hilstar.units import NS_PER_MS, NS_PER_S

SWAP_JITTER_NS, DIODE_JITTER_NS = 20_000, 100_000
MASKS_KEPT = 8  # masks of patterns: one step repeats this many in other codes


class VirtualBench(ImageSource):
    """A bench as a truth file describes it: lens, mounting, light, and the tracker's focus and noise.

    Free it with `close`. Raises InputError for a truth that cannot stand in for the bench.
    """

    def __init__(self, bench: BenchFile, truth: BenchFile, seed: int) -> None:
        self.truth, self._seed, self.sets_exposure = truth, seed, True
        self.identity = f"virtual: sha256 {truth.sha256}, seed {seed}"
        _refuse_other_bench(bench, truth)
        config = truth.config
        with open_bench(truth) as real:
            self._panel, camera = real.panel, real.camera
        tracker = config.tracker
        self.geometry = BenchGeometry(camera, tracker_camera(tracker, truth.folder))
        self._optics = TwinOptics(self.geometry, tracker_psf(tracker, truth.folder))
        self._detector = Detector(tracker.detector, tracker.resolution_px, tracker.pixel_pitch_um)
        self._glow_e_per_s: FloatArray = self._optics.glow_e_per_s(self._panel)
        self._sky_e_per_s: FloatArray = background_e(config, truth.folder) / tracker.exposure_s
        uniformity = 1.0 if self._panel.uniformity is None else self._panel.uniformity.astype(np.float64)
        self._white_e_per_s: FloatArray = np.full(camera.resolution_px[::-1], self._panel.flux_at_white_e_per_s) * uniformity
        self._units: dict[bytes, FloatArray] = {}
        if bench.config.render.bit_stealing:
            _ = self._primaries  # refused now where they are not known

    def look(self, file: BenchFile, pattern: Pattern, stem: Path, exposure_s: float) -> Path:
        """The tracker's image of a pattern: a PNG of 16 bits."""
        mine, its = orientation_of(file.config.monitor), orientation_of(self.truth.config.monitor)
        frames = [np.ascontiguousarray(off_screen(on_screen(codes, mine), its)) for codes in pattern.frames]
        shown = max(1, round(exposure_s * file.config.monitor.refresh_hz))
        image = self._image_e_per_s([frames[number % len(frames)] for number in range(shown if len(frames) > 1 else 1)])
        return self._exposed(image + self._glow_e_per_s, exposure_s, stem)

    def unlit(self, stem: Path) -> Path | None:
        """The tracker's image of a monitor that is switched off."""
        return self._exposed(np.zeros_like(self._glow_e_per_s), self.truth.config.tracker.exposure_s, stem)

    def diode(self, file: BenchFile, seconds: float) -> DiodeRecording | None:
        """A simulated photodiode: the true panel's delay and scan-out, with a little jitter."""
        rng = np.random.default_rng((self._seed, zlib.crc32(b"diode")))
        frames = int(seconds * file.config.monitor.refresh_hz)
        period_ns = NS_PER_S / file.config.monitor.refresh_hz
        swap_ns = np.rint(np.arange(frames) * period_ns + rng.normal(0, SWAP_JITTER_NS, frames)).astype(np.int64)
        shown = edges_of(swap_ns, np.array([marker_light(number, KIND) for number in range(frames)]))
        monitor = replace(self.truth.config.monitor, photodiode_px=file.config.monitor.photodiode_px)
        delay_ns = (monitor.panel_delay_ms + swap_to_square_ms(monitor)) * NS_PER_MS
        late_ns = delay_ns + rng.normal(0, DIODE_JITTER_NS, len(shown.host_ns))
        return DiodeRecording(shown, Edges(shown.host_ns + np.rint(late_ns).astype(np.int64), shown.level))

    def _exposed(self, light_e_per_s: FloatArray, exposure_s: float, stem: Path) -> Path:
        from PIL import Image

        mean_e = (light_e_per_s + self._sky_e_per_s) * exposure_s
        rng = np.random.default_rng((self._seed, zlib.crc32(str(Path(stem.parent.name) / stem.name).encode())))
        image = Image.fromarray(self._detector.expose(mean_e, exposure_s, rng))
        path = stem.with_name(stem.name + ".png")
        written(path, lambda file: image.save(file, "PNG", compress_level=1))
        return path

    def _image_e_per_s(self, frames: list[CodeImage]) -> FloatArray:
        """Mean electrons per second (h, w) of frames. A pattern with one level is drawn once and scaled for others."""
        light = np.mean([self._light(codes) for codes in frames], axis=0)
        lit, brightest = light > 0, float(light.max())
        if not brightest:
            return np.zeros_like(self._glow_e_per_s)
        if not (light[lit] == brightest).all():
            return self._optics.image_e_per_s(light * self._white_e_per_s)
        key = np.packbits(lit).tobytes()
        if key not in self._units:
            if len(self._units) == MASKS_KEPT:
                del self._units[next(iter(self._units))]
            self._units[key] = self._optics.image_e_per_s(lit * self._white_e_per_s)
        return self._units[key] * brightest

    def _light(self, codes: CodeImage) -> FloatArray:
        """Light above black (h, w) of codes (h, w) or (h, w, 3), relative to white at the screen's brightest place."""
        if codes.ndim == 2:
            return np.asarray(self._panel.response.light[codes])
        return np.asarray(sum(self._primaries[place][codes[..., place]] for place in range(3)))

    @cached_property
    def _primaries(self) -> FloatArray:
        monitor = self.truth.config.monitor
        source = monitor.calibration if monitor.calibration in BUILT_IN else self.truth.folder / monitor.calibration
        return primary_lights(source, monitor.bits)

    def close(self) -> None:
        """Free the GL context."""
        self._optics.close()


def _refuse_other_bench(bench: BenchFile, truth: BenchFile) -> None:
    """Refuse (InputError) a truth whose screen or tracker does not match the bench file's."""
    mine, its = bench.config, truth.config
    screens = [orientation_of(c.monitor).screen_px(c.monitor.resolution_px) for c in (mine, its)]
    if screens[0] != screens[1]:
        sizes = "{} x {} px and the bench file's is {} x {}".format(*screens[1], *screens[0])
        raise InputError(f"{truth.path}: [monitor] resolution_px: its screen is {sizes}; write the same screen")
    if mine.monitor.bits != its.monitor.bits:
        raise InputError(f"{truth.path}: [monitor] bits = {its.monitor.bits} and the bench file says {mine.monitor.bits}")
    if mine.tracker.resolution_px != its.tracker.resolution_px:
        raise InputError(f"{truth.path}: [tracker] resolution_px is not the bench file's; write the same tracker")
    if its.render.bit_stealing:
        raise InputError(f"{truth.path}: [render] bit_stealing is for the bench that shows; leave it out of the truth")
