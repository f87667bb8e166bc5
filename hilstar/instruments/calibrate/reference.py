"""From a theodolite's readings to `[alignment] q_mon_to_reference`: how the display stands to the
tracker's cube.

Each reading is where the telescope points, azimuth clockwise and elevation up:

- a face of the cube (`+x`, `-x`, `+y`, ...), onto which it is collimated: it points against the
  face's normal;
- a `dot`, a lit pixel of the screen through the collimator: it points where mon has the dot;
- a link (any other name): a target at infinity that several stations see, such as another
  collimator. Its direction is unknown.

Every station is level and has an azimuth zero of its own, which links tell. Unknown are the
rotations of mon and of the cube, the stations' zeros and the links' directions; Gauss and Newton
find them by least squares from Wahba's rotations. The covariance is that of the readings' scatter,
or of their stated sigmas where the scatter does not contradict these.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import optimize, stats

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, shortened
from hilstar.basics.rotation import from_matrix, from_rotation_vector, normalise, to_matrix
from hilstar.basics.text_tables import finite_numbers, read_rows
from hilstar.basics.toml_tables import toml_text
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.optics.camera import Camera

MAX_TABLE_BYTES = 10_000_000
MAX_READINGS = 10_000
NEEDED = ("target", "azimuth_deg", "elevation_deg")
MORE = ("station", "sigma_arcsec", "x_px", "y_px", "mon_x", "mon_y", "mon_z")
ADVICE = f"write a CSV with the columns {','.join(NEEDED)} (docs: calibration files)"
DOT = "dot"
FACES = {
    f"{sign}{axis}": np.eye(3)["xyz".index(axis)] * (1.0 if sign == "+" else -1.0)
    for sign in "+-"
    for axis in "xyz"
}
MIN_APART_DEG = 1.0  # two directions nearer to each other tell no rotation
SURE = 0.01  # below this probability the scatter contradicts the stated sigmas
MAX_ELEVATION_DEG = 89.9
DIGITS = 9


@dataclass(frozen=True, slots=True)
class Reading:
    """One pointing: its line in the file, target, station, azimuth and elevation, rad, and stated
    sigma, arcsec (None: none). `direction` (3,) is the dot's in mon, or the face's pointing in the
    cube; None for a link.
    """

    line: int
    target: str
    station: str
    azimuth_rad: float
    elevation_rad: float
    sigma_arcsec: float | None
    direction: FloatArray | None


@dataclass(frozen=True, slots=True)
class ReferenceFit:
    """The rotation from mon to the cube, its covariance (3, 3) about mon x, y and z, arcsec
    squared, and its freedom (None: by stated sigmas).

    `residual_arcsec` (n, 2) are the readings less the fit, along azimuth and elevation.
    """

    readings: tuple[Reading, ...]
    q_mon_to_reference: FloatArray
    covariance_arcsec2: FloatArray
    dof: float | None
    residual_arcsec: FloatArray

    @property
    def sigma_arcsec(self) -> tuple[float, float, float]:
        """One sigma about mon x, y and z."""
        x, y, z = np.sqrt(np.diag(self.covariance_arcsec2)).tolist()
        return x, y, z


def read_readings(path: Path, camera: Camera | None) -> list[Reading]:
    """The readings of a table; `camera` is the bench's, for dots by their pixels. Raises InputError
    with the line.
    """
    readings = []
    for line, cells in read_rows(path, NEEDED, ADVICE, MAX_TABLE_BYTES, MORE):
        target = cells[0].strip().lower()
        azimuth, elevation = finite_numbers(path, line, NEEDED[1:], cells[1:3], ADVICE)
        if abs(elevation) > MAX_ELEVATION_DEG:
            raise InputError(
                f"{path}:{line}: elevation_deg = {elevation:g}; write degrees above the horizon,"
                f" less than {MAX_ELEVATION_DEG:g}"
            )
        more = dict(zip(MORE, cells[3:], strict=True))
        sigma = None
        if more["sigma_arcsec"].strip():
            (sigma,) = finite_numbers(path, line, ["sigma_arcsec"], [more["sigma_arcsec"]], ADVICE)
            if not sigma > 0:
                raise InputError(f"{path}:{line}: sigma_arcsec = {sigma:g}; write arcsec above 0")
        direction = None
        if target == DOT:
            direction = _dot(path, line, more, camera)
        elif target in FACES:
            direction = -FACES[target]
        elif not target or target[0] in "+-":
            raise InputError(
                f"{path}:{line}: target = {shortened(target)!r}; write a face (+x, -y, ...), dot,"
                " or the name of a link"
            )
        station = more["station"].strip()
        angles = math.radians(azimuth), math.radians(elevation)
        readings.append(Reading(line, target, station, *angles, sigma, direction))
        if len(readings) > MAX_READINGS:
            raise InputError(f"{path}: more than {MAX_READINGS} readings; write fewer")
    return readings


def _dot(path: Path, line: int, more: dict[str, str], camera: Camera | None) -> FloatArray:
    """A dot's direction in mon: as it is given, or by its pixel."""
    given = [more[name] for name in ("mon_x", "mon_y", "mon_z")]
    if all(cell.strip() for cell in given):
        vector = np.array(finite_numbers(path, line, ("mon_x", "mon_y", "mon_z"), given, ADVICE))
        size = float(np.linalg.norm(vector))
        if not size > 0:
            raise InputError(f"{path}:{line}: mon_x, mon_y, mon_z are all 0; write a direction")
        return np.asarray(vector / size)
    pixel = [more[name] for name in ("x_px", "y_px")]
    if not all(cell.strip() for cell in pixel):
        raise InputError(
            f"{path}:{line}: a dot without a place; write x_px and y_px, or mon_x, mon_y and mon_z"
        )
    if camera is None:
        raise InputError(
            f"{path}:{line}: a dot by its pixel needs the bench file; add --bench BENCH.toml"
        )
    x_px, y_px = finite_numbers(path, line, ("x_px", "y_px"), pixel, ADVICE)
    ray = camera.rays(np.array([x_px]), np.array([y_px]))[0]
    return np.asarray(ray / np.linalg.norm(ray))


