"""Benches by chance: a bench file as its user writes it from data sheets, and the truth that the
user does not know.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import from_rotation_vector, multiply, to_matrix
from hilstar.basics.toml_tables import toml_text
from hilstar.display.calibration import (
    CalibrationHead,
    NotesTable,
    add_uniformity,
    write_calibration,
)
from hilstar.display.geometry import ErrorTable, MadeTable, Notes, write_geometry
from hilstar.display.response import srgb_response
from hilstar.optics.camera import Camera, Lens
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import full_scale_e_per_s

# Panels that labs have: kind, range of pixel pitch in um, sizes.
PANELS = (
    ("microdisplay", (6.0, 12.0), ((800, 600), (1280, 1024), (1920, 1080), (1920, 1200))),
    ("phone", (45.0, 80.0), ((1920, 1080), (2560, 1440), (3840, 2160))),
    ("laptop", (90.0, 180.0), ((1920, 1080), (2560, 1600), (3840, 2160))),
    ("4K and 5K monitor", (116.0, 185.0), ((3840, 2160), (5120, 2880))),
    ("8K monitor", (92.0, 182.0), ((7680, 4320),)),
    ("office monitor", (233.0, 311.0), ((1280, 1024), (1920, 1080), (1920, 1200), (2560, 1440))),
)
PANEL_WEIGHTS = (0.25, 0.1, 0.2, 0.15, 0.05, 0.25)
DETECTORS_PX = (
    (256, 256),
    (512, 512),
    (640, 480),
    (1024, 1024),
    (1280, 1024),
    (2048, 2048),
    (2592, 1944),
    (4096, 4096),
)
DETECTOR_WEIGHTS = (0.12, 0.16, 0.1, 0.22, 0.1, 0.18, 0.07, 0.05)
# Of small benches, which a test can afford.
SMALL_PANELS_PX, SMALL_DETECTORS_PX = (
    ((400, 300), (480, 320), (640, 480)),
    ((160, 160), (200, 150), (256, 256)),
)
FOCAL_MM, TRACKER_PITCH_UM, PSF_PX = (20.0, 150.0), (2.2, 15.0), (0.35, 3.0)
F_NUMBERS, COLLIMATORS_MM = (1.0, 4.0), (12.0, 4000.0)
TRACKER_FIELD_DEG, MAX_SCREEN_DEG = (0.5, 60.0), 80.0
SEEN = (0.02, 3.0)  # the tracker's field over the screen, as areas
PIXEL_RATIOS = (0.05, 8.0)  # tracker pixels to a monitor pixel
MAX_TILT_DEG, MAX_FOCAL_ERROR, MAX_ROLL_DEG = 3.0, 0.015, 3.0
FULL_WELL_E_PER_UM2 = (300.0, 1500.0)
MAX_HOT_PIXELS, MAX_READ_NOISE_E = 1e-4, 20.0
EXPOSURES_S = (0.05, 0.1, 0.2, 0.5)  # 20 s of the longest are answers enough for `assess`
REFRESH_HZ = 60
STARS_IN_FIELD = 40  # that a user wants, and chooses the faintest magnitude for
DECADES_FAINTER = 5.5  # magnitudes from the brightest star that is shown whole to the faintest
# Hipparcos has 0.12 stars to a square degree up to V = 6 and three times as many a magnitude
# fainter.
STARS_A_DEG2_AT_6, STARS_A_MAG = 0.12, 0.48
FAINTEST_V_MAG = (4.0, 9.5)
# Electrons a second and a square metre from V = 0 through 0.85 of glass with a quantum efficiency
# of 0.6 over the visible.
V0_E_PER_S_M2 = 1.5e10
FAINTEST_SNR = 5.0
GRID = (9, 16)
NOTES = Notes({}, ErrorTable(), MadeTable(by="planted", poses=1))


@dataclass(frozen=True)
class Panel:
    """A screen: its kind, size and pitch, bits, and light from black to white."""

    kind: str
    size_px: tuple[int, int]
    pitch_um: float
    bits: int
    law: str
    gamma: float
    black: float
    fall: float
    stated_law: str


@dataclass(frozen=True)
class Detector:
    """A tracker's sensor and lens, with the true PSF and the one of the data sheet."""

    size_px: tuple[int, int]
    pitch_um: float
    focal_mm: float
    f_number: float
    psf_px: float
    stated_psf_px: float
    full_well_e: float
    read_noise_e: float
    hot_pixels: float

    @property
    def tangents(self) -> tuple[float, float]:
        """Tangents of half the field, across and down."""
        width, height = (size * self.pitch_um / 2000 / self.focal_mm for size in self.size_px)
        return width, height


