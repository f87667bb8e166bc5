"""A detector's settings in plain numbers, which are also the keys of a bench file's [tracker.detector]."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from hilstar.errors import InputError

BOLTZMANN_EV_PER_K = 8.617333262e-5  # CODATA 2018
TABLE_4_2_TEMPERATURE_K = 293.0
DATASHEET_RANGE_K = (230.0, 300.0)  # where the CCD47-20's datasheet gives its law of dark current

# More is refused. numpy's Poisson sampler compares logarithms of the size of mean * ln(mean): their rounding is 0.004
# at 1e12 and of order 1 at 1e15, where the sampler is wrong long before it fails (9.2e18).
MAX_E = 1e12

Amount = Annotated[float, Meta(ge=0, le=MAX_E)]
Charge = Annotated[float, Meta(ge=1e-6, le=MAX_E)]
Share = Annotated[float, Meta(ge=0, le=1)]
Temperature = Annotated[float, Meta(ge=50, le=500)]
PixelPitch = Annotated[float, Meta(ge=0.1, le=1000)]


class DetectorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The virtual tracker's sensor.

    Physical order: light, PRNU, shot noise, dark current, full well, read noise, ADC. Rates are per pixel, those of dark
    current at `dark_reference_temperature_k`.
    """

    gain_e_per_dn: Annotated[Charge, Meta(description="Electrons per DN. The ADC rounds and clips.")] = 24.0
    full_well_e: Annotated[Charge, Meta(description="Charge above this is lost, or spills with `blooming`.")] = 70_000.0
    bits: Annotated[int, Meta(ge=1, le=16, description="Bits of a DN.")] = 12
    offset_dn: Annotated[Amount, Meta(description="Added by the ADC.")] = 0.0
    read_noise_e: Annotated[Amount, Meta(description="Sigma of the read noise.")] = 0.0
    dark_e_per_s: Annotated[Amount, Meta(description="Dark current of a pixel at the reference temperature.")] = 0.0
    dsnu_e_per_s: Annotated[Amount, Meta(description="Sigma of the dark current over the device (DSNU).")] = 0.0
    prnu: Annotated[Share, Meta(description="Relative sigma of the gain map (PRNU), which is fixed for a device.")] = 0.0
    device_seed: Annotated[
        int,
        Meta(
            ge=0,
            le=2**63 - 1,
            description="Seed of all that is fixed in a device: PRNU, DSNU, hot and dead pixels, columns. `--seed` is the "
            "frame's.",
        ),
    ] = 0
    fixed_pattern: Annotated[
        Literal["ccd", "cmos"], Meta(description='`"cmos"` allows `column_noise_e`; a `"ccd"` has one amplifier.')
    ] = "ccd"
    temperature_k: Annotated[Temperature, Meta(description="Temperature of the sensor.")] = TABLE_4_2_TEMPERATURE_K
    dark_reference_temperature_k: Annotated[
        Temperature, Meta(description="Temperature at which the dark currents above hold.")
    ] = TABLE_4_2_TEMPERATURE_K
    dark_law: Annotated[
        Literal["arrhenius", "ccd47-20"],
        Meta(
            description='Dark current against temperature. `"arrhenius"`: with `dark_activation_ev`. `"ccd47-20"`: the '
            "datasheet's law, 230 to 300 K."
        ),
    ] = "arrhenius"
    # Half of silicon's band gap: the depletion term of eq. 4.12.
    dark_activation_ev: Annotated[
        float, Meta(ge=0, le=1.2, description="Activation energy of `arrhenius`; the default is half of silicon's band gap.")
    ] = 0.56
    hot_pixel_fraction: Annotated[Share, Meta(description="Share of the pixels that are hot.")] = 0.0
    hot_pixel_e_per_s: Annotated[
        Amount, Meta(description="Mean of the exponential law from which the extra dark current of a hot pixel is drawn.")
    ] = 10_000.0
    dead_pixel_fraction: Annotated[Share, Meta(description="Share of the pixels that give no electrons.")] = 0.0
    column_noise_e: Annotated[Amount, Meta(description="Sigma of a fixed offset of each column, for `cmos`.")] = 0.0
    cosmic_rays_per_cm2_s: Annotated[
        Amount, Meta(description="Hits by isotropic minimum-ionising particles; each leaves a straight track.")
    ] = 0.0
    false_stars: Annotated[int, Meta(ge=0, le=100_000, description="False stars, at new places in every frame.")] = 0
    false_star_e_per_s: Annotated[Amount, Meta(description="Rate of a false star.")] = 10_000.0
    false_star_sigma_px: Annotated[float, Meta(ge=0.05, le=20, description="Gaussian sigma of a false star.")] = 0.55
    blooming: Annotated[bool, Meta(description="Charge above the full well spills along the column.")] = False
    quantisation_noise: Annotated[
        bool, Meta(description="Adds the Gaussian quantisation noise of the thesis to what rounding does.")
    ] = False

    def __post_init__(self) -> None:
        """Refuse (InputError) a value that no sensor has."""
        for name, kind in _KINDS.items():
            check_value(name, getattr(self, name), kind)
        low_k, high_k = DATASHEET_RANGE_K
        for name in ("temperature_k", "dark_reference_temperature_k"):
            if self.dark_law == "ccd47-20" and not low_k <= getattr(self, name) <= high_k:
                raise InputError(
                    f'{name} = {getattr(self, name):g}; dark_law "ccd47-20" holds from {low_k:g} to {high_k:g} K: '
                    'write such a temperature, or dark_law = "arrhenius"'
                )
        if self.fixed_pattern == "ccd" and self.column_noise_e > 0:
            raise InputError(
                'column_noise_e is for CMOS, whose columns have an amplifier each; write fixed_pattern = "cmos", '
                "or column_noise_e = 0"
            )

    @property
    def dark_factor(self) -> float:
        """What the temperature does to every dark rate: 1 at the reference temperature."""
        cold_k, warm_k = self.dark_reference_temperature_k, self.temperature_k
        if self.dark_law == "ccd47-20":
            return ccd47_20_dark(warm_k) / ccd47_20_dark(cold_k)
        return math.exp(self.dark_activation_ev / BOLTZMANN_EV_PER_K * (1 / cold_k - 1 / warm_k))

    @property
    def adc_noise_e(self) -> float:
        """The thesis's quantisation noise, full well / (2^bits sqrt 12) (table 4.1); rounding makes gain / sqrt 12."""
        return self.full_well_e / float(2**self.bits * math.sqrt(12))


_KINDS = get_type_hints(DetectorSettings, include_extras=True)


def ccd47_20_dark(temperature_k: float) -> float:
    """Dark signal of an AIMO CCD47-20 relative to 293 K, 230 to 300 K: 1.14e6 T^3 exp(-9080/T) (e2v's datasheet).

    The coefficients are recalled, not read off the sheet; they give 0.997 at 293 K, as they must.
    """
    return float(1.14e6 * temperature_k**3 * math.exp(-9080.0 / temperature_k))


def check_value(name: str, value: Any, kind: Any) -> None:
    """Refuse (InputError) a value outside the limits or the choices of its annotated type, `kind`."""
    plain, *notes = get_args(kind) if get_origin(kind) is Annotated else (kind,)
    if get_origin(plain) is Literal:
        if value not in get_args(plain):
            wanted = " or ".join(f'"{choice}"' for choice in get_args(plain))
            raise InputError(f"{name} = {value!r}; write {wanted}")
        return
    for note in notes:
        if isinstance(note, Meta) and note.ge is not None and not note.ge <= value <= note.le:
            raise InputError(f"{name} = {value:g}; write a number from {note.ge:g} to {note.le:g}")
