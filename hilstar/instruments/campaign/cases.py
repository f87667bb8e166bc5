"""A case: its attitude and bench file, from its number and its point in the design; and its row,
from its answers.
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np

from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.log_file import log_timeline, open_log
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.reading import parse_toml
from hilstar.basics.rotation import (
    from_radec_roll_deg,
    from_rotation_vector,
    multiply,
    normalise,
    to_radec_roll_deg,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.campaign.case_motion import (
    ACCELERATION,
    ACROSS,
    AXES,
    AXIS_STREAM,
    JITTER,
    JITTER_HZ,
    MOTION_S,
    RATE,
    CaseMotion,
    by_axis,
    swing_pieces,
)
from hilstar.instruments.campaign.plan import (
    SCENARIO,
    Attitudes,
    Further,
    Parameter,
    Plan,
    changed_bench,
    parameters,
)
from hilstar.instruments.campaign.store import Row
from hilstar.instruments.simulate.exposures import faulty_exposure, view_at
from hilstar.instruments.simulate.simulator import FaultyExposure, Simulator
from hilstar.optics.layers.fault_kinds import Fault, fault_of
from hilstar.optics.layers.view import View
from hilstar.server.bench.bench_file import BenchFile, dated, stated_in
from hilstar.server.bench.scenario import NO_SCENARIO, Scenario, read_scenario
from hilstar.server.bench.star_light import bench_moving

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky

ATTITUDE_DIMENSIONS = {"all-sky": 3, "field": 3, "log": 1, "body": 3}
STRAY, STRAY_DEG, STRAY_FROM_S = "stray_e_per_px", 80.0, -1e5
SEED_BITS = 63  # a FITS header, a Parquet column of int64 and `simulate --seed` hold as many
# what varies on a real bench
ON_BENCH = (
    "sky",
    "render",
    "spacecraft",
    RATE,
    ACCELERATION,
    MOTION_S,
    JITTER,
    JITTER_HZ,
    "time_s",
    "scenario",
    "body_deg",
    "limb_deg",
)
Kind = Literal["int64", "float64", "bool", "text", "floats"]

SINGLE_BODIES = ("sun", "moon", "earth")  # that have keys of their own; planets share one
MIN_FRAMES_A_SWING = 6  # of jitter on a display: fewer are steps of half an amplitude and more

DONE, FAILED = "done", "failed"

Q = ("qw", "qx", "qy", "qz")
TEXTS = {"status", "why", "bench_sha256", "image_sha256", "image", "begun_utc"}
WHOLE = {"case", "noise_seed", "t_ns", "frames", "stars_in_view", "solved", "wrong"}
WHOLE |= {"stars", "found", "matched", "false", "measured", "order", "run", "received", "late"}
BEFORE = (
    *("case", "status", "why", "noise_seed", "bench_sha256", "image_sha256", "image", "t_ns"),
    *(*Q, "ra_deg", "dec_deg", "roll_deg"),
)
AFTER = (
    *(
        "frames",
        "stars_in_view",
        "limit_v_mag",
        "solved",
        "wrong",
        "first_attitude_s",
        *(f"solved_{name}" for name in Q),
    ),
    *(f"{what}_{axis}_arcsec" for what in ("error", "scatter") for axis in AXES),
)
BENCH_BEFORE = (
    "case",
    "status",
    "why",
    "order",
    "run",
    "begun_utc",
    "bench_sha256",
    *BEFORE[BEFORE.index("t_ns") :],
)
BENCH_AFTER = (
    *(
        "frames",
        "received",
        "late",
        "solved",
        "wrong",
        "wrong_deg",
        "first_attitude_s",
        "stars",
        "signal_mag",
    ),
    *(f"{what}_{name}" for what in ("solved", "lit") for name in Q),
    *AFTER[AFTER.index("error_x_arcsec") :],
)
# Lists of a value a frame with a right answer, or a star: what [[require]] is judged by, in a plan
# whose `columns` ask for it.
FRAME_RATES = tuple(f"frame_rate_{axis}_deg_s" for axis in AXES)
FRAME_ERRORS = tuple(f"frame_error_{axis}_arcsec" for axis in AXES)
FRAME_RATE_ERRORS = tuple(f"frame_rate_error_{axis}_deg_s" for axis in AXES)
STAR_LISTS = (
    *("star_x_px", "star_y_px", "star_v_mag", "star_bv"),
    *("star_dx_px", "star_dy_px", "star_signal_mag", "star_lit_mag"),
)
REPORTED_FRAMES, FALSE_STARS = "star_frames", "star_false"
FURTHER: dict[Further, tuple[str, ...]] = {
    "rate": (*FRAME_RATES, *FRAME_RATE_ERRORS),
    "time": (*FRAME_RATES, *FRAME_ERRORS),
    "stars": (REPORTED_FRAMES, FALSE_STARS, *STAR_LISTS),
}
RECOVERY = ("fault_end_s", "recovery_s")  # only in a plan that varies scenario or motion_s
CENTROIDS = (
    *("stars", "found", "matched", "false", "measured"),
    *("centroid_dx_px", "centroid_dy_px", "centroid_sigma_x_px", "centroid_sigma_y_px"),
)


@dataclass(frozen=True, slots=True)
class Case:
    """A case before its bench is made: its values by key, the seed of its noise, the view of its
    first exposure, and how it moves from there.
    """

    number: int
    values: dict[str, Any]
    noise_seed: int
    first: View
    motion: CaseMotion

    @property
    def body_deg(self) -> float:
        """The angle from the body that the case looks beside: from its limb where the plan gives
        that, else from its middle; 180 without a body.
        """
        limb_deg = self.values.get("limb_deg")
        if limb_deg is None:
            return float(self.values.get("body_deg", 180.0))
        return float(limb_deg)


@dataclass(frozen=True, slots=True)
class _Log:
    timeline: Timeline
    span_ns: tuple[int, int]
    scale: str | None

    @property
    def begin_ns(self) -> int:
        """The time of the log's first sample."""
        return self.span_ns[0]


