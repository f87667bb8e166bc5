"""Satellites: their element sets, their brightness and their positions.

- Lists of element sets are read as CelesTrak and Space-Track write them: two lines each, with or
  without names, or OMM (`omm`).
- A satellite is as bright as a diffuse sphere in sunlight, in and out of the Earth's shadow, with
  flashes. A standard magnitude is V at 1000 km and 90 degrees of phase, in full sunlight at 1 au
  (McCants, Heavens-Above). A diffuse sphere's light is in proportion to sin p + (pi - p) cos p of
  the phase angle p (Lambert; Hejduk 2011, AMOS Conference, eq. 2), which is 1 at 90 degrees, and
  to the inverse square of the distance.
- A table gives what users know of satellites, by catalogue number: brightness, flashes and sizes.
- The positions of many satellites at any time come from SGP4 (Vallado et al. 2006, AIAA
  2006-6753), with cubics between. SGP4 takes 0.5 us a satellite, 11 ms for 20 000, which is most of
  a frame. So it is computed only at the ends of steps of STEP_S, for a share of the list at a time.
  Between them a position follows the cubic through the positions and velocities at both ends. Low
  orbits are then within 0.25 m of SGP4 (0.05 arcsec at 1000 km), others within 3.2 m, and none is
  more than 0.07 arcsec off as seen from the Earth's centre, measured over three days. With exact
  velocities a cubic would be within 5 mm, but SGP4's velocities are not quite the derivatives of
  its positions.
"""

import importlib.util
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilstar.basics.arrays import FloatArray, IntArray
from hilstar.basics.errors import InputError, MachineError, printable, shortened
from hilstar.basics.text_tables import Chosen, TextTable, table_of
from hilstar.basics.units import KM_PER_AU, NS_PER_S, flux_ratio
from hilstar.sky.bodies.kernel import INSTALL, NS_PER_DAY, UNIX_JD
from hilstar.sky.bodies.omm import is_omm, read_omm
from hilstar.sky.bodies.orbit import LINE_LENGTH, TURN_NS, digit_sum, icrs_from_teme

if TYPE_CHECKING:
    from sgp4.api import Satrec


MAX_NAME = 24  # characters, as in CelesTrak's lists
LIST_FORM = (
    "give a list of two-line element sets, with name lines or without, or OMM in JSON, XML or CSV"
)
# What the numeric columns (from 0) of each element line contain.
NUMBERS = {
    "1": {
        "epoch's year": (18, 20),
        "epoch's day": (20, 32),
        "first derivative of the mean motion": (33, 43),
    },
    "2": {
        "inclination": (8, 16),
        "right ascension of the node": (17, 25),
        "eccentricity": (26, 33),
        "argument of perigee": (34, 42),
        "mean anomaly": (43, 51),
        "mean motion": (52, 63),
    },
}

STANDARD_KM = 1000.0  # the distance to which a standard magnitude refers
SUN_KM = 695_700.0
EARTH_KM, EARTH_FLATTENING = 6378.137, 1 / 298.257  # IERS Conventions 2010
MAX_PHASE_FACTOR = np.pi  # at full phase
FWHM_SIGMAS = 2 * float(np.sqrt(2 * np.log(2)))
# Which flashes may be under way at a time, in periods from the last: one lasts at most half a
# period (at half height), so 3 periods are 14 sigmas.
NEIGHBOURS = np.arange(-3, 4)
SHORTEST_S = 1e-6  # a mean is over this time at least, as it divides by it
KEY = "norad"
# The optional columns, with the limits of their values.
COLUMNS = {
    "standard_mag": (-30.0, 50.0),
    "period_s": (1e-3, 1e7),
    "amplitude_mag": (0.0, 20.0),
    "flash_s": (1e-4, 5e6),
    "flash_at_s": (-1e10, 1e10),
    "size_m": (0.0, 1e5),
}
TABLE_FORM = (
    f"write a CSV with the columns {KEY},{','.join(COLUMNS)}, of which only the first has to be"
    " there"
)
Row = dict[str, float]
STEP_S = 20
STEP_NS = STEP_S * NS_PER_S
# Satellites in one call of SGP4, which takes 0.3 ms. The steps of different shares begin at times
# spread over a step, so that no frame computes all of them.
SHARE = 512
# Turns the position and the velocity times the step at the beginning, then at the end, into the
# coefficients of 1, s, s^2 and s^3 of the cubic through them, s from 0 to 1.
HERMITE = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-3.0, -2.0, 3.0, -1.0], [2.0, 1.0, -2.0, 1.0]]
)


