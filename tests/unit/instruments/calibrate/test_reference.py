"""The alignment reference by a theodolite: planted rotations are found, within the stated
uncertainty, whatever the stations; readings that tell none are refused.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import (
    conjugate,
    from_matrix,
    multiply,
    normalise,
    to_matrix,
    to_rotation_vector,
)
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.calibrate.reference import (
    FACES,
    Reading,
    _moved,
    _station_zeros,
    _Unknowns,
    fit_reference,
    pointing,
    read_readings,
    summary_of,
    toml_of,
)
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import bench_camera
from tests.support.bench_files import filed_bench
from tests.support.benches import bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.refusals import refusal

NOISE_ARCSEC = 1.0
BENCHES = 400
# The mean square of 400 errors in their sigmas is 1 within sqrt(2 / 400) = 0.07, three times: a
# sigma that is a tenth off is noticed.
MAX_OFF_ONE = 3 * math.sqrt(2 / BENCHES)
EXACT_ARCSEC = 1e-3
DOTS = ((0.05, 0.02, 1.0), (-0.06, 0.03, 1.0), (0.01, -0.07, 1.0))


def test_a_face_of_the_cube_is_named_by_its_normal():
    for axis, normal in zip("xyz", np.eye(3), strict=True):
        np.testing.assert_array_equal(FACES[f"+{axis}"], normal)
        np.testing.assert_array_equal(FACES[f"-{axis}"], -normal)


def random_rotation(rng: np.random.Generator, size: float = 1.0) -> FloatArray:
    """A rotation matrix by chance; with a small `size` near the identity."""
    q = normalise(np.array([1.0, *(size * rng.normal(size=3))]))
    return to_matrix(q)


def angles_deg(direction: FloatArray) -> tuple[float, float]:
    azimuth = math.degrees(math.atan2(direction[1], direction[0]))
    return azimuth, math.degrees(math.asin(-direction[2]))


def planted_cube(
    rng: np.random.Generator,
    noise_arcsec: float = NOISE_ARCSEC,
    stations: bool = True,
    repeats: int = 3,
    sigma: bool = False,
) -> tuple[list[Reading], FloatArray]:
    """The readings of a display and a cube that stand by chance, and the rotation between them."""
    # mon looks along the horizon, and the cube is levelled to some degrees
    level = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    from_mon = random_rotation(rng, 0.05) @ level
    cube = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    from_cube = random_rotation(rng, 0.05) @ cube
    zero_deg = float(rng.uniform(-180, 180)) if stations else 0.0
    readings: list[Reading] = []

    def add(
        target: str, direction: FloatArray, station: str, known: FloatArray | None = None
    ) -> None:
        for _ in range(repeats):
            azimuth, elevation = angles_deg(direction)
            azimuth -= zero_deg if station == "B" else 0.0
            azimuth += rng.normal() * noise_arcsec / 3600 / math.cos(math.radians(elevation))
            elevation += rng.normal() * noise_arcsec / 3600
            stated = noise_arcsec if sigma else None
            angles = math.radians(azimuth), math.radians(elevation)
            line = len(readings) + 2
            readings.append(Reading(line, target, station, *angles, stated, known))

    for dot in DOTS:
        unit = np.array(dot) / np.linalg.norm(dot)
        add("dot", from_mon @ unit, "A", unit)
    second = "B" if stations else "A"
    for face in ("+x", "-y"):
        add(face, -from_cube @ FACES[face], second, -FACES[face])
    if stations:
        for link in (pointing(0.3, 0.02), pointing(2.0, -0.1)):
            name = f"link {link[0]:.1f}"
            add(name, link, "A")
            add(name, link, "B")
    return readings, from_matrix(from_cube.T @ from_mon)


def planted_cube_readings(rng: np.random.Generator, *settings: Any) -> tuple[str, FloatArray]:
    """The table of a `planted_cube`, and its rotation."""
    readings, true = planted_cube(rng, *settings)
    rows = ["target,azimuth_deg,elevation_deg,station,sigma_arcsec,mon_x,mon_y,mon_z"]
    for each in readings:
        angles = f"{math.degrees(each.azimuth_rad):.9f},{math.degrees(each.elevation_rad):.9f}"
        stated = "" if each.sigma_arcsec is None else f"{each.sigma_arcsec:g}"
        place = ",,"
        if each.target == "dot" and each.direction is not None:
            place = ",".join(map(repr, each.direction.tolist()))
        rows.append(f"{each.target},{angles},{each.station},{stated},{place}")
    return "\n".join(rows) + "\n", true


def fitted_reference(folder: Path, text: str) -> Any:
    path = folder / "readings.csv"
    path.write_text(text)
    return fit_reference(path, read_readings(path, None))


def axis_errors_arcsec(found: FloatArray, true: FloatArray) -> FloatArray:
    """The error of a rotation about mon's axes (3,)."""
    return np.asarray(ARCSEC_PER_RAD * to_rotation_vector(multiply(conjugate(true), found)))


