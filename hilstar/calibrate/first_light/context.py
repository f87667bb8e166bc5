"""The context of a step: the bench file as it stands, the step's folder, the source of images, and figures of earlier steps."""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.bench_file import BenchFile
from hilstar.bench.cameras import bench_camera, ideal_monitor, tracker_camera, tracker_psf
from hilstar.calibrate.first_light.image_sources import ByHand, ImageSource, Pattern, VirtualBench, black
from hilstar.calibrate.first_light.records import Figure, KeyChange
from hilstar.calibrate.geometric.observed import read_image
from hilstar.errors import InputError
from hilstar.files import make_directory
from hilstar.scene.psf import Psf
from hilstar.tracker.mosaic import software_image
from hilstar.twin.optics import BenchGeometry

MAX_FILL = 0.8  # relative to the tracker's range: brighter pixels are not trusted
HOT_FILL = 0.5  # a pixel above this in the dark frame is hot, and is not used
LIGHT_STEP = 4.0  # by which the light is lowered while a pattern is too bright


@dataclass(frozen=True, slots=True)
class DarkSubtracted:
    """An image of the tracker: its file, and its light above the dark frame (h, w), DN.

    `raw_peak` is the peak before subtraction, without hot pixels; `floor_dn` is the median of the dark frame.
    """

    path: Path
    image: FloatArray
    raw_peak: float
    floor_dn: float


@dataclass(frozen=True, slots=True)
class StepContext:
    """Everything that a step works with.

    Images go to `folder`, results to `session`. `kept` has the images of an interrupted attempt, which are not taken again.
    `known` has the figures of earlier steps; `patches` is the maximum number of readings of the response. `watch` is called
    with each pattern before it is shown. White is watched for `watched_s` at most, 0 for not at all.
    """

    file: BenchFile
    session: Path
    folder: Path
    source: ImageSource
    known: dict[str, Figure]
    kept: Mapping[str, Path]
    patches: int
    watch: Callable[[Pattern], object] = lambda pattern: None
    watched_s: float = 0.0

    @property
    def resolution_px(self) -> tuple[int, int]:
        """Size of the monitor's image."""
        return self.file.config.monitor.resolution_px

    @property
    def white(self) -> int:
        """The largest code."""
        return int(2**self.file.config.monitor.bits - 1)

    @property
    def truth(self) -> BenchFile | None:
        """The true bench of a virtual session, None otherwise."""
        return self.source.truth if isinstance(self.source, VirtualBench) else None

    @property
    def tracker_psf(self) -> Psf:
        """The tracker's PSF, as the bench file has it. Raises InputError."""
        return tracker_psf(self.file.config.tracker, self.file.folder)

    def geometry(self) -> BenchGeometry:
        """Monitor and tracker as the bench file has them, with an ideal collimator."""
        return BenchGeometry(ideal_monitor(self.file.config), tracker_camera(self.file.config.tracker, self.file.folder))

    def real_geometry(self) -> BenchGeometry:
        """Monitor and tracker with the measured lens."""
        return BenchGeometry(bench_camera(self.file.config, self.file.folder), self.geometry().tracker)

    def names(self, table: str, key: str, path: Path) -> tuple[KeyChange, ...]:
        """The change of a key of the bench file that names a file of the session; none where it does already."""
        name, before = os.path.relpath(path, self.file.folder), getattr(getattr(self.file.config, table), key)
        return () if before == name else (KeyChange(table=table, key=key, before=before, after=name),)

    @property
    def exposure_s(self) -> float:
        """The tracker's exposure, from the bench file."""
        return self.file.config.tracker.exposure_s

    def take(self, pattern: Pattern, exposure_s: float | None = None) -> Path:
        """Take the tracker's image of a pattern, by default at the bench file's exposure."""
        if pattern.name in self.kept:
            return self.kept[pattern.name]
        make_directory(self.folder)
        stem = self.folder / pattern.name
        self.watch(pattern)
        return self.source.look(self.file, pattern, stem, self.exposure_s if exposure_s is None else exposure_s)

    def take_or_key(self, pattern: Pattern, keys: Mapping[str, str]) -> Path | str:
        """Take the tracker's image of a pattern, or by hand the key that says how it looks; `keys` has their meanings."""
        if isinstance(self.source, ByHand) and pattern.name not in self.kept:
            stem = make_directory(self.folder) / pattern.name
            self.watch(pattern)
            return self.source.look_or_key(self.file, pattern, stem, keys)
        return self.take(pattern)

    def unlit(self) -> Path | None:
        """The tracker's image with the monitor switched off, None where there is none."""
        name = "unlit_000"
        return self.kept[name] if name in self.kept else self.source.unlit(make_directory(self.folder) / name)

    def dark(self) -> Path:
        """Take the tracker's image of a black screen."""
        return self.take(Pattern("dark_000", black(self.resolution_px)))

    def look(self, pattern: Pattern, dark: FloatArray) -> DarkSubtracted:
        """The tracker's image of a pattern, above its dark frame. Raises InputError for one that cannot be read."""
        return self.looked(self.take(pattern), dark)

    def looked(self, path: Path, dark: FloatArray) -> DarkSubtracted:
        """An image of the tracker above its dark frame. Raises InputError for one that cannot be read."""
        pixels, cold = self.pixels(path), dark < HOT_FILL * self.full_dn
        seen = software_image(pixels, self.file.config.tracker.detector)
        return DarkSubtracted(path, seen - dark, float(pixels[cold].max(initial=0.0)), float(np.median(dark)))

    def read(self, path: Path) -> FloatArray:
        """An image of the tracker (h, w), DN, of a mosaic its superpixels."""
        return np.asarray(software_image(self.pixels(path), self.file.config.tracker.detector))

    def pixels(self, path: Path) -> FloatArray:
        """The pixels (h, w) of an image of the tracker, DN."""
        return read_image(path, self.file.config.tracker.resolution_px)

    @property
    def full_dn(self) -> float:
        """The level at which the tracker saturates: its ADC's last code, or its full well, DN."""
        detector = self.file.config.tracker.detector
        return min(2.0**detector.bits - 1, detector.offset_dn + detector.full_well_e / detector.gain_e_per_dn)

    def is_too_bright(self, looked: DarkSubtracted) -> bool:
        """Whether pixels are near the end of the tracker's range."""
        return looked.raw_peak > MAX_FILL * self.full_dn

    def darker(self, code: int) -> int:
        """The code of about a quarter of the light. Raises InputError where none is left."""
        lower = int(np.floor(code / LIGHT_STEP ** (1 / 2.2)))
        if lower < 1:
            raise InputError("the tracker is saturated by the darkest code; expose shorter, and write [tracker] exposure_s so")
        return lower
