"""The plan of a campaign: its file, the parameters that it varies, and its design.

The file is TOML, read into checked and frozen tables. A parameter is a key of the bench file by its
dotted name, or one of the case's own keys. The design gives each case a point of the unit cube, by
the plan's sampling and seed alone.
"""

import copy
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.reading import MAX_TOML_BYTES, parse_toml, read_text
from hilstar.basics.toml_tables import Kind, Table, explained
from hilstar.server.bench.bench_file import BenchFile, changed_file
from hilstar.server.bench.config import GAUSSIAN

if TYPE_CHECKING:
    from scipy.stats.qmc import Sobol

TYPE_WORDS = {
    "float": "number",
    "int": "whole number",
    "str": "text",
    "object": "table",
    "array": "list",
    "bool": "true or false",
}
MAX_CASES = 1_000_000_000
MAX_FRAMES = 10_000
MAX_VALUES = 10_000
MAX_SEED = 2**63 - 1
DEFAULT_ANSWERS, DEFAULT_TIMEOUT_S = 5, 10.0
MAX_BENCH_CASES = 1_000_000
# for through = "bench" alone
BENCH_KEYS = ("answers", "settle_s", "timeout_s", "blank_s", "silent_s", "check_every")
TRACKER_KEYS = ("frames", "step_s", "noise", "centroids", "planted")  # for the others

