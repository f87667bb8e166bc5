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
from hilstar.tracker.identify import wahba

MAX_TABLE_BYTES = 10_000_000
MAX_READINGS = 10_000
NEEDED = ("target", "azimuth_deg", "elevation_deg")
MORE = ("station", "sigma_arcsec", "x_px", "y_px", "mon_x", "mon_y", "mon_z")
ADVICE = f"write a CSV with the columns {','.join(NEEDED)} (docs: calibration files)"
DOT = "dot"
FACES = {
    "+x": np.array([1.0, 0.0, 0.0]),
    "+y": np.array([0.0, 1.0, 0.0]),
    "+z": np.array([0.0, 0.0, 1.0]),
    "-x": np.array([-1.0, 0.0, 0.0]),
    "-y": np.array([0.0, -1.0, 0.0]),
    "-z": np.array([0.0, 0.0, -1.0]),
}
VECTOR = ("mon_x", "mon_y", "mon_z")
PIXEL = ("x_px", "y_px")
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
        readings.append(_reading(path, line, cells, camera))
        if len(readings) > MAX_READINGS:
            raise InputError(f"{path}: more than {MAX_READINGS} readings; write fewer")
    return readings


def _reading(path: Path, line: int, cells: list[str], camera: Camera | None) -> Reading:
    """The reading of a line. Raises InputError."""
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
        # the telescope looks against the face's normal
        direction = -FACES[target]
    elif not target or target[0] in "+-":
        raise InputError(
            f"{path}:{line}: target = {shortened(target)!r}; write a face (+x, -y, ...), dot,"
            " or the name of a link"
        )
    return Reading(
        line=line,
        target=target,
        station=more["station"].strip(),
        azimuth_rad=math.radians(azimuth),
        elevation_rad=math.radians(elevation),
        sigma_arcsec=sigma,
        direction=direction,
    )


def _dot(path: Path, line: int, more: dict[str, str], camera: Camera | None) -> FloatArray:
    """A dot's direction in mon: as it is given, or by its pixel."""
    vector_cells = [more[name] for name in VECTOR]
    if all(cell.strip() for cell in vector_cells):
        vector = np.array(finite_numbers(path, line, VECTOR, vector_cells, ADVICE))
        size = float(np.linalg.norm(vector))
        if not size > 0:
            raise InputError(f"{path}:{line}: mon_x, mon_y, mon_z are all 0; write a direction")
        return np.asarray(vector / size)
    pixel_cells = [more[name] for name in PIXEL]
    if not all(cell.strip() for cell in pixel_cells):
        raise InputError(
            f"{path}:{line}: a dot without a place; write x_px and y_px, or mon_x, mon_y and mon_z"
        )
    if camera is None:
        raise InputError(
            f"{path}:{line}: a dot by its pixel needs the bench file; add --bench BENCH.toml"
        )
    x_px, y_px = finite_numbers(path, line, PIXEL, pixel_cells, ADVICE)
    ray = camera.rays(np.array([x_px]), np.array([y_px]))[0]
    return np.asarray(ray / np.linalg.norm(ray))


def fit_reference(path: Path, readings: list[Reading]) -> ReferenceFit:
    """The rotation from mon to the cube. Raises InputError where the readings do not tell it."""
    dots = [reading for reading in readings if reading.target == DOT]
    faces = [reading for reading in readings if reading.target in FACES]
    _check_apart(path, "dots", dots)
    _check_apart(path, "faces of the cube", faces)
    unknowns = _Unknowns.of(readings, _station_zeros(path, readings))
    weights = np.repeat([1.0 / (reading.sigma_arcsec or 1.0) for reading in readings], 2)

    def residuals(parameters: FloatArray) -> FloatArray:
        return np.asarray(weights * unknowns.residuals(parameters) * ARCSEC_PER_RAD)

    solution = optimize.least_squares(
        residuals, np.zeros(unknowns.count), method="trf", x_scale=1e-5
    )
    # two dots, two faces and a link of each station leave some
    free = 2 * len(readings) - unknowns.count
    squares = float((solution.fun**2).sum())
    dof: float | None = float(free)
    scale = squares / free
    is_stated = all(reading.sigma_arcsec is not None for reading in readings)
    if is_stated and float(stats.chi2.sf(squares, free)) > SURE:
        dof = None
        scale = 1.0
    jacobian = np.asarray(solution.jac, dtype=np.float64)
    normal = jacobian.T @ jacobian
    covariance = np.asarray(np.linalg.pinv(normal, hermitian=True) * scale, dtype=np.float64)
    q_mon_to_reference, covariance_rad2 = unknowns.rotation(solution.x, covariance)
    residual_rad = unknowns.residuals(solution.x).reshape(-1, 2)
    return ReferenceFit(
        readings=tuple(readings),
        q_mon_to_reference=q_mon_to_reference,
        covariance_arcsec2=covariance_rad2 * ARCSEC_PER_RAD**2,
        dof=dof,
        residual_arcsec=residual_rad * ARCSEC_PER_RAD,
    )


