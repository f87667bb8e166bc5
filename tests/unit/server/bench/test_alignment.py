"""From cube to boresight: where it points, and that its 95 % holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalise,
    to_matrix,
)
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.server.bench.alignment import Turned, cube_to_boresight, radius_of_95
from hilstar.server.bench.bench_file import BenchFile, read_bench_file
from tests.support.benches import bench_text

COVARIANCE = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 9.0]])
Q_CAM_TO_MON = normalise(np.array([1.0, 0.01, -0.02, 0.03]))
Q_MON_TO_REFERENCE = normalise(np.array([0.5, 0.5, -0.5, 0.5]) + 0.01)
BENCHES = 4000
# binomial: of 4000 with 95 % each, between these in 998 of 1000
MIN_HELD, MAX_HELD = 3757, 3841


def aligned_bench(folder: Path, *, covariance: bool = True) -> BenchFile:
    path = folder / "bench.toml"
    lines = ["[alignment]", f"q_mon_to_reference = {Q_MON_TO_REFERENCE.tolist()}"]
    if covariance:
        lines.append(f"covariance_arcsec2 = {COVARIANCE.tolist()}")
    text = bench_text({"collimator": {"q_cam_to_mon": Q_CAM_TO_MON.tolist()}})
    path.write_text(text + "\n" + "\n".join(lines) + "\n")
    return read_bench_file(path)


def test_the_boresight_is_cam_z_in_the_reference(tmp_path: Path) -> None:
    found = cube_to_boresight(aligned_bench(tmp_path), None)
    assert found is not None
    z = to_matrix(Q_MON_TO_REFERENCE) @ to_matrix(Q_CAM_TO_MON) @ np.array([0.0, 0.0, 1.0])
    assert np.array(found.boresight) == pytest.approx(z, abs=1e-12)
    assert "certificate" in found.without[0] and "95 %" in found.line


def test_a_tracker_s_bias_turns_its_boresight_where_it_stands(tmp_path: Path) -> None:
    """A tracker that truly stands at q_cam_to_mon Q' reports a bias M = Q'* Q."""
    truly = multiply(Q_CAM_TO_MON, from_rotation_vector(np.array([1e-4, -2e-4, 3e-4])))
    bias = multiply(conjugate(truly), Q_CAM_TO_MON)
    bias_arcsec = 2 * ARCSEC_PER_RAD * bias[1:]
    turned = Turned(bias_arcsec, np.zeros(3))
    found = cube_to_boresight(aligned_bench(tmp_path), None, turned)
    assert found is not None
    z = to_matrix(Q_MON_TO_REFERENCE) @ to_matrix(truly) @ np.array([0.0, 0.0, 1.0])
    assert np.array(found.boresight) == pytest.approx(z, abs=1e-9)


def test_the_radius_and_the_roll_hold_95_percent(tmp_path: Path, rng: np.random.Generator) -> None:
    found = cube_to_boresight(aligned_bench(tmp_path), None)
    assert found is not None and found.cross_arcsec is not None and found.roll_arcsec is not None
    errors = rng.multivariate_normal(np.zeros(3), COVARIANCE, BENCHES) / ARCSEC_PER_RAD
    across = about = 0
    for error in errors:
        q = multiply(Q_MON_TO_REFERENCE, from_rotation_vector(error))
        z = to_matrix(q) @ to_matrix(Q_CAM_TO_MON)[:, 2]
        off = np.linalg.norm(np.cross(z, found.boresight)) * ARCSEC_PER_RAD
        across += off <= found.cross_arcsec
        turn = to_matrix(Q_CAM_TO_MON).T @ error
        about += abs(turn[2]) * ARCSEC_PER_RAD <= found.roll_arcsec
    assert MIN_HELD <= across <= MAX_HELD and MIN_HELD <= about <= MAX_HELD


@pytest.mark.parametrize(
    ("sigmas", "radius"),
    [((1.0, 1.0), 2.44775), ((1.0, 0.0), 1.95996), ((0.0, 0.0), 0.0)],
)
def test_the_radius_of_a_circle_and_of_a_line(sigmas: tuple[float, float], radius: float) -> None:
    """sqrt of chi-square of two degrees of freedom, and of one, at 95 %."""
    assert radius_of_95(np.diag(np.square(sigmas))) == pytest.approx(radius, abs=1e-4)


def test_without_a_covariance_the_uncertainty_is_not_known(tmp_path: Path) -> None:
    found = cube_to_boresight(aligned_bench(tmp_path, covariance=False), None)
    assert found is not None and found.cross_arcsec is None and "not known" in found.line


def test_a_bench_without_the_table_has_none(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(bench_text())
    assert cube_to_boresight(read_bench_file(path), None) is None


DIAGONAL = np.diag([4.0, 4.0, 9.0])
HALF_OF_95 = 1.959964
ROUND = 2.4477468  # of a circle of sigma 1 at 95 %: the root of chi-square of two, 5.99146
OF_FIVE = 2.5705818 / HALF_OF_95  # Student's t of five readings over a normal one, at 95 %


@pytest.mark.parametrize(
    ("keys", "is_certified", "is_turned", "across", "about", "without"),
    [
        ("", True, True, 4 + 2.25 + 4, 9 + 4 + 36, []),
        ("", True, False, 4 + 2.25, 9 + 4, ["bias"]),
        ("", False, True, 4 + 4, 9 + 36, ["certificate"]),
        ("dof = 5", False, False, 4 * OF_FIVE**2, 9 * OF_FIVE**2, ["certificate", "bias"]),
        ("dof = 5", True, True, 4 * OF_FIVE**2 + 6.25, 9 * OF_FIVE**2 + 40, []),
    ],
)
def test_each_part_of_the_uncertainty_adds_its_variance(
    tmp_path: Path,
    keys: str,
    is_certified: bool,
    is_turned: bool,
    across: float,
    about: float,
    without: list[str],
) -> None:
    path = tmp_path / "bench.toml"
    table = ["[alignment]", 'name = "cube"', "q_mon_to_reference = [0.5, 0.5, -0.5, 0.5]", keys]
    table.append(f"covariance_arcsec2 = {DIAGONAL.tolist()}")
    path.write_text(bench_text() + "\n".join(table) + "\n")
    certificate = SimpleNamespace(attitude_arcsec=(HALF_OF_95 * 1.5, HALF_OF_95 * 2))
    turned = Turned(np.zeros(3), HALF_OF_95 * np.array([2.0, 2.0, 6.0]))
    found = cube_to_boresight(
        read_bench_file(path),
        certificate if is_certified else None,
        turned if is_turned else None,
    )
    assert found is not None
    assert found.cross_arcsec == pytest.approx(ROUND * np.sqrt(across), rel=1e-5)
    assert found.roll_arcsec == pytest.approx(HALF_OF_95 * np.sqrt(about), rel=1e-6)
    assert len(found.without) == len(without)
    assert all(word in part for word, part in zip(without, found.without, strict=True))
    assert found.reference == "cube"
    assert found.q_tracker_to_reference == pytest.approx((0.5, 0.5, -0.5, 0.5))


def test_the_attitude_of_the_tracker_in_the_reference_has_no_negative_scalar(
    tmp_path: Path,
) -> None:
    """Whatever the signs of its vector, and of what the bench file has."""
    file = aligned_bench(tmp_path)
    for mounting in (Q_MON_TO_REFERENCE, (0.8, -0.6, 0.0, 0.0), (0.1, 0.7, -0.1, 0.7)):
        for sign in (1.0, -1.0):
            q = sign * np.array(mounting)
            alignment = msgspec.structs.replace(
                file.config.alignment, q_mon_to_reference=tuple(q.tolist())
            )
            config = msgspec.structs.replace(file.config, alignment=alignment)
            found = cube_to_boresight(replace(file, config=config), None)
            assert found is not None
            wanted = multiply(q, Q_CAM_TO_MON)
            assert found.q_tracker_to_reference == pytest.approx(
                tuple(wanted * np.sign(wanted[0])), abs=1e-12
            )


def test_a_variance_is_about_the_axis_of_the_tracker_that_stands_there(tmp_path: Path) -> None:
    """Turned by a third about (1, 1, 1) the tracker's z is the display's x, and its x and y are y
    and z.
    """
    table = "[alignment]\nq_mon_to_reference = [1, 0, 0, 0]\n"
    table += "covariance_arcsec2 = [[4, 0, 0], [0, 25, 0], [0, 0, 25]]\n"
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({"collimator": {"q_cam_to_mon": [0.5, 0.5, 0.5, 0.5]}}) + table)
    found = cube_to_boresight(read_bench_file(path), None)
    assert found is not None
    assert found.roll_arcsec == pytest.approx(HALF_OF_95 * 2, rel=1e-6)
    assert found.cross_arcsec == pytest.approx(ROUND * 5, rel=1e-5)