class CaseMaker:
    """Makes the cases of a plan, whose relative paths start in `folder`. Raises InputError for a
    fault of the plan.
    """

    def __init__(self, plan: Plan, file: BenchFile, folder: Path) -> None:
        self.plan = plan
        self.file = file
        self._tables = parse_toml(file.path, file.text)
        self._log: _Log | None = None
        if plan.attitudes.log is not None:
            self._log = _read_log(folder / plan.attitudes.log, file)
            self.file = dated(file, self._log.scale, self._log.begin_ns)
        self.parameters: list[Parameter] = parameters(plan, file)
        self._scenarios: dict[str, Scenario] = {}
        for parameter in self.parameters:
            if parameter.key == SCENARIO:
                for name in filter(None, parameter.values):
                    self._scenarios[str(name)] = read_scenario(folder / str(name))
        self._skies: dict[str, MovingSky | None] = {}
        _check_through(plan, self.parameters, file)
        if plan.attitudes.body is not None:  # so that a body that is not there is refused here
            dimensions = self.attitude_dimensions + len(self.parameters)
            self.case(0, np.full(dimensions, 0.5))

    @property
    def attitude_dimensions(self) -> int:
        """How many of a point's coordinates, its first, set the attitude."""
        return ATTITUDE_DIMENSIONS[self.plan.attitudes.kind]

    def case(self, number: int, point: FloatArray) -> Case:
        """The case of this number at a point (dimensions,) of the design."""
        look = point[: self.attitude_dimensions]
        rest = point[self.attitude_dimensions :]
        values = {}
        for parameter, u in zip(self.parameters, rest, strict=True):
            values[parameter.key] = parameter.value(float(u))
        seed = values.get("noise_seed")
        if seed is None:
            sequence = np.random.SeedSequence((self.plan.seed, number))
            state = sequence.generate_state(1, np.uint64)
            seed = int(state[0]) >> 64 - SEED_BITS
        t_ns = self._begin_ns(look, values)
        q = self._begin_q(look, values, t_ns)
        rng = np.random.default_rng((self.plan.seed, number, AXIS_STREAM))
        motion = CaseMotion.of(q, values, rng)
        return Case(number, values, int(seed), motion.exposure(0.0, 0.0, t_ns), motion)

    def bench(self, case: Case) -> BenchFile:
        """The bench file with the case's values. Raises InputError where they do not go
        together.
        """
        file = changed_bench(self.file, self._tables, case.values)
        if self._log is not None:
            file = dated(file, self._log.scale, self._log.begin_ns)
        turn_arcsec = by_axis(case.values, "misalignment_arcsec")
        if turn_arcsec.any():
            return _misaligned(file, turn_arcsec)
        return file

    def view(self, case: Case, frame: int, exposure_s: float) -> View:
        """The view of one of the case's exposures, `step_s` apart: at the case's rate, or along
        the log.
        """
        step_ns = round(frame * self.plan.step_s * NS_PER_S)
        return self.after(case, step_ns, exposure_s)

    def after(self, case: Case, step_ns: int, exposure_s: float = 0.0) -> View:
        """The view so long after the case's begin."""
        first = case.first
        if self._log is not None and first.t_ns is not None:
            _, end_ns = self._log.span_ns
            t_ns = min(first.t_ns + step_ns, end_ns)
            along = view_at(self._log.timeline, self._log.span_ns, t_ns, exposure_s)
            if not any(key.startswith("rate_deg_s.") for key in case.values):
                return along
            return View.exposure(along.q_icrs_to_cam, first.turn.rate_cam_rad_s, exposure_s, t_ns)
        return case.motion.exposure(step_ns / NS_PER_S, exposure_s, (first.t_ns or 0) + step_ns)

    def faults(self, case: Case, view: View, simulator: Simulator) -> FaultyExposure | None:
        """The exposure of a view by its pieces, with the faults of the case's scenario at the
        case's time or the log's since its beginning; None where it is one piece without faults.
        """
        scenario = self.scenario(case)
        views = [view]
        t_ns = view.t_ns or 0
        if self._log is None:
            since_s = (t_ns - (case.first.t_ns or 0)) / NS_PER_S
            views = case.motion.pieces(since_s, view.exposure_s, t_ns)
        if scenario is None and len(views) == 1:
            return None
        return faulty_exposure(simulator, views, scenario or NO_SCENARIO, t_ns - self.begin_ns)

    @property
    def begin_ns(self) -> int:
        """The time of a case's view from which its scenario counts: 0, or the log's begin."""
        if self._log is None:
            return 0
        return self._log.begin_ns

    def scenario(self, case: Case) -> Scenario | None:
        """The case's scenario, its stray light among the faults."""
        name = str(case.values.get(SCENARIO, ""))
        scenario = self._scenarios.get(name)
        stray_e = float(case.values.get(STRAY, 0.0))
        if stray_e <= 0:
            return scenario
        glow = stray_light(stray_e, self.file)
        if scenario is None:
            return Scenario(Path(), "", case.noise_seed, (glow,))
        return dataclasses.replace(scenario, faults=(*scenario.faults, glow))

    def fault_end_s(self, case: Case, length_s: float) -> float | None:
        """When the case's motion or the last fault of its scenario ends, after the case's begin;
        None outside its `length_s`.
        """
        end_s = case.motion.motion_s
        scenario = self.scenario(case)
        if scenario is not None and scenario.end_s:
            since_begin_ns = (case.first.t_ns or 0) - self.begin_ns
            end_s = scenario.end_s - since_begin_ns / NS_PER_S
        if 0 < end_s <= length_s:
            return end_s
        return None

    def _begin_ns(self, look: FloatArray, values: dict[str, Any]) -> int:
        """The time of a case's first exposure: the case's own, or along the log."""
        if self._log is not None:
            begin_ns, end_ns = self._log.span_ns
            return begin_ns + round(float(look[0]) * (end_ns - begin_ns))
        return round(float(values.get("time_s", 0.0)) * NS_PER_S)

    def _begin_q(self, look: FloatArray, values: dict[str, Any], t_ns: int) -> FloatArray:
        """The attitude `q_icrs_to_cam` (4,) with which a case begins."""
        if self._log is not None:
            return view_at(self._log.timeline, self._log.span_ns, t_ns, 0.0).q_icrs_to_cam
        if self.plan.attitudes.body is None:
            return looking_q(self.plan.attitudes, look)
        return self._beside_body(self.plan.attitudes, look, values, t_ns)

    def _beside_body(
        self, attitudes: Attitudes, look: FloatArray, values: dict[str, Any], t_ns: int
    ) -> FloatArray:
        """`q_icrs_to_cam` (4,) at the case's angle from a body, on any side of it. Raises
        InputError where the bench has no such body.
        """
        file = changed_bench(self.file, self._tables, values)
        if file.sha256 not in self._skies:
            self._skies = {file.sha256: bench_moving(file.config, file.folder)}
        moving = self._skies[file.sha256]
        disc = None
        if moving is not None:
            pole = np.array([0.0, 0.0, 1.0])
            discs = moving.discs(pole, math.pi, t_ns=t_ns)
            disc = next((disc for disc in discs if disc.name.lower() == attitudes.body), None)
        if disc is None:
            key = str(attitudes.body)
            if key not in SINGLE_BODIES:
                key = "planets"
            raise InputError(
                f'[attitudes] body = "{attitudes.body}": the bench has none; write [sky] epoch_utc'
                f" and [sky.bodies] {key} = true, or vary sky.bodies.{key}"
            )
        off_rad = math.radians(float(values.get("body_deg", 0.0)))
        limb_deg = values.get("limb_deg")
        if limb_deg is not None:
            # deeper than the middle of the disc is nowhere
            limb_rad = math.radians(float(limb_deg))
            off_rad = max(disc.radius_rad + limb_rad, 0.0)
        position_angle_rad = 2 * math.pi * float(look[0])
        roll_deg = _roll_deg(attitudes, float(look[2]))
        return beside_q(disc.direction, off_rad, position_angle_rad, roll_deg)