def _check_apart(path: Path, what: str, readings: list[Reading]) -> None:
    """Refuse (InputError) readings of which no two directions span a rotation: parallel or
    opposite ones.
    """
    directions = [reading.direction for reading in readings if reading.direction is not None]
    minimum = math.sin(math.radians(MIN_APART_DEG))
    for other in directions[1:]:
        sine = float(np.linalg.norm(np.cross(directions[0], other)))
        if sine > minimum:
            return
    raise InputError(
        f"{path}: {len(readings)} readings of {what}; two {what} or more, in directions over"
        f" {MIN_APART_DEG:g} deg apart, tell a rotation: read another one"
    )


def pointing(azimuth_rad: float, elevation_rad: float) -> FloatArray:
    """Where a telescope points (3,): north, east, down."""
    level = math.cos(elevation_rad)
    north = level * math.cos(azimuth_rad)
    east = level * math.sin(azimuth_rad)
    return np.array([north, east, -math.sin(elevation_rad)])


def _station_zeros(path: Path, readings: list[Reading]) -> dict[str, float]:
    """Each station's azimuth zero against the first one's, rad, by the links that both see. Raises
    InputError for a station without one.
    """
    stations = list(dict.fromkeys(reading.station for reading in readings))
    azimuths: dict[str, dict[str, float]] = {station: {} for station in stations}
    for reading in readings:
        if reading.direction is None:
            azimuths[reading.station].setdefault(reading.target, reading.azimuth_rad)
    zeros = {stations[0]: 0.0}
    waiting = stations[1:]
    while waiting:
        linked = next(_linked(waiting, azimuths, zeros), None)
        if linked is None:
            raise InputError(
                f"{path}: station {shortened(waiting[0])!r} shares no link with"
                f" {shortened(stations[0])!r}; read one target at infinity from both"
            )
        station, zero = linked
        zeros[station] = zero
        waiting.remove(station)
    return zeros


