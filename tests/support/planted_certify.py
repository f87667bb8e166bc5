"""Benches whose truth is planted: what `hilstar certify` has to find, drawn without any of its code."""

from __future__ import annotations

import datetime
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from hilstar.bench.bench_file import read_bench_file
from hilstar.certify import assembly, certificate
from hilstar.certify.budget import BATCH
from hilstar.certify.readings import VirtualReader

NOW = datetime.datetime(2026, 11, 26, tzinfo=datetime.UTC)

GRID = (9, 16)
BENCH = """[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
resolution_px = [1024, 1024]
quantum_efficiency = "ccd47-20"
[sky]
epoch_jyear = 2026.0
faintest_v_mag = 7.5
[monitor]
resolution_px = [1920, 1080]
pixel_pitch_um = 57.65
calibration = "{calibration}"
panel_delay_ms = {delay_ms}
photodiode_px = 40
[collimator]
focal_length_mm = 350
{geometry}
[render]
flux_at_white_e_per_s = {white}
sprite_sigma_px = [0.85, 0.85]
"""


@dataclass(frozen=True)
class Plant:
    """What is drawn of a bench: one number each, so that a test can hold one and draw the others."""

    gamma: float
    wave: float
    black: float
    fall: float
    k1: float
    k2: float
    tilt_deg: tuple[float, float]
    mount_arcsec: tuple[float, float, float]
    focal: float
    white: float
    delay_ms: float
    drift_percent_per_h: float
    reading_noise: float
    dot_noise_px: float


def drawn(rng: np.random.Generator) -> Plant:
    """A bench at random."""
    return Plant(
        gamma=rng.uniform(1.9, 2.5),
        wave=rng.normal(0, 0.03),
        black=rng.uniform(0, 0.002),
        fall=rng.uniform(0, 0.2),
        k1=rng.normal(0, 0.05),
        k2=rng.normal(0, 0.2),
        tilt_deg=(rng.normal(0, 1.0), rng.normal(0, 1.0)),
        mount_arcsec=(rng.normal(0, 60), rng.normal(0, 60), rng.normal(0, 60)),
        focal=rng.normal(0, 0.003),
        white=2.6e6 * float(np.exp(rng.normal(0, 0.1))),
        delay_ms=rng.uniform(2, 20),
        drift_percent_per_h=rng.normal(0, 2.0),
        reading_noise=rng.uniform(0.001, 0.004),
        dot_noise_px=rng.uniform(0.01, 0.04),
    )


def plant(folder: Path, one: Plant, bench_keys: str = "", truth_keys: str = "") -> tuple[Path, Path]:
    """Write BENCH.toml, which knows nothing of the plant, and TRUTH.toml with its files; their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    codes = np.arange(256) / 255
    light = codes**one.gamma * (1 + one.wave * np.sin(4 * codes)) / (1 + one.wave * np.sin(4.0)) + one.black
    rows = "".join(f"{code},{value!r}\n" for code, value in enumerate(light.tolist()))
    (folder / "true-response.csv").write_text("code,w\n" + rows)
    y, x = ((np.arange(n) + 0.5) / n * 2 - 1 for n in GRID)
    grid = 1 - one.fall * (x[None] ** 2 + 0.3 * y[:, None] ** 2) / 1.3
    (folder / "true-even.csv").write_text("".join(",".join(map(repr, row)) + "\n" for row in grid.tolist()))
    (folder / "true-light.toml").write_text(
        '[calibration]\nkind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\nbits = 8\n'
        'response = "true-response.csv"\n[uniformity]\nfile = "true-even.csv"\n'
    )
    a, b, c = (angle / 3600 / 57.29577951308232 / 2 for angle in one.mount_arcsec)
    w = float(np.sqrt(1 - a * a - b * b - c * c))
    (folder / "true-lens.toml").write_text(
        'kind = "hilstar geometry 1"\nresolution_px = [1920, 1080]\n'
        f"focal_length_px = {350e3 / 57.65 * (1 + one.focal)!r}\nprincipal_point_px = [959.5, 539.5]\n"
        f"q_cam_to_mon = [{w!r}, {a!r}, {b!r}, {c!r}]\ntilt_deg = [{one.tilt_deg[0]!r}, {one.tilt_deg[1]!r}]\n"
        f"k1 = {one.k1!r}\nk2 = {one.k2!r}\n"
    )
    bench = BENCH.format(calibration="srgb", delay_ms=8.0, geometry="", white=2.6e6)
    truth = BENCH.format(
        calibration="true-light.toml", delay_ms=one.delay_ms, geometry='geometry = "true-lens.toml"', white=one.white
    )
    (folder / "bench.toml").write_text(bench + bench_keys)
    (folder / "truth.toml").write_text(
        f"{truth}[certify.virtual]\nreading_noise = {one.reading_noise!r}\ndot_noise_px = {one.dot_noise_px!r}\n"
        f"drift_percent_per_h = {one.drift_percent_per_h!r}\n{truth_keys}"
    )
    return folder / "bench.toml", folder / "truth.toml"


def coverage(benches: int, seed: int, keys: str = "") -> dict[tuple[str, str], list[bool]]:
    """By quantity and region, whether each stated interval holds the truth."""
    rng, held = np.random.default_rng(seed), defaultdict(list)
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        # Every bench file is the same, so that its stars are; one batch of trials knows an end within 2 % of the half width.
        first = read_bench_file(plant(Path(folder), drawn(np.random.default_rng(0)), f"[certify]\nfields = 1\n{keys}")[0])
        stars = assembly.reference_stars(first)
        patch.setattr(assembly, "reference_stars", lambda file: stars)
        patch.setattr(certificate, "QUICK_TRIALS", BATCH)
        for number in range(benches):
            paths = plant(Path(folder), drawn(rng), f"[certify]\nfields = 1\n{keys}")
            bench, truth = (read_bench_file(path) for path in paths)
            assert bench.sha256 == first.sha256
            found, _ = certificate.certify(bench, VirtualReader(bench, truth, 1_000_003 * seed + number), NOW, quick=True)
            for each in found.figures:
                if each.truth is not None:
                    region = "field" if each.region.startswith("field") else each.region
                    held[each.quantity, region].append(each.lower <= each.truth <= each.upper)
    return dict(held)
