"""The context of a step: the bench file as it stands, the step's folder, the source of images, and
figures of earlier steps.

Before it the session's records: session.json, and the keys set in the bench file.
"""

import dataclasses
import hashlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.files import make_directory, write_whole
from hilstar.basics.reading import NOT_JSON, exists, read_bytes
from hilstar.basics.rotation import to_matrix
from hilstar.display.calibration import (
    Calibration,
    load_calibration,
)
from hilstar.instruments.calibrate.first_light.image_sources import (
    ByHand,
    ImageSource,
    Pattern,
    VirtualBench,
    black,
)
from hilstar.instruments.calibrate.full_well import check_full_well
from hilstar.instruments.calibrate.geometric.dots import SeenScreen
from hilstar.instruments.calibrate.geometric.geometry_fit import psf_sigma_of
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.psf import Psf
from hilstar.server.bench.bench_file import BenchFile, read_bench_file, with_key
from hilstar.server.bench.cameras import (
    before_detector,
    bench_camera,
    ideal_monitor,
    tracker_camera,
)
from hilstar.server.bench.config import Monitor, parse_config
from hilstar.server.bench.monitor import calibration_source
from hilstar.server.sync import BeatSummary
from hilstar.tracker.mosaic import software_image
from hilstar.tracker.settings import DetectorSettings

Verdict = Literal["done", "skipped", "failed"]
Figure = float | int | str
TomlValue = float | int | str | bool | list[int]

END_SHARE = 1e-3  # of an end: a figure so near to it was stopped by it
MAX_SESSION_BYTES = 20_000_000
MAX_FILE_BYTES = 2_000_000_000
KIND = "hilstar first light 1"
SESSION_FILE = "session.json"
ADVICE = "give the directory of a first-light session, or a new one"
INSTEAD_OF = {"flux_at_white_e_per_s": ("brightest_v_mag",)}
# Figures of the step `orientation`: the monitor's camera as the figure was seen, with its
# q_cam_to_mon.
SEEN_FOCAL, SEEN_Q = "seen_focal_length_px", ("seen_qw", "seen_qx", "seen_qy", "seen_qz")
# Errors of the measured PSF within which the bench file's stands, so that `calibrate geometric` has
# the session's figures.
PSF_AGREES_SIGMAS = 2.0
MAX_FILL = 0.8  # relative to the tracker's range: brighter pixels are not trusted
HOT_FILL = 0.5  # a pixel above this in the dark frame is hot, and is not used
LIGHT_STEP = 4.0  # by which the light is lowered while a pattern is too bright


class KeyChange(msgspec.Struct, frozen=True, kw_only=True):
    """A key of the bench file that a step sets; `before` is None where it was not written."""

    table: str
    key: str
    before: TomlValue | None
    after: TomlValue

    @property
    def line(self) -> str:
        """The change for a person."""
        before = "not set" if self.before is None else self.before
        return f"[{self.table}] {self.key}: {before} -> {self.after}"


class StepNumber(msgspec.Struct, frozen=True):
    """The one figure of a step: value, standard error (None for a count or a figure without
    one), unit, and what it is.
    """

    value: float
    error: float | None
    unit: str
    of: str


class FittedFigure(NamedTuple):
    """A figure of a fit, and the ends of its model: a figure at an end was not found there, the
    model stopped it.
    """

    name: str
    value: float
    low: float
    high: float

    @property
    def is_at_end(self) -> bool:
        """Whether the figure is at an end of its model."""
        below = END_SHARE * abs(self.low)
        above = END_SHARE * abs(self.high)
        return not self.low + below < self.value < self.high - above


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """The result of a step: one line, figures, files made, pictures for the page, keys to set, and
    its one figure.

    `fitted` has the figures of its fits whose models have ends; a step with one at an end is never
    done (see `checked`).
    """

    verdict: Verdict
    line: str
    figures: Mapping[str, Figure] = field(default_factory=dict)
    files: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    changes: tuple[KeyChange, ...] = ()
    number: StepNumber | None = None
    fitted: tuple[FittedFigure, ...] = ()

    def checked(self) -> "StepOutcome":
        """This outcome; failed, and without its changes, where a figure is at an end of its
        model.

        A light map or a scale that stars contradict a little is nearer than what it replaces, so a
        failed step may have changes: its line then names their keys.
        """
        if self.verdict == "failed" and self.changes:
            keys = ", ".join(f"[{change.table}] {change.key}" for change in self.changes)
            return dataclasses.replace(self, line=f"{self.line}; set all the same: {keys}")
        at_end = [figure for figure in self.fitted if figure.is_at_end]
        if self.verdict != "done" or not at_end:
            return self
        ends = ", ".join(
            f"{figure.name} {figure.value:.4g} is at an end of its model ({figure.low:g} to"
            f" {figure.high:g})"
            for figure in at_end
        )
        line = f"{self.line}; but {ends}, so it was not measured and nothing was changed"
        return dataclasses.replace(self, verdict="failed", line=line, changes=(), number=None)


