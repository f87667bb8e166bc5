"""A detector's settings in plain numbers, which are also the keys of a bench file's
[tracker.detector].
"""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError

BOLTZMANN_EV_PER_K = 8.617333262e-5  # CODATA 2018
ELECTRON_C = 1.602176634e-19
TABLE_4_2_TEMPERATURE_K = 293.0
# e2v's dark signal relative to 293 K, a T^3 exp(-b / T), from 230 to 300 K: a in 1/K^3 and b in K.
# Seen in public code, not on a data sheet: the first (AIMO) in the response model of Solar-C's
# EUVST, the second (NIMO) there, in a simulator that quotes the CCD230-42's sheet, and in a
# background analysis of New Horizons' LORRI. They give 0.997 and 1.001 at 293 K.
E2V_DARK = {"ccd47-20": (1.14e6, 9080.0), "e2v-nimo": (122.0, 6400.0)}
DATASHEET_RANGE_K = (230.0, 300.0)

# More is refused. numpy's Poisson sampler compares logarithms of the size of mean * ln(mean): their
# rounding is 0.004 at 1e12 and of order 1 at 1e15, where the sampler is wrong long before it fails
# (9.2e18).
MAX_E = 1e12

Amount = Annotated[float, Meta(ge=0, le=MAX_E)]
Charge = Annotated[float, Meta(ge=1e-6, le=MAX_E)]
Share = Annotated[float, Meta(ge=0, le=1)]
Temperature = Annotated[float, Meta(ge=50, le=500)]
PixelPitch = Annotated[float, Meta(ge=0.1, le=1000)]


@dataclass(frozen=True, slots=True)
class PixelNoise:
    """Variances of a pixel's signal by source, e-^2, each of the shape of the light or a number.

    Shot is the light's, dark the dark current's own shot noise. PRNU and DSNU, which holds CMOS
    columns too, are fixed in a device: variances over its pixels.
    """

    shot_e2: FloatArray
    dark_e2: float
    read_e2: float
    reset_e2: float
    quantisation_e2: float
    prnu_e2: FloatArray
    dsnu_e2: float

    @property
    def total_e2(self) -> FloatArray:
        """The sum: the square of n_TOT (thesis table 4.1, eq. 4.14)."""
        even_e2 = self.dark_e2 + self.read_e2 + self.reset_e2 + self.quantisation_e2
        even_e2 = even_e2 + self.dsnu_e2
        return np.asarray(self.shot_e2 + self.prnu_e2 + even_e2)


class DetectorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The virtual tracker's sensor."""

    gain_e_per_dn: Charge = 24.0  #: Electrons per DN. The ADC rounds and clips.
    full_well_e: Charge = 70_000.0  #: Charge above this is lost, or spills with `blooming`.
    bits: Annotated[int, Meta(ge=1, le=16)] = 12  #: Bits of a DN.
    offset_dn: Amount = 0.0  #: Added by the ADC.
    #: Colours of the pixels, two rows from the top left: `"rggb"` has red in pixel (0, 0). Needs
    #: three quantum efficiencies ([colour](colour.md)). Default: no mosaic: mono
    bayer: Literal["rggb", "bggr", "grbg", "gbrg"] | None = None
    #: With `bayer`, what the solvers get: `"superpixel"`, the mean of the four squares of 2 x 2
    #: around a pixel, or `"mosaic"`, the raw pixels.
    solver_image: Literal["superpixel", "mosaic"] = "superpixel"
    #: Share of a pixel that takes light: `quantum_efficiency` is that of its open part.
    fill_factor: Annotated[float, Meta(ge=1e-3, le=1)] = 1.0
    read_noise_e: Amount = 0.0  #: Sigma of the read noise, at `read_noise_reference_hz`.
    #: Pixels that an output reads in a second; 0: `read_noise_e` holds as it is.
    readout_hz: Amount = 0.0
    read_noise_reference_hz: Charge = 1e6  #: Readout frequency of `read_noise_e`.
    #: Where 1/f noise equals white noise: read noise goes as the root of readout frequency plus
    #: this.
    read_noise_corner_hz: Amount = 0.0
    #: Read noise by readout frequency, instead: points `[hz, e-]`, between which its logarithm is
    #: straight. Default: none
    read_noise_table: Annotated[
        tuple[tuple[Charge, Amount], ...], Meta(extra={"form": "[[hz, e], ...]"})
    ] = ()
    #: `"global"`: all pixels at once. `"rolling"`: each row begins `row_time_us` after the one
    #: before. `"frame-transfer"`: no shutter while rows are shifted under the mask, so light smears
    #: along the columns ([real glass](optics.md#the-shutter)).
    shutter: Literal["global", "rolling", "frame-transfer"] = "global"
    #: With `rolling`: from the beginning of a row's exposure to the next row's.
    row_time_us: Amount = 0.0
    #: With `rolling`: `"down"`, the top row first, or `"up"`, the bottom row first.
    row_direction: Literal["down", "up"] = "down"
    #: With `frame-transfer`: the time in which charge is shifted by one row.
    row_shift_us: Amount = 0.0
    #: Capacitance whose reset adds kTC noise; 0: none, as with correlated double sampling.
    sense_capacitance_ff: Amount = 0.0
    dark_e_per_s: Amount = 0.0  #: Dark current of a pixel at the reference temperature.
    dsnu_e_per_s: Amount = 0.0  #: Sigma of the dark current over the device (DSNU).
    #: Sigma of a fixed offset of each pixel, whatever the exposure (EMVA 1288's DSNU).
    dsnu_e: Amount = 0.0
    #: Law of pixels' dark currents about their mean: `"normal"`, cut at 0, `"gamma"`,
    #: `"log-normal"`.
    dark_distribution: Literal["normal", "gamma", "log-normal"] = "normal"
    #: Measured quantiles of the pixels' dark currents, points `[share, e-/s]`. `dark_distribution`
    #: is fitted to them, and gives `dark_e_per_s` and `dsnu_e_per_s`. Default: none
    dark_quantiles: Annotated[
        tuple[tuple[Share, Amount], ...], Meta(extra={"form": "[[share, e/s], ...]"})
    ] = ()
    prnu: Share = 0.0  #: Relative sigma of the gain map (PRNU), which is fixed for a device.
    #: Seed of all that is fixed in a device: PRNU, DSNU, hot and dead pixels, rows and columns.
    #: `--seed` is the frame's.
    device_seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] = 0
    #: `"cmos"` allows `column_noise_e`; a `"ccd"` has one amplifier.
    fixed_pattern: Literal["ccd", "cmos"] = "ccd"
    temperature_k: Temperature = TABLE_4_2_TEMPERATURE_K  #: Temperature of the sensor.
    #: Temperature at which the dark currents above hold.
    dark_reference_temperature_k: Temperature = TABLE_4_2_TEMPERATURE_K
    #: Dark current against temperature. `"arrhenius"`: with `dark_activation_ev`.
    #: `"diffusion-depletion"`: T^3 exp(-E/kT) and T^1.5 exp(-E/2kT). `"ccd47-20"` (AIMO) and
    #: `"e2v-nimo"`: e2v's laws, 230 to 300 K.
    dark_law: Literal["arrhenius", "diffusion-depletion", "ccd47-20", "e2v-nimo"] = "arrhenius"
    #: Share of depletion in the dark current at the reference temperature; the rest is diffusion.
    dark_depletion_share: Share = 1.0
    #: E of `diffusion-depletion`; 0 is silicon's gap, 1.125 eV at 300 K, wider if colder.
    dark_gap_ev: Annotated[float, Meta(ge=0, le=2)] = 0.0
    # Half of silicon's band gap: the depletion term of eq. 4.12.
    #: Activation energy of `arrhenius`; the default is half of silicon's band gap.
    dark_activation_ev: Annotated[float, Meta(ge=0, le=1.2)] = 0.56
    hot_pixel_fraction: Share = 0.0  #: Share of the pixels that are hot.
    #: Mean of the exponential law from which the extra dark current of a hot pixel is drawn.
    hot_pixel_e_per_s: Amount = 10_000.0
    #: Activation energy of that extra current; 0: it goes as the dark current does.
    hot_pixel_activation_ev: Annotated[float, Meta(ge=0, le=2)] = 0.0
    dead_pixel_fraction: Share = 0.0  #: Share of the pixels that give no electrons.
    dead_row_fraction: Share = 0.0  #: Share of the rows that give no electrons, whole rows.
    dead_column_fraction: Share = 0.0  #: Share of the columns that give no electrons.
    column_noise_e: Amount = 0.0  #: Sigma of a fixed offset of each column, for `cmos`.
    #: Sigma of a dark current that a column's pixels share, for `cmos`.
    column_dark_e_per_s: Amount = 0.0
    #: Hits by isotropic minimum-ionising particles; each leaves a straight track.
    cosmic_rays_per_cm2_s: Amount = 0.0
    #: False stars, at new places in every frame.
    false_stars: Annotated[int, Meta(ge=0, le=100_000)] = 0
    false_star_e_per_s: Amount = 10_000.0  #: Rate of a false star.
    #: Gaussian sigma of a false star.
    false_star_sigma_px: Annotated[float, Meta(ge=0.05, le=20)] = 0.55
    blooming: bool = False  #: Charge above the full well spills along the column.
    #: How a frame's noise is drawn from its seed. `2`: in blocks, on every core, the same on any
    #: number of them; `1`: as up to version 0.2, slower.
    noise_version: Literal[1, 2] = 2
    #: Adds the Gaussian quantisation noise of the thesis to what rounding does.
    quantisation_noise: bool = False

    def __post_init__(self) -> None:
        """Refuse (InputError) a value that no sensor has."""
        for name, kind in _KINDS.items():
            check_value(name, getattr(self, name), kind)
        if self.dark_quantiles:
            points = np.array(self.dark_quantiles, dtype=np.float64)
            mean, sigma = fitted_dark(self.dark_distribution, points)
            msgspec.structs.force_setattr(self, "dark_e_per_s", mean)
            msgspec.structs.force_setattr(self, "dsnu_e_per_s", sigma)
        low_k, high_k = DATASHEET_RANGE_K
        for name in ("temperature_k", "dark_reference_temperature_k"):
            kelvin = getattr(self, name)
            if self.dark_law in E2V_DARK and not low_k <= kelvin <= high_k:
                raise InputError(
                    f'{name} = {kelvin:g}; dark_law "{self.dark_law}" holds from {low_k:g} to'
                    f' {high_k:g} K: write such a temperature, or dark_law = "arrhenius"'
                )
        _check_shutter(self)
        for name in ("column_noise_e", "column_dark_e_per_s"):
            if self.fixed_pattern == "ccd" and getattr(self, name) > 0:
                raise InputError(
                    f"{name} is for CMOS, whose columns have an amplifier each; write fixed_pattern"
                    f' = "cmos", or {name} = 0'
                )
        if self.dark_distribution != "normal" and self.dsnu_e_per_s and not self.dark_e_per_s:
            raise InputError(
                f'dark_distribution = "{self.dark_distribution}" has no mean of 0; write'
                " dark_e_per_s above 0"
            )
        hz = [point[0] for point in self.read_noise_table]
        if hz and self.readout_hz:
            is_rising = sorted(set(hz)) == hz
            if not (is_rising and hz[0] <= self.readout_hz <= hz[-1]):
                raise InputError(
                    f"readout_hz = {self.readout_hz:g}; write a frequency within read_noise_table,"
                    f" whose frequencies rise: {hz[0]:g} to {hz[-1]:g}"
                )

    @property
    def takes_superpixels(self) -> bool:
        """Whether stars are found in the luminance of a mosaic."""
        return self.bayer is not None and self.solver_image == "superpixel"

    @property
    def saturation_dn(self) -> float:
        """The level at which a pixel saturates: the ADC's last code, or the full well, DN."""
        full_well_dn = self.offset_dn + self.full_well_e / self.gain_e_per_dn
        return min(2.0**self.bits - 1, full_well_dn)

    @property
    def dark_factor(self) -> float:
        """What the temperature does to dark rates: 1 at the reference temperature (thesis eq.
        4.12).
        """
        cold_k = self.dark_reference_temperature_k
        warm_k = self.temperature_k
        if self.dark_law == "arrhenius":
            return _arrhenius(self.dark_activation_ev, cold_k, warm_k)
        if self.dark_law in E2V_DARK:
            return e2v_dark(self.dark_law, warm_k) / e2v_dark(self.dark_law, cold_k)
        # depletion goes with the intrinsic carriers, diffusion with their square
        cold_ev = self.dark_gap_ev or silicon_gap_ev(cold_k)
        warm_ev = self.dark_gap_ev or silicon_gap_ev(warm_k)
        exponent = (cold_ev / cold_k - warm_ev / warm_k) / (2 * BOLTZMANN_EV_PER_K)
        depletion = math.pow(warm_k / cold_k, 1.5) * math.exp(exponent)
        depletion_share = self.dark_depletion_share
        return (1 - depletion_share) * depletion**2 + depletion_share * depletion

    @property
    def hot_factor(self) -> float:
        """What the temperature does to the extra dark current of hot pixels."""
        if not self.hot_pixel_activation_ev:
            return self.dark_factor
        reference_k = self.dark_reference_temperature_k
        return _arrhenius(self.hot_pixel_activation_ev, reference_k, self.temperature_k)

    @property
    def read_noise_now_e(self) -> float:
        """Sigma of the read noise at `readout_hz`: white noise of the band, and 1/f noise, which
        has as much in each octave.
        """
        if not self.readout_hz:
            return self.read_noise_e
        if self.read_noise_table:
            hz, table_e = np.log(np.maximum(self.read_noise_table, 1e-12)).T
            return math.exp(float(np.interp(math.log(self.readout_hz), hz, table_e)))
        corner_hz = self.read_noise_corner_hz
        band = (self.readout_hz + corner_hz) / (self.read_noise_reference_hz + corner_hz)
        return self.read_noise_e * math.sqrt(band)

    @property
    def reset_noise_e(self) -> float:
        """kTC noise: sqrt(k T C) / q, e-."""
        thermal_v = BOLTZMANN_EV_PER_K * self.temperature_k
        squared_c = thermal_v * self.sense_capacitance_ff * 1e-15
        return math.sqrt(squared_c / ELECTRON_C)

    def noise(self, light_e: npt.ArrayLike, exposure_s: float) -> PixelNoise:
        """The noise of pixels that light gives `light_e` electrons on average, background among
        them (thesis table 4.1).

        Of pixels that are neither hot nor dead nor hit by a cosmic ray, below full well and above
        code 0.
        """
        light = np.asarray(light_e, dtype=np.float64)
        seconds = self.dark_factor * exposure_s
        quantisation_e2 = self.gain_e_per_dn**2 / 12
        if self.quantisation_noise:
            quantisation_e2 += self.adc_noise_e**2
        dark_pattern_e_per_s = math.hypot(self.dsnu_e_per_s, self.column_dark_e_per_s)
        dark_pattern_e2 = dark_pattern_e_per_s**2 * seconds**2
        return PixelNoise(
            shot_e2=light,
            dark_e2=self.dark_e_per_s * seconds,
            read_e2=self.read_noise_now_e**2,
            reset_e2=self.reset_noise_e**2,
            quantisation_e2=quantisation_e2,
            prnu_e2=(self.prnu * light) ** 2,
            dsnu_e2=dark_pattern_e2 + self.column_noise_e**2 + self.dsnu_e**2,
        )

    @property
    def electronics_e(self) -> float:
        """Sigma of what the electronics add to the charge: read and reset noise, and the ADC's
        for `quantisation_noise`.
        """
        adc_noise_e = self.adc_noise_e if self.quantisation_noise else 0.0
        return math.hypot(self.read_noise_now_e, self.reset_noise_e, adc_noise_e)

    @property
    def adc_noise_e(self) -> float:
        """The thesis's quantisation noise, full well / (2^bits sqrt 12) (table 4.1); rounding
        makes gain / sqrt 12.
        """
        return self.full_well_e / float(2**self.bits * math.sqrt(12))


