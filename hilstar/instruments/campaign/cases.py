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
    propagate,
    to_radec_roll_deg,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
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
from hilstar.optics.frame_motion import CameraTurn
from hilstar.optics.layers.fault_kinds import Fault, fault_of
from hilstar.optics.layers.view import View
from hilstar.server.bench.bench_file import BenchFile, dated, stated_in
from hilstar.server.bench.scenario import Scenario, read_scenario
from hilstar.server.bench.star_light import bench_moving

if TYPE_CHECKING:
    from hilstar.sky.bodies.moving import MovingSky

ATTITUDE_DIMENSIONS = {"all-sky": 3, "field": 3, "log": 1, "body": 3}
MAX_STEP_S = 0.01  # of a turn that accelerates
STRAY, STRAY_DEG, STRAY_FROM_S = "stray_e_per_px", 80.0, -1e5
AXIS_STREAM = 2  # stream of a case's seed for the axis of a rate across the boresight
SEED_BITS = 63  # a FITS header, a Parquet column of int64 and `simulate --seed` hold as many
# what varies on a real bench
ON_BENCH = (
    "sky",
    "render",
    "spacecraft",
    "rate_deg_s",
    "acceleration_deg_s2",
    "time_s",
    "scenario",
    "body_deg",
    "limb_deg",
)
Kind = Literal["int64", "float64", "bool", "text", "floats"]

DONE, FAILED = "done", "failed"
AXES = ("x", "y", "z")

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
    *("star_dx_px", "star_dy_px", "star_signal_mag"),
)
REPORTED_FRAMES, FALSE_STARS = "star_frames", "star_false"
FURTHER: dict[Further, tuple[str, ...]] = {
    "rate": (*FRAME_RATES, *FRAME_RATE_ERRORS),
    "time": (*FRAME_RATES, *FRAME_ERRORS),
    "stars": (REPORTED_FRAMES, FALSE_STARS, *STAR_LISTS),
}
RECOVERY = ("fault_end_s", "recovery_s")  # only in a plan that varies scenario
CENTROIDS = (
    *("stars", "found", "matched", "false", "measured"),
    *("centroid_dx_px", "centroid_dy_px", "centroid_sigma_x_px", "centroid_sigma_y_px"),
)


@dataclass(frozen=True, slots=True)
class Case:
    """A case before its bench is made: its values by key, the seed of its noise, and the view of
    its first exposure.
    """

    number: int
    values: dict[str, Any]
    noise_seed: int
    first: View

    @property
    def body_deg(self) -> float:
        """The angle from the body that the case looks beside: from its limb where the plan gives
        that, else from its middle; 180 without a body.
        """
        limb_deg = self.values.get("limb_deg")
        if limb_deg is None:
            return float(self.values.get("body_deg", 180.0))
        return float(limb_deg)

    @property
    def acceleration_rad_s2(self) -> FloatArray:
        """The angular acceleration (3,), cam."""
        return np.radians(
            [float(self.values.get(f"acceleration_deg_s2.{axis}", 0.0)) for axis in AXES]
        )


@dataclass(frozen=True, slots=True)
class _Log:
    timeline: Timeline
    span_ns: tuple[int, int]
    scale: str | None