Sampling = Literal["grid", "latin-hypercube", "sobol"]
Number = Annotated[float, Meta(ge=-1e12, le=1e12)]
Ra = Annotated[float, Meta(ge=-360, le=360)]
Dec = Annotated[float, Meta(ge=-90, le=90)]
Roll = Annotated[float, Meta(ge=-360, le=720)]
# Keys of a case that are not in its bench file. Rates are those of cam with respect to icrs, in cam
# components; `across` is about an axis in the image plane that each case draws.
# `misalignment_arcsec` turns the display's true mounting, cam axes. `body_deg` is from a body's
# middle, `limb_deg` from its limb, below 0 within its disc.
OWN_KEYS = (
    *("rate_deg_s.x", "rate_deg_s.y", "rate_deg_s.z", "rate_deg_s.across"),
    *("acceleration_deg_s2.x", "acceleration_deg_s2.y", "acceleration_deg_s2.z"),
    *("acceleration_deg_s2.across", "motion_s"),
    *("jitter_arcsec.x", "jitter_arcsec.y", "jitter_arcsec.z", "jitter_arcsec.across"),
    *("jitter_hz",),
    *("misalignment_arcsec.x", "misalignment_arcsec.y", "misalignment_arcsec.z"),
    *("time_s", "noise_seed", "scenario", "body_deg", "limb_deg", "stray_e_per_px"),
)
MAX_OWN = {
    "rate_deg_s": 360.0,
    "acceleration_deg_s2": 360.0,
    "motion_s": 86400.0,
    "jitter_arcsec": 36_000.0,
    "jitter_hz": 10_000.0,
    "misalignment_arcsec": 36_000.0,
    "body_deg": 180.0,
    "limb_deg": 90.0,
    "stray_e_per_px": 1e9,
    "time_s": 9e9,
    "noise_seed": 2.0**63 - 1,
}
WHOLE = ("noise_seed",)
NOT_NEGATIVE = (*WHOLE, "motion_s", "jitter_hz")
# Further columns of the table, lists of a value a frame or a star.
Further = Literal["rate", "time", "stars"]
# What [[require]] limits (ECSS-E-ST-60-20C), and its unit; those of an axis, arcsec, come first.
Quantity = Literal[
    "bias",
    "fov-error",
    "pixel-error",
    "noise",
    "nea",
    "availability",
    "wrong-rate",
    "time-to-first-attitude",
    "recovery",
    "no-attitude",
    "false-attitude",
    "rate-bias",
    "rate-noise",
    "rate-scale",
    "rate-lag",
    "time-bias",
    "time-jitter",
    "aberration",
    "proper-motion",
    "catalogue-age",
    "parallax",
    "star-noise",
    "star-fov-error",
    "star-colour",
    "star-limit",
    "false-stars",
    "edge",
]
AXIS_QUANTITIES = ("bias", "fov-error", "pixel-error", "noise", "nea")
RATE_QUANTITIES = ("rate-bias", "rate-noise", "rate-scale", "rate-lag")
WITH_AXIS = (*AXIS_QUANTITIES, *RATE_QUANTITIES)
TIME_QUANTITIES = ("time-to-first-attitude", "recovery")
SHARE_QUANTITIES = ("availability", "wrong-rate", "no-attitude", "false-attitude")
MOTION_QUANTITIES = ("proper-motion", "catalogue-age")
PARALLAX = "parallax"
STAR_QUANTITIES = ("star-noise", "star-fov-error", "star-colour", "star-limit", "false-stars")
# These take `share`: the quantile of so many cases.
WITH_SHARE = ("fov-error", "pixel-error", "noise", "nea", *TIME_QUANTITIES)
QUANTITY_UNITS = dict.fromkeys(AXIS_QUANTITIES, "arcsec") | dict.fromkeys(TIME_QUANTITIES, "s")
QUANTITY_UNITS |= dict.fromkeys(SHARE_QUANTITIES, "")
QUANTITY_UNITS |= {"rate-bias": "deg/s", "rate-noise": "deg/s", "rate-scale": "", "rate-lag": "s"}
QUANTITY_UNITS |= {"time-bias": "s", "time-jitter": "s", "aberration": ""}
QUANTITY_UNITS |= {"proper-motion": "", "catalogue-age": "yr", PARALLAX: ""}
QUANTITY_UNITS |= {"star-noise": "px", "star-fov-error": "px", "star-colour": "mag/mag"}
QUANTITY_UNITS |= {"star-limit": "mag", "false-stars": "a frame", "edge": ""}
# The further columns that a quantity is found from.
QUANTITY_COLUMNS: dict[str, Further] = {
    **dict.fromkeys(RATE_QUANTITIES, "rate"),
    **dict.fromkeys(("time-bias", "time-jitter", "aberration", *MOTION_QUANTITIES), "time"),
    PARALLAX: "time",
    **dict.fromkeys(STAR_QUANTITIES, "stars"),
}
CONDITION = re.compile(
    r"\s*([A-Za-z0-9_.]+)\s*(<=|>=|==|!=|<|>)\s*(?:\"([^\"]*)\"|([-+0-9.eE]+))\s*"
)
SCENARIO = "scenario"  # the path of a file of faults; empty for none
ATTITUDE_STREAM = 1  # stream of a case's seed for the attitudes of a grid
SOBOL_BITS = 30
MAX_HYPERCUBE_VALUES = 200_000_000  # 1.6 GB: a Latin hypercube is made as a whole
TRACKER_PSF = "tracker"
Body = Literal[
    "sun",
    "moon",
    "earth",
    "mercury",
    "venus",
    "mars",
    "jupiter",
    "saturn",
    "uranus",
    "neptune",
]


class Attitudes(Table, frozen=True):
    """[attitudes]: where the cases look. `field` is a cap of `radius_deg` around `radec_deg`;
    `log` goes along a log; `body` looks at the angle `body_deg` of the case from a `body`, or at
    `limb_deg` from its limb.
    """

    kind: Literal["all-sky", "field", "log", "body"] = "all-sky"
    body: Body | None = None
    radec_deg: tuple[Ra, Dec] | None = None
    radius_deg: Annotated[float, Meta(ge=0, le=180)] = 5.0
    roll_deg: tuple[Roll, Roll] = (0.0, 360.0)
    log: str | None = None