def looking_q(attitudes: Attitudes, look: FloatArray) -> FloatArray:
    """`q_icrs_to_cam` (4,) at three coordinates in [0, 1): uniform over the sphere or the
    field's cap, and over the rolls.
    """
    around, along, rolled = look.tolist()
    roll_deg = _roll_deg(attitudes, rolled)
    if attitudes.kind == "all-sky" or attitudes.radec_deg is None:
        dec_rad = math.asin(2 * along - 1)
        return from_radec_roll_deg(360 * around, math.degrees(dec_rad), roll_deg)
    radius_rad = math.radians(attitudes.radius_deg)
    off_rad = math.acos(1 - along * (1 - math.cos(radius_rad)))
    ra_deg, dec_deg = attitudes.radec_deg
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    x = math.cos(dec) * math.cos(ra)
    y = math.cos(dec) * math.sin(ra)
    middle = np.array([x, y, math.sin(dec)])
    return beside_q(middle, off_rad, 2 * math.pi * around, roll_deg)


def _roll_deg(attitudes: Attitudes, rolled: float) -> float:
    """The roll at a coordinate in [0, 1)."""
    low_deg, high_deg = attitudes.roll_deg
    return low_deg + rolled * (high_deg - low_deg)


def beside_q(middle: FloatArray, off: float, angle: float, roll_deg: float) -> FloatArray:
    """`q_icrs_to_cam` (4,) with the boresight `off` (rad) from an ICRS direction (3,), at a
    position angle (rad) from north to east.
    """
    middle_x, middle_y, middle_z = middle.tolist()
    ra = math.atan2(middle_y, middle_x)
    # rounding may have made a direction longer than 1
    sin_dec = max(-1.0, min(1.0, middle_z))
    dec = math.asin(sin_dec)
    east = np.array([-math.sin(ra), math.cos(ra), 0.0])
    north_x = -math.sin(dec) * math.cos(ra)
    north_y = -math.sin(dec) * math.sin(ra)
    north = np.array([north_x, north_y, math.cos(dec)])
    sideways = math.sin(angle) * east + math.cos(angle) * north
    x, y, z = math.cos(off) * middle + math.sin(off) * sideways
    boresight_ra = math.atan2(y, x)
    boresight_dec = math.atan2(z, math.hypot(x, y))
    return from_radec_roll_deg(math.degrees(boresight_ra), math.degrees(boresight_dec), roll_deg)