@dataclass(frozen=True)
class Mounting:
    """How the screen really stands behind the collimator."""

    flip_x: bool
    rotate_deg: int
    roll_deg: float
    offset_deg: tuple[float, float]
    tilt_deg: tuple[float, float]
    focal_error: float
    white_mag: float
    delay_ms: float


@dataclass(frozen=True)
class DrawnBench:
    """A bench by chance: what it is, and the sky that its user chose for it."""

    panel: Panel
    detector: Detector
    mounting: Mounting
    collimator_mm: float
    seen: float
    exposure_s: float
    faintest_v_mag: float
    photodiode: bool

    @property
    def pixel_ratio(self) -> float:
        """Tracker pixels to a monitor pixel."""
        on_sky = self.panel.pitch_um / self.collimator_mm
        return on_sky * self.detector.focal_mm / self.detector.pitch_um

    def planted(self) -> dict[str, Any]:
        """All of it as the columns of a table."""
        table: dict[str, Any] = {}
        for part in ("panel", "detector", "mounting"):
            for key, value in dataclasses.asdict(getattr(self, part)).items():
                text = (
                    " x ".join(f"{each:.6g}" for each in value)
                    if isinstance(value, tuple)
                    else value
                )
                table[f"{part}_{key}"] = text
        own = ("collimator_mm", "seen", "exposure_s", "faintest_v_mag", "photodiode")
        return table | {key: getattr(self, key) for key in own} | {"pixel_ratio": self.pixel_ratio}


def drawn_bench(seed: int, number: int, *, is_small: bool = False) -> DrawnBench:
    """Bench `number` of a seed; the same whatever other benches are drawn. A small one has few
    pixels, and is another.
    """
    rng = np.random.default_rng((seed, number))
    while True:
        panel, detector = _panel(rng), _detector(rng)
        if is_small:
            panel = dataclasses.replace(
                panel, size_px=SMALL_PANELS_PX[rng.integers(len(SMALL_PANELS_PX))]
            )
            detector = dataclasses.replace(
                detector, size_px=SMALL_DETECTORS_PX[rng.integers(len(SMALL_DETECTORS_PX))]
            )
        seen = _log_uniform(rng, SEEN)
        field = math.prod(detector.tangents)
        screen_mm2 = math.prod(panel.size_px) * panel.pitch_um**2 / 4e6
        collimator_mm = math.sqrt(seen * screen_mm2 / field)
        bench = DrawnBench(
            panel,
            detector,
            _mounting(rng, detector),
            collimator_mm,
            seen,
            0.1,
            6.0,
            bool(rng.random() < 0.5),
        )
        if _is_built(bench):
            return _with_sky(bench)


def _is_built(bench: DrawnBench) -> bool:
    """Whether lenses of such fields and lengths are sold."""
    low_deg, high_deg = TRACKER_FIELD_DEG
    width_deg, height_deg = (
        2 * math.degrees(math.atan(tangent)) for tangent in bench.detector.tangents
    )
    width_px, height_px = bench.panel.size_px
    diagonal_mm = math.hypot(width_px, height_px) * bench.panel.pitch_um / 1000
    screen_deg = 2 * math.degrees(math.atan(diagonal_mm / 2 / bench.collimator_mm))
    fields = height_deg >= low_deg and width_deg <= high_deg and screen_deg <= MAX_SCREEN_DEG
    lengths = COLLIMATORS_MM[0] <= bench.collimator_mm <= COLLIMATORS_MM[1]
    return fields and lengths and PIXEL_RATIOS[0] <= bench.pixel_ratio <= PIXEL_RATIOS[1]