class Varied(Table, frozen=True):
    """[[vary]]: one key, with the values that it takes, or the range that it is drawn from."""

    key: Annotated[str, Meta(min_length=1, max_length=200)]
    values: Annotated[list[Any], Meta(min_length=1, max_length=MAX_VALUES)] | None = None
    minimum: Number | None = None
    maximum: Number | None = None
    steps: Annotated[int, Meta(ge=1, le=MAX_VALUES)] | None = None
    scale: Literal["linear", "log"] = "linear"


class Centroiding(Table, frozen=True):
    """[centroids]: how `--solver centroids` finds stars, and which PSF `centroider = "psf"` is
    told.

    `psf` is the tracker's own, the Gaussian nearest to it, or that of a file at `psf_focus_um`.
    """

    threshold_sigma: Annotated[float, Meta(ge=0, le=1e6)] = 5.0
    minimum_pixels: Annotated[int, Meta(ge=1, le=1000)] = 1
    centroider: Literal["window", "psf"] = "window"
    psf: Annotated[str, Meta(min_length=1)] = TRACKER_PSF
    psf_focus_um: Annotated[float, Meta(ge=-1e6, le=1e6)] = 0.0
    psf_spectrum: Literal["star", "mean"] = "star"
    window: Literal["gaussian", "plain"] = "gaussian"
    window_sigma_px: Annotated[float, Meta(ge=0.1, le=100)] | None = None
    remove_s_curve: bool = False


class Require(Table, frozen=True):
    """[[require]]: a limit of one figure, to be shown at `confidence`; `share` asks for the
    quantile of that share of cases.
    """

    quantity: Quantity
    maximum: Number | None = None
    minimum: Number | None = None
    confidence: Annotated[float, Meta(ge=0.5, le=0.99999)] = 0.95
    share: Annotated[float, Meta(ge=0.01, le=0.99999)] | None = None
    axis: Literal["x", "y", "z", "cross", "roll"] | None = None
    condition: Annotated[str, Meta(max_length=400)] = ""

    @property
    def limit(self) -> float:
        """The limit, of either kind."""
        if self.minimum is None:
            limit = self.maximum
        else:
            limit = self.minimum
        return 0.0 if limit is None else limit

    @property
    def unit(self) -> str:
        """The unit of its quantity."""
        return QUANTITY_UNITS[self.quantity]

    @property
    def of_axis(self) -> bool:
        """Whether its quantity has an axis."""
        return self.quantity in WITH_AXIS

    @property
    def words(self) -> str:
        """The requirement in words: quantity, axis, limit, share and condition."""
        axis = f" {self.axis or 'cross'}" if self.of_axis else ""
        if self.share:
            share = f" in {100 * self.share:g} % of cases"
        else:
            share = ""
        if self.condition:
            where = f" where {self.condition}"
        else:
            where = ""
        side = "at most" if self.minimum is None else "at least"
        unit = QUANTITY_UNITS[self.quantity]
        return (
            f"{self.quantity}{axis} {side} {self.limit:g}{f' {unit}' if unit else ''}{share}{where}"
        )


class PlantedFaults(Table, frozen=True):
    """[planted]: what is wrong with the virtual tracker on purpose, so that a plan shows that it
    finds it. Vectors are about cam x, y, z. `wrong` and `missing` are shares of frames,
    `aberration`, `proper_motion` and `parallax` the shares that are left, `rate_scale` a share of
    the rate, `star_colour` mag a mag of B-V, and `false_stars` a frame's.
    """

    bias_arcsec: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    noise_arcsec: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    lost_roll: bool = False
    wrong: Annotated[float, Meta(ge=0, le=1)] = 0.0
    missing: Annotated[float, Meta(ge=0, le=1)] = 0.0
    acquisition_s: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    recovery_s: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    max_rate_deg_s: Annotated[float, Meta(ge=0, le=1e6)] | None = None
    exclusion_deg: Annotated[float, Meta(ge=0, le=180)] = 0.0
    max_false_stars: Annotated[int, Meta(ge=0, le=100_000)] | None = None
    rate_bias_deg_s: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    rate_noise_deg_s: tuple[Number, Number, Number] = (0.0, 0.0, 0.0)
    rate_scale: Number = 0.0
    rate_lag_s: Number = 0.0
    stamp_bias_s: Number = 0.0
    stamp_jitter_s: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    aberration: Number = 0.0
    proper_motion: Number = 0.0
    catalogue_age_yr: Number = 0.0
    parallax: Number = 0.0
    star_noise_px: Annotated[float, Meta(ge=0, le=100)] = 0.0
    star_fov_px: Annotated[float, Meta(ge=0, le=100)] = 0.0
    star_colour: Number = 0.0
    star_limit_v_mag: Number | None = None
    false_stars: Annotated[float, Meta(ge=0, le=1000)] = 0.0