def stray_light(electrons: float, file: BenchFile) -> Fault:
    """Even light over the tracker's detector: a glow that is far wider than any field."""
    width, height = file.config.tracker.resolution_px
    middle = [(width - 1) / 2, (height - 1) / 2]
    table = {"name": "stray light", "kind": "glow", "scale_deg": STRAY_DEG, "tracker_px": middle}
    # on before the first exposure begins, half of which is before the case's begin
    return fault_of(table | {"electrons": electrons, "at_s": STRAY_FROM_S})


def _read_log(path: Path, file: BenchFile) -> _Log:
    read = open_log(path, stated_in(file.config))
    max_rate_rad_s = math.radians(file.config.attitude.max_rate_deg_s)
    timeline = log_timeline(read.samples, Policy(0, NS_PER_S, max_rate_rad_s))
    begin, end = read.samples[0], read.samples[-1]
    return _Log(timeline, (begin.t_ns, end.t_ns), read.conventions.scale)


def _misaligned(file: BenchFile, turn_arcsec: FloatArray) -> BenchFile:
    """The file with the display's true mounting turned from the assumed one by small angles (3,)
    about cam's axes.
    """
    config = file.config
    assumed = np.array(config.verify.true_q_cam_to_mon or config.collimator.q_cam_to_mon)
    turn = from_rotation_vector(turn_arcsec / ARCSEC_PER_RAD)
    true = normalise(multiply(assumed, turn))
    w, x, y, z = true.tolist()
    verify = msgspec.structs.replace(config.verify, true_q_cam_to_mon=(w, x, y, z))
    config = msgspec.structs.replace(config, verify=verify)
    return dataclasses.replace(file, config=config)