def _log_uniform(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    low, high = np.log(limits)
    return float(np.exp(rng.uniform(low, high)))


def _panel(rng: np.random.Generator) -> Panel:
    kind, pitches_um, sizes_px = PANELS[rng.choice(len(PANELS), p=PANEL_WEIGHTS)]
    law = str(rng.choice(["srgb", "gamma", "s-curve"], p=[0.3, 0.4, 0.3]))
    return Panel(
        kind=kind,
        size_px=sizes_px[rng.integers(len(sizes_px))],
        pitch_um=round(float(rng.uniform(*pitches_um)), 2),
        bits=int(rng.choice([8, 10], p=[0.7, 0.3])),
        law=law,
        gamma=float(rng.uniform(1.8, 2.6)),
        black=float(rng.choice([0.0, 1.0]) * _log_uniform(rng, (1e-5, 2e-3))),
        fall=float(rng.choice([0.0, 1.0], p=[0.3, 0.7]) * rng.uniform(0.02, 0.3)),
        stated_law=str(rng.choice(["srgb", "gamma2.2"])),
    )


def _detector(rng: np.random.Generator) -> Detector:
    pitch_um = round(_log_uniform(rng, TRACKER_PITCH_UM), 2)
    psf_px = _log_uniform(rng, PSF_PX)
    full_well_e = min(pitch_um**2 * rng.uniform(*FULL_WELL_E_PER_UM2), 3e5)
    return Detector(
        size_px=DETECTORS_PX[rng.choice(len(DETECTORS_PX), p=DETECTOR_WEIGHTS)],
        pitch_um=pitch_um,
        focal_mm=round(_log_uniform(rng, FOCAL_MM), 1),
        f_number=_log_uniform(rng, F_NUMBERS),
        psf_px=psf_px,
        stated_psf_px=round(psf_px * float(rng.uniform(0.85, 1.15)), 2),
        full_well_e=float(np.rint(full_well_e)),
        read_noise_e=round(float(rng.uniform(1.0, MAX_READ_NOISE_E)), 1),
        hot_pixels=float(rng.choice([0.0, 1.0]) * rng.uniform(0, MAX_HOT_PIXELS)),
    )


def _mounting(rng: np.random.Generator, detector: Detector) -> Mounting:
    smallest_deg = 2 * math.degrees(math.atan(min(detector.tangents)))
    any_angle = rng.random() < 0.3
    roll_deg = rng.uniform(-45, 45) if any_angle else rng.uniform(-MAX_ROLL_DEG, MAX_ROLL_DEG)
    right_deg, down_deg = rng.uniform(-0.03, 0.03, 2) * smallest_deg
    tilt_a_deg, tilt_b_deg = rng.uniform(-MAX_TILT_DEG, MAX_TILT_DEG, 2)
    return Mounting(
        flip_x=bool(rng.random() < 0.4),
        rotate_deg=int(rng.choice([0, 90, 180, 270], p=[0.6, 0.1, 0.2, 0.1])),
        roll_deg=float(roll_deg),
        offset_deg=(float(right_deg), float(down_deg)),
        tilt_deg=(float(tilt_a_deg), float(tilt_b_deg)),
        focal_error=float(rng.uniform(-MAX_FOCAL_ERROR, MAX_FOCAL_ERROR)),
        white_mag=float(rng.uniform(-0.3, 0.3)),
        delay_ms=float(rng.uniform(2, 20)),
    )


def _with_sky(bench: DrawnBench) -> DrawnBench:
    """The faintest star and the exposure that a user takes: so many stars in view, each above
    the noise.
    """
    across, down = bench.detector.tangents
    field_deg2 = math.degrees(2 * math.atan(across)) * math.degrees(2 * math.atan(down))
    field_deg2 *= min(1.0, 1 / bench.seen)
    wanted = 6 + math.log10(STARS_IN_FIELD / field_deg2 / STARS_A_DEG2_AT_6) / STARS_A_MAG
    faintest = min(max(wanted, FAINTEST_V_MAG[0]), FAINTEST_V_MAG[1])
    aperture_m = bench.detector.focal_mm / bench.detector.f_number / 1000
    wide_px = math.hypot(bench.detector.psf_px, 0.9 * bench.pixel_ratio, 0.3)
    noise_e = FAINTEST_SNR * bench.detector.read_noise_e * 4 * math.pi * wide_px**2
    for exposure_s in EXPOSURES_S:
        white_e = V0_E_PER_S_M2 * math.pi / 4 * aperture_m**2 * exposure_s
        visible = 2.5 * math.log10(white_e / noise_e)
        if visible >= faintest:
            break
    chosen = round(min(faintest, max(visible, FAINTEST_V_MAG[0])), 1)
    return dataclasses.replace(bench, exposure_s=exposure_s, faintest_v_mag=chosen)


def true_light(panel: Panel) -> FloatArray:
    """Light of each code, black level included, relative to white above black."""
    codes = np.arange(2**panel.bits) / (2**panel.bits - 1)
    if panel.law == "srgb":
        light = np.asarray(srgb_response(panel.bits).light)
    elif panel.law == "gamma":
        light = codes**panel.gamma
    else:
        # Between a power law and a logistic's rise: steep in the middle, flat towards white, still
        # rising everywhere.
        rise = np.tanh(2.2 * codes - 0.4) + np.tanh(0.4)
        light = codes ** (panel.gamma - 1) * rise
        light = light / light[-1]
    return np.asarray(light + panel.black)


def write_bench(bench: DrawnBench, folder: Path) -> tuple[Path, Path]:
    """Write bench.toml, which knows nothing of the truth, and truth.toml with its files; their
    paths.
    """
    panel, detector, mounting = bench.panel, bench.detector, bench.mounting
    tracker = {
        "aperture_mm": round(detector.focal_mm / detector.f_number, 2),
        "focal_length_mm": detector.focal_mm,
        "pixel_pitch_um": detector.pitch_um,
        "resolution_px": list(detector.size_px),
        "exposure_s": bench.exposure_s,
        "psf_sigma_px": [detector.stated_psf_px] * 2,
        "quantum_efficiency": 0.6,
        "transmission": 0.85,
    }
    sensor = {
        "full_well_e": detector.full_well_e,
        "gain_e_per_dn": detector.full_well_e / 4000,
        "bits": 12,
        "offset_dn": 40,
        "read_noise_e": detector.read_noise_e,
        "dark_e_per_s": 20,
    }
    monitor = {
        "resolution_px": list(panel.size_px),
        "pixel_pitch_um": panel.pitch_um,
        "refresh_hz": REFRESH_HZ,
    }
    monitor |= {"bits": panel.bits, "calibration": panel.stated_law}
    monitor |= {"photodiode_px": 40 if bench.photodiode else 0}
    sky = {"epoch_jyear": 2026.0, "faintest_v_mag": bench.faintest_v_mag}
    render = {"brightest_v_mag": round(max(1.5, bench.faintest_v_mag - DECADES_FAINTER), 1)}
    tables: dict[str, dict[str, Any]] = {
        "tracker": tracker | {"detector": sensor},
        "sky": sky,
        "monitor": monitor,
        "collimator": {"focal_length_mm": round(bench.collimator_mm, 2)},
        "render": render,
    }
    (folder / "bench.toml").write_text(toml_text(tables))
    white_e_per_s = full_scale_e_per_s(read_bench_file(folder / "bench.toml"))
    _write_true_light(panel, mounting, folder)
    size_px = panel.size_px if mounting.rotate_deg % 180 == 0 else panel.size_px[::-1]
    _write_true_lens(bench, size_px, folder)
    true_sensor = sensor | {
        "prnu": 0.005,
        "hot_pixel_fraction": detector.hot_pixels,
        "device_seed": 1,
    }
    truth = tables | {
        "tracker": tracker | {"psf_sigma_px": [detector.psf_px] * 2, "detector": true_sensor},
        "monitor": (
            monitor
            | {
                "resolution_px": list(size_px),
                "calibration": "true-light.toml",
                "flip_x": mounting.flip_x,
                "rotate_deg": mounting.rotate_deg,
                "panel_delay_ms": mounting.delay_ms,
            }
        ),
        "collimator": {
            "focal_length_mm": round(bench.collimator_mm, 2),
            "geometry": "true-lens.toml",
        },
        "render": {"flux_at_white_e_per_s": white_e_per_s * 10 ** (-0.4 * mounting.white_mag)},
    }
    (folder / "truth.toml").write_text(toml_text(truth))
    return folder / "bench.toml", folder / "truth.toml"


def _write_true_light(panel: Panel, mounting: Mounting, folder: Path) -> None:
    head = CalibrationHead(
        "photometric", "planted", "2026-11-28", "none", "relative", panel.bits, "true-response.csv"
    )
    path = folder / "true-light.toml"
    write_calibration(path, head, {"w": true_light(panel)}, 0.0, NotesTable())
    if panel.fall:
        y, x = ((np.arange(count) + 0.5) / count * 2 - 1 for count in GRID)
        grid = 1 - panel.fall * (x[None] ** 2 + 0.6 * y[:, None] ** 2) / 1.6
        upright = mounting.rotate_deg % 180 == 0
        add_uniformity(path, grid if upright else np.ascontiguousarray(grid.T))


def _write_true_lens(bench: DrawnBench, size_px: tuple[int, int], folder: Path) -> None:
    mounting = bench.mounting
    aside = from_rotation_vector(np.radians([mounting.offset_deg[1], mounting.offset_deg[0], 0.0]))
    q = multiply(from_rotation_vector(np.radians([0.0, 0.0, mounting.roll_deg])), aside)
    focal_px = bench.collimator_mm * 1000 / bench.panel.pitch_um * (1 + mounting.focal_error)
    tilt_a_deg, tilt_b_deg = mounting.tilt_deg
    lens = Lens(tilt_rad=(math.radians(tilt_a_deg), math.radians(tilt_b_deg)))
    centre = ((size_px[0] - 1) / 2, (size_px[1] - 1) / 2)
    write_geometry(
        folder / "true-lens.toml", Camera(size_px, focal_px, centre, to_matrix(q), lens), q, NOTES
    )