class Plan(Table, frozen=True):
    """The plan of a campaign, with the tables of its file."""

    bench: Annotated[str, Meta(min_length=1)]
    seed: Annotated[int, Meta(ge=0, le=MAX_SEED)] = 0
    cases: Annotated[int, Meta(ge=1, le=MAX_CASES)] | None = None
    sampling: Sampling = "sobol"
    through: Literal["tracker", "display", "bench"] = "tracker"
    frames: Annotated[int, Meta(ge=1, le=MAX_FRAMES)] = 1
    step_s: Annotated[float, Meta(ge=1e-6, le=1e6)] = 0.2
    noise: Literal["full", "none"] = "full"
    wrong_above_arcsec: Annotated[float, Meta(ge=0, le=648000)] = 1800.0
    answers: Annotated[int, Meta(ge=1, le=MAX_FRAMES)] | None = None
    settle_s: Annotated[float, Meta(ge=0, le=86400)] | None = None
    timeout_s: Annotated[float, Meta(ge=0.01, le=86400)] | None = None
    blank_s: Annotated[float, Meta(ge=0, le=86400)] = 0.0
    silent_s: Annotated[float, Meta(ge=0, le=86400)] = 20.0
    check_every: Annotated[int, Meta(ge=0, le=MAX_CASES)] = 0
    attitudes: Attitudes = msgspec.field(default_factory=Attitudes)
    centroids: Centroiding = msgspec.field(default_factory=Centroiding)
    columns: tuple[Further, ...] = ()
    planted: PlantedFaults | None = None
    vary: Annotated[list[Varied], Meta(max_length=64)] = msgspec.field(default_factory=list)
    require: Annotated[list[Require], Meta(max_length=256)] = msgspec.field(default_factory=list)

    @property
    def asked(self) -> int:
        """How many answers a case on the bench gathers."""
        if self.answers is None:
            return DEFAULT_ANSWERS
        return self.answers

    @property
    def limit_s(self) -> float:
        """How long a case on the bench lasts at most."""
        if self.timeout_s is None:
            return DEFAULT_TIMEOUT_S
        return self.timeout_s


KIND = Kind(Plan, "docs/campaign.md", TYPE_WORDS)


def read_plan(path: Path) -> Plan:
    """Read and check a plan. Raises InputError with file, key, fault and remedy."""
    return parse_plan(path, read_text(path, "give the path of a plan", MAX_TOML_BYTES))