@dataclass(frozen=True, slots=True, eq=False)
class Satellite:
    """One satellite: its name, which no other in its list has, its catalogue number, and its
    elements as SGP4 needs them.
    """

    name: str
    number: int
    satrec: "Satrec"

    def age_days(self, utc_ns: int) -> float:
        """How many days a UTC, ns since 1970, is after the elements' epoch; below 0 before it."""
        epoch_jd = self.satrec.jdsatepoch
        return float(utc_ns / NS_PER_DAY + UNIX_JD - epoch_jd - self.satrec.jdsatepochF)


def read_satellites(text: str, file: str, utc_ns: int) -> list[Satellite]:
    """The satellites in the text of a list (of the file `file`), in its order. Where it has several
    element sets of one satellite, the one whose epoch is nearest to a UTC, ns since 1970, counts.

    Where several satellites have the same name, the catalogue number follows it; a satellite
    without a name is named by its number ("NORAD 25544").

    Raises InputError, which names the line that is wrong, and MachineError where SGP4 is not
    installed.
    """
    if importlib.util.find_spec("sgp4") is None:
        raise MachineError(f"[sky.bodies] satellites need SGP4; {INSTALL}")
    by_number: dict[int, Satellite] = {}
    for satellite in _satellites(text, file):
        number = satellite.number
        other = by_number.get(number)
        days_off = abs(satellite.age_days(utc_ns))
        if other is None or days_off < abs(other.age_days(utc_ns)):
            by_number[number] = satellite
    if not by_number:
        raise InputError(f"{file}: no element set in it; {LIST_FORM}")
    satellites_of_name = Counter(satellite.name for satellite in by_number.values())
    named: list[Satellite] = []
    for number, satellite in by_number.items():
        name = satellite.name
        if not name:
            name = f"NORAD {number}"
        elif satellites_of_name[name] > 1:
            name = f"{name} {number}"
        named.append(Satellite(name, number, satellite.satrec))
    return named


def _satellites(text: str, file: str) -> "Iterator[Satellite]":
    """Each element set of a list as a satellite, with the name in the list ("" for none). Raises
    InputError for a damaged line or set.
    """
    from sgp4.api import Satrec

    if is_omm(text):
        for element_set in read_omm(text, file):
            yield Satellite(_name(element_set.name), element_set.number, element_set.satrec)
        return
    for name, first, second in _sets(text, file):
        satrec = Satrec.twoline2rv(first, second)
        yield Satellite(name, satrec.satnum, satrec)


def _sets(text: str, file: str) -> Iterator[tuple[str, str, str]]:
    """The name ("" for none), the first line and the second line of each element set. Raises
    InputError for a line that is damaged or missing.
    """
    name = ""
    first = ""
    first_at = 0
    for at, line in enumerate(text.splitlines(), start=1):
        line = line.rstrip()
        where = f"{file}:{at}"
        if not line or line.startswith("#"):
            continue
        if first:
            if not line.startswith("2 "):
                raise InputError(
                    f"{where}: element line 2 is missing after line {first_at}; {LIST_FORM}"
                )
            _check(line, where)
            number = line[2:7]
            other = first[2:7]
            if number != other:
                raise InputError(
                    f"{where}: it is of satellite {number.strip()}, line {first_at} of"
                    f" {other.strip()}; {LIST_FORM}"
                )
            yield name, first, line
            name = ""
            first = ""
        elif line.startswith("1 "):
            _check(line, where)
            first = line
            first_at = at
        elif line.startswith("2 "):
            raise InputError(f"{where}: element line 1 is missing before it; {LIST_FORM}")
        elif name:
            raise InputError(f"{where}: two lines in a row that are no elements; {LIST_FORM}")
        else:
            name = _name(line)
    if first or name:
        raise InputError(f"{file}: it ends within an element set; {LIST_FORM}")