class CaseMaker:
    """Makes the cases of a plan, whose relative paths start in `folder`. Raises InputError for a
    fault of the plan.
    """

    def __init__(self, plan: Plan, file: BenchFile, folder: Path) -> None:
        self.plan = plan
        self.file = file
        self._tables = parse_toml(file.path, file.text)
        self._log = (
            None if plan.attitudes.log is None else _read_log(folder / plan.attitudes.log, file)
        )
        if self._log is not None:
            self.file = dated(file, self._log.scale, self._log.span_ns[0])
        self.parameters: list[Parameter] = parameters(plan, file)
        named = [
            str(name)
            for parameter in self.parameters
            if parameter.key == SCENARIO
            for name in parameter.values
            if name
        ]
        self._scenarios = {name: read_scenario(folder / name) for name in named}
        self._skies: dict[str, MovingSky | None] = {}
        _check_through(plan, self.parameters, file)
        if plan.attitudes.body is not None:  # so that a body that is not there is refused here
            self.case(0, np.full(self.attitude_dimensions + len(self.parameters), 0.5))

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
            state = np.random.SeedSequence((self.plan.seed, number)).generate_state(1, np.uint64)
            seed = int(state[0]) >> 64 - SEED_BITS
        return Case(number, values, int(seed), self._first(number, look, values))

    def bench(self, case: Case) -> BenchFile:
        """The bench file with the case's values. Raises InputError where they do not go
        together.
        """
        file = changed_bench(self.file, self._tables, case.values)
        if self._log is not None:
            file = dated(file, self._log.scale, self._log.span_ns[0])
        turn_arcsec = [float(case.values.get(f"misalignment_arcsec.{axis}", 0.0)) for axis in "xyz"]
        if any(turn_arcsec):
            return _misaligned(file, np.array(turn_arcsec))
        return file

    def view(self, case: Case, frame: int, exposure_s: float) -> View:
        """The view of one of the case's exposures, `step_s` apart: at the case's rate, or along
        the log.
        """
        return self.after(case, round(frame * self.plan.step_s * NS_PER_S), exposure_s)

    def after(self, case: Case, step_ns: int, exposure_s: float = 0.0) -> View:
        """The view so long after the case's begin."""
        first = case.first
        if self._log is not None and first.t_ns is not None:
            t_ns = min(first.t_ns + step_ns, self._log.span_ns[1])
            along = view_at(self._log.timeline, self._log.span_ns, t_ns, exposure_s)
            if not any(key.startswith("rate_deg_s.") for key in case.values):
                return along
            return View.exposure(along.q_icrs_to_cam, first.turn.rate_cam_rad_s, exposure_s, t_ns)
        rate_rad_s = first.turn.rate_cam_rad_s
        acceleration_rad_s2 = case.acceleration_rad_s2
        if acceleration_rad_s2.any():
            q, rate_rad_s = accelerated(first.turn, acceleration_rad_s2, step_ns / NS_PER_S)
        elif step_ns:
            q = propagate(first.q_icrs_to_cam, rate_rad_s, step_ns / NS_PER_S)
        else:
            q = first.q_icrs_to_cam
        return View.exposure(q, rate_rad_s, exposure_s, (first.t_ns or 0) + step_ns)

    def faults(self, case: Case, view: View, simulator: Simulator) -> FaultyExposure | None:
        """The faults of the case's scenario in an exposure, at the case's time or the log's
        since its beginning.
        """
        scenario = self.scenario(case)
        if scenario is None:
            return None
        return faulty_exposure(simulator, view, scenario, (view.t_ns or 0) - self.begin_ns)

    @property
    def begin_ns(self) -> int:
        """The time of a case's view from which its scenario counts: 0, or the log's begin."""
        return 0 if self._log is None else self._log.span_ns[0]

    def scenario(self, case: Case) -> Scenario | None:
        """The case's scenario, its stray light among the faults."""
        scenario = self._scenarios.get(str(case.values.get(SCENARIO, "")))
        stray_e = float(case.values.get(STRAY, 0.0))
        if stray_e <= 0:
            return scenario
        glow = stray_light(stray_e, self.file)
        if scenario is None:
            return Scenario(Path(), "", case.noise_seed, (glow,))
        return dataclasses.replace(scenario, faults=(*scenario.faults, glow))

    def fault_end_s(self, case: Case, length_s: float) -> float | None:
        """When the last fault of the case's scenario ends, after the case's begin; None outside
        its `length_s`.
        """
        scenario = self.scenario(case)
        if scenario is None:
            return None
        end_s = scenario.end_s - ((case.first.t_ns or 0) - self.begin_ns) / NS_PER_S
        return end_s if 0 < end_s <= length_s else None

    def _first(self, number: int, look: FloatArray, values: dict[str, Any]) -> View:
        rate_rad_s = np.radians([float(values.get(f"rate_deg_s.{axis}", 0.0)) for axis in "xyz"])
        across = math.radians(float(values.get("rate_deg_s.across", 0.0)))
        if across:
            angle_rad = np.random.default_rng((self.plan.seed, number, AXIS_STREAM)).uniform(
                0.0, 2 * math.pi
            )
            rate_rad_s += across * np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
        if self._log is not None:
            begin_ns, end_ns = self._log.span_ns
            t_ns = begin_ns + round(float(look[0]) * (end_ns - begin_ns))
            return View.exposure(
                view_at(self._log.timeline, self._log.span_ns, t_ns, 0.0).q_icrs_to_cam,
                rate_rad_s,
                0.0,
                t_ns,
            )
        t_ns = round(float(values.get("time_s", 0.0)) * NS_PER_S)
        if self.plan.attitudes.body is None:
            q = looking_q(self.plan.attitudes, look)
        else:
            q = self._beside_body(self.plan.attitudes, look, values, t_ns)
        return View.exposure(q, rate_rad_s, 0.0, t_ns)

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
        discs = [] if moving is None else moving.discs(np.eye(3)[2], math.pi, t_ns=t_ns)
        disc = next((disc for disc in discs if disc.name.lower() == attitudes.body), None)
        if disc is None:
            raise InputError(
                f'[attitudes] body = "{attitudes.body}": the bench has none; write [sky] epoch_utc'
                f" and [sky.bodies] {attitudes.body} = true, or vary sky.bodies.{attitudes.body}"
            )
        off_rad = math.radians(float(values.get("body_deg", 0.0)))
        limb_deg = values.get("limb_deg")
        if limb_deg is not None:
            # deeper than the middle of the disc is nowhere
            off_rad = max(disc.radius_rad + math.radians(float(limb_deg)), 0.0)
        low_deg, high_deg = attitudes.roll_deg
        roll_deg = low_deg + float(look[2]) * (high_deg - low_deg)
        return beside_q(disc.direction, off_rad, 2 * math.pi * float(look[0]), roll_deg)