def parse_plan(path: Path, text: str) -> Plan:
    """Check the text of the plan `path`. Raises InputError as `read_plan` does."""
    tables = parse_toml(path, text)
    _check_finite(path, tables)
    try:
        plan = msgspec.convert(tables, Plan)
    except RecursionError as error:
        raise InputError(f"{path}: its tables are nested too deep; see {KIND.reference}") from error
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {explained(str(error), tables, KIND)}") from error
    try:
        for key in TRACKER_KEYS if plan.through == "bench" else BENCH_KEYS:
            if key in tables:
                other = (
                    'through = "tracker" or "display"'
                    if plan.through == "bench"
                    else 'through = "bench"'
                )
                raise InputError(f"{key}: is for {other}; write that, or leave {key} out")
        _check_attitudes(plan.attitudes)
        _check_told(plan.centroids)
        keys = [varied.key for varied in plan.vary]
        for varied in plan.vary:
            if keys.count(varied.key) > 1:
                raise InputError(
                    f'[[vary]] key = "{varied.key}" stands there twice; leave one of them out'
                )
            _check_range(varied, plan.sampling)
        _check_body_angle(keys)
        _check_requires(plan)
        if plan.cases is None and plan.sampling != "grid":
            raise InputError(
                f'sampling = "{plan.sampling}" needs the number of cases; add cases = 1000'
            )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return plan


def _check_finite(path: Path, value: Any) -> None:
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            _check_finite(path, inner)
    elif isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{path}: has the value {value}; a finite number is wanted")


def _check_attitudes(attitudes: Attitudes) -> None:
    if attitudes.kind == "field" and attitudes.radec_deg is None:
        raise InputError('[attitudes] kind = "field" needs radec_deg = [RA, DEC]; add it')
    if attitudes.kind == "log" and attitudes.log is None:
        raise InputError('[attitudes] kind = "log" needs log = "FILE"; add it')
    if (attitudes.kind == "body") != (attitudes.body is not None):
        raise InputError(
            '[attitudes] kind = "body" and body = "sun", "moon", "earth" or a planet go together;'
            " write both, or neither"
        )
    if attitudes.kind != "field" and attitudes.radec_deg is not None:
        raise InputError(
            f'[attitudes] radec_deg is for kind = "field", and kind is "{attitudes.kind}"; write'
            " that, or leave it out"
        )
    if attitudes.kind != "log" and attitudes.log is not None:
        raise InputError(
            f'[attitudes] log is for kind = "log", and kind is "{attitudes.kind}"; write that, or'
            " leave it out"
        )


def _check_body_angle(keys: list[str]) -> None:
    if {"body_deg", "limb_deg"} <= set(keys):
        raise InputError(
            '[[vary]] key = "limb_deg" and "body_deg" are one angle, from the limb and from the'
            " middle of a body; leave one of them out"
        )


def _check_told(centroids: Centroiding) -> None:
    told_keys = centroids.psf, centroids.psf_focus_um, centroids.psf_spectrum
    if centroids.centroider == "window" and told_keys != (TRACKER_PSF, 0.0, "star"):
        raise InputError(
            '[centroids] psf, psf_focus_um and psf_spectrum are for centroider = "psf"; write that,'
            " or leave them out"
        )
    if centroids.psf_focus_um and centroids.psf in (TRACKER_PSF, GAUSSIAN):
        raise InputError(
            f'[centroids] psf_focus_um is for the file of psf, and psf is "{centroids.psf}"; leave'
            " it out"
        )


def _check_range(varied: Varied, sampling: Sampling) -> None:
    where = f'[[vary]] key = "{varied.key}"'
    ends = varied.minimum, varied.maximum
    if (varied.values is None) == (ends == (None, None)):
        raise InputError(f"{where}: write either values = [...], or minimum and maximum")
    if varied.values is not None:
        if varied.steps is not None or varied.scale != "linear":
            raise InputError(
                f"{where}: steps and scale are for minimum and maximum; leave them out beside"
                " values"
            )
        return
    low, high = ends
    if low is None or high is None or not low < high:
        raise InputError(
            f"{where}: minimum = {low}, maximum = {high}; write two numbers, the smaller one first"
        )
    if varied.scale == "log" and low <= 0:
        raise InputError(f'{where}: minimum = {low:g} with scale = "log"; write a number above 0')
    if sampling == "grid" and varied.steps is None:
        raise InputError(
            f'{where}: sampling = "grid" needs values, or steps beside minimum and maximum; add'
            " steps = 5"
        )
    if sampling != "grid" and varied.steps is not None:
        raise InputError(f'{where}: steps is for sampling = "grid"; leave it out')