def _name(line: str) -> str:
    """The name in a name line, in ASCII and of MAX_NAME characters at most. Space-Track writes
    "0 " before it, which is left out.
    """
    text = line[2:] if line.startswith("0 ") else line
    ascii_text = printable(text.strip()).encode("ascii", "replace").decode()
    return ascii_text[:MAX_NAME].strip()


def _check(line: str, where: str) -> None:
    """Check an element line. Raises InputError for a wrong length, a control character, a wrong
    checksum, or a column that is no number.
    """
    if len(line) != LINE_LENGTH or not line.isascii():
        raise InputError(
            f"{where}: {len(line)} characters, where an element line has {LINE_LENGTH}; {LIST_FORM}"
        )
    # SGP4's parser is written in C, where a NUL ends the text.
    if not line.isprintable():
        raise InputError(f"{where}: it has a control character: a damaged line; take the list anew")
    total = digit_sum(line)
    stated = line[-1]
    if str(total) != stated:
        raise InputError(
            f"{where}: its digits add up to {total}, not {stated}: a damaged line; take the list"
            " anew"
        )
    for what, (begin, end) in NUMBERS[line[0]].items():
        part = line[begin:end].strip()
        digits = part.lstrip("+-").replace(".", "", 1)
        if not digits.isdigit():
            raise InputError(
                f"{where}: columns {begin + 1} to {end}, its {what}, read {part!r}; write a number"
            )