def accelerated(
    turn: CameraTurn, acceleration_rad_s2: FloatArray, seconds: float
) -> tuple[FloatArray, FloatArray]:
    """Attitude (4,) and rate (3,) after turning at a rate that changes at a constant rate, cam
    components: the midpoint rule in steps of MAX_STEP_S.
    """
    q = turn.q_icrs_to_cam
    steps = max(1, math.ceil(abs(seconds) / MAX_STEP_S))
    step_s = seconds / steps
    for step in range(steps):
        middle_s = (step + 0.5) * step_s
        q = propagate(q, turn.rate_cam_rad_s + acceleration_rad_s2 * middle_s, step_s)
    return q, turn.rate_cam_rad_s + acceleration_rad_s2 * seconds


def looking_q(attitudes: Attitudes, look: FloatArray) -> FloatArray:
    """`q_icrs_to_cam` (4,) at three coordinates in [0, 1): uniform over the sphere or the
    field's cap, and over the rolls.
    """
    low_deg, high_deg = attitudes.roll_deg
    roll_deg = low_deg + float(look[2]) * (high_deg - low_deg)
    if attitudes.kind == "all-sky" or attitudes.radec_deg is None:
        return from_radec_roll_deg(
            360 * float(look[0]), math.degrees(math.asin(2 * float(look[1]) - 1)), roll_deg
        )
    off = math.acos(1 - float(look[1]) * (1 - math.cos(math.radians(attitudes.radius_deg))))
    ra, dec = (math.radians(degrees) for degrees in attitudes.radec_deg)
    middle = np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])
    return beside_q(middle, off, 2 * math.pi * float(look[0]), roll_deg)