@pytest.mark.parametrize("stations", [False, True])
def test_a_rotation_is_found_exactly_without_noise(
    tmp_path: Path, stations: bool, rng: np.random.Generator
) -> None:
    text, true = planted_cube_readings(rng, 0.0, stations)
    found = fitted_reference(tmp_path, text)
    assert np.abs(axis_errors_arcsec(found.q_mon_to_reference, true)).max() < EXACT_ARCSEC


@pytest.mark.parametrize("sigma", [False, True])
def test_errors_of_400_benches_are_as_large_as_their_sigmas(
    sigma: bool, rng: np.random.Generator
) -> None:
    squares = np.zeros(3)
    small = []
    for _ in range(BENCHES):
        readings, true = planted_cube(rng, sigma=sigma)
        found = fit_reference(Path("readings.csv"), readings)
        # the variance of Student's t with so many degrees of freedom
        variance = 1.0 if found.dof is None else found.dof / (found.dof - 2)
        off = axis_errors_arcsec(found.q_mon_to_reference, true) / np.array(found.sigma_arcsec)
        squares += off**2 / variance
        small.append(max(found.sigma_arcsec[:2]))
    assert np.abs(squares / BENCHES - 1).max() < MAX_OFF_ONE
    # the aim of 1 arcsec: three readings of 1 arcsec of each target know the boresight to it
    assert np.median(small) < 1.0


def test_scatter_that_contradicts_the_stated_sigmas_counts(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    text, _ = planted_cube_readings(rng, 10.0, True, 3, True)
    found = fitted_reference(tmp_path, text.replace(",10,", ",1,"))
    assert found.dof is not None and max(found.sigma_arcsec) > 3.0


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda rows: [row for row in rows if not row.startswith("dot")], "readings of dots"),
        (lambda rows: [row for row in rows if not row.startswith("-y")], "faces of the cube"),
        (lambda rows: [row for row in rows if not row.startswith("link")], "shares no link"),
        (lambda rows: [rows[0], "+q,1,2,A,,,,", *rows[1:]], "write a face"),
        (lambda rows: [rows[0], "+x,1,95,A,,,,", *rows[1:]], "above the horizon"),
        (lambda rows: [rows[0], "+x,1,-90,A,,,,", *rows[1:]], "above the horizon"),
        (lambda rows: [rows[0], "dot,1,2,A,,,,", *rows[1:]], "without a place"),
        (lambda rows: [rows[0], "dot,1,2,A,0,0,0,1", *rows[1:]], "arcsec above 0"),
        (lambda rows: [rows[0], "dot,1,2,A,-1,0,0,1", *rows[1:]], "arcsec above 0"),
        (lambda rows: [rows[0], "dot,one,2,A,,0,0,1", *rows[1:]], "no finite number|not a finite"),
    ],
)
def test_readings_that_tell_no_rotation_are_refused(
    tmp_path: Path, change: Any, told: str, rng: np.random.Generator
) -> None:
    rows = planted_cube_readings(rng)[0].splitlines()
    with pytest.raises(InputError, match=told):
        fitted_reference(tmp_path, "\n".join(change(rows)) + "\n")


