"""From a case's number and its point in the design to its values, its attitude and its bench file."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.arrays import FloatArray
from hilstar.attitude.clock.timeline import Policy, Timeline
from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import log_timeline, open_log
from hilstar.attitude.wire.source import Mounting
from hilstar.bench.bench_file import BenchFile, dated
from hilstar.bench.faults.scenario import Scenario, read_scenario
from hilstar.campaign.plan.parameters import SCENARIO, Parameter, changed_bench, parameters
from hilstar.campaign.plan.tables import Attitudes, Plan
from hilstar.errors import InputError
from hilstar.reading import parse_toml
from hilstar.rotation import from_radec_roll_deg, from_rotation_vector, multiply, normalise, propagate
from hilstar.scene.exposure_motion import Motion
from hilstar.twin.batch import faulty_exposure, motion_at
from hilstar.twin.faulty_exposure import FaultyExposure
from hilstar.twin.simulator import Simulator
from hilstar.units import ARCSEC_PER_RAD, NS_PER_S

ATTITUDE_DIMENSIONS = {"all-sky": 3, "field": 3, "log": 1}
AXIS_STREAM = 2  # of a case's seed: the axis of a rate across the boresight
SEED_BITS = 63  # what a FITS header, a Parquet column of int64 and `simulate --seed` hold


@dataclass(frozen=True, slots=True)
class Case:
    """A case before its bench is made: its values by key, the seed of its noise, and the motion of its first exposure."""

    number: int
    values: dict[str, Any]
    noise_seed: int
    first: Motion


@dataclass(frozen=True, slots=True)
class _Log:
    timeline: Timeline
    span_ns: tuple[int, int]
    scale: str | None


class CaseMaker:
    """Makes the cases of a plan, whose relative paths start in `folder`. Raises InputError for what the plan has wrong."""

    def __init__(self, plan: Plan, file: BenchFile, folder: Path) -> None:
        self.plan, self.file = plan, file
        self._tables = parse_toml(file.path, file.text)
        self._log = None if plan.attitudes.log is None else _read_log(folder / plan.attitudes.log, file)
        if self._log is not None:
            self.file = dated(file, self._log.scale, self._log.span_ns[0])
        self.parameters: list[Parameter] = parameters(plan, file)
        self._scenarios = _read_scenarios(self.parameters, folder)
        _check_through(plan, self.parameters, file)

    @property
    def attitude_dimensions(self) -> int:
        """How many of a point's coordinates say where the case looks; they come first."""
        return ATTITUDE_DIMENSIONS[self.plan.attitudes.kind]

    def case(self, number: int, point: FloatArray) -> Case:
        """The case of this number at a point (dimensions,) of the design."""
        look, rest = point[: self.attitude_dimensions], point[self.attitude_dimensions :]
        values = {parameter.key: parameter.value(float(u)) for parameter, u in zip(self.parameters, rest, strict=True)}
        seed = values.get("noise_seed")
        if seed is None:
            state = np.random.SeedSequence((self.plan.seed, number)).generate_state(1, np.uint64)
            seed = int(state[0]) >> 64 - SEED_BITS
        return Case(number, values, int(seed), self._first(number, look, values))

    def bench(self, case: Case) -> BenchFile:
        """The bench file with the case's values. Raises InputError where they do not go together."""
        file = changed_bench(self.file, self._tables, case.values)
        if self._log is not None:
            file = dated(file, self._log.scale, self._log.span_ns[0])
        turn_arcsec = [float(case.values.get(f"misalignment_arcsec.{axis}", 0.0)) for axis in "xyz"]
        return _misaligned(file, np.array(turn_arcsec)) if any(turn_arcsec) else file

    def motion(self, case: Case, frame: int, exposure_s: float) -> Motion:
        """The motion of one of the case's exposures, `step_s` apart: at the case's rate, or along the log."""
        first = case.first
        step_ns = round(frame * self.plan.step_s * NS_PER_S)
        if self._log is not None and first.t_ns is not None:
            t_ns = min(first.t_ns + step_ns, self._log.span_ns[1])
            along = motion_at(self._log.timeline, self._log.span_ns, t_ns, exposure_s)
            return along if not _has_rate(case.values) else Motion(along.q_icrs_to_cam, first.rate_cam_rad_s, exposure_s, t_ns)
        q = propagate(first.q_icrs_to_cam, first.rate_cam_rad_s, step_ns / NS_PER_S) if step_ns else first.q_icrs_to_cam
        return Motion(q, first.rate_cam_rad_s, exposure_s, (first.t_ns or 0) + step_ns)

    def faults(self, case: Case, motion: Motion, simulator: Simulator) -> FaultyExposure | None:
        """What the case's scenario does to an exposure; its time is that of the case, or the log's since its beginning."""
        scenario = self._scenarios.get(str(case.values.get(SCENARIO, "")))
        if scenario is None:
            return None
        begin_ns = 0 if self._log is None else self._log.span_ns[0]
        return faulty_exposure(simulator, motion, scenario, (motion.t_ns or 0) - begin_ns)

    def _first(self, number: int, look: FloatArray, values: dict[str, Any]) -> Motion:
        rate_rad_s = self._rate_rad_s(number, values)
        if self._log is not None:
            begin_ns, end_ns = self._log.span_ns
            t_ns = begin_ns + round(float(look[0]) * (end_ns - begin_ns))
            return Motion(motion_at(self._log.timeline, self._log.span_ns, t_ns, 0.0).q_icrs_to_cam, rate_rad_s, 0.0, t_ns)
        t_ns = round(float(values.get("time_s", 0.0)) * NS_PER_S)
        return Motion(looking_q(self.plan.attitudes, look), rate_rad_s, 0.0, t_ns)

    def _rate_rad_s(self, number: int, values: dict[str, Any]) -> FloatArray:
        rate = np.radians([float(values.get(f"rate_deg_s.{axis}", 0.0)) for axis in "xyz"])
        across = math.radians(float(values.get("rate_deg_s.across", 0.0)))
        if across:
            angle_rad = np.random.default_rng((self.plan.seed, number, AXIS_STREAM)).uniform(0.0, 2 * math.pi)
            rate += across * np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
        return rate