def _check_through(plan: Plan, varied: list[Parameter], file: BenchFile) -> None:
    """Refuse (InputError) parameters that would change nothing, or that cannot be shown."""
    _check_motion(plan, varied, file)
    for parameter in varied:
        table = parameter.key.split(".")[0]
        if plan.through == "bench" and table not in ON_BENCH:
            raise InputError(
                f'[[vary]] key = "{parameter.key}": cannot be changed on a real bench; write a key'
                " of [sky], [render] or [spacecraft], rate_deg_s.*, time_s or scenario, or leave"
                " it out"
            )
        if plan.through == "tracker" and table in {
            "monitor",
            "collimator",
            "render",
            "verify",
            "misalignment_arcsec",
        }:
            raise InputError(
                f'[[vary]] key = "{parameter.key}": changes nothing for through = "tracker", which'
                ' sees no display; write through = "display", or leave it out'
            )
        if plan.attitudes.kind == "log" and parameter.key == "time_s":
            raise InputError(
                '[[vary]] key = "time_s": with a log the times are the log\'s; leave it out'
            )
        if plan.through == "display" and table in (SCENARIO, STRAY, MOTION_S, JITTER, JITTER_HZ):
            raise InputError(
                f'[[vary]] key = "{parameter.key}": what changes within an exposure is of'
                ' through = "tracker"; write that'
            )
        if plan.attitudes.kind == "log" and table in (ACCELERATION, MOTION_S, JITTER, JITTER_HZ):
            raise InputError(
                f'[[vary]] key = "{parameter.key}": with a log the motion is the log\'s; leave it'
                " out"
            )
        if table == "misalignment_arcsec" and (
            file.config.collimator.geometry or file.config.verify.true_geometry
        ):
            raise InputError(
                f'[[vary]] key = "{parameter.key}": the bench has a geometry file, whose own'
                " alignment counts; vary verify.true_geometry over several files instead"
            )