def test_a_dot_by_its_pixel_is_where_the_bench_shows_it(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    file = filed_bench(tmp_path)
    camera = bench_camera(file.config, file.folder)
    path = tmp_path / "readings.csv"
    path.write_text("target,azimuth_deg,elevation_deg,x_px,y_px\ndot,0,0,200,300\n")
    (reading,) = read_readings(path, camera)
    ray = camera.rays(np.array([200.0]), np.array([300.0]))[0]
    assert reading.direction is not None
    assert reading.direction == pytest.approx(ray / np.linalg.norm(ray))
    assert "--bench" in refusal(read_readings, path, None)


def test_the_command_prints_a_table_that_a_bench_file_takes(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    text, true = planted_cube_readings(rng)
    (tmp_path / "readings.csv").write_text(text)
    words = ("calibrate", "reference", "readings.csv", "-o", "alignment.toml", "--name", "cube 7")
    done = run_hilstar_here(*words, cwd=tmp_path)
    assert done.returncode == 0 and "one sigma" in done.stdout
    table = (tmp_path / "alignment.toml").read_text()
    assert table in done.stdout
    after = tmp_path / "with.toml"
    after.write_text(f"{bench_text()}\n{table}")
    file = read_bench_file(after)
    assert file.config.alignment is not None and file.config.alignment.name == "cube 7"
    off = axis_errors_arcsec(np.array(file.config.alignment.q_mon_to_reference), true)
    assert np.abs(off).max() < 5 * max(fitted_reference(tmp_path, text).sigma_arcsec)
    # what is said of a bench changes no frame
    assert file.sha256 == filed_bench(tmp_path).sha256
    assert_refused(run_hilstar_here(*words[:3], "-o", "a.csv", cwd=tmp_path), 2, ".toml")


def test_the_table_keeps_what_was_found(tmp_path: Path, rng: np.random.Generator) -> None:
    found = fitted_reference(tmp_path, planted_cube_readings(rng)[0])
    path = tmp_path / "bench.toml"
    path.write_text(f"{bench_text()}\n{toml_of(found, '', '2026-01-01')}")
    settings = read_bench_file(path).config.alignment
    assert settings is not None and settings.dof == found.dof
    assert np.array(settings.covariance_arcsec2) == pytest.approx(found.covariance_arcsec2)


def test_a_telescope_points_by_azimuth_from_north_over_east_and_by_elevation_up():
    """In north, east, down."""
    right = math.pi / 2
    for angles, wanted in (((0, 0), (1, 0, 0)), ((right, 0), (0, 1, 0)), ((1, right), (0, 0, -1))):
        np.testing.assert_allclose(pointing(*angles), wanted, atol=1e-15)


def test_an_azimuth_counts_by_the_circle_that_it_moves_on(rng: np.random.Generator) -> None:
    """A link at 60 degrees, read 10 arcsec to either side: 5 arcsec along its circle, and up and
    down as far as it is read.
    """
    readings, _ = planted_cube(rng, 0.0, stations=False)
    off_rad = 10.0 / ARCSEC_PER_RAD
    for k, (along, up) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1))):
        angles = 1.0 + along * off_rad, math.radians(60.0) + up * off_rad
        readings.append(Reading(100 + k, "lamp", "A", *angles, None, None))
    found = fit_reference(Path("readings.csv"), readings)
    residual = found.residual_arcsec[-4:]
    wanted = [[5.0, 0.0], [-5.0, 0.0], [0.0, 10.0], [0.0, -10.0]]
    assert residual == pytest.approx(np.array(wanted), abs=EXACT_ARCSEC)
    summary = summary_of(found)
    assert summary["readings"] == len(readings)
    # along either axis
    assert summary["worst_arcsec"] == pytest.approx(10.0, abs=EXACT_ARCSEC)
    assert summary["worst_line"] in (102, 103)
    squares = 2 * 5.0**2 + 2 * 10.0**2
    rms_arcsec = math.sqrt(squares / (2 * len(readings)))
    assert summary["residual_rms_arcsec"] == pytest.approx(rms_arcsec, rel=1e-3)


def test_stated_sigmas_stand_where_the_scatter_is_less(rng: np.random.Generator) -> None:
    """Readings that agree exactly do not make a theodolite of 2 arcsec a better one."""
    exact, _ = planted_cube(rng, 0.0, stations=False)
    sigmas = {}
    for stated in (2.0, 4.0):
        found = fit_reference(
            Path("readings.csv"), [replace(reading, sigma_arcsec=stated) for reading in exact]
        )
        assert found.dof is None
        sigmas[stated] = np.array(found.sigma_arcsec)
    # nine readings of dots and six of faces know a rotation better than one of them does
    assert (sigmas[2.0] > 2.0 / math.sqrt(15)).all()
    assert sigmas[4.0] == pytest.approx(2 * sigmas[2.0])


def off_arcsec(readings: list[Reading], true: FloatArray) -> float:
    """How far the fit of readings is from a planted rotation."""
    found = fit_reference(Path("readings.csv"), readings)
    turn = to_rotation_vector(multiply(found.q_mon_to_reference, conjugate(true)))
    return float(np.linalg.norm(turn)) * ARCSEC_PER_RAD


def test_an_azimuth_may_be_read_from_any_zero_and_past_a_whole_turn(
    rng: np.random.Generator,
) -> None:
    """A theodolite counts from 0 to 360 degrees, or from -180; each station has its own zero."""
    for _ in range(5):
        readings, true = planted_cube(rng, 0.0, repeats=2)
        assert off_arcsec(readings, true) < EXACT_ARCSEC
        turned = [
            replace(reading, azimuth_rad=reading.azimuth_rad + 2 * math.pi * (k % 3 - 1))
            for k, reading in enumerate(readings)
        ]
        assert off_arcsec(turned, true) < EXACT_ARCSEC