def looking_q(attitudes: Attitudes, look: FloatArray) -> FloatArray:
    """`q_icrs_to_cam` (4,) at three coordinates in [0, 1): evenly over the sphere or the field's cap, and over the rolls."""
    low_deg, high_deg = attitudes.roll_deg
    roll_deg = low_deg + float(look[2]) * (high_deg - low_deg)
    if attitudes.kind == "all-sky" or attitudes.radec_deg is None:
        return from_radec_roll_deg(360 * float(look[0]), math.degrees(math.asin(2 * float(look[1]) - 1)), roll_deg)
    off = math.acos(1 - float(look[1]) * (1 - math.cos(math.radians(attitudes.radius_deg))))
    angle = 2 * math.pi * float(look[0])
    ra, dec = (math.radians(degrees) for degrees in attitudes.radec_deg)
    east = np.array([-math.sin(ra), math.cos(ra), 0.0])
    north = np.array([-math.sin(dec) * math.cos(ra), -math.sin(dec) * math.sin(ra), math.cos(dec)])
    middle = np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])
    x, y, z = math.cos(off) * middle + math.sin(off) * (math.sin(angle) * east + math.cos(angle) * north)
    return from_radec_roll_deg(math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y))), roll_deg)


def _read_scenarios(varied: list[Parameter], folder: Path) -> dict[str, Scenario]:
    """The scenarios that a plan names, by their names. Raises InputError."""
    names = [str(name) for parameter in varied if parameter.key == SCENARIO for name in parameter.values if name]
    return {name: read_scenario(folder / name) for name in names}


def _has_rate(values: dict[str, Any]) -> bool:
    return any(key.startswith("rate_deg_s.") for key in values)


def _read_log(path: Path, file: BenchFile) -> _Log:
    read = open_log(path, Stated(Mounting(file.config.tracker.q_body_to_cam)))
    max_rate_rad_s = math.radians(file.config.attitude.max_rate_deg_s)
    timeline = log_timeline(read.samples, Policy(0, NS_PER_S, max_rate_rad_s))
    return _Log(timeline, (read.samples[0].t_ns, read.samples[-1].t_ns), read.conventions.scale)


def _misaligned(file: BenchFile, turn_arcsec: FloatArray) -> BenchFile:
    """The file with the display's true mounting turned about cam's axes by small angles (3,), from the one that it assumes."""
    config = file.config
    assumed = np.array(config.verify.true_q_cam_to_mon or config.collimator.q_cam_to_mon)
    true = normalise(multiply(assumed, from_rotation_vector(turn_arcsec / ARCSEC_PER_RAD)))
    w, x, y, z = true.tolist()
    verify = msgspec.structs.replace(config.verify, true_q_cam_to_mon=(w, x, y, z))
    return dataclasses.replace(file, config=msgspec.structs.replace(config, verify=verify))


def _check_through(plan: Plan, varied: list[Parameter], file: BenchFile) -> None:
    """Refuse (InputError) what would change nothing."""
    for parameter in varied:
        table = parameter.key.split(".")[0]
        if plan.through == "tracker" and table in {"monitor", "collimator", "render", "verify", "misalignment_arcsec"}:
            raise InputError(
                f'[[vary]] key = "{parameter.key}": changes nothing for through = "tracker", which sees no display; write'
                ' through = "display", or leave it out'
            )
        if plan.attitudes.kind == "log" and parameter.key == "time_s":
            raise InputError('[[vary]] key = "time_s": with a log the times are the log\'s; leave it out')
        if plan.through == "display" and parameter.key == SCENARIO:
            raise InputError('[[vary]] key = "scenario": faults are of through = "tracker"; write that')
        if parameter.key == SCENARIO and not parameter.values:
            raise InputError('[[vary]] key = "scenario": is a file; write values = ["faults.toml", ""]')
        if table == "misalignment_arcsec" and (file.config.collimator.geometry or file.config.verify.true_geometry):
            raise InputError(
                f'[[vary]] key = "{parameter.key}": the bench has a geometry file, whose own alignment counts; vary'
                " verify.true_geometry over several files instead"
            )