@dataclass(frozen=True, slots=True, eq=False)
class Brightness:
    """The brightness of n satellites by the columns of `read_table`, each (n,);
    `standard_e_per_s` is the rate, electrons/s, at a satellite's standard magnitude.

    Without a `period_s` (NaN) a satellite's light is steady. With a period and a `flash_s` it
    flashes; with a period alone (`flash_s` NaN) its light varies as a cosine.
    """

    standard_e_per_s: FloatArray
    period_s: FloatArray
    amplitude_mag: FloatArray
    flash_s: FloatArray
    flash_at_s: FloatArray
    size_m: FloatArray

    def most(self, which: IntArray) -> FloatArray:
        """The largest factor (n,) by which the satellites `which` (n,) are ever brighter than their
        mean, or, for those that flash, than between flashes.
        """
        ratio = flux_ratio(-self.amplitude_mag[which])
        waved = 2 * ratio / (ratio + 1)
        is_flashing = ~np.isnan(self.flash_s[which])
        varied = np.where(is_flashing, ratio, waved)
        is_steady = np.isnan(self.period_s[which])
        return np.where(is_steady, 1.0, varied)

    def variation(self, which: IntArray, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
        """The mean factor (n,) of the light of the satellites `which` (n,) between two times (n,),
        seconds after `epoch_utc`, in closed form.

        Without flashes the flux varies as a cosine, whose extremes are `amplitude_mag` apart, with
        a mean of 1. Flashes are Gaussians that last `flash_s` at half height, and are
        `amplitude_mag` brighter at their top. A maximum is at `flash_at_s`.
        """
        factor = np.ones(len(which))
        steady = np.isnan(self.period_s[which])
        if steady.all():
            return factor
        end_s = np.maximum(end_s, begin_s + SHORTEST_S)
        has_flash = ~np.isnan(self.flash_s[which])
        flashing = has_flash & ~steady
        waving = ~has_flash & ~steady
        factor[waving] = self._waved(which[waving], begin_s[waving], end_s[waving])
        factor[flashing] = self._flashed(which[flashing], begin_s[flashing], end_s[flashing])
        return factor

    def _waved(self, which: IntArray, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
        """The mean factors (n,) of satellites whose light varies as a cosine: the mean of the
        cosine over a time is damped by a sinc. See `variation`.
        """
        ratio = flux_ratio(-self.amplitude_mag[which])
        per_s = 1 / self.period_s[which]
        middle_s = (begin_s + end_s) / 2 - self.flash_at_s[which]
        middle = middle_s * per_s
        depth = (ratio - 1) / (ratio + 1)
        damping = np.sinc((end_s - begin_s) * per_s)
        wave = depth * np.cos(2 * np.pi * middle)
        return np.asarray(1 + wave * damping)

    def _flashed(self, which: IntArray, begin_s: FloatArray, end_s: FloatArray) -> FloatArray:
        """The mean factors (n,) of satellites that flash; see `variation`."""
        # The import takes 0.1 s, which benches without flashes save.
        from scipy.special import ndtr

        period_s = self.period_s[which]
        sigma_s = self.flash_s[which] / FWHM_SIGMAS
        flash_at_s = self.flash_at_s[which]
        # The light of all flashes up to each of the two times, in flashes: one for each whole
        # period, and the parts of those near the time.
        ends = []
        for seconds in (begin_s, end_s):
            turn = np.floor((seconds - flash_at_s) / period_s)
            rest_s = seconds - flash_at_s - turn * period_s
            since_s = rest_s[:, None] - NEIGHBOURS * period_s[:, None]
            ended = ndtr(since_s / sigma_s[:, None])
            ends.append((turn, ended.sum(axis=1)))
        (first_turn, first_near), (last_turn, last_near) = ends
        flashes = (last_turn - first_turn) + (last_near - first_near)
        extra = flux_ratio(-self.amplitude_mag[which]) - 1
        light_s = extra * flashes * sigma_s * np.sqrt(2 * np.pi)
        return np.asarray(1 + light_s / (end_s - begin_s))


def reflected_share(
    from_observer_km: FloatArray, place_km: FloatArray, sun_km: FloatArray
) -> FloatArray:
    """The flux (n,) of satellites, relative to that of their standard magnitude, with the Earth's
    shadow.

    `from_observer_km` (n, 3) are their positions from the observer, `place_km` (n, 3) those from
    the Earth's centre, and `sun_km` (3,) is the Sun's position from the Earth's centre, all in ICRS
    axes.
    """
    distance_au = float(np.linalg.norm(sun_km)) / KM_PER_AU
    # The Earth's direction to the Sun: that of any satellite is within 1 arcmin of it.
    to_sun = sun_km / np.linalg.norm(sun_km)
    range_km = np.linalg.norm(from_observer_km, axis=1)
    cos_phase = np.clip(-(from_observer_km @ to_sun) / range_km, -1.0, 1.0)
    by_distance = (STANDARD_KM / range_km) ** 2 / distance_au**2
    sunlit = sunlit_share(place_km, sun_km)
    return np.asarray(by_distance * phase_factor(cos_phase) * sunlit)


def phase_factor(cos_phase: FloatArray) -> FloatArray:
    """The light (n,) of a diffuse sphere, relative to that at 90 degrees of phase, by the cosines
    (n,) of its phase angles.
    """
    phase_rad = np.arccos(cos_phase)
    return np.asarray(np.sqrt(1 - cos_phase**2) + (np.pi - phase_rad) * cos_phase)


def sunlit_share(place_km: FloatArray, sun_km: FloatArray) -> FloatArray:
    """The share (n,) of the Sun's disc that the Earth, without its air, does not hide at positions
    (n, 3), km, from the Earth's centre; `sun_km` (3,) is the Sun's.

    It is the area of two overlapping circles, in space that is stretched along the Earth's axis so
    that the Earth is a sphere.
    """
    place = _stretched(place_km)
    sun = _stretched(sun_km)
    distance = np.linalg.norm(place, axis=1)
    to_sun = sun - place
    far = np.linalg.norm(to_sun, axis=1)
    earth = np.arcsin(np.minimum(1.0, EARTH_KM / distance))
    disc = np.arcsin(SUN_KM / far)
    cosine = -np.einsum("ij,ij->i", place, to_sun) / (distance * far)
    apart = np.arccos(np.clip(cosine, -1.0, 1.0))
    within = np.abs(earth - disc)
    # Where one circle is inside the other, the Earth hides the whole disc, or as much as its own
    # area.
    ring = np.maximum(0.0, 1 - (earth / disc) ** 2)
    share = np.where(apart <= within, ring, 1.0)
    partly = np.flatnonzero((apart > within) & (apart < earth + disc))
    if len(partly):
        part_disc = disc[partly]
        hidden = _overlap(earth[partly], part_disc, apart[partly])
        share[partly] = 1 - hidden / (np.pi * part_disc**2)
    return share


def _overlap(a: FloatArray, b: FloatArray, apart: FloatArray) -> FloatArray:
    """The area (n,) common to two circles in a plane, of radii a and b (n,), whose middles are
    `apart` (n,).
    """
    from_a = (apart**2 + a**2 - b**2) / (2 * apart)
    from_b = apart - from_a
    in_a = np.arccos(np.clip(from_a / a, -1.0, 1.0))
    in_b = np.arccos(np.clip(from_b / b, -1.0, 1.0))
    segment_a = a**2 * (in_a - np.sin(2 * in_a) / 2)
    segment_b = b**2 * (in_b - np.sin(2 * in_b) / 2)
    return np.asarray(segment_a + segment_b)


def in_front(observer_km: FloatArray, place_km: FloatArray, depth_km: float = 0.0) -> FloatArray:
    """0 (n,) for positions (n, 3) that the Earth hides from observers at (n, 3), else 1; an
    observer inside the Earth sees all. Both are km from the Earth's centre.

    A line of sight that goes at most `depth_km` deep below the Earth's surface is not hidden.
    """
    observer = _stretched(observer_km)
    place = _stretched(place_km)
    way = place - observer
    along_way = -np.einsum("ij,ij->i", observer, way)
    share = np.clip(along_way / np.einsum("ij,ij->i", way, way), 0.0, 1.0)
    closest = observer + share[:, None] * way
    is_hidden = np.linalg.norm(closest, axis=1) < EARTH_KM - depth_km
    is_inside = np.linalg.norm(observer, axis=1) < EARTH_KM
    return np.where(is_hidden & ~is_inside, 0.0, 1.0)


def _stretched(vectors_km: FloatArray) -> FloatArray:
    """Vectors (..., 3), km, ICRS axes, stretched along z so that the Earth is a sphere of its
    equatorial radius. The Earth's axis is ICRS z within 0.2 degrees.
    """
    to_sphere = np.array([1.0, 1.0, 1 / (1 - EARTH_FLATTENING)])
    return np.asarray(vectors_km * to_sphere)


def read_table(text: str, file: str) -> dict[int, Row]:
    """The rows of a table by catalogue number, each with the values of its filled columns. Raises
    InputError, which names the line that is wrong.
    """
    rows: dict[int, Row] = {}
    table = table_of(Path(file), TABLE_FORM, iter(text.splitlines(keepends=True)))
    key, columns = _columns(table)
    table.warn()
    for line, cells in table.rows():
        where = f"{file}:{line}"
        number = _number(table.cell(cells, key), where)
        if number in rows:
            raise InputError(f"{where}: satellite {number} is there twice; leave one row")
        texts = {name: table.cell(cells, column) for name, column in columns.items()}
        rows[number] = _values(texts, where)
    return rows


def _columns(table: TextTable) -> tuple[Chosen, dict[str, Chosen]]:
    """The catalogue number's column, and the others by name. Raises InputError for one that is
    unknown or there twice.
    """
    key = table.chosen(KEY)
    columns: dict[str, Chosen] = {}
    for name in COLUMNS:
        column = table.chosen(name)
        if column is not None:
            columns[name] = column
    if not table.columns or key is None:
        raise table.refusal(table.header_line, f"no header with {KEY} and each column once")
    places = {key.place}
    places.update(column.place for column in columns.values())
    for place, written in enumerate(table.columns):
        if place not in places:
            name = shortened(written.header)
            raise table.refusal(table.header_line, f"no column {name!r} is known")
    return key, columns


def _number(text: str, where: str) -> int:
    """A catalogue number from its digits, or from Alpha-5 (a letter and four digits). Raises
    InputError for other text.
    """
    from sgp4.alpha5 import from_alpha5

    try:
        return int(from_alpha5(text) if len(text) <= 5 else text)
    except (ValueError, IndexError, KeyError) as error:
        raise InputError(
            f"{where}: {KEY} = {shortened(text)!r}; write a catalogue number, such as 25544"
        ) from error


def _values(row: dict[str, str], where: str) -> Row:
    """The values of a row's filled columns. Raises InputError for one that is no number or beyond
    its limits, and for flashes or variations that are incomplete.
    """
    values: Row = {}
    for name, text in row.items():
        if not text:
            continue
        low, high = COLUMNS[name]
        try:
            values[name] = float(text)
        except ValueError:
            values[name] = math.nan
        if not low <= values[name] <= high:
            raise InputError(
                f"{where}: {name} = {shortened(text)!r}; write {low:g} to {high:g}, or leave it"
                " empty"
            )
    if "amplitude_mag" in values or "flash_s" in values or "period_s" in values:
        if "period_s" not in values or "amplitude_mag" not in values:
            raise InputError(
                f"{where}: light that varies has a period_s and an amplitude_mag; write both"
            )
        flash_s = values.get("flash_s", 0.0)
        if flash_s > values["period_s"] / 2:
            raise InputError(
                f"{where}: flash_s is over half of period_s; leave it out: the light then goes up"
                " and down"
            )
    return values


def brightness_of(
    satellites: Sequence[Satellite], rows: dict[int, Row], default_mag: float, v0_e_per_s: float
) -> Brightness:
    """The brightness of satellites by a table's rows; `default_mag` is the standard magnitude of
    those without one in the table.

    `v0_e_per_s` is the electron rate, electrons/s, of sunlight of V = 0.
    """

    def column(name: str, default: float) -> FloatArray:
        values = []
        for satellite in satellites:
            row = rows.get(satellite.number, {})
            values.append(row.get(name, default))
        return np.array(values, dtype=np.float64)

    return Brightness(
        standard_e_per_s=v0_e_per_s * flux_ratio(column("standard_mag", default_mag)),
        period_s=column("period_s", math.nan),
        amplitude_mag=column("amplitude_mag", 0.0),
        flash_s=column("flash_s", math.nan),
        flash_at_s=column("flash_at_s", 0.0),
        size_m=column("size_m", 0.0),
    )


class Swarm:
    """Many satellites, whose positions follow SGP4 at steps of STEP_S and cubics between. A
    position depends on its time alone, not on the times asked for before.
    """

    def __init__(self, satrecs: "Sequence[Satrec]") -> None:
        from sgp4.api import SatrecArray

        shares = [satrecs[k : k + SHARE] for k in range(0, len(satrecs), SHARE)]
        self._shares = [SatrecArray(list(share)) for share in shares]
        self._late_ns = np.arange(len(shares)) * (STEP_NS // len(shares))
        self._step = np.full(len(shares), np.iinfo(np.int64).min)
        self._terms = np.zeros((len(satrecs), 4, 3))
        self._begin_ns = np.zeros(len(satrecs), dtype=np.int64)
        self._ends: list[FloatArray | None] = [None] * len(shares)
        # SGP4's code for what is wrong with a satellite in its present step, 0 for nothing.
        self.error = np.zeros(len(satrecs), dtype=np.uint8)

    def __len__(self) -> int:
        return len(self.error)

    def move_to(self, utc_ns: int) -> bool:
        """Prepare the positions about a UTC, ns since 1970; returns whether new cubics were
        computed, as a satellite entered another step.
        """
        step = (utc_ns - self._late_ns) // STEP_NS
        due = np.flatnonzero(step != self._step)
        if not len(due):
            return False
        for k in due.tolist():
            end = min(len(self), (k + 1) * SHARE)
            part = slice(k * SHARE, end)
            begin_ns = int(step[k]) * STEP_NS + int(self._late_ns[k])
            follows = bool(step[k] == self._step[k] + 1)
            self._load(k, part, begin_ns, follows)
            self._begin_ns[part] = begin_ns
        self._step = step
        return True

    def _load(self, k: int, part: slice, begin_ns: int, follows: bool) -> None:
        """Compute the cubics of share `k`, the satellites `part`, for the step that begins at
        `begin_ns`. Where it follows the last step, it begins with the states at that one's end.
        """
        last = self._ends[k]
        if last is None or not follows:
            last, error = self._states(k, begin_ns)
        else:
            has_none = np.isnan(last[:, 0, 0])
            error = np.where(has_none, self.error[part], 0).astype(np.uint8)
        end, end_error = self._states(k, begin_ns + STEP_NS)
        both = np.concatenate([last, end], axis=1)
        self._terms[part] = HERMITE @ both
        self.error[part] = np.where(error, error, end_error)
        self._ends[k] = end

    def _states(self, k: int, utc_ns: int) -> tuple[FloatArray, FloatArray]:
        """The positions, km, and the velocities times STEP_S, km, as (n, 2, 3) in ICRS axes, of
        share `k` at a UTC; and SGP4's error codes (n,), 0 for none. Where there is an error the
        state is NaN.
        """
        days, rest_ns = divmod(utc_ns, NS_PER_DAY)
        utc_days = np.array([UNIX_JD + days])
        utc_rest_days = np.array([rest_ns / NS_PER_DAY])
        codes, place_km, velocity_km_s = self._shares[k].sgp4(utc_days, utc_rest_days)
        velocity_km_step = velocity_km_s[:, 0] * STEP_S
        teme = np.stack([place_km[:, 0], velocity_km_step], axis=1)
        turn = icrs_from_teme(utc_ns // TURN_NS)
        states = teme @ turn.T
        is_finite = np.isfinite(states).all(axis=(1, 2))
        error = codes[:, 0]
        error = np.where(is_finite, error, np.maximum(error, 1))
        states[error != 0] = np.nan
        return states, error

    def places_km(
        self, which: IntArray | slice, utc_ns: int, seconds: FloatArray | float = 0.0
    ) -> FloatArray:
        """The positions (n, 3), km from the Earth's centre, ICRS axes, of the satellites `which`
        `seconds` (n,) after `utc_ns`, the time of `move_to`; NaN where SGP4 gives none.
        """
        after_s = (utc_ns - self._begin_ns[which]) / NS_PER_S + seconds
        s = after_s[:, None] / STEP_S
        a, b, c, d = np.moveaxis(self._terms[which], 1, 0)
        return np.asarray(a + s * (b + s * (c + s * d)))

    def motion_km(self, which: IntArray, utc_ns: int) -> FloatArray:
        """The coefficients (4, n, 3) of 1, s, s^2 and s^3 of the positions of `places_km`, s in
        seconds after `utc_ns`.
        """
        after_s = (utc_ns - self._begin_ns[which]) / NS_PER_S
        s = after_s[:, None] / STEP_S
        a, b, c, d = np.moveaxis(self._terms[which], 1, 0)
        # the same cubic, expanded about s instead of 0
        place = a + s * (b + s * (c + s * d))
        velocity = b + s * (2 * c + s * 3 * d)
        bend = c + s * 3 * d
        steps = [term / STEP_S**power for power, term in enumerate((place, velocity, bend, d))]
        return np.stack(steps)