def _check_requires(plan: Plan) -> None:
    for number, require in enumerate(plan.require, start=1):
        columns = QUANTITY_COLUMNS.get(require.quantity)
        if columns is not None and columns not in plan.columns:
            raise InputError(
                f"[[require]] number {number} ({require.quantity}): is found from columns that the"
                f' table has not; write columns = ["{columns}"] at the top'
            )
        if require.quantity == "edge":
            raise InputError(
                f"[[require]] number {number} (edge): is of a sweep; write it as a [[clause]] of a"
                " plan for hilstar accept"
            )
        check_require(f"[[require]] number {number}", require)


def check_require(where: str, require: Require) -> None:
    """Refuse (InputError) a requirement whose keys do not go together."""
    quantity = require.quantity
    where = f"{where} ({quantity})"
    if (require.maximum is None) == (require.minimum is None):
        raise InputError(f"{where}: write either maximum or minimum, a number")
    if require.axis is not None and not require.of_axis:
        raise InputError(f"{where}: has no axis; leave axis out")
    if require.share is not None and quantity not in WITH_SHARE:
        raise InputError(
            f"{where}: is one figure of all cases, without a share of them; leave share out"
        )
    if quantity in SHARE_QUANTITIES and not 0 <= require.limit <= 1:
        raise InputError(f"{where}: the limit {require.limit:g}; write a share from 0 to 1")
    try:
        conditions_of(require.condition)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


class Condition(NamedTuple):
    """A condition on a column: the key, the comparison, and a number or a text."""

    key: str
    comparison: str
    value: float | str


def conditions_of(text: str) -> list[Condition]:
    """The conditions of `condition = "KEY <= 0.5 and KEY > 0.1"`, none for an empty text. Raises
    InputError.
    """
    conditions = []
    for part in text.split(" and ") if text.strip() else []:
        match = CONDITION.fullmatch(part)
        key, comparison, word, number = match.groups() if match else ("", "", None, "")
        try:
            value = word if word is not None else float(number)
        except ValueError:
            match = None
        if match is None or (word is not None and comparison not in ("==", "!=")):
            raise InputError(
                f'condition = "{shortened(text)}"; write such as "rate_deg_s.across <= 0.5": a key,'
                ' one of <= < >= > == !=, a number, and " and " between several'
            )
        conditions.append(Condition(key, comparison, value))
    return conditions


def checked_conditions(text: str, columns: Mapping[str, str]) -> list[Condition]:
    """The conditions on columns (name -> kind) of a campaign's table, by their names there.
    Raises InputError.
    """
    conditions = []
    for key, comparison, value in conditions_of(text):
        name = f"vary.{key}" if f"vary.{key}" in columns else key
        if name not in columns or isinstance(value, str) != (columns[name] == "text"):
            varied = (
                ", ".join(
                    column.removeprefix("vary.") for column in columns if column.startswith("vary.")
                )
                or "none"
            )
            raise InputError(
                f'[[require]] condition = "{shortened(text)}": {shortened(key)} is no key that the'
                f" plan varies ({varied}),"
                f" and no column of {'texts' if isinstance(value, str) else 'numbers'}; write one"
                " of those"
            )
        conditions.append(Condition(name, comparison, value))
    return conditions


@dataclass(frozen=True, slots=True)
class Parameter:
    """One varied key: its values in order, or its range. `whole` ones are rounded to whole
    numbers.
    """

    key: str
    values: tuple[Any, ...] = ()
    minimum: float = 0.0
    maximum: float = 1.0
    log: bool = False
    whole: bool = False

    def value(self, share: float) -> Any:
        """The value at a place in [0, 1)."""
        if self.values:
            return self.values[min(int(share * len(self.values)), len(self.values) - 1)]
        low, high = (
            (math.log(end) for end in (self.minimum, self.maximum))
            if self.log
            else (self.minimum, self.maximum)
        )
        value = low + share * (high - low)
        if self.log:
            value = min(max(math.exp(value), self.minimum), self.maximum)
        return round(value) if self.whole else value