def _check_motion(plan: Plan, varied: list[Parameter], file: BenchFile) -> None:
    """Refuse (InputError) motions that do not go together, or are too fast to be shown."""
    by_key = {parameter.key: parameter for parameter in varied}
    jitters = [key for key in by_key if key.split(".")[0] == JITTER]
    if bool(jitters) != (JITTER_HZ in by_key):
        raise InputError(
            f'[[vary]] key = "{JITTER}.across" and "{JITTER_HZ}" go together; write both, or'
            " neither"
        )
    if MOTION_S in by_key and SCENARIO in by_key:
        raise InputError(
            f'[[vary]] key = "{MOTION_S}" and "{SCENARIO}": recovery counts from the end of either;'
            " leave one of them out"
        )
    # a rate's errors are fitted with one acceleration a case, which its row has by axis
    fitted = [f"{ACCELERATION}.{ACROSS}", MOTION_S, *jitters]
    for key in fitted:
        if "rate" in plan.columns and key in by_key:
            raise InputError(
                f'[[vary]] key = "{key}": errors of the rate are not told in such cases; vary'
                f" {ACCELERATION}.x, .y and .z, or write other cases for them"
            )
    if not jitters:
        return
    hz = by_key[JITTER_HZ]
    fastest_hz = max(hz.values or (hz.maximum,))
    if plan.through == "bench":
        shown_hz = file.config.monitor.refresh_hz / MIN_FRAMES_A_SWING
        if fastest_hz > shown_hz:
            raise InputError(
                f'[[vary]] key = "{JITTER_HZ}": {fastest_hz:g} Hz on a display of'
                f" {file.config.monitor.refresh_hz:g} Hz; write at most {shown_hz:g}"
            )
        return
    try:
        swing_pieces(file.config.tracker.exposure_s, fastest_hz)
    except InputError as error:
        raise InputError(f'[[vary]] key = "{JITTER_HZ}": {error}') from error


def bench_columns(
    parameters: list[Parameter], further: tuple[Further, ...] = ()
) -> dict[str, Kind]:
    """The columns of the rows of a campaign on the bench, in their order."""
    names = columns(parameters, False)
    varied = [name for name in names if name.startswith("vary.")]
    kinds: dict[str, Kind] = {}
    for name in (*BENCH_BEFORE, *varied, *BENCH_AFTER):
        kinds[name] = columns_kind(name)
    kinds["stars"] = "float64"
    for name in (*varied, *RECOVERY):
        if name in names:
            kinds[name] = names[name]
    return kinds | further_columns(further)


def columns_kind(name: str) -> Kind:
    """The kind of a column that is not varied."""
    if name in TEXTS:
        return "text"
    if name in WHOLE:
        return "int64"
    return "float64"


def columns(
    parameters: list[Parameter], with_centroids: bool, further: tuple[Further, ...] = ()
) -> dict[str, Kind]:
    """The columns of a campaign's rows, in their order."""
    varied: dict[str, Kind] = {}
    for parameter in parameters:
        varied[f"vary.{parameter.key}"] = value_kind(parameter)
    names = [*BEFORE, *varied, *AFTER]
    if f"vary.{SCENARIO}" in varied or f"vary.{MOTION_S}" in varied:
        names += RECOVERY
    if with_centroids:
        names += CENTROIDS
    kinds: dict[str, Kind] = {}
    for name in names:
        kinds[name] = varied.get(name) or columns_kind(name)
    return kinds | further_columns(further)


def further_columns(further: tuple[Further, ...]) -> dict[str, Kind]:
    """The columns that a plan's `columns` ask for."""
    kinds: dict[str, Kind] = {}
    for part in further:
        for name in FURTHER[part]:
            kinds[name] = "floats"
            if name in (REPORTED_FRAMES, FALSE_STARS):
                kinds[name] = "int64"
    return kinds


def value_kind(parameter: Parameter) -> Kind:
    """The column type of a parameter's values."""
    if not parameter.values:
        return "int64" if parameter.whole else "float64"
    kinds = {type(value) for value in parameter.values}
    if kinds == {bool}:
        return "bool"
    if kinds == {int} and all(abs(value) < 2**63 for value in parameter.values):
        return "int64"
    return "float64" if kinds <= {int, float} else "text"


def first_row(case: Case, plan_columns: dict[str, Kind]) -> Row:
    """The row of a case before its exposures: columns of results are None."""
    row: Row = dict.fromkeys(plan_columns)
    q = case.first.q_icrs_to_cam
    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(q)
    row |= {
        "case": case.number,
        "status": DONE,
        "why": "",
        "noise_seed": case.noise_seed,
        "t_ns": case.first.t_ns,
    }
    row |= dict(zip(Q, q.tolist(), strict=True))
    row |= {"ra_deg": ra_deg, "dec_deg": dec_deg, "roll_deg": roll_deg}
    for key, value in case.values.items():
        name = f"vary.{key}"
        row[name] = value
        if plan_columns[name] == "text":
            row[name] = str(value)
    return row


def failed(row: Row, why: str) -> Row:
    """The row of a case that failed."""
    return row | {"status": FAILED, "why": why}
