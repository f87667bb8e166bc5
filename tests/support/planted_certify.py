"""Benches whose truth is planted: what `hilstar certify` has to find, drawn without any of its
code.
"""

from __future__ import annotations

import datetime
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from hilstar.instruments.calibrate.first_light.image_sources import VirtualBench
from hilstar.instruments.certify import assembly, certificate, structure
from hilstar.instruments.certify.budget import BATCH
from hilstar.instruments.certify.model import ReferenceStar
from hilstar.instruments.certify.readings import ImageReader
from hilstar.server.bench.bench_file import BenchFile, bench_file_of, read_bench_file
from tests.support.planted_readings import (
    ARCSEC,
    DELAY_MS,
    LENS_ARCSEC,
    SEEN_TANGENT,
    TRACKER_K1,
    WHITE_E_PER_S,
    PlantedReader,
    Truth,
    true_figures,
)

if TYPE_CHECKING:
    from collections.abc import Collection

    from hilstar.server.bench.certificate_file import Certificate

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


def stated_bench(keys: str = "") -> BenchFile:
    """The bench with these lines added, as it is read: of an sRGB monitor and a plain lens."""
    text = BENCH.format(calibration="srgb", delay_ms=DELAY_MS, geometry="", white=WHITE_E_PER_S)
    return bench_file_of(Path("bench.toml"), f"{text}{keys}")


def reference_star(**changes: Any) -> ReferenceStar:
    """A star of the first field's left third, of one level of full light in one pixel."""
    whole = ReferenceStar(
        hip=1,
        row=0,
        v_mag=5.0,
        b_v_mag=0.5,
        field=0,
        third=0,
        x_px=100.0,
        y_px=100.0,
        direction=np.array([0.0, 0.0, 1.0]),
        quantised_mag=0.0,
        log_light=np.zeros(1),
        share=np.ones(1),
        pixel_px=np.zeros((1, 2), dtype=np.intp),
    )
    return replace(whole, **changes)


@dataclass(frozen=True)
class Plant:
    """What is drawn of a bench: one number each, so that a test can hold one and draw the
    others.
    """

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