_KINDS = get_type_hints(DetectorSettings, include_extras=True)


def _check_shutter(detector: DetectorSettings) -> None:
    """Raise InputError where a shutter lacks its time, or has another's."""
    for name, shutter in (("row_time_us", "rolling"), ("row_shift_us", "frame-transfer")):
        time_us = getattr(detector, name)
        is_that_shutter = detector.shutter == shutter
        if (time_us > 0) != is_that_shutter:
            way = "above 0" if is_that_shutter else f'= 0, or shutter = "{shutter}"'
            raise InputError(
                f'{name} = {time_us:g} with shutter = "{detector.shutter}"; write {name} {way}'
            )


def fitted_dark(law: str, points: FloatArray) -> tuple[float, float]:
    """Mean and sigma of the law of `dark_distribution` through quantiles (n, 2): shares and e-/s.
    Raises InputError.

    Least squares of the quantiles; of their logarithms, except for the normal law.
    """
    from scipy.optimize import minimize_scalar
    from scipy.special import gammaincinv, ndtri

    share, rate = points.reshape(-1, 2).T
    low = 0.0 if law == "normal" else 1e-9
    if len(share) < 2:
        is_distribution = False
    else:
        is_rising = (np.diff(share) > 0).all() and (np.diff(rate) > 0).all()
        is_distribution = bool(is_rising and share[0] > 0 and share[-1] < 1)
    if not is_distribution:
        raise InputError(
            "dark_quantiles: write two points or more, shares between 0 and 1, both columns rising"
        )
    if rate[0] < low:
        raise InputError(
            f'dark_quantiles: dark_distribution = "{law}" has no rate of 0; write rates above 0'
        )
    if law == "gamma":

        def misfit(log_shape: float) -> float:
            quantiles = gammaincinv(math.exp(log_shape), share)
            return float(np.var(np.log(rate / np.maximum(quantiles, 1e-300))))

        bounds = (math.log(0.02), math.log(1e6))
        shape = math.exp(minimize_scalar(misfit, bounds=bounds, method="bounded").x)
        scales = rate / gammaincinv(shape, share)
        mean = shape * math.exp(float(np.log(scales).mean()))
        return mean, mean / math.sqrt(shape)
    normal_rate = rate if law == "normal" else np.log(rate)
    slope, middle = np.polyfit(ndtri(share), normal_rate, 1).tolist()
    if law == "normal":
        if middle < 0:
            raise InputError(
                "dark_quantiles: their normal law has a mean below 0; write dark_distribution ="
                ' "gamma"'
            )
        return middle, slope
    mean = math.exp(middle + slope**2 / 2)
    return mean, mean * math.sqrt(math.expm1(slope**2))


