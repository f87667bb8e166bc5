"""The row of a case: its columns by name and type, and how its exposures and answers become one."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.campaign.cases.case import Case
from hilstar.campaign.plan.parameters import Parameter
from hilstar.campaign.solvers.answer import Answer, StarErrors
from hilstar.rotation import conjugate, multiply, to_radec_roll_deg, to_rotation_vector
from hilstar.twin.simulator import Exposure
from hilstar.units import ARCSEC_PER_RAD

Kind = Literal["int64", "float64", "bool", "text"]
Row = dict[str, Any]

DONE, FAILED = "done", "failed"
AXES = ("x", "y", "z")

BEFORE: tuple[tuple[str, Kind], ...] = (
    ("case", "int64"),
    ("status", "text"),
    ("why", "text"),
    ("noise_seed", "int64"),
    ("bench_sha256", "text"),
    ("image_sha256", "text"),
    ("image", "text"),
    ("t_ns", "int64"),
    ("qw", "float64"),
    ("qx", "float64"),
    ("qy", "float64"),
    ("qz", "float64"),
    ("ra_deg", "float64"),
    ("dec_deg", "float64"),
    ("roll_deg", "float64"),
)
AFTER: tuple[tuple[str, Kind], ...] = (
    ("frames", "int64"),
    ("stars_in_view", "int64"),
    ("limit_v_mag", "float64"),
    ("solved", "int64"),
    ("wrong", "int64"),
    ("solved_qw", "float64"),
    ("solved_qx", "float64"),
    ("solved_qy", "float64"),
    ("solved_qz", "float64"),
    ("error_x_arcsec", "float64"),
    ("error_y_arcsec", "float64"),
    ("error_z_arcsec", "float64"),
    ("scatter_x_arcsec", "float64"),
    ("scatter_y_arcsec", "float64"),
    ("scatter_z_arcsec", "float64"),
)
CENTROIDS: tuple[tuple[str, Kind], ...] = (
    ("stars", "int64"),
    ("found", "int64"),
    ("matched", "int64"),
    ("false", "int64"),
    ("measured", "int64"),
    ("centroid_dx_px", "float64"),
    ("centroid_dy_px", "float64"),
    ("centroid_sigma_x_px", "float64"),
    ("centroid_sigma_y_px", "float64"),
)


def columns(parameters: list[Parameter], with_centroids: bool) -> dict[str, Kind]:
    """The columns of a campaign's rows, in their order."""
    varied = {f"vary.{parameter.key}": value_kind(parameter) for parameter in parameters}
    return dict(BEFORE) | varied | dict(AFTER) | (dict(CENTROIDS) if with_centroids else {})


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
    """A row with what the case is, before anything is exposed: all else is missing."""
    row: Row = dict.fromkeys(plan_columns)
    q = case.first.q_icrs_to_cam
    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(q)
    row |= {"case": case.number, "status": DONE, "why": "", "noise_seed": case.noise_seed, "t_ns": case.first.t_ns}
    row |= dict(zip(("qw", "qx", "qy", "qz"), q.tolist(), strict=True))
    row |= {"ra_deg": ra_deg, "dec_deg": dec_deg, "roll_deg": roll_deg}
    for key, value in case.values.items():
        name = f"vary.{key}"
        row[name] = _as_text(value) if plan_columns[name] == "text" else value
    return row


def failed(row: Row, why: str) -> Row:
    """The row of a case that failed."""
    return row | {"status": FAILED, "why": why}


def _as_text(value: Any) -> str:
    return value if isinstance(value, str) else str(value)


@dataclass(slots=True)
class Tally:
    """What a case's exposures came to so far."""

    with_centroids: bool
    wrong_above_arcsec: float
    frames: int = 0
    stars_in_view: int = 0
    errors_arcsec: list[FloatArray] = field(default_factory=list)
    why: str = ""
    star_errors: list[StarErrors] = field(default_factory=list)
    wrong: int = 0
    first_q: FloatArray | None = None
    _digest: Any = field(default_factory=hashlib.sha256)

    def see(self, exposure: Exposure) -> None:
        """One more exposure."""
        self.frames += 1
        self.stars_in_view += len(exposure.truth)
        self._digest.update(exposure.dn.tobytes())

    def hear(self, exposure: Exposure, answer: Answer) -> None:
        """The answer to an exposure."""
        if answer.star_errors is not None:
            self.star_errors.append(answer.star_errors)
        if answer.q_icrs_to_cam is None:
            self.why = self.why or answer.why
            return
        error = attitude_error_arcsec(exposure.motion.q_icrs_to_cam, answer.q_icrs_to_cam)
        if self.frames == 1:
            self.first_q = answer.q_icrs_to_cam
        if np.linalg.norm(error) > self.wrong_above_arcsec:
            self.wrong += 1
        else:
            self.errors_arcsec.append(error)

    def into(self, row: Row) -> Row:
        """The case's row with what was seen and answered; errors are those of answers that are not wrong."""
        row = row | {"why": self.why, "image_sha256": self._digest.hexdigest(), "frames": self.frames}
        row |= {"stars_in_view": self.stars_in_view, "solved": self.wrong + len(self.errors_arcsec), "wrong": self.wrong}
        if self.first_q is not None:
            row |= dict(zip(("solved_qw", "solved_qx", "solved_qy", "solved_qz"), self.first_q.tolist(), strict=True))
        if self.errors_arcsec:
            errors = np.array(self.errors_arcsec)
            row |= _by_axis("error", errors.mean(axis=0))
            if len(errors) > 1:
                row |= _by_axis("scatter", errors.std(axis=0, ddof=1))
        return row | self._centroids() if self.with_centroids and self.star_errors else row

    def _centroids(self) -> Row:
        dx_px, dy_px = (np.concatenate([getattr(seen, name) for seen in self.star_errors]) for name in ("dx_px", "dy_px"))
        v_mag = np.concatenate([seen.v_mag for seen in self.star_errors])
        row: Row = {
            name: sum(getattr(seen, name) for seen in self.star_errors) for name in ("stars", "found", "matched", "false")
        }
        row["measured"] = len(dx_px)
        if len(dx_px):
            row |= {
                "limit_v_mag": float(v_mag.max()),
                "centroid_dx_px": float(dx_px.mean()),
                "centroid_dy_px": float(dy_px.mean()),
            }
        if len(dx_px) > 1:
            row |= {"centroid_sigma_x_px": float(dx_px.std(ddof=1)), "centroid_sigma_y_px": float(dy_px.std(ddof=1))}
        return row


def _by_axis(name: str, arcsec: npt.NDArray[np.float64]) -> Row:
    return {f"{name}_{axis}_arcsec": float(value) for axis, value in zip(AXES, arcsec, strict=True)}


def attitude_error_arcsec(q_commanded: FloatArray, q_reported: FloatArray) -> FloatArray:
    """The rotation vector (3,), arcsec, cam axes, from the commanded to the reported attitude."""
    return to_rotation_vector(multiply(q_reported, conjugate(q_commanded))) * ARCSEC_PER_RAD