def plant(
    folder: Path, one: Plant, bench_keys: str = "", truth_keys: str = ""
) -> tuple[Path, Path]:
    """Write BENCH.toml, which knows nothing of the plant, and TRUTH.toml with its files; their
    paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    codes = np.arange(256) / 255
    light = (
        codes**one.gamma * (1 + one.wave * np.sin(4 * codes)) / (1 + one.wave * np.sin(4.0))
        + one.black
    )
    rows = "".join(f"{code},{value!r}\n" for code, value in enumerate(light.tolist()))
    (folder / "true-response.csv").write_text("code,w\n" + rows)
    y, x = ((np.arange(n) + 0.5) / n * 2 - 1 for n in GRID)
    grid = 1 - one.fall * (x[None] ** 2 + 0.3 * y[:, None] ** 2) / 1.3
    (folder / "true-even.csv").write_text(
        "".join(",".join(map(repr, row)) + "\n" for row in grid.tolist())
    )
    (folder / "true-light.toml").write_text(
        '[calibration]\nkind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\nbits'
        ' = 8\nresponse = "true-response.csv"\n[uniformity]\nfile = "true-even.csv"\n'
    )
    a, b, c = (angle / 3600 / 57.29577951308232 / 2 for angle in one.mount_arcsec)
    w = float(np.sqrt(1 - a * a - b * b - c * c))
    (folder / "true-lens.toml").write_text(
        'kind = "hilstar geometry 1"\nresolution_px = [1920, 1080]\nfocal_length_px ='
        f" {350e3 / 57.65 * (1 + one.focal)!r}\nprincipal_point_px = [959.5, 539.5]\nq_cam_to_mon ="
        f" [{w!r}, {a!r}, {b!r}, {c!r}]\ntilt_deg = [{one.tilt_deg[0]!r}, {one.tilt_deg[1]!r}]\nk1"
        f" = {one.k1!r}\nk2 = {one.k2!r}\n"
    )
    bench = BENCH.format(calibration="srgb", delay_ms=8.0, geometry="", white=2.6e6)
    truth = BENCH.format(
        calibration="true-light.toml",
        delay_ms=one.delay_ms,
        geometry='geometry = "true-lens.toml"',
        white=one.white,
    )
    (folder / "bench.toml").write_text(bench + bench_keys)
    (folder / "truth.toml").write_text(
        f"{truth}[certify.virtual]\nreading_noise = {one.reading_noise!r}\ndot_noise_px ="
        f" {one.dot_noise_px!r}\ndrift_percent_per_h = {one.drift_percent_per_h!r}\n{truth_keys}"
    )
    return folder / "bench.toml", folder / "truth.toml"


@dataclass
class Counted:
    """A figure of a kind and region over many benches: whether each interval held the truth, its
    error and its uncertainty.

    `absent` counts the benches whose certificate did not assess it.
    """

    held: list[bool] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    standard: list[float] = field(default_factory=list)
    absent: int = 0

    @property
    def ratio(self) -> float:
        """The stated uncertainty over the true error, by the median of their ratios: 1 where
        errors are as large as stated.
        """
        return NORMAL_MEDIAN / float(
            np.median(np.abs(self.error) / np.maximum(self.standard, 1e-300))
        )


NORMAL_MEDIAN = 0.6745  # of the size of a normal error, in sigmas
REGIONS = ("left third", "middle third", "right third")
QUANTITIES = (
    "flux",
    "place_along",
    "place_across",
    "attitude_x",
    "attitude_y",
    "attitude_z",
    "latency",
)
EXACT_LENS = "[certify.tracker]\nname = 'planted'\ndirection_expanded_arcsec = 0.0\n"


def stated_lens() -> str:
    """A statement of the tracker's lens as it is planted in `own_lens`, k = 2."""
    edge_arcsec = TRACKER_K1 * SEEN_TANGENT**3 * ARCSEC
    return f"{EXACT_LENS}distortion_expanded_arcsec = {2 * edge_arcsec!r}\n"


def stated_directions() -> str:
    """A statement of the tracker's directions as they are planted in `own_directions`, k = 2."""
    expanded = f"direction_expanded_arcsec = {2 * LENS_ARCSEC!r}"
    return f"[certify.tracker]\nname = 'planted'\n{expanded}\n"


After = Callable[[int, dict[tuple[str, str], Counted]], None]

# What a part of a certificate is read by; the figures that it tells.
LIGHT, PLACE, DELAY = "light", "place", "delay"
PARTS = {
    LIGHT: QUANTITIES[:1],
    PLACE: QUANTITIES[1:6],
    DELAY: QUANTITIES[6:],
}


def coverage(
    draw: Callable[[np.random.Generator], Truth],
    benches: int,
    seed: int,
    keys: str = "",
    tables: str = EXACT_LENS,
    parts: tuple[str, ...] = (LIGHT, PLACE, DELAY),
    after: After | None = None,
) -> dict[tuple[str, str], Counted]:
    """Certify planted benches of a kind by their readings and count, by quantity and region.

    `after` gets the number of benches and the counts after each.
    Of `parts` alone each bench's fits are made and its figures are counted: the others are the
    first bench's, which no figure of `parts` goes by.
    """
    found: dict[tuple[str, str], Counted] = defaultdict(Counted)
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        path = Path(folder) / "bench.toml"
        bench = BENCH.format(
            calibration="srgb", delay_ms=DELAY_MS, geometry="", white=WHITE_E_PER_S
        )
        path.write_text(f"{bench}[certify]\nfields = 1\n{keys}{tables}")
        file = read_bench_file(path)
        # Every bench file is the same, so that its stars are, and what the sky adds to them; one
        # batch of trials knows an end within 2 % of the half width.
        for name in ("reference_stars", "of_sky"):
            patch.setattr(assembly, name, _once(getattr(assembly, name)))
        patch.setattr(certificate, "QUICK_TRIALS", BATCH)
        without_check(patch)
        patch.setattr(structure, "_diagonal_in_time", _for_each(structure._diagonal_in_time))
        if LIGHT not in parts:
            patch.setattr(assembly, "light_deviation", _once(assembly.light_deviation))
            patch.setattr(assembly, "evenness", _once(assembly.evenness))
        if PLACE not in parts:
            patch.setattr(assembly, "lens_fit", _once(assembly.lens_fit))
        stars = assembly.reference_stars(file)
        counted = [quantity for part in parts for quantity in PARTS[part]]
        for number in range(benches):
            rng = np.random.default_rng((seed, number))
            one = draw(rng)
            certified, _ = certificate.certify(file, PlantedReader(one, rng), NOW, quick=True)
            count(certified, true_figures(one, stars), found, counted)
            if after is not None:
                after(number + 1, found)
    return dict(found)