def test_a_station_s_zero_is_what_has_to_be_added_to_its_azimuths() -> None:
    """B reads both links 0.3 rad higher than A does, and C 0.1 rad higher than B."""
    readings = []
    for station, off_rad, names in (("A", 0.0, "pq"), ("B", 0.3, "pqr"), ("C", 0.4, "r")):
        for name in names:
            azimuth_rad = {"p": 1.0, "q": 2.0, "r": 2.5}[name] + off_rad
            readings.append(Reading(1, name, station, azimuth_rad, 0.0, None, None))
    zeros = _station_zeros(Path("readings.csv"), readings)
    assert zeros == pytest.approx({"A": 0.0, "B": -0.3, "C": -0.4})


def test_a_covariance_is_about_the_axes_of_mon(rng: np.random.Generator) -> None:
    """Dots within 4 degrees of the boresight tell the turn about it ten times worse than those
    across it; it is level, and mon's z.
    """
    readings, _ = planted_cube(rng, stations=False, sigma=True)
    x, y, z = fit_reference(Path("readings.csv"), readings).sigma_arcsec
    assert z > 5 * max(x, y)


@pytest.mark.parametrize("elevation_rad", [0.0, 1.1, -0.7])
def test_a_link_is_moved_by_angles_on_the_sky(elevation_rad: float) -> None:
    right_rad, up_rad = 2e-4, -3e-4
    moved = _moved(pointing(0.4, elevation_rad), right_rad, up_rad)
    azimuth_deg, elevation_deg = angles_deg(moved)
    turned_deg = math.degrees(0.4 + right_rad / math.cos(elevation_rad))
    assert azimuth_deg == pytest.approx(turned_deg, abs=1e-9)
    assert elevation_deg == pytest.approx(math.degrees(elevation_rad + up_rad), abs=1e-9)


def test_each_station_s_zero_and_each_link_moves_its_own_readings(rng: np.random.Generator) -> None:
    """Of three stations: 0.1 mrad of the third one's zero moves its azimuths and no others."""
    readings, _ = planted_cube(rng, noise_arcsec=0.0, repeats=1)
    for reading in list(readings):
        if reading.target.startswith("link") and reading.station == "B":
            readings.append(replace(reading, station="C"))
    zeros = _station_zeros(Path("readings.csv"), readings)
    unknowns = _Unknowns.of(readings, zeros)
    none = np.zeros(unknowns.count)
    start = unknowns.residuals(none)
    # two rotations, and the zeros of B and C; then the links
    for number, station in ((6, "B"), (7, "C")):
        moved = none.copy()
        moved[number] = 1e-4
        change = (unknowns.residuals(moved) - start).reshape(-1, 2)
        for reading, (across, up) in zip(readings, change, strict=True):
            is_its = reading.station == station
            level = math.cos(reading.elevation_rad)
            assert across == pytest.approx(1e-4 * level if is_its else 0.0, abs=1e-12)
            assert up == 0.0
    for number, link in enumerate(unknowns.links):
        moved = none.copy()
        moved[8 + 2 * number + 1] = 1e-4
        change = (unknowns.residuals(moved) - start).reshape(-1, 2)
        for reading, (_, up) in zip(readings, change, strict=True):
            assert up == pytest.approx(-1e-4 if reading.target == link else 0.0, abs=1e-12)


def test_the_covariance_of_a_rotation_is_that_of_the_turns_of_mon_and_of_the_cube(
    rng: np.random.Generator,
) -> None:
    """By how the rotation itself turns, about mon's axes, with each unknown."""
    readings, _ = planted_cube(rng, noise_arcsec=0.0, repeats=1)
    # a cube that is far from level
    turned = random_rotation(rng)
    unknowns = replace(
        _Unknowns.of(readings, _station_zeros(Path("readings.csv"), readings)), from_cube=turned
    )
    none = np.zeros(unknowns.count)
    root = rng.normal(size=(unknowns.count, unknowns.count))
    covariance = root @ root.T
    q, found = unknowns.rotation(none, covariance)
    step = 1e-6
    turns = []
    for number in range(unknowns.count):
        moved = none.copy()
        moved[number] = step
        other, _ = unknowns.rotation(moved, covariance)
        turns.append(to_rotation_vector(multiply(conjugate(q), other)) / step)
    slopes = np.array(turns).T
    np.testing.assert_allclose(found, slopes @ covariance @ slopes.T, rtol=1e-4, atol=1e-3)