def fit_reference(path: Path, readings: list[Reading]) -> ReferenceFit:
    """The rotation from mon to the cube. Raises InputError where the readings do not tell it."""
    for what, some in (
        ("dots", [reading for reading in readings if reading.target == DOT]),
        ("faces of the cube", [reading for reading in readings if reading.target in FACES]),
    ):
        if not _apart([reading.direction for reading in some if reading.direction is not None]):
            raise InputError(
                f"{path}: {len(some)} readings of {what}; two {what} or more, in directions over"
                f" {MIN_APART_DEG:g} deg apart, tell a rotation: read another one"
            )
    zeros = _station_zeros(path, readings)
    unknowns = _Unknowns.of(readings, zeros)
    weights = np.array([1.0 / (reading.sigma_arcsec or 1.0) for reading in readings])
    weights = np.repeat(weights, 2)

    def residuals(parameters: FloatArray) -> FloatArray:
        return np.asarray(weights * unknowns.residuals(parameters) * ARCSEC_PER_RAD)

    found = optimize.least_squares(residuals, np.zeros(unknowns.count), method="trf", x_scale=1e-5)
    # two dots, two faces and a link of each station leave some
    free = 2 * len(readings) - unknowns.count
    squares = float((found.fun**2).sum())
    stated = all(reading.sigma_arcsec is not None for reading in readings)
    dof: float | None = float(free)
    scale = squares / free
    if stated and float(stats.chi2.sf(squares, free)) > SURE:
        dof, scale = None, 1.0
    jacobian = np.asarray(found.jac, dtype=np.float64)
    normal = jacobian.T @ jacobian
    covariance = np.asarray(np.linalg.pinv(normal, hermitian=True) * scale, dtype=np.float64)
    q, turned = unknowns.rotation(found.x, covariance)
    residual = unknowns.residuals(found.x).reshape(-1, 2) * ARCSEC_PER_RAD
    return ReferenceFit(tuple(readings), q, turned * ARCSEC_PER_RAD**2, dof, residual)