def beside_q(middle: FloatArray, off: float, angle: float, roll_deg: float) -> FloatArray:
    """`q_icrs_to_cam` (4,) with the boresight `off` (rad) from an ICRS direction (3,), at a
    position angle (rad) from north to east.
    """
    ra, dec = math.atan2(middle[1], middle[0]), math.asin(max(-1.0, min(1.0, float(middle[2]))))
    east = np.array([-math.sin(ra), math.cos(ra), 0.0])
    north = np.array([-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec)])
    x, y, z = math.cos(off) * middle + math.sin(off) * (
        math.sin(angle) * east + math.cos(angle) * north
    )
    return from_radec_roll_deg(
        math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y))), roll_deg
    )


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
    return _Log(timeline, (read.samples[0].t_ns, read.samples[-1].t_ns), read.conventions.scale)


def _misaligned(file: BenchFile, turn_arcsec: FloatArray) -> BenchFile:
    """The file with the display's true mounting turned from the assumed one by small angles (3,)
    about cam's axes.
    """
    config = file.config
    assumed = np.array(config.verify.true_q_cam_to_mon or config.collimator.q_cam_to_mon)
    true = normalise(multiply(assumed, from_rotation_vector(turn_arcsec / ARCSEC_PER_RAD)))
    w, x, y, z = true.tolist()
    verify = msgspec.structs.replace(config.verify, true_q_cam_to_mon=(w, x, y, z))
    return dataclasses.replace(file, config=msgspec.structs.replace(config, verify=verify))


def _check_through(plan: Plan, varied: list[Parameter], file: BenchFile) -> None:
    """Refuse (InputError) parameters that would change nothing."""
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
        if plan.through == "display" and parameter.key in (SCENARIO, STRAY):
            raise InputError(
                f'[[vary]] key = "{parameter.key}": faults are of through = "tracker"; write that'
            )
        if plan.attitudes.kind == "log" and table == "acceleration_deg_s2":
            raise InputError(
                f'[[vary]] key = "{parameter.key}": with a log the motion is the log\'s; leave it'
                " out"
            )
        if parameter.key == SCENARIO and not parameter.values:
            raise InputError(
                '[[vary]] key = "scenario": is a file; write values = ["faults.toml", ""]'
            )
        if table == "misalignment_arcsec" and (
            file.config.collimator.geometry or file.config.verify.true_geometry
        ):
            raise InputError(
                f'[[vary]] key = "{parameter.key}": the bench has a geometry file, whose own'
                " alignment counts; vary verify.true_geometry over several files instead"
            )


def bench_columns(
    parameters: list[Parameter], further: tuple[Further, ...] = ()
) -> dict[str, Kind]:
    """The columns of the rows of a campaign on the bench, in their order."""
    names = columns(parameters, False)
    varied = [name for name in names if name.startswith("vary.")]
    kinds = {name: columns_kind(name) for name in (*BENCH_BEFORE, *varied, *BENCH_AFTER)} | {
        "stars": "float64"
    }
    kinds |= {name: names[name] for name in (*varied, *RECOVERY) if name in names}
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
    varied = {f"vary.{parameter.key}": value_kind(parameter) for parameter in parameters}
    kinds: dict[str, Kind] = {}
    recovery = RECOVERY if f"vary.{SCENARIO}" in varied else ()
    for name in (*BEFORE, *varied, *AFTER, *recovery, *(CENTROIDS if with_centroids else ())):
        kinds[name] = varied.get(name) or columns_kind(name)
    return kinds | further_columns(further)


def further_columns(further: tuple[Further, ...]) -> dict[str, Kind]:
    """The columns that a plan's `columns` ask for."""
    kinds: dict[str, Kind] = {}
    for name in (name for part in further for name in FURTHER[part]):
        kinds[name] = "int64" if name in (REPORTED_FRAMES, FALSE_STARS) else "floats"
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
        row[name] = str(value) if plan_columns[name] == "text" else value
    return row


def failed(row: Row, why: str) -> Row:
    """The row of a case that failed."""
    return row | {"status": FAILED, "why": why}
