"""What the twin measured, on its way from the comparison to the verdict."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from hilstar.bench.config import BenchConfig
from hilstar.monitor.calibration import Calibration
from hilstar.scene.camera import Camera
from hilstar.tracker.centroiders import FAMILY, Centroider
from hilstar.twin.bench_geometry import Mirror
from hilstar.twin.verify.displacement import Displaced


@dataclass(frozen=True, slots=True)
class Star:
    """One star at its place on the tracker, px: errors of the display, + too faint, right and down, magnitudes and px.

    `codes_mag`, `codes_px` are what the codes would cost on the monitor that the bench assumes, NaN where that star would
    be lost; `floor_mag`, `floor_px` are the estimator's own, of the linear image against catalogue and sky. A body has a
    `name`, and 0 for `hip`.
    """

    hip: int
    v_mag: float
    x_px: float
    y_px: float
    flux_mag: float
    dx_px: float
    dy_px: float
    codes_mag: float
    codes_px: float
    floor_mag: float
    floor_px: float
    name: str = ""


@dataclass(slots=True)
class Tally:
    """Stars by what became of them, added up over the fields.

    `summed` stars are part of a brighter one that the tracker cannot part from them. `displaced` are the stars that the display
    really shows, however far off. `vanished` counts how many fewer are found than the sky has, `mirrored` those found where a
    screen so mirrored would show them; `noisy_mag`, `noisy_px` are the errors with all of the detector's noise.
    `off_px` has how far off each kind of centroider finds each of `stars`.
    """

    stars: list[Star] = field(default_factory=list)
    lost: list[Star] = field(default_factory=list)
    displaced: list[Displaced] = field(default_factory=list)
    blended: int = 0
    summed: int = 0
    clipped: int = 0
    not_shown: int = 0
    at_edge: int = 0
    vanished: int = 0
    mirrored: Counter[Mirror] = field(default_factory=Counter)
    noisy_mag: list[float] = field(default_factory=list)
    noisy_px: list[float] = field(default_factory=list)
    off_px: dict[Centroider, list[float]] = field(default_factory=lambda: {kind: [] for kind in FAMILY})


@dataclass(frozen=True, slots=True)
class Glow:
    """The light of the screen's black level in a tracker pixel, electrons per second: as assumed, as seen, and their limit."""

    assumed_e_per_s_px: float
    seen_e_per_s_px: float
    limit_e_per_s_px: float


@dataclass(frozen=True, slots=True)
class Measured:
    """All fields, and what a verdict has to know of the bench; `wide_bodies` says which bodies are drawn as discs.

    `calibration` is the one that the bench assumes; `true_calibration` is the monitor's own, where it is another.
    """

    field_count: int
    tally: Tally
    config: BenchConfig
    camera: Camera
    glow: Glow
    calibration: Calibration
    true_calibration: Calibration | None
    gl_renderer: str
    wide_bodies: list[str]