def _apart(directions: list[FloatArray]) -> bool:
    """Whether some two directions span a rotation: neither parallel nor opposite."""
    least = math.sin(math.radians(MIN_APART_DEG))
    return any(
        float(np.linalg.norm(np.cross(directions[0], other))) > least for other in directions[1:]
    )


def pointing(azimuth_rad: float, elevation_rad: float) -> FloatArray:
    """Where a telescope points (3,): north, east, down."""
    level = math.cos(elevation_rad)
    return np.array(
        [
            level * math.cos(azimuth_rad),
            level * math.sin(azimuth_rad),
            -math.sin(elevation_rad),
        ]
    )


def _station_zeros(path: Path, readings: list[Reading]) -> dict[str, float]:
    """Each station's azimuth zero against the first one's, rad, by the links that both see. Raises
    InputError for a station without one.
    """
    stations = list(dict.fromkeys(reading.station for reading in readings))
    seen: dict[str, dict[str, float]] = {station: {} for station in stations}
    for reading in readings:
        if reading.direction is None:
            seen[reading.station].setdefault(reading.target, reading.azimuth_rad)
    zeros = {stations[0]: 0.0}
    waiting = stations[1:]
    while waiting:
        found = next(_linked(waiting, seen, zeros), None)
        if found is None:
            raise InputError(
                f"{path}: station {shortened(waiting[0])!r} shares no link with"
                f" {shortened(stations[0])!r}; read one target at infinity from both"
            )
        station, zero = found
        zeros[station] = zero
        waiting.remove(station)
    return zeros


def _linked(
    waiting: list[str], seen: dict[str, dict[str, float]], zeros: dict[str, float]
) -> Iterator[tuple[str, float]]:
    for station in waiting:
        for other, zero in zeros.items():
            for target in seen[station].keys() & seen[other].keys():
                yield station, zero + seen[other][target] - seen[station][target]