def parameters(plan: Plan, file: BenchFile) -> list[Parameter]:
    """The plan's parameters, each tried in the bench file at its ends, with those before it that
    have one value alone, or else with the first value of all before it: an orbit needs a date.
    Raises InputError as the file does.
    """
    tables = parse_toml(file.path, file.text)
    parameter_list = []
    fixed: dict[str, Any] = {}
    first: dict[str, Any] = {}
    for varied in plan.vary:
        parameter = _parameter(varied, file)
        ends = parameter.values or (parameter.value(0.0), parameter.value(1.0))
        for value in ends:
            try:
                _check_value(parameter, value, file, tables, fixed)
            except InputError as error:
                try:
                    _check_value(parameter, value, file, tables, first)
                except InputError:
                    named = f'[[vary]] key = "{shortened(varied.key)}"'
                    raise InputError(f"{named}: {error}") from error
        if len(parameter.values) == 1:
            fixed[parameter.key] = parameter.values[0]
        first[parameter.key] = ends[0]
        parameter_list.append(parameter)
    return parameter_list


def grid_levels(plan: Plan) -> list[int]:
    """How many values each key of a grid has."""
    return [len(varied.values or ()) or varied.steps or 1 for varied in plan.vary]


def changed_bench(file: BenchFile, tables: dict[str, Any], values: dict[str, Any]) -> BenchFile:
    """The bench file with some keys (dotted name -> value) changed. Raises InputError as the
    file itself would.
    """
    changes = {key: value for key, value in values.items() if key not in OWN_KEYS}
    if not changes:
        return file
    tables = copy.deepcopy(tables)
    for key, other in (("epoch_utc", "epoch_jyear"), ("epoch_jyear", "epoch_utc")):
        # a varied date stands in the place of the file's
        if f"sky.{key}" in changes:
            tables.get("sky", {}).pop(other, None)
    for key, value in changes.items():
        _set(tables, key.split("."), value, file.config)
    return changed_file(file, tables)


def _parameter(varied: Varied, file: BenchFile) -> Parameter:
    if varied.values is not None:
        return Parameter(varied.key, tuple(varied.values))
    if varied.minimum is None or varied.maximum is None:
        raise AssertionError("the plan has been checked")
    now = _now(varied.key.split("."), file.config)
    now = now[0] if isinstance(now, tuple) and now else now
    whole = varied.key in WHOLE or (isinstance(now, int) and not isinstance(now, bool))
    ends = Parameter(varied.key, (), varied.minimum, varied.maximum, varied.scale == "log", whole)
    if varied.steps is None:
        return ends
    return Parameter(
        varied.key,
        tuple(ends.value(step / max(1, varied.steps - 1)) for step in range(varied.steps)),
    )


def _check_value(
    parameter: Parameter,
    value: Any,
    file: BenchFile,
    tables: dict[str, Any],
    fixed: dict[str, Any],
) -> None:
    if parameter.key not in OWN_KEYS:
        changed_bench(file, tables, fixed | {parameter.key: value})
        return
    if parameter.key == SCENARIO:
        if not isinstance(value, str):
            raise InputError(
                f'the value {shortened(value)}; write paths of scenario files, and "" for none'
            )
        return
    whole = parameter.key in WHOLE
    largest = MAX_OWN[parameter.key.split(".")[0]]
    low = 0 if parameter.key in NOT_NEGATIVE else -largest
    if (
        isinstance(value, bool)
        or not isinstance(value, int if whole else int | float)
        or not low <= value <= largest
    ):
        raise InputError(
            f"the value {shortened(value)}; write a number from {low:g} to {largest:g}"
        )