class StepRecord(msgspec.Struct, frozen=True, kw_only=True):
    """A step in session.json: `state_sha256` is of what it depends on, `files` has each file's
    SHA-256 by its path there.
    """

    name: str
    verdict: Verdict
    line: str
    exit_code: int
    state_sha256: str
    figures: dict[str, Figure]
    files: dict[str, str]
    pictures: list[str]
    changes: list[KeyChange]
    ended: str
    seconds: float
    number: StepNumber | None = None


class SessionFile(msgspec.Struct, frozen=True, kw_only=True):
    """session.json: the bench, where its patterns are seen, and the steps in their order.

    `unfinished` has the state of each interrupted step: while it is the same, the images taken are
    used again. `beat` is that of the tracker's exposures with the display's refresh, measured where
    it could be; `forced` what --force shows it on.
    """

    kind: str
    hilstar: str
    bench: str
    bench_sha256: str
    seen_by: str
    running: str | None
    steps: list[StepRecord]
    unfinished: dict[str, str] = {}
    beat: BeatSummary | None = None
    forced: list[str] = []


def read_session(folder: Path) -> SessionFile | None:
    """The session in a directory, None where there is none. Raises InputError for a file that is
    no session.
    """
    path = folder / SESSION_FILE
    if not exists(path):
        return None
    try:
        session = msgspec.json.decode(read_bytes(path, ADVICE, MAX_SESSION_BYTES), type=SessionFile)
    except NOT_JSON as error:
        raise InputError(f"{path}: is no session ({shortened(error)}); {ADVICE}") from error
    if session.kind != KIND:
        raise InputError(
            f"{path}: kind = {shortened(repr(session.kind))} and {KIND!r} is wanted; {ADVICE}"
        )
    return session


def write_session(folder: Path, session: SessionFile) -> None:
    """Write session.json, complete or not at all."""
    write_whole(folder / SESSION_FILE, msgspec.json.format(msgspec.json.encode(session)))


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file's bytes. Raises InputError where it cannot be read."""
    return hashlib.sha256(read_bytes(path, ADVICE, MAX_FILE_BYTES)).hexdigest()


def with_changes(file: BenchFile, changes: Sequence[KeyChange]) -> BenchFile:
    """The bench file with the changes, without writing it. Raises InputError where a key cannot
    be set in this file.
    """
    text = file.text
    for change in changes:
        text = with_key(
            text, change.table, change.key, change.after, INSTEAD_OF.get(change.key, ())
        )
    config = parse_config(file.path, text)
    for change in changes:
        now = getattr(getattr(config, change.table), change.key)
        if (list(now) if isinstance(now, tuple) else now) != change.after:
            raise InputError(
                f"{file.path}: {change.key} could not be set; write it under [{change.table}]"
                " yourself"
            )
    return BenchFile(file.path, text, config, file.sha256)


def rewrite(file: BenchFile, changes: Sequence[KeyChange]) -> BenchFile:
    """Write the changed bench file over the old one, and read it. Raises InputError."""
    if not changes:
        return file
    write_whole(file.path, with_changes(file, changes).text)
    return read_bench_file(file.path)


@dataclass(frozen=True, slots=True)
class DarkSubtracted:
    """An image of the tracker: its file, and its light above the dark frame (h, w), DN.

    `raw_peak` is the peak before subtraction, without hot pixels; `floor_dn` is the median of the
    dark frame.
    """

    path: Path
    image: FloatArray
    raw_peak: float
    floor_dn: float


