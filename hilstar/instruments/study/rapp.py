"""RAPP 1 to 3 (thesis eq. 5.1 to 5.3): the spectral model of light over the average one.

They depend on the sensor: of the two that the thesis has (figures 5.19 and 5.22), and of a bench's
own, with the stars that it sees in the thesis's three fields and in any other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import structs

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import MUTED, SERIES, chart, label_ends, plain_ticks, write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import LIGHT_M_S
from hilstar.instruments.study.engine import ChartFinding, write_columns, write_findings
from hilstar.instruments.study.fields import SkyField, fields_of
from hilstar.instruments.study.study_benches import study_optics
from hilstar.optics.camera import Camera
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import tracker_camera
from hilstar.server.bench.star_light import bench_stars
from hilstar.server.bench.star_rates import bench_optics
from hilstar.sky.electrons import (
    REFERENCE_TEMPERATURE_K,
    Optics,
    Photometry,
    Weighting,
    ags_electrons_per_s,
    dgs_electrons_per_s,
    reference_mean_w_m2_m,
    v_band_mean_w_m2_m,
)
from hilstar.sky.spectrum import PLANCK_J_S, blackbody_exitance_w_m2_m, integration_nodes
from hilstar.sky.stars import Stars

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SENSORS = {"ccd47-20": "CCD47-20", "kai-4021": "KAI-4021 (approximate QE)"}
WEIGHTINGS: tuple[Weighting, ...] = ("energy", "photon")
QUOTED_K = (3000.0, 5000.0, 9000.0, 50_000.0)
TICKS_K = (3000, 5000, 9000, 15_000, 30_000, 50_000)
TEMPERATURES = 400
SAID_OF_THESIS = {  # section 5.4, of figures 5.19 and 5.22
    "ccd47-20": " (thesis: 15 % to 5 %)",
    "kai-4021": (
        "; RAPP1 at 50000 K is {:.2f}, and {:.2f} with any curve from 300 to 1050 nm (thesis: the"
        " CCD47-20's)"
    ),
}
RATIOS = ("irradiance", "photons", "electrons")
BENCH_FILES = (
    "rapp_bench.png",
    "rapp_bench.svg",
    "rapp_bench.csv",
    "rapp_stars.csv",
    "findings.csv",
)


class StarRatio(NamedTuple):
    """A star of a field, and its electrons by its spectrum over those of the average model."""

    field: str
    hip: int
    v_mag: float
    bv_mag: float
    temperature_k: float
    rapp3: float


@dataclass(frozen=True, slots=True)
class FieldRatios:
    """The stars (n,) of a field, and the electrons of each by its spectrum over the average
    model's.
    """

    field: SkyField
    star: npt.NDArray[np.intp]
    ratio: FloatArray

    @property
    def text(self) -> str:
        """The median and 90 % of the stars."""
        if not len(self.star):
            return f"{self.field.name}: no star"
        low, middle, high = np.percentile(self.ratio, (5, 50, 95))
        spread = f"median {middle:.2f}, 90 % from {low:.2f} to {high:.2f}"
        return f"{self.field.name}: {len(self.star)} stars, {spread}"


def rapp_ratios(temperature_k: FloatArray, optics: Optics, weighting: Weighting) -> FloatArray:
    """RAPP1, RAPP2 and RAPP3, shape (3, n): DGS over AGS in irradiance, photons and electrons."""
    photometry = Photometry(weighting=weighting)
    nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission)
    joule_m = PLANCK_J_S * LIGHT_M_S
    reference = reference_mean_w_m2_m(photometry)

    def in_range(kelvin: FloatArray, response: FloatArray) -> FloatArray:
        spectrum = blackbody_exitance_w_m2_m(nm, kelvin[:, None])
        scale = reference / v_band_mean_w_m2_m(kelvin, weighting)
        weights = response * weight_m
        return np.asarray(scale * (spectrum @ weights))

    ones = np.ones_like(nm)
    reference_k = np.array([REFERENCE_TEMPERATURE_K])
    average = in_range(reference_k, ones)[0]
    mean_nm = sum(optics.range_nm) / 2
    mean_photons_per_j = mean_nm * 1e-9 / joule_m
    irradiance = in_range(temperature_k, ones) / average
    photons_per_j = nm * 1e-9 / joule_m
    average_photons = average * mean_photons_per_j
    photons = in_range(temperature_k, photons_per_j) / average_photons
    spectral = dgs_electrons_per_s(temperature_k, optics, photometry)
    average_electrons = ags_electrons_per_s(optics, photometry)
    electrons = spectral / average_electrons
    return np.stack((irradiance, photons, electrons))


def _ratios(kelvin: FloatArray, optics: Optics) -> dict[Weighting, FloatArray]:
    """The three ratios (3, n) by weighting."""
    ratios = {}
    for weighting in WEIGHTINGS:
        ratios[weighting] = rapp_ratios(kelvin, optics, weighting)
    return ratios


def rapp(directory: Path, sensor: str) -> ChartFinding:
    """The three ratios of a sensor, 3000 to 50 000 K, for both passband weightings."""
    optics = study_optics(sensor)
    kelvin = _temperatures_k()
    ratios = _ratios(kelvin, optics)
    # which the range of wavelengths alone makes
    hottest_k = kelvin[-1:]
    full_range = study_optics("ccd47-20")
    in_full_range = rapp_ratios(hottest_k, full_range, "energy")
    coolest, cool, hot, hottest = _quoted(kelvin, ratios["energy"])
    thesis = SAID_OF_THESIS[sensor].format(ratios["energy"][0, -1], in_full_range[0, 0])
    hot_percent = 100 * (hot - 1)
    hottest_percent = 100 * (hottest - 1)
    text = (
        f"{SENSORS[sensor]}: the spectral model gives {coolest:.2f} times the electrons of the"
        f" average one at 3000 K, {cool:.2f} at 5000 K; at 9000 K they differ by"
        f" {hot_percent:+.1f} %, at 50000 K by {hottest_percent:+.1f} %{thesis}"
    )
    title = (
        f"{SENSORS[sensor]}: a black body of 3000 K gives {coolest:.2f} times the electrons of the"
        f" average model, one of 5000 K {cool:.2f} times"
    )
    note = _note(optics, "energy")
    with chart(directory / f"rapp_{sensor}", title, note=note) as (axes,):
        _draw_ratios(axes, ratios, "energy")
        _finish([axes])
    _write(directory / f"rapp_{sensor}.csv", kelvin, ratios)
    return ChartFinding(f"rapp_{sensor}", text)


def bench_rapp(
    directory: Path, file: BenchFile, radec_roll_deg: tuple[float, float, float] | None = None
) -> list[ChartFinding]:
    """The three ratios of a bench's tracker, and RAPP3 of the stars in its fields.

    The fields are the thesis's, and the user's own where one is given. The curves are of black
    bodies; the stars have the spectra that the bench gives them. Raises InputError.
    """
    optics = bench_optics(file.config.tracker, file.folder)
    weighting = file.config.sky.passband_weighting
    kelvin = _temperatures_k()
    ratios = _ratios(kelvin, optics)
    coolest, cool, hot, hottest = _quoted(kelvin, ratios[weighting])
    text = (
        f"By {file.path.name} a black body of 3000 K gives {coolest:.2f} times the electrons of"
        f" the average model, one of 5000 K {cool:.2f}, 9000 K {hot:.2f}, 50000 K {hottest:.2f}"
    )
    stars, ratio = _star_ratios(file)
    camera = tracker_camera(file.config.tracker, file.folder)
    fields = []
    for sky_field in fields_of(radec_roll_deg):
        fields.append(_in_field(sky_field, stars, ratio, camera))
    note = _note(optics, weighting)
    with chart(directory / "rapp_bench", text, 2, note=note) as panels:
        _draw_ratios(panels[0], ratios, weighting)
        _draw_stars(panels[1], stars, fields)
        _finish(panels)
    _write(directory / "rapp_bench.csv", kelvin, ratios)
    _write_stars(directory / "rapp_stars.csv", fields, stars)
    findings = [ChartFinding("rapp_bench", text)]
    for field in fields:
        finding = ChartFinding("rapp_stars", f"RAPP3 of the stars of {field.text}")
        findings.append(finding)
    write_findings(directory, findings)
    return findings


def _temperatures_k() -> FloatArray:
    between = np.geomspace(QUOTED_K[0], QUOTED_K[-1], TEMPERATURES)[1:-1]
    return np.union1d(between, QUOTED_K)


def _quoted(kelvin: FloatArray, ratios: FloatArray) -> FloatArray:
    """RAPP3 at QUOTED_K."""
    places = np.searchsorted(kelvin, QUOTED_K)
    return np.asarray(ratios[2][places])


def _star_ratios(file: BenchFile) -> tuple[Stars, FloatArray]:
    """The stars of a bench, and the electrons of each (n,) over those by the average model."""
    spectral = _stars_by(file, "dgs")
    if not len(spectral):
        raise InputError(
            f"[sky] faintest_v_mag = {file.config.sky.faintest_v_mag:g} leaves no star; write a"
            " larger magnitude"
        )
    average = _stars_by(file, "ags")
    ratio = spectral.electrons_per_s / average.electrons_per_s
    return spectral, ratio


def _stars_by(file: BenchFile, brightness: Literal["dgs", "ags"]) -> Stars:
    """The stars of a bench by one model of brightness."""
    sky = structs.replace(file.config.sky, brightness=brightness)
    config = structs.replace(file.config, sky=sky)
    return bench_stars(config, file.folder)


def _in_field(field: SkyField, stars: Stars, ratio: FloatArray, camera: Camera) -> FieldRatios:
    """The stars whose centre is on the image."""
    q_icrs_to_cam = from_radec_roll_deg(*field.radec_roll_deg)
    to_image = camera.cam_to_image @ to_matrix(q_icrs_to_cam)
    radius_rad = camera.field_radius_rad(0.0)
    near = stars.near(to_image[2], radius_rad)
    directions = stars.directions(near) @ to_image.T
    x_px, y_px = camera.project(directions)
    on_image = camera.contains_px(x_px, y_px)
    star = near[on_image]
    return FieldRatios(field, star, ratio[star])


def _star_rows(in_field: FieldRatios, stars: Stars) -> list[StarRatio]:
    """A row for each star of a field."""
    rows = []
    for star, ratio in zip(in_field.star.tolist(), in_field.ratio.tolist(), strict=True):
        hip = stars.hip[star].item()
        v_mag = stars.v_mag[star].item()
        bv_mag = stars.bv_mag[star].item()
        temperature_k = stars.temperature_k[star].item()
        row = StarRatio(in_field.field.stem, hip, v_mag, bv_mag, temperature_k, ratio)
        rows.append(row)
    return rows


def _note(optics: Optics, solid: Weighting) -> str:
    """What the ratios compare, and how each weighting is drawn."""
    (dotted,) = set(WEIGHTINGS) - {solid}
    low_nm, high_nm = optics.range_nm
    return (
        f"DGS over AGS at one V, {low_nm:.0f} to {high_nm:.0f} nm. Solid: {solid} weighting;"
        f" dotted: {dotted}."
    )


def _draw_ratios(axes: "Axes", ratios: dict[Weighting, FloatArray], solid: Weighting) -> None:
    """The ratios over temperature, solid by the weighting `solid`."""
    kelvin = _temperatures_k()
    (dotted,) = set(WEIGHTINGS) - {solid}
    series = zip(RATIOS, SERIES, strict=False)
    for number, (name, colour) in enumerate(series):
        axes.loglog(kelvin, ratios[solid][number], color=colour, label=name)
        axes.loglog(kelvin, ratios[dotted][number], ":", color=colour, label="_dotted")
    axes.set(ylabel="ratio of the models [1]")


def _draw_stars(axes: "Axes", stars: Stars, fields: Sequence[FieldRatios]) -> None:
    """RAPP3 of the stars of each field."""
    for field, colour in zip(fields, SERIES, strict=False):
        kelvin = stars.temperature_k[field.star]
        axes.loglog(kelvin, field.ratio, ".", ms=4, color=colour, label=field.field.name)
    axes.set(ylabel="electrons of stars [1]")
    axes.legend(loc="upper right")


def _finish(panels: "Sequence[Axes]") -> None:
    """Draw where both models agree, and label the panels' temperatures."""
    for axes in panels:
        axes.axhline(1, color=MUTED, lw=1)
        axes.set_xlim(QUOTED_K[0], QUOTED_K[-1])
    panels[-1].set(xlabel="black-body temperature [K]")
    plain_ticks(panels[-1].xaxis, TICKS_K)
    label_ends(panels[0])


def _write_stars(path: Path, fields: Sequence[FieldRatios], stars: Stars) -> None:
    rows: list[StarRatio] = []
    for field in fields:
        rows += _star_rows(field, stars)
    write_csv(path, StarRatio._fields, rows)


def _write(path: Path, kelvin: FloatArray, ratios: dict[Weighting, FloatArray]) -> None:
    columns = {"temperature_k": kelvin}
    for weighting in WEIGHTINGS:
        for number, ratio in enumerate(ratios[weighting], start=1):
            columns[f"rapp{number}_{weighting}"] = ratio
    write_columns(path, columns)
