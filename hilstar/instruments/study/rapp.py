"""RAPP 1 to 3 (thesis eq. 5.1 to 5.3): the spectral model of light over the average one.

They depend on the sensor: of the two that the thesis has (figures 5.19 and 5.22), and of a bench's
own, with the stars that it sees in the thesis's three fields and in any other.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from msgspec import structs

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import MUTED, SERIES, chart, label_ends, plain_ticks, write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_radec_roll_deg, to_matrix
from hilstar.basics.units import LIGHT_M_S
from hilstar.instruments.study.engine import ChartFinding, write_findings
from hilstar.instruments.study.fields import Field, fields_of
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
STAR_COLUMNS = ("field", "hip", "v_mag", "bv_mag", "temperature_k", "rapp3")


@dataclass(frozen=True, slots=True)
class FieldRatios:
    """The stars (n,) of a field, and the electrons of each by its spectrum over the average
    model's.
    """

    field: Field
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
    wavelength_nm, weight_m = integration_nodes(optics.quantum_efficiency, optics.transmission)
    low_nm, high_nm = optics.range_nm
    photons_per_j = wavelength_nm * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
    mean_photons_per_j = (low_nm + high_nm) / 2 * 1e-9 / (PLANCK_J_S * LIGHT_M_S)
    reference = reference_mean_w_m2_m(photometry)

    def in_range(kelvin: FloatArray, response: FloatArray) -> FloatArray:
        spectrum = blackbody_exitance_w_m2_m(wavelength_nm, kelvin[:, None])
        return np.asarray(
            reference / v_band_mean_w_m2_m(kelvin, weighting) * (spectrum @ (response * weight_m))
        )

    ones = np.ones_like(wavelength_nm)
    average = in_range(np.array([REFERENCE_TEMPERATURE_K]), ones)[0]
    irradiance = in_range(temperature_k, ones) / average
    photons = in_range(temperature_k, photons_per_j) / (average * mean_photons_per_j)
    electrons = dgs_electrons_per_s(temperature_k, optics, photometry) / ags_electrons_per_s(
        optics, photometry
    )
    return np.stack((irradiance, photons, electrons))


def rapp(directory: Path, sensor: str) -> ChartFinding:
    """The three ratios of a sensor, 3000 to 50 000 K, for both passband weightings."""
    optics = study_optics(sensor)
    kelvin = _temperatures_k()
    ratios = {weighting: rapp_ratios(kelvin, optics, weighting) for weighting in WEIGHTINGS}
    # which the range of wavelengths alone makes
    in_full_range = rapp_ratios(kelvin[-1:], study_optics("ccd47-20"), "energy")
    coolest, cool, hot, hottest = _quoted(kelvin, ratios["energy"])
    text = (
        f"{SENSORS[sensor]}: the spectral model gives {coolest:.2f} times the electrons of the"
        " average one at 3000 K,"
        f" {cool:.2f} at 5000 K; at 9000 K they differ by {100 * (hot - 1):+.1f} %, at 50000 K by"
        f" {100 * (hottest - 1):+.1f} %"
        + SAID_OF_THESIS[sensor].format(ratios["energy"][0, -1], in_full_range[0, 0])
    )
    title = (
        f"{SENSORS[sensor]}: a black body of 3000 K gives {coolest:.2f} times the electrons of the"
        " average model,"
        f" one of 5000 K {cool:.2f} times"
    )
    _draw(directory / f"rapp_{sensor}", title, optics, ratios, "energy")
    _write(directory / f"rapp_{sensor}.csv", kelvin, ratios)
    return ChartFinding(f"rapp_{sensor}", text)


def bench_rapp(
    directory: Path, file: BenchFile, radec_roll_deg: tuple[float, float, float] | None = None
) -> list[ChartFinding]:
    """The three ratios of a bench's tracker, and RAPP3 of the stars that it sees.

    The stars are those of the thesis's fields, and of one of one's own. The curves are of black
    bodies; the stars have the spectra that the bench gives them. Raises InputError.
    """
    optics = bench_optics(file.config.tracker, file.folder)
    weighting = file.config.sky.passband_weighting
    kelvin = _temperatures_k()
    ratios = {name: rapp_ratios(kelvin, optics, name) for name in WEIGHTINGS}
    coolest, cool, hot, hottest = _quoted(kelvin, ratios[weighting])
    text = (
        f"By {file.path.name} a black body of 3000 K gives {coolest:.2f} times the electrons of"
        " the average model, one of"
        f" 5000 K {cool:.2f}, 9000 K {hot:.2f}, 50000 K {hottest:.2f}"
    )
    stars, ratio = _star_ratios(file)
    camera = tracker_camera(file.config.tracker, file.folder)
    fields = [_in_field(field, stars, ratio, camera) for field in fields_of(radec_roll_deg)]
    _draw(directory / "rapp_bench", text, optics, ratios, weighting, (stars, fields))
    _write(directory / "rapp_bench.csv", kelvin, ratios)
    rows = [row for field in fields for row in _star_rows(field, stars)]
    write_csv(directory / "rapp_stars.csv", STAR_COLUMNS, rows)
    findings = [ChartFinding("rapp_bench", text)]
    findings += [
        ChartFinding("rapp_stars", f"RAPP3 of the stars of {field.text}") for field in fields
    ]
    write_findings(directory, findings)
    return findings


def _temperatures_k() -> FloatArray:
    between = np.geomspace(QUOTED_K[0], QUOTED_K[-1], TEMPERATURES)[1:-1]
    return np.union1d(between, QUOTED_K)


def _quoted(kelvin: FloatArray, ratios: FloatArray) -> FloatArray:
    """RAPP3 at QUOTED_K."""
    return np.asarray(ratios[2][np.searchsorted(kelvin, QUOTED_K)])


def _star_ratios(file: BenchFile) -> tuple[Stars, FloatArray]:
    """The stars of a bench, and the electrons of each (n,) over those by the average model."""
    config = file.config
    spectral, average = (
        bench_stars(
            structs.replace(config, sky=structs.replace(config.sky, brightness=model)), file.folder
        )
        for model in ("dgs", "ags")
    )
    if not len(spectral):
        raise InputError(
            f"[sky] faintest_v_mag = {config.sky.faintest_v_mag:g} leaves no star; write a larger"
            " magnitude"
        )
    return spectral, spectral.electrons_per_s / average.electrons_per_s


def _in_field(field: Field, stars: Stars, ratio: FloatArray, camera: Camera) -> FieldRatios:
    """The stars whose centre is on the image."""
    to_image = camera.cam_to_image @ to_matrix(from_radec_roll_deg(*field.radec_roll_deg))
    near = stars.near(to_image[2], camera.field_radius_rad(0.0))
    x_px, y_px = camera.project(stars.directions(near) @ to_image.T)
    star = near[camera.contains_px(x_px, y_px)]
    return FieldRatios(field, star, ratio[star])


def _star_rows(in_field: FieldRatios, stars: Stars) -> list[tuple[object, ...]]:
    properties = (stars.hip, stars.v_mag, stars.bv_mag, stars.temperature_k)
    columns = [values[in_field.star].tolist() for values in properties]
    stems = [in_field.field.stem] * len(in_field.star)
    return list(zip(stems, *columns, in_field.ratio.tolist(), strict=True))


def _draw(
    path: Path,
    title: str,
    optics: Optics,
    ratios: dict[Weighting, FloatArray],
    solid: Weighting,
    stars: tuple[Stars, list[FieldRatios]] | None = None,
) -> None:
    """The ratios over temperature, solid by the weighting `solid`; below, the stars of fields."""
    kelvin = _temperatures_k()
    (dotted,) = set(WEIGHTINGS) - {solid}
    low_nm, high_nm = optics.range_nm
    note = (
        f"DGS over AGS at one V, {low_nm:.0f} to {high_nm:.0f} nm. Solid: {solid} weighting;"
        f" dotted: {dotted}."
    )
    panels = 1 if stars is None else 2
    with chart(path, title, panels, note=note) as axes:
        for k, (name, colour) in enumerate(zip(RATIOS, SERIES, strict=False)):
            axes[0].loglog(kelvin, ratios[solid][k], color=colour, label=name)
            axes[0].loglog(kelvin, ratios[dotted][k], ":", color=colour, label="_dotted")
        axes[0].set(ylabel="ratio of the models [1]")
        if stars is not None:
            catalogue, fields = stars
            for field, colour in zip(fields, SERIES, strict=False):
                kelvin_of_stars = catalogue.temperature_k[field.star]
                name = field.field.name
                axes[1].loglog(kelvin_of_stars, field.ratio, ".", ms=4, color=colour, label=name)
            axes[1].set(ylabel="electrons of stars [1]")
            axes[1].legend(loc="upper right")
        for panel in axes:
            panel.axhline(1, color=MUTED, lw=1)
            panel.set_xlim(kelvin[0], kelvin[-1])
        axes[-1].set(xlabel="black-body temperature [K]")
        plain_ticks(axes[-1].xaxis, TICKS_K)
        label_ends(axes[0])


def _write(path: Path, kelvin: FloatArray, ratios: dict[Weighting, FloatArray]) -> None:
    numbers = range(len(RATIOS))
    names = [f"rapp{k + 1}_{weighting}" for weighting in WEIGHTINGS for k in numbers]
    values = [ratios[weighting][k] for weighting in WEIGHTINGS for k in numbers]
    write_csv(path, ("temperature_k", *names), np.column_stack((kelvin, *values)).tolist())
