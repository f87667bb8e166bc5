"""The catalogue of a bench's tracker, one row for each star, with errors, origins and synthetic
magnitudes; and the files to which it is written.

`catalogue_columns.csv` beside this file lists the columns in their order, with units, UCDs and
descriptions; the functions here compute their values.
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import write_csv
from hilstar.basics.errors import InputError, MachineError
from hilstar.basics.files import STDOUT, whole_file
from hilstar.basics.units import ARCSEC_PER_RAD, flux_ratio, magnitude
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.star_light import catalogue_choice
from hilstar.server.bench.star_rates import StarRates, bench_optics, star_kinds, star_rates
from hilstar.sky.catalog import Catalog
from hilstar.sky.electrons import Photometry, star_temperatures_k
from hilstar.sky.facts import errors_of, motion_at, sigma_v_mag
from hilstar.sky.spectral_types import luminosity_class
from hilstar.sky.star_table import choose_catalog, table_facts
from hilstar.sky.stars import unit_vectors_icrs
from hilstar.sky.synthetic import (
    BANDS,
    VEGA_V_MAG,
    ab_electrons_per_s,
    colours,
    vega_electrons_per_s,
)

MIN_PARALLAX_SIGMAS = 5.0  # for an absolute magnitude: the distance is then known within 20 %
FAINTER_MAG = 3.0  # how much fainter than its star a neighbour may be
COLOUR_STEP_MAG = 0.01  # difference of a colour over which a rate's derivative is taken
DECIMALS = 9  # places in degrees: 4 microarcseconds
ENDINGS = (".csv", ".fits", ".parquet", ".vot")
COLUMNS = Path(__file__).with_name("catalogue_columns.csv")
PARQUET = "parquet needs pyarrow: pip install 'hilstar[campaign]', or write .csv, .fits or .vot"


# The figures or texts (n,) of all stars, by the name of the column.
Values = dict[str, npt.NDArray[Any]]


class Column(NamedTuple):
    """A column: its figures or texts (n,), its unit as astropy writes it ("" for none), its UCD,
    and its description.
    """

    values: npt.NDArray[Any]
    unit: str
    ucd: str
    description: str


@dataclass(frozen=True, slots=True)
class InstrumentCatalogue:
    """The columns by name, with the brightest star first; the epoch of the places, a Julian year;
    and the zero points, the magnitude of one electron per second by the system ("vega", "ab").
    """

    columns: dict[str, Column]
    epoch_jyear: float
    zero_points: dict[str, float]

    def __len__(self) -> int:
        return len(self.columns["hip"].values)


def bench_catalogue(
    file: BenchFile, faintest_v_mag: float | None, epoch_jyear: float | None
) -> InstrumentCatalogue:
    """The catalogue of a bench's stars down to V = `faintest_v_mag`, with places at an epoch, a
    Julian year; None for either means that of the bench file.

    Places are barycentric, ICRS, without aberration or parallax. Raises InputError where no star is
    that bright, or a file cannot be read.
    """
    sky = file.config.sky
    choice = catalogue_choice(file.config, file.folder)
    every = choose_catalog(choice)
    if faintest_v_mag is None:
        limit = sky.faintest_v_mag
    else:
        limit = faintest_v_mag
    rows = np.flatnonzero(every.v_mag <= limit)
    if not len(rows):
        raise InputError(
            f"no star of the catalogue is brighter than V = {limit:g}; write a larger --faintest or"
            " [sky] faintest_v_mag"
        )
    rows = rows[np.argsort(every.v_mag[rows], kind="stable")]
    if epoch_jyear is None:
        epoch = sky.epoch_jyear
    else:
        epoch = epoch_jyear
    chosen = every.taken(rows)
    facts = table_facts(choice, chosen, errors_of(chosen))
    zero_points = _zero_points(file)
    values = _places(chosen, facts, epoch)
    values |= _photometry(chosen, facts)
    values |= _light(file, chosen, facts, zero_points)
    values |= _distances(chosen, facts, values["bolometric_mag"])
    values |= _company(every, rows, facts, epoch)
    columns = _described(values, sky.temperature, zero_points)
    return InstrumentCatalogue(columns, epoch, zero_points)


def _described(
    values: Values, temperature: str, zero_points: dict[str, float]
) -> dict[str, Column]:
    """The columns in the order of the file COLUMNS. In its descriptions, names in braces are
    replaced by the bench's own choices.
    """
    columns = {}
    with COLUMNS.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            description = row["description"].format(
                temperature=temperature,
                fainter_mag=FAINTER_MAG,
                vega_mag=zero_points["vega"],
                ab_mag=zero_points["ab"],
            )
            name = row["name"]
            columns[name] = Column(values[name], row["unit"], row["ucd"], description)
    return columns


def _places(stars: Catalog, facts: dict[str, Any], epoch_jyear: float) -> Values:
    motion = motion_at(stars, facts, epoch_jyear)
    sigma = np.sqrt(np.einsum("nii->in", motion.covariance))
    product = sigma[0] * sigma[1]
    unknown = np.full(len(product), np.nan)
    covariance = motion.covariance[:, 0, 1]
    correlation = np.divide(covariance, product, out=unknown, where=product > 0)
    names = ["" if hip else stars.name(k) for k, hip in enumerate(stars.hip.tolist())]
    values: Values = {}
    values["hip"] = stars.hip
    values["name"] = np.array(names, dtype=np.str_)
    # A right ascension may round up to 360 degrees, which is 0.
    values["ra_deg"] = np.round(motion.ra_deg, DECIMALS) % 360.0
    values["dec_deg"] = np.round(motion.dec_deg, DECIMALS)
    values["sigma_ra_mas"] = sigma[0]
    values["sigma_dec_mas"] = sigma[1]
    values["ra_dec_correlation"] = correlation
    values["pm_ra_mas_yr"] = motion.pm_ra_mas_yr
    values["pm_dec_mas_yr"] = motion.pm_dec_mas_yr
    values["sigma_pm_ra_mas_yr"] = sigma[2]
    values["sigma_pm_dec_mas_yr"] = sigma[3]
    values["parallax_mas"] = stars.parallax_mas
    values["sigma_parallax_mas"] = facts["sigma_parallax_mas"]
    return values


def _photometry(stars: Catalog, facts: dict[str, Any]) -> Values:
    spectral_type = facts["spectral_type"]
    values: Values = {}
    values["v_mag"] = stars.v_mag
    values["sigma_v_mag"] = sigma_v_mag(facts, stars.bv_mag)
    values["v_source"] = facts["v_source"].astype(np.str_)
    values["b_v_mag"] = stars.bv_mag
    values["sigma_b_v_mag"] = facts["sigma_bv_mag"]
    values["b_v_source"] = facts["bv_source"].astype(np.str_)
    values["v_i_mag"] = stars.vi_mag
    values["sigma_v_i_mag"] = facts["sigma_vi_mag"]
    values["v_i_source"] = facts["vi_source"].astype(np.str_)
    values["spectral_type"] = spectral_type.astype(np.str_)
    values["luminosity_class"] = luminosity_class(spectral_type)
    values["spectral_type_source"] = facts["spectral_type_source"].astype(np.str_)
    values["variable"] = stars.variable.astype(np.str_)
    values["range_mag"] = _decimals(stars.range_mag)
    values["period_d"] = _decimals(stars.period_d)
    return values


def _decimals(values: npt.NDArray[np.float32]) -> FloatArray:
    # from float32 back to the catalogue's own decimals
    return np.asarray(np.round(values.astype(np.float64), 3), dtype=np.float64)


def _zero_points(file: BenchFile) -> dict[str, float]:
    """The magnitude of one electron per second, by the system ("vega", "ab")."""
    sky = file.config.sky
    optics = bench_optics(file.config.tracker, file.folder)
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    vega = magnitude(1 / vega_electrons_per_s(optics, photometry))
    ab = magnitude(1 / ab_electrons_per_s(optics))
    return {"vega": VEGA_V_MAG + vega, "ab": ab}


def _light(
    file: BenchFile, stars: Catalog, facts: dict[str, Any], zero_points: dict[str, float]
) -> Values:
    sky = file.config.sky
    v, bv, vi = stars.v_mag, stars.bv_mag, stars.vi_mag
    kind = star_kinds(file.config, stars)
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    colour = colours(sky.spectrum, sky.temperature, photometry)
    rates = star_rates(file.config, file.folder)
    rate = rates(v, bv, vi, kind)
    values: Values = {}
    values["temperature_k"] = star_temperatures_k(bv, sky.temperature)
    # A star's spectrum is chosen by its V-I or its type. Its synthetic B is then not V + (B-V), so
    # the measured B has a column of its own.
    for band in BANDS:
        values[f"{band}_mag"] = v + colour[band](bv, vi, kind)
    values["b_measured_mag"] = v + bv
    values["i_measured_mag"] = v - vi
    values["bolometric_mag"] = v + colour["bolometric"](bv, vi, kind)
    values["electrons_per_s"] = rate
    for system, zero_mag in zero_points.items():
        values[f"instrument_mag_{system}"] = zero_mag + magnitude(rate)
    values["sigma_instrument_mag"] = sigma_instrument_mag(stars, facts, rates, kind)
    return values


def sigma_instrument_mag(
    stars: Catalog, facts: dict[str, Any], rates: StarRates, kind: FloatArray | None = None
) -> FloatArray:
    """The error (n,), mag, of each star's magnitude in the tracker, by the errors of V, B-V and
    V-I, which are taken as independent.

    It does not include the error of choosing a spectrum by colours.
    """
    v = stars.v_mag
    bv = stars.bv_mag
    vi = stars.vi_mag
    half = COLOUR_STEP_MAG / 2
    redder = rates(v, bv + half, vi, kind)
    bluer = rates(v, bv - half, vi, kind)
    by_bv = magnitude(redder / bluer) / COLOUR_STEP_MAG
    redder = rates(v, bv, vi + half, kind)
    bluer = rates(v, bv, vi - half, kind)
    by_vi = magnitude(redder / bluer) / COLOUR_STEP_MAG
    # Where a colour has no effect on the rate, its error may be unknown (NaN), and counts as 0.
    of_bv = by_bv * np.where(by_bv == 0, 0, facts["sigma_bv_mag"])
    of_vi = by_vi * np.where(by_vi == 0, 0, facts["sigma_vi_mag"])
    return np.sqrt(sigma_v_mag(facts, bv) ** 2 + of_bv**2 + of_vi**2)


def _distances(stars: Catalog, facts: dict[str, Any], bolometric_mag: FloatArray) -> Values:
    parallax = stars.parallax_mas
    min_parallax = MIN_PARALLAX_SIGMAS * facts["sigma_parallax_mas"]
    # A parallax of unknown error (NaN) is used as it is, since the comparison with NaN is False.
    is_sure = (parallax > 0) & ~(parallax < min_parallax)
    modulus = 10 - 5 * np.log10(np.where(is_sure, parallax, np.nan))
    values: Values = {}
    values["absolute_mag"] = stars.v_mag - modulus
    values["absolute_bolometric_mag"] = bolometric_mag - modulus
    return values


def _company(
    every: Catalog, rows: npt.NDArray[np.intp], facts: dict[str, Any], epoch_jyear: float
) -> Values:
    stars = every.taken(rows)
    difference = facts["difference_hp_mag"]
    ratio = flux_ratio(difference)  # the fainter component's light to the brighter's
    brighter = stars.v_mag + 2.5 * np.log10(1 + ratio)
    neighbour, arcsec = nearest_neighbours(every, rows, epoch_jyear)
    names = [every.name(k) for k in neighbour.tolist()]
    values: Values = {}
    values["double"] = stars.multiple.astype(np.str_)
    values["separation_arcsec"] = _decimals(stars.separation_arcsec)
    values["component_a_mag"] = brighter
    values["component_b_mag"] = brighter + difference
    values["neighbour"] = np.array(names, dtype=np.str_)
    values["neighbour_arcsec"] = arcsec
    values["neighbour_v_mag"] = every.v_mag[neighbour]
    return values


def nearest_neighbours(
    every: Catalog, rows: npt.NDArray[np.intp], epoch_jyear: float
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """For each of the stars at `rows` (n,), the row (n,) of the nearest other star that is brighter
    than its V + FAINTER_MAG, and the distance (n,) to that, arcsec.

    A star without such a neighbour has its own row, and NaN as the distance.
    """
    from scipy.spatial import cKDTree

    vectors = unit_vectors_icrs(every, epoch_jyear)
    tree = cKDTree(vectors)
    neighbours = rows.copy()
    chord = np.full(len(rows), np.nan)
    limit_mag = every.v_mag[rows] + FAINTER_MAG
    # For most stars the nearest few contain a neighbour. For the rest the search is repeated with
    # four times as many, up to all.
    rest = np.arange(len(rows))
    count = 8
    while len(rest):
        count = min(count, len(every))
        star = rows[rest]
        ranks = np.arange(1, count + 1)
        distances, places = tree.query(vectors[star], k=ranks)
        far = np.atleast_2d(distances)
        near = np.atleast_2d(places)
        is_bright = every.v_mag[near] < limit_mag[rest, None]
        fits = is_bright & (near != star[:, None])
        first = fits.argmax(axis=1)
        has = fits.any(axis=1)
        neighbours[rest[has]] = near[has, first[has]]
        chord[rest[has]] = far[has, first[has]]
        if count == len(every):
            break
        rest = rest[~has]
        count = count * 4
    return neighbours, 2 * np.arcsin(chord / 2) * ARCSEC_PER_RAD


def write_catalogue(path: Path, catalogue: InstrumentCatalogue) -> None:
    """Write a catalogue as CSV, VOTable, Parquet or a FITS table, by the ending of the file's name.
    Raises InputError where it cannot be written, MachineError for Parquet without pyarrow.
    """

    ending = path.suffix.lower()
    if path == STDOUT or ending == ".csv":
        _write_csv(path, catalogue)
    elif ending == ".parquet":
        _write_parquet(path, catalogue)
    elif ending == ".vot":
        from astropy.io.votable import from_table

        with whole_file(path) as file:
            from_table(_table(catalogue)).to_xml(file)
    else:
        with whole_file(path) as file:
            _fits(_table(catalogue), catalogue).writeto(file)


def _table(catalogue: InstrumentCatalogue) -> Any:
    """The catalogue as Astropy's table, with units, descriptions and UCDs."""
    from astropy.table import Table

    table = Table()
    for name, column in catalogue.columns.items():
        table[name] = column.values
        table[name].unit = column.unit or None
        table[name].description = column.description
        table[name].meta["ucd"] = column.ucd
    return table