def e2v_dark(law: str, temperature_k: float) -> float:
    """Dark signal by e2v's law (a name of E2V_DARK) relative to 293 K."""
    per_k3, kelvin = E2V_DARK[law]
    return float(per_k3 * temperature_k**3 * math.exp(-kelvin / temperature_k))


def silicon_gap_ev(temperature_k: float) -> float:
    """Silicon's band gap, eV (Thurmond, J. Electrochem. Soc. 122 (1975) 1133; Sze, Physics of
    Semiconductor Devices).
    """
    return 1.17 - 4.73e-4 * temperature_k**2 / (temperature_k + 636.0)


def _arrhenius(activation_ev: float, cold_k: float, warm_k: float) -> float:
    """The factor by which a process of an activation energy is faster at the warm temperature."""
    inverse_k = 1 / cold_k - 1 / warm_k
    return math.exp(activation_ev / BOLTZMANN_EV_PER_K * inverse_k)


def check_value(name: str, value: Any, kind: Any) -> None:
    """Refuse (InputError) a value outside the limits or the choices of its annotated type,
    `kind`.
    """
    plain, *notes = get_args(kind) if get_origin(kind) is Annotated else (kind,)
    if get_origin(plain) is Literal:
        if value not in get_args(plain):
            wanted = " or ".join(f'"{choice}"' for choice in get_args(plain))
            raise InputError(f"{name} = {value!r}; write {wanted}")
        return
    for note in notes:
        if not isinstance(note, Meta) or note.ge is None:
            continue
        if not note.ge <= value <= note.le:
            raise InputError(f"{name} = {value:g}; write a number from {note.ge:g} to {note.le:g}")