@dataclass(frozen=True, slots=True)
class StepContext:
    """Everything that a step works with.

    Images go to `folder`, results to `session`. `images` has those of an interrupted attempt,
    which are not taken again. `known` has the figures of earlier steps; `patches` is the maximum
    number of readings of the response. `watch` is called with each pattern before it is shown.
    White is watched for `watched_s` at most, 0 for not at all.
    `frames` images of each field of stars are averaged, 0: as many as their noise asks for. `stage`
    is told what begins.
    """

    file: BenchFile
    session: Path
    folder: Path
    source: ImageSource
    known: dict[str, Figure]
    images: Mapping[str, Path]
    patches: int
    watch: Callable[[Pattern], object] = lambda pattern: None
    watched_s: float = 0.0
    frames: int = 0
    stage: Callable[[str], object] = lambda words: None

    @property
    def monitor(self) -> Monitor:
        """The bench file's [monitor]."""
        return self.file.config.monitor

    @property
    def detector(self) -> DetectorSettings:
        """The bench file's [tracker.detector]."""
        return self.file.config.tracker.detector

    @property
    def resolution_px(self) -> tuple[int, int]:
        """Size of the monitor's image."""
        return self.monitor.resolution_px

    @property
    def white(self) -> int:
        """The largest code."""
        return int(2**self.monitor.bits - 1)

    @property
    def truth(self) -> BenchFile | None:
        """The true bench of a virtual session, None otherwise."""
        if isinstance(self.source, VirtualBench):
            return self.source.truth
        return None

    @property
    def tracker_psf(self) -> Psf:
        """How collimator and tracker spread a monitor's point, as the bench file has it. Raises
        InputError.
        """
        return before_detector(self.file.config, self.file.folder, self.geometry().monitor)

    def geometry(self) -> BenchGeometry:
        """Monitor and tracker as the bench file has them, with an ideal collimator."""
        return BenchGeometry(
            ideal_monitor(self.file.config),
            tracker_camera(self.file.config.tracker, self.file.folder),
        )

    def real_geometry(self) -> BenchGeometry:
        """Monitor and tracker with the measured lens."""
        return BenchGeometry(
            bench_camera(self.file.config, self.file.folder), self.geometry().tracker
        )

    @property
    def seen_screen(self) -> SeenScreen:
        """The part of the screen that the tracker sees, by the figure of the step `orientation`
        where it was measured.
        """
        geometry = self.geometry()
        psf_px = psf_sigma_of(self.file)
        focal_px = self.known.get(f"orientation.{SEEN_FOCAL}")
        if focal_px is None:
            return SeenScreen(
                geometry.monitor, geometry.tracker, is_sure=False, psf_sigma_px=psf_px
            )
        turn = np.array([float(self.known[f"orientation.{name}"]) for name in SEEN_Q])
        monitor = dataclasses.replace(
            geometry.monitor, focal_length_px=float(focal_px), cam_to_image=to_matrix(turn)
        )
        return SeenScreen(monitor, geometry.tracker, is_sure=True, psf_sigma_px=psf_px)

    @property
    def psf_sigma_px(self) -> float:
        """The sigma of the tracker's PSF: that of the step `focus` where it is done, else the
        bench file's.
        """
        return float(self.known.get("focus.psf_sigma_px", np.mean(self.tracker_psf.width_px)))

    @property
    def agreed_psf_sigma_px(self) -> float:
        """The bench file's sigma of the tracker's PSF, or that of the step `focus` where it
        contradicts it.
        """
        stated_px = psf_sigma_of(self.file)
        error_px = float(self.known.get("focus.psf_sigma_error_px", math.inf))
        if abs(self.psf_sigma_px - stated_px) <= PSF_AGREES_SIGMAS * error_px:
            return stated_px
        return self.psf_sigma_px

    def names(self, table: str, key: str, path: Path) -> tuple[KeyChange, ...]:
        """The change of a key of the bench file that names a file of the session; none where it
        does already.
        """
        return self.change(table, key, os.path.relpath(path, self.file.folder))

    def change(self, table: str, key: str, after: TomlValue) -> tuple[KeyChange, ...]:
        """The change of a key of the bench file; none where it is so already."""
        before = getattr(getattr(self.file.config, table), key)
        if before == after:
            return ()
        return (KeyChange(table=table, key=key, before=before, after=after),)

    @property
    def exposure_s(self) -> float:
        """The tracker's exposure, from the bench file."""
        return self.file.config.tracker.exposure_s

    def take(self, pattern: Pattern, exposure_s: float | None = None) -> Path:
        """Take the tracker's image of a pattern, by default at the bench file's exposure."""
        if pattern.name in self.images:
            return self.images[pattern.name]
        make_directory(self.folder)
        if exposure_s is None:
            exposure_s = self.exposure_s
        stem = self.folder / pattern.name
        self.watch(pattern)
        return self.source.look(self.file, pattern, stem, exposure_s)

    def take_or_key(self, pattern: Pattern, keys: Mapping[str, str]) -> Path | str:
        """Take the tracker's image of a pattern, or by hand the key that says how it looks;
        `keys` has their meanings.
        """
        if isinstance(self.source, ByHand) and pattern.name not in self.images:
            stem = make_directory(self.folder) / pattern.name
            self.watch(pattern)
            return self.source.look_or_key(self.file, pattern, stem, keys)
        return self.take(pattern)

    def unlit(self) -> Path | None:
        """The tracker's image with the monitor switched off, None where there is none."""
        name = "unlit_000"
        if name in self.images:
            return self.images[name]
        return self.source.unlit(make_directory(self.folder) / name)

    def dark(self, number: int = 0) -> Path:
        """Take the tracker's image of a black screen, the first or a further one."""
        return self.take(Pattern(f"dark_{number:03}", black(self.resolution_px)))

    def look(self, pattern: Pattern, dark: FloatArray) -> DarkSubtracted:
        """The tracker's image of a pattern, above its dark frame. Raises InputError for one that
        cannot be read.
        """
        return self.looked(self.take(pattern), dark)

    def looked(self, path: Path, dark: FloatArray) -> DarkSubtracted:
        """An image of the tracker above its dark frame. Raises InputError for one that cannot be
        read, whose dark frame is saturated, or that is cut off under the stated saturation.
        """
        floor_dn = float(np.median(dark))
        if floor_dn > MAX_FILL * self.full_dn:
            raise InputError(
                f"a black screen fills the tracker to {floor_dn / self.full_dn:.0%} of its range in"
                f" {self.exposure_s:g} s: expose shorter, and write [tracker] exposure_s so; look"
                " at the monitor's black level, and at other light"
            )
        pixels = self.pixels(path)
        light = pixels[dark < HOT_FILL * self.full_dn]
        check_full_well(light, dark, floor_dn, self.detector)
        pixel_light = software_image(pixels, self.detector)
        raw_peak = float(light.max(initial=0.0))
        return DarkSubtracted(path, pixel_light - dark, raw_peak, floor_dn)

    def read(self, path: Path) -> FloatArray:
        """An image of the tracker (h, w), DN, of a mosaic its superpixels."""
        return np.asarray(software_image(self.pixels(path), self.file.config.tracker.detector))

    def pixels(self, path: Path) -> FloatArray:
        """The pixels (h, w) of an image of the tracker, DN."""
        return self.source.pixels(path, self.file.config.tracker.resolution_px)

    @property
    def full_dn(self) -> float:
        """The level at which the tracker saturates: its ADC's last code, or its full well, DN."""
        return self.file.config.tracker.detector.saturation_dn

    def is_too_bright(self, looked: DarkSubtracted) -> bool:
        """Whether pixels are near the end of the tracker's range."""
        return looked.raw_peak > MAX_FILL * self.full_dn

    def darker(self, code: int) -> int:
        """The code of about a quarter of the light. Raises InputError where none is left."""
        return darker_code(code)


def darker_code(code: int) -> int:
    """The code of about a quarter of the light. Raises InputError where none is left."""
    lower = int(np.floor(code / LIGHT_STEP ** (1 / 2.2)))
    if lower < 1:
        raise InputError(
            "the tracker is saturated by the darkest code; expose shorter, and write [tracker]"
            " exposure_s so"
        )
    return lower


def calibration_of(context: StepContext) -> Calibration:
    """The calibration that the bench file names."""
    monitor = context.monitor
    return load_calibration(calibration_source(monitor, context.file.folder), monitor.bits)