def _linked(
    waiting: list[str], azimuths: dict[str, dict[str, float]], zeros: dict[str, float]
) -> Iterator[tuple[str, float]]:
    """Waiting stations that see a link of a station whose zero is known, and their zeros, rad."""
    for station in waiting:
        for other, zero in zeros.items():
            for target in azimuths[station].keys() & azimuths[other].keys():
                yield station, zero + azimuths[other][target] - azimuths[station][target]


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
        dots = []
        faces = []
        links = {}
        for reading in readings:
            azimuth_rad = reading.azimuth_rad + zeros[reading.station]
            pointed = pointing(azimuth_rad, reading.elevation_rad)
            if reading.direction is None:
                links[reading.target] = pointed
            elif reading.target == DOT:
                dots.append((reading.direction, pointed))
            else:
                faces.append((reading.direction, pointed))
        return cls(readings, _turn(dots), _turn(faces), zeros, links)

    @property
    def count(self) -> int:
        """How many there are."""
        return 6 + len(self.zeros) - 1 + 2 * len(self.links)

    def residuals(self, parameters: FloatArray) -> FloatArray:
        """Readings less the fit (2 n,), rad: along azimuth, then elevation, of each."""
        from_mon, from_cube = self._rotations(parameters)
        zeros = self._zeros(parameters)
        links = self._link_angles(parameters)
        residual = np.zeros(2 * len(self.readings))
        for k, reading in enumerate(self.readings):
            zero = zeros[reading.station]
            if reading.direction is None:
                azimuth, elevation = links[reading.target]
            elif reading.target == DOT:
                azimuth, elevation = _angles(from_mon @ reading.direction)
            else:
                azimuth, elevation = _angles(from_cube @ reading.direction)
            turn = math.remainder(reading.azimuth_rad - (azimuth - zero), 2 * math.pi)
            # along azimuth: a circle is smaller the higher it is
            residual[2 * k] = turn * math.cos(reading.elevation_rad)
            residual[2 * k + 1] = reading.elevation_rad - elevation
        return residual

    def _zeros(self, parameters: FloatArray) -> dict[str, float]:
        """Each station's azimuth zero, rad."""
        zeros = {}
        for place, (station, zero) in enumerate(self.zeros.items()):
            # the first station's zero is every azimuth's
            if place:
                zero = zero + float(parameters[5 + place])
            zeros[station] = zero
        return zeros

    def _link_angles(self, parameters: FloatArray) -> dict[str, tuple[float, float]]:
        """Each link's azimuth and elevation, rad."""
        first_link = 6 + len(self.zeros) - 1
        moves = parameters[first_link:].reshape(-1, 2).tolist()
        angles = {}
        for (target, direction), (right_rad, up_rad) in zip(self.links.items(), moves, strict=True):
            angles[target] = _angles(_moved(direction, right_rad, up_rad))
        return angles

    def _rotations(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The matrices (3, 3) from mon and from the cube to the theodolite's axes."""
        mon_turn = to_matrix(from_rotation_vector(parameters[:3]))
        cube_turn = to_matrix(from_rotation_vector(parameters[3:6]))
        return mon_turn @ self.from_mon, cube_turn @ self.from_cube

    def rotation(
        self, parameters: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The quaternion (4,) from mon to the cube, and its covariance (3, 3) about mon's axes,
        rad squared.
        """
        from_mon, from_cube = self._rotations(parameters)
        q = normalise(from_matrix(from_cube.T @ from_mon))
        # q and -q are one rotation: that with a positive scalar is written
        if q[0] < 0:
            q = -q
        # an error a of mon and b of the cube, in the theodolite's axes, turns mon by a - b
        difference = np.zeros((3, len(covariance)))
        difference[:, :3] = from_mon.T
        difference[:, 3:6] = -from_mon.T
        turned = difference @ covariance @ difference.T
        # rounding leaves a product like this not quite symmetric
        return np.asarray(q), (turned + turned.T) / 2


def _angles(direction: FloatArray) -> tuple[float, float]:
    """Azimuth and elevation, rad, of a direction (3,)."""
    north, east, down = direction.tolist()
    azimuth = math.atan2(east, north)
    elevation = math.asin(max(-1.0, min(1.0, -down)))
    return azimuth, elevation


def _moved(direction: FloatArray, right_rad: float, up_rad: float) -> FloatArray:
    """A direction (3,) that is moved by small angles along azimuth and elevation."""
    azimuth, elevation = _angles(direction)
    level = max(math.cos(elevation), 1e-6)
    return pointing(azimuth + right_rad / level, elevation + up_rad)


def _turn(pairs: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """The rotation matrix (3, 3) from first to second directions."""
    before, after = np.array(pairs).swapaxes(0, 1)
    return to_matrix(wahba(after, before, np.ones(len(pairs))))


def alignment_table(found: ReferenceFit, name: str, date: str) -> dict[str, Any]:
    """The table [alignment] of a bench file."""
    q = [round(value, DIGITS + 3) for value in found.q_mon_to_reference.tolist()]
    table: dict[str, Any] = {"q_mon_to_reference": q}
    rows = []
    for row in found.covariance_arcsec2:
        rows.append([float(f"{value:.{DIGITS}g}") for value in row])
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
    residual = np.abs(found.residual_arcsec)
    rms = float(np.sqrt((residual**2).mean()))
    worst = int(np.argmax(residual.max(axis=1)))
    return {
        "readings": len(found.readings),
        "q_mon_to_reference": found.q_mon_to_reference.tolist(),
        "sigma_arcsec": found.sigma_arcsec,
        "covariance_arcsec2": found.covariance_arcsec2.tolist(),
        "dof": found.dof,
        "residual_rms_arcsec": rms,
        "worst_line": found.readings[worst].line,
        "worst_arcsec": float(residual[worst].max()),
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