def without_check(patch: pytest.MonkeyPatch) -> None:
    """A certificate takes its first check, which is in no figure of it: here it does not."""
    patch.setattr(certificate, "take_check", lambda file, reader: None)


def _for_each(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of moments and a length that keeps its results: all benches have the same."""
    results: dict[tuple[bytes, float], Any] = {}

    def kept(t: np.ndarray, length: float) -> Any:
        key = t.tobytes(), length
        if key not in results:
            results[key] = function(t, length)
        return results[key]

    return kept


def _once(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that gives its first result again, whatever it is asked."""
    results: list[Any] = []

    def first(*arguments: object) -> object:
        if not results:
            result = function(*arguments)
            results.append(result if not isinstance(result, Iterator) else list(result))
        return results[0]

    return first


DETECTOR = "[tracker.detector]\nread_noise_e = 15\n"


def coverage_by_images(
    benches: int, seed: int, after: After | None = None, tables: str = ""
) -> dict[tuple[str, str], Counted]:
    """The same by images of the tracker, each drawn: the truth is a file, and hilstar's own twin
    draws it. `tables` are further keys of [certify].
    """
    found: dict[tuple[str, str], Counted] = defaultdict(Counted)
    with pytest.MonkeyPatch.context() as patch:
        without_check(patch)
        stars = None
        for number in range(benches):
            with TemporaryDirectory() as name:
                folder, keys = Path(name), f"[certify]\nfields = 1\n{tables}{EXACT_LENS}{DETECTOR}"
                # The virtual monitor warms up from its first image on: with a drift the truth file
                # is not the first reading's.
                one = replace(drawn(np.random.default_rng((seed, number))), drift_percent_per_h=0.0)
                bench, truth = (
                    read_bench_file(path) for path in plant(folder, one, keys, DETECTOR)
                )
                if stars is None:
                    stars = assembly.reference_stars(bench)
                    patch.setattr(assembly, "reference_stars", lambda file, stars=stars: stars)
                images = folder / "images"
                images.mkdir()
                with closing(VirtualBench(bench, truth, number)) as source:
                    certified, _ = certificate.certify(
                        bench, ImageReader(bench, source, images, truth), NOW, quick=True
                    )
            figures = [each for each in certified.figures if each.truth is not None]
            count(certified, {(each.quantity, each.star): each.truth for each in figures}, found)
            if after is not None:
                after(number + 1, found)
    return dict(found)


def count(
    certified: Certificate,
    truth: dict[tuple[str, int | None], float],
    found: dict[tuple[str, str], Counted],
    quantities: Collection[str] = QUANTITIES,
) -> None:
    """Add one certificate's figures of some quantities to the counts."""
    stated = [each for each in certified.figures if each.quantity in quantities]
    for each in stated:
        region = "field" if each.region.startswith("field") else each.region
        one, true = found[each.quantity, region], truth[each.quantity, each.star]
        one.held.append(each.lower <= true <= each.upper)
        one.error.append(each.value - true)
        one.standard.append(each.standard_uncertainty)
    of_truth = {name for name, _ in truth} & set(quantities)
    for quantity in of_truth - {each.quantity for each in stated}:
        for region in (
            REGIONS
            if quantity in QUANTITIES[:3]
            else ("screen" if quantity == "latency" else "field",)
        ):
            found[quantity, region].absent += 1