def _write_csv(path: Path, catalogue: InstrumentCatalogue) -> None:
    texts = []
    for name, column in catalogue.columns.items():
        if name in ("ra_deg", "dec_deg"):
            form = f".{DECIMALS}f"
        elif column.values.dtype.kind == "f":
            form = ".6g"
        else:
            form = ""
        texts.append([format(value, form) for value in column.values.tolist()])
    # write_csv quotes cells where needed: MK types such as "S5,1" contain commas
    write_csv(path, list(catalogue.columns), zip(*texts, strict=True))


def _fits(table: Any, catalogue: InstrumentCatalogue) -> Any:
    from astropy.io import fits

    hdu = fits.table_to_hdu(table)
    hdu.header["EPOCH"] = (catalogue.epoch_jyear, "Julian year of the places")
    for system, zero in catalogue.zero_points.items():
        hdu.header[f"ZP{system.upper()}"] = (zero, "mag of one electron per second")
    for number, column in enumerate(catalogue.columns.values(), start=1):
        hdu.header[f"TUCD{number}"] = column.ucd
        hdu.header.comments[f"TTYPE{number}"] = column.description[:45]
    return fits.HDUList([fits.PrimaryHDU(), hdu])


def _write_parquet(path: Path, catalogue: InstrumentCatalogue) -> None:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MachineError(PARQUET) from error
    fields = []
    arrays = []
    for name, column in catalogue.columns.items():
        array = pa.array(column.values.tolist())
        metadata = {"unit": column.unit, "ucd": column.ucd, "description": column.description}
        fields.append(pa.field(name, array.type, metadata=metadata))
        arrays.append(array)
    table = pa.table(arrays, schema=pa.schema(fields))
    with whole_file(path) as file:
        pq.write_table(table, file)