@dataclass(frozen=True, slots=True)
class _Unknowns:
    """The unknowns about a first guess: two rotation vectors, the zeros of all stations but the
    first, and two angles of each link.
    """

    readings: list[Reading]
    from_mon: FloatArray
    from_cube: FloatArray
    zeros: dict[str, float]
    links: dict[str, FloatArray]

    @classmethod
    def of(cls, readings: list[Reading], zeros: dict[str, float]) -> "_Unknowns":
        """The first guess."""
        pointed = [
            pointing(reading.azimuth_rad + zeros[reading.station], reading.elevation_rad)
            for reading in readings
        ]
        guesses = []
        for is_dot in (True, False):
            pairs = [
                (reading.direction, seen)
                for reading, seen in zip(readings, pointed, strict=True)
                if reading.direction is not None and (reading.target == DOT) == is_dot
            ]
            guesses.append(_wahba(pairs))
        links = {
            reading.target: seen
            for reading, seen in zip(readings, pointed, strict=True)
            if reading.direction is None
        }
        return cls(readings, guesses[0], guesses[1], zeros, links)

    @property
    def count(self) -> int:
        """How many there are."""
        return 6 + len(self.zeros) - 1 + 2 * len(self.links)

    def residuals(self, parameters: FloatArray) -> FloatArray:
        """Readings less the fit (2 n,), rad: along azimuth, then elevation, of each."""
        from_mon = to_matrix(from_rotation_vector(parameters[:3])) @ self.from_mon
        from_cube = to_matrix(from_rotation_vector(parameters[3:6])) @ self.from_cube
        stations = list(self.zeros)
        links = list(self.links)
        first_link = 6 + len(stations) - 1
        residual = np.zeros(2 * len(self.readings))
        for k, reading in enumerate(self.readings):
            place = stations.index(reading.station)
            zero = self.zeros[reading.station] + (parameters[5 + place] if place else 0.0)
            if reading.direction is None:
                at = first_link + 2 * links.index(reading.target)
                model = _moved(self.links[reading.target], *parameters[at : at + 2])
            elif reading.target == DOT:
                model = from_mon @ reading.direction
            else:
                model = from_cube @ reading.direction
            azimuth = math.atan2(model[1], model[0]) - zero
            elevation = math.asin(max(-1.0, min(1.0, -model[2])))
            turn = math.remainder(reading.azimuth_rad - azimuth, 2 * math.pi)
            residual[2 * k] = turn * math.cos(reading.elevation_rad)
            residual[2 * k + 1] = reading.elevation_rad - elevation
        return residual

    def rotation(
        self, parameters: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The quaternion (4,) from mon to the cube, and its covariance (3, 3) about mon's axes,
        rad squared.
        """
        from_mon = to_matrix(from_rotation_vector(parameters[:3])) @ self.from_mon
        from_cube = to_matrix(from_rotation_vector(parameters[3:6])) @ self.from_cube
        q = normalise(from_matrix(from_cube.T @ from_mon))
        # an error a of mon and b of the cube, in the theodolite's axes, turns mon by a - b
        difference = np.zeros((3, len(covariance)))
        difference[:, :3] = from_mon.T
        difference[:, 3:6] = -from_mon.T
        turned = difference @ covariance @ difference.T
        return np.asarray(-q if q[0] < 0 else q), (turned + turned.T) / 2


def _moved(direction: FloatArray, right_rad: float, up_rad: float) -> FloatArray:
    """A direction (3,) that is moved by small angles along azimuth and elevation."""
    azimuth = math.atan2(direction[1], direction[0])
    elevation = math.asin(max(-1.0, min(1.0, -direction[2])))
    return pointing(azimuth + right_rad / max(math.cos(elevation), 1e-6), elevation + up_rad)


def _wahba(pairs: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """The rotation matrix (3, 3) from first to second directions."""
    product = sum((np.outer(seen, of) for of, seen in pairs), np.zeros((3, 3)))
    u, _, v = np.linalg.svd(product)
    return np.asarray(u @ np.diag([1.0, 1.0, float(np.linalg.det(u) * np.linalg.det(v))]) @ v)


def alignment_table(found: ReferenceFit, name: str, date: str) -> dict[str, Any]:
    """The table [alignment] of a bench file."""
    q = [round(value, DIGITS + 3) for value in found.q_mon_to_reference.tolist()]
    table: dict[str, Any] = {"q_mon_to_reference": q}
    rows = [[float(f"{value:.{DIGITS}g}") for value in row] for row in found.covariance_arcsec2]
    table["covariance_arcsec2"] = rows
    if found.dof is not None:
        table["dof"] = found.dof
    if name:
        table["name"] = name
    table["date"] = date
    return {"alignment": table}


def toml_of(found: ReferenceFit, name: str, date: str) -> str:
    """The same as text."""
    return toml_text(alignment_table(found, name, date))


def summary_of(found: ReferenceFit) -> dict[str, Any]:
    """The fit in figures, by the keys of --json."""
    rms = float(np.sqrt((found.residual_arcsec**2).mean()))
    worst = int(np.argmax(np.abs(found.residual_arcsec).max(axis=1)))
    return {
        "readings": len(found.readings),
        "q_mon_to_reference": found.q_mon_to_reference.tolist(),
        "sigma_arcsec": found.sigma_arcsec,
        "covariance_arcsec2": found.covariance_arcsec2.tolist(),
        "dof": found.dof,
        "residual_rms_arcsec": rms,
        "worst_line": found.readings[worst].line,
        "worst_arcsec": float(np.abs(found.residual_arcsec[worst]).max()),
    }


def lines_of(found: ReferenceFit) -> list[str]:
    """The fit for a person."""
    summary = summary_of(found)
    x, y, z = found.sigma_arcsec
    if found.dof is None:
        by = "by the stated sigmas"
    else:
        by = f"by the scatter, {found.dof:g} degrees of freedom"
    return [
        f"{'readings':16}{summary['readings']}, rms {summary['residual_rms_arcsec']:.3g} arcsec",
        f"{'worst':16}line {summary['worst_line']}, {summary['worst_arcsec']:.3g} arcsec",
        f"{'one sigma':16}{x:.3g}, {y:.3g}, {z:.3g} arcsec about mon x, y, z, {by}",
    ]
