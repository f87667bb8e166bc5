"""The table [certify]: what a certificate says beside its figures, its limits, and what no calibration file holds."""

from typing import Annotated, Literal

from msgspec import Meta

from hilstar.bench.config.values import NotNegative, Positive
from hilstar.toml_tables import Table

NO_LIMIT = {"default": "no limit"}
NOT_KNOWN = {"default": "not assessed"}
Relative = Annotated[float, Meta(ge=0, le=1)]


class InstrumentSettings(Table, frozen=True):
    """The photometer by which full scale was measured, from its own certificate.

    Without a name there is none: light is then certified in the tracker's own electrons, and its scale is not assessed.
    """

    name: Annotated[str, Meta(description="Maker, model and serial number; empty for none.")] = ""
    relative_expanded: Annotated[
        Relative, Meta(description="Expanded uncertainty of its scale, relative: 0.01 for one per cent.")
    ] = 0.0
    k: Annotated[float, Meta(ge=1, le=10, description="The coverage factor of that.")] = 2.0
    date: Annotated[str, Meta(description="The day of its certificate.")] = ""


class VirtualSettings(Table, frozen=True):
    """In a truth file alone: how the instruments of a virtual bench read (`hilstar certify --virtual TRUTH.toml`)."""

    reading_noise: Annotated[Relative, Meta(description="Relative noise of one reading of light.")] = 0.002
    dot_noise_px: Annotated[NotNegative, Meta(description="Noise of a dot's place along each axis, tracker pixels.")] = 0.02
    delay_noise_ms: Annotated[NotNegative, Meta(description="Noise of one edge that the photodiode sees.")] = 0.1
    drift_percent_per_h: Annotated[
        float, Meta(ge=-100, le=100, description="How fast the light changes from the first reading on.")
    ] = 0.0
    cold_percent: Annotated[float, Meta(ge=-50, le=50, description="How much darker a monitor just switched on is.")] = 0.0
    warm_up_min: Annotated[Positive, Meta(description="In how many minutes that falls to a third.")] = 8.0
    instrument_error: Annotated[
        float, Meta(ge=-0.5, le=0.5, description="Error of the instrument's scale, relative: it reads too much where positive.")
    ] = 0.0
    seconds_a_reading: Annotated[Positive, Meta(description="Time from one reading to the next.")] = 1.0


class CertifySettings(Table, frozen=True):
    """What `hilstar certify` states, and holds the bench to; see [certificates](certify.md)."""

    certificate: Annotated[
        str | None,
        Meta(
            description="The path of the bench's `certificate.json`: `serve` names it in ledger, page and FITS headers, "
            "`assess` and requirements take its uncertainty off.",
            extra={"default": "none"},
        ),
    ] = None
    who: Annotated[str, Meta(description="Who certifies.")] = ""
    where: Annotated[str, Meta(description="Where.")] = ""
    ambient: Annotated[str, Meta(description="Ambient conditions: temperature, humidity, darkness.")] = ""
    traceability: Annotated[str, Meta(description="To what the figures are traceable, as it is printed.")] = ""
    valid_days: Annotated[int, Meta(ge=1, le=3650, description="For how many days a certificate holds.")] = 180
    fields: Annotated[int, Meta(ge=1, le=20, description="How many fields of stars are certified.")] = 3
    levels: Annotated[int, Meta(ge=10, le=1000, description="How many codes of the response are read.")] = 48
    repeats: Annotated[int, Meta(ge=1, le=100, description="How often each of them is read; white twice as often.")] = 2
    decision: Annotated[
        Literal["guard-band", "simple"],
        Meta(
            description='`"guard-band"`: a figure conforms where its whole interval is within its limit. `"simple"`: where its '
            "value is (ISO 17025, ILAC-G8)."
        ),
    ] = "guard-band"
    max_flux_mag: Annotated[Positive | None, Meta(description="Limit of a star's flux.", extra=NO_LIMIT)] = None
    max_place_arcsec: Annotated[Positive | None, Meta(description="Limit of a star's place, each axis.", extra=NO_LIMIT)] = None
    max_attitude_arcsec: Annotated[
        Positive | None, Meta(description="Limit of a field's attitude across the boresight.", extra=NO_LIMIT)
    ] = None
    max_roll_arcsec: Annotated[Positive | None, Meta(description="Limit of it about the boresight.", extra=NO_LIMIT)] = None
    max_latency_ms: Annotated[
        Positive | None, Meta(description="Limit of the latency's difference from `panel_delay_ms`.", extra=NO_LIMIT)
    ] = None
    rate_deg_s: Annotated[
        NotNegative, Meta(description="Rate at which places are certified: stars then move along the image's x.")
    ] = 0.0
    jitter_ms: Annotated[
        NotNegative, Meta(description="Standard deviation of the moment of light against the predicted one, at that rate.")
    ] = 0.0
    clock_ms: Annotated[
        NotNegative, Meta(description="Standard uncertainty of the offset between the clocks of sender and host.")
    ] = 0.0
    flux_at_white_relative: Annotated[
        Relative | None,
        Meta(description="Standard uncertainty of `flux_at_white_e_per_s`, where nothing is read.", extra=NOT_KNOWN),
    ] = None
    flux_at_white_dof: Annotated[
        Positive | None, Meta(description="Its degrees of freedom: readings less one.", extra={"default": "unlimited"})
    ] = None
    panel_delay_u_ms: Annotated[
        NotNegative | None,
        Meta(description="Standard uncertainty of `panel_delay_ms`, where nothing is read.", extra=NOT_KNOWN),
    ] = None
    warm_up_percent: Annotated[
        NotNegative | None,
        Meta(description="How much white may still change in the ten minutes after it counts as warm.", extra=NOT_KNOWN),
    ] = None
    temperature_k: Annotated[
        NotNegative, Meta(description="Half of the range of the bench's temperature while the certificate holds.")
    ] = 0.0
    flux_mag_per_k: Annotated[float, Meta(ge=-1, le=1, description="Change of the light by temperature.")] = 0.0
    place_arcsec_per_k: Annotated[
        float, Meta(ge=-100, le=100, description="Change of the alignment by temperature, about x and y.")
    ] = 0.0
    instrument: Annotated[InstrumentSettings, Meta(description="See below.")] = InstrumentSettings()
    virtual: Annotated[VirtualSettings, Meta(description="See below.")] = VirtualSettings()