def _now(names: list[str], config: Any) -> Any:
    """The bench file's value at dotted `names`, defaults included; None for an unknown one."""
    for name in names:
        if isinstance(config, tuple):
            if name.isdigit() and int(name) < len(config):
                config = config[int(name)]
            else:
                config = None
        elif isinstance(config, msgspec.Struct):
            config = getattr(config, name, None)
        else:
            return None
    return config


def _set(tables: dict[str, Any], names: list[str], value: Any, config: Any) -> None:
    """Set the key of dotted `names`. One number for a key of several (sigma along x and y) sets
    each of them.
    """
    table: Any = tables
    for name in names[:-1]:
        if isinstance(table, dict):
            inside = table.get(name)
        else:
            inside = None
        if inside is None or not isinstance(inside, dict | list):
            present = _now(names[: names.index(name) + 1], config)
            if isinstance(present, tuple):
                inside = list(present)
            else:
                inside = {}
            table[name] = inside
        table = inside
    last = names[-1]
    present = _now(names, config)
    if isinstance(present, tuple) and not isinstance(value, list):
        value = [value] * len(present)
    if isinstance(table, list):
        if not last.isdigit() or int(last) >= len(table):
            raise InputError(
                f"{'.'.join(names)}: write a number from 0 to {len(table) - 1} after the last dot"
            )
        table[int(last)] = value
    else:
        table[last] = value


class Design:
    """Points (n, dimensions) of the cases in [0, 1): the coordinates of the attitude, then one for
    each varied key.

    A grid's keys have `levels` values each, in order, the last key fastest, and repeat after the
    last combination. Raises InputError for a Latin hypercube that does not fit into memory.
    """

    def __init__(
        self,
        sampling: Sampling,
        seed: int,
        cases: int,
        attitude_dimensions: int,
        levels: Sequence[int],
    ) -> None:
        self.sampling = sampling
        self.seed = seed
        self.cases = cases
        self.attitude_dimensions = attitude_dimensions
        self.levels = tuple(levels)
        self.dimensions = attitude_dimensions + len(levels)
        self._cube: FloatArray | None = None
        self._engine: Sobol | None = None
        if sampling == "latin-hypercube":
            if cases * self.dimensions > MAX_HYPERCUBE_VALUES:
                most = MAX_HYPERCUBE_VALUES // self.dimensions
                raise InputError(
                    f"cases = {cases}: a Latin hypercube is made as a whole, of at most {most}"
                    " cases with"
                    f' {self.dimensions} dimensions; write sampling = "sobol"'
                )
            from scipy.stats import qmc

            self._cube = qmc.LatinHypercube(
                self.dimensions, rng=np.random.default_rng(seed)
            ).random(cases)

    def points(self, begin: int, end: int) -> FloatArray:
        """The points of the cases from `begin` to before `end`."""
        if self._cube is not None:
            return self._cube[begin:end]
        if self.sampling == "sobol":
            from scipy.stats import qmc

            if self._engine is None or self._engine.num_generated > begin:
                rng = np.random.default_rng(self.seed)
                self._engine = qmc.Sobol(self.dimensions, scramble=True, bits=SOBOL_BITS, rng=rng)
            if begin > self._engine.num_generated:
                self._engine.fast_forward(begin - self._engine.num_generated)
            # that the number of points is no power of two: the plan decides it
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                return np.asarray(self._engine.random(end - begin))
        points = np.empty((end - begin, self.dimensions))
        own_dimensions = self.attitude_dimensions
        for row, case in zip(points, range(begin, end), strict=True):
            row[:own_dimensions] = np.random.default_rng((self.seed, case, ATTITUDE_STREAM)).random(
                own_dimensions
            )
            if self.levels:
                level = np.unravel_index(case % math.prod(self.levels), self.levels)
            else:
                level = ()
            row[own_dimensions:] = (np.array(level) + 0.5) / self.levels
        return points
