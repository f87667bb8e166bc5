"""A bench's catalogue as its tracker sees it: a row a star, with errors, origins and synthetic
magnitudes; and its files.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import write_csv
from hilstar.basics.errors import InputError, MachineError
from hilstar.basics.files import STDOUT, whole_file
from hilstar.basics.units import ARCSEC_PER_RAD, magnitude
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

MIN_PARALLAX_SIGMAS = 5.0  # beyond which a distance is within 20 %
FAINTER_MAG = 3.0  # by this a neighbour may be fainter
COLOUR_STEP_MAG = 0.01  # step of the derivative of a rate by a colour
DECIMALS = 9  # places in degrees: 4 microarcseconds
PASSBANDS = {
    "u": "Bessell's U",
    "b": "Bessell's B",
    "r": "Bessell's R",
    "i": "Bessell's I",
    "g": "Gaia's G",
}
# A star's spectrum is chosen by its V-I, or its type: what it has in B is then not what was
# measured.
NOT_MEASURED = {
    "b": "; not V + (B-V), which is b_measured_mag: the spectrum is chosen by V-I or by type",
    "i": "; V - (V-I) is i_measured_mag",
}
ENDINGS = (".csv", ".fits", ".parquet", ".vot")
PARQUET = "parquet needs pyarrow: pip install 'hilstar[campaign]', or write .csv, .fits or .vot"


class Column(NamedTuple):
    """A column: figures or text (n,), its unit as astropy writes it, its UCD, and what it is."""

    values: npt.NDArray[Any]
    unit: str
    ucd: str
    words: str


@dataclass(frozen=True, slots=True)
class InstrumentCatalogue:
    """The columns by name, the brightest star first, and what is to be said of them."""

    columns: dict[str, Column]
    epoch_jyear: float
    zero_points: dict[str, float]

    def __len__(self) -> int:
        return len(self.columns["hip"].values)


def bench_catalogue(
    file: BenchFile, faintest_v_mag: float | None, epoch_jyear: float | None
) -> InstrumentCatalogue:
    """The catalogue of a bench to V = `faintest_v_mag` (None: the bench's) at an epoch (None: the
    bench's).

    Places are barycentric ICRS, without aberration or parallax. Raises InputError.
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
    light, zero_points = _light(file, chosen, facts)
    columns = (
        _places(chosen, facts, epoch)
        | _photometry(chosen, facts)
        | light
        | _distances(chosen, facts, light)
    )
    return InstrumentCatalogue(columns | _company(every, rows, facts, epoch), epoch, zero_points)


def _places(stars: Catalog, facts: dict[str, Any], epoch_jyear: float) -> dict[str, Column]:
    motion = motion_at(stars, facts, epoch_jyear)
    sigma = np.sqrt(np.einsum("nii->in", motion.covariance))
    product = sigma[0] * sigma[1]
    correlation = np.divide(
        motion.covariance[:, 0, 1], product, out=np.full(len(product), np.nan), where=product > 0
    )
    place = "pos.eq.ra;meta.main"
    speed = "pos.pm;pos.eq.ra"
    names = ["" if hip else stars.name(k) for k, hip in enumerate(stars.hip.tolist())]
    return {
        "hip": Column(stars.hip, "", "meta.id;meta.main", "Hipparcos number, 0 for a star without"),
        "name": Column(
            np.array(names, dtype=np.str_),
            *("", "meta.id", "designation of a star without a HIP number"),
        ),
        "ra_deg": Column(
            np.round(motion.ra_deg, DECIMALS) % 360.0,
            "deg",
            place,
            "right ascension, ICRS, at the epoch",
        ),
        "dec_deg": Column(
            np.round(motion.dec_deg, DECIMALS),
            "deg",
            place.replace(".ra", ".dec"),
            "declination, ICRS",
        ),
        "sigma_ra_mas": Column(
            sigma[0], "mas", "stat.error;pos.eq.ra", "error at the epoch, times cos(dec)"
        ),
        "sigma_dec_mas": Column(
            sigma[1], "mas", "stat.error;pos.eq.dec", "error of declination at the epoch"
        ),
        "ra_dec_correlation": Column(
            correlation, "", "stat.correlation", "correlation of both errors at the epoch"
        ),
        "pm_ra_mas_yr": Column(
            motion.pm_ra_mas_yr, "mas/yr", speed, "proper motion in right ascension, times cos(dec)"
        ),
        "pm_dec_mas_yr": Column(
            motion.pm_dec_mas_yr,
            "mas/yr",
            speed.replace(".ra", ".dec"),
            "proper motion in declination",
        ),
        "sigma_pm_ra_mas_yr": Column(sigma[2], "mas/yr", f"stat.error;{speed}", "its error"),
        "sigma_pm_dec_mas_yr": Column(
            sigma[3], "mas/yr", "stat.error;pos.pm;pos.eq.dec", "its error"
        ),
        "parallax_mas": Column(stars.parallax_mas, "mas", "pos.parallax.trig", "parallax"),
        "sigma_parallax_mas": Column(
            facts["sigma_parallax_mas"], "mas", "stat.error;pos.parallax.trig", "its error"
        ),
    }


def _photometry(stars: Catalog, facts: dict[str, Any]) -> dict[str, Column]:
    def origin(name: str, words: str) -> Column:
        return Column(facts[name].astype(np.str_), "", "meta.ref", words)

    return {
        "v_mag": Column(stars.v_mag, "mag", "phot.mag;em.opt.V", "Johnson V"),
        "sigma_v_mag": Column(
            sigma_v_mag(facts, stars.bv_mag), "mag", "stat.error;phot.mag;em.opt.V", "its error"
        ),
        "v_source": origin("v_source", "origin of V: G ground, H Hipparcos, T Tycho, U the table"),
        "b_v_mag": Column(stars.bv_mag, "mag", "phot.color;em.opt.B;em.opt.V", "Johnson B-V"),
        "sigma_b_v_mag": Column(facts["sigma_bv_mag"], "mag", "stat.error;phot.color", "its error"),
        "b_v_source": origin("bv_source", "origin of B-V: G ground, T Tycho"),
        "v_i_mag": Column(stars.vi_mag, "mag", "phot.color;em.opt.V;em.opt.I", "Cousins V-I"),
        "sigma_v_i_mag": Column(facts["sigma_vi_mag"], "mag", "stat.error;phot.color", "its error"),
        "v_i_source": origin("vi_source", "origin of V-I: field H42 of CDS I/239"),
        "spectral_type": Column(
            facts["spectral_type"].astype(np.str_), "", "src.spType", "MK type"
        ),
        "luminosity_class": Column(
            luminosity_class(facts["spectral_type"]),
            "",
            "src.class.luminosity",
            "class in that type",
        ),
        "spectral_type_source": origin(
            "spectral_type_source", "origin of the type: field H77 of CDS I/239, or U: the table"
        ),
        "variable": Column(
            stars.variable.astype(np.str_),
            "",
            "src.var",
            "P periodic, U unsolved, M within 0.03 mag",
        ),
        "range_mag": Column(
            _decimals(stars.range_mag), "mag", "src.var.amplitude", "range of its light in Hp"
        ),
        "period_d": Column(_decimals(stars.period_d), "d", "time.period", "period"),
    }


def _decimals(values: npt.NDArray[np.float32]) -> FloatArray:
    # back to the catalogue's from float32
    return np.asarray(np.round(values.astype(np.float64), 3), dtype=np.float64)


def _light(
    file: BenchFile, stars: Catalog, facts: dict[str, Any]
) -> tuple[dict[str, Column], dict[str, float]]:
    sky = file.config.sky
    optics = bench_optics(file.config.tracker, file.folder)
    photometry = Photometry(sky.zero_point, sky.passband_weighting)
    rates = star_rates(file.config, file.folder)
    kind = star_kinds(file.config, stars)
    rate = rates(stars.v_mag, stars.bv_mag, stars.vi_mag, kind)
    zero_points = {
        "vega": VEGA_V_MAG + magnitude(1 / vega_electrons_per_s(optics, photometry)),
        "ab": magnitude(1 / ab_electrons_per_s(optics)),
    }
    colour = colours(sky.spectrum, sky.temperature, photometry)
    columns = {
        "temperature_k": Column(
            star_temperatures_k(stars.bv_mag, sky.temperature),
            "K",
            "phys.temperature",
            f"temperature by B-V ({sky.temperature})",
        )
    }
    for band in BANDS:
        values = stars.v_mag + colour[band](stars.bv_mag, stars.vi_mag, kind)
        light_note = (
            f"synthetic, its spectrum through {PASSBANDS[band]}{NOT_MEASURED.get(band, '')}"
        )
        columns[f"{band}_mag"] = Column(
            values, "mag", f"phot.mag;em.opt.{band.upper()}", light_note
        )
    columns["b_measured_mag"] = Column(
        stars.v_mag + stars.bv_mag, "mag", "phot.mag;em.opt.B", "V + (B-V), as measured"
    )
    columns["i_measured_mag"] = Column(
        stars.v_mag - stars.vi_mag, "mag", "phot.mag;em.opt.I", "V - (V-I), as measured"
    )
    bolometric = stars.v_mag + colour["bolometric"](stars.bv_mag, stars.vi_mag, kind)
    columns["bolometric_mag"] = Column(
        bolometric, "mag", "phot.mag.bc", "apparent bolometric magnitude (IAU 2015)"
    )
    columns["electrons_per_s"] = Column(
        rate, "1/s", "phot.count", "electrons per second in this tracker"
    )
    for system, zero in zero_points.items():
        light_note = f"magnitude in this tracker, {zero:.4f} - 2.5 log10(electrons_per_s)"
        columns[f"instrument_mag_{system}"] = Column(
            zero + magnitude(rate), "mag", "phot.mag;instr", light_note
        )
    columns["sigma_instrument_mag"] = Column(
        sigma_instrument_mag(stars, facts, rates, kind),
        "mag",
        "stat.error;phot.mag;instr",
        "its error, by those of V and of the colours",
    )
    return columns, zero_points


def sigma_instrument_mag(
    stars: Catalog, facts: dict[str, Any], rates: StarRates, kind: FloatArray | None = None
) -> FloatArray:
    """The error of each star's magnitude in the tracker (n,), by the errors of V, B-V and V-I taken
    as independent.

    That of the step from colours to a spectrum is not in it.
    """
    v = stars.v_mag
    bv = stars.bv_mag
    vi = stars.vi_mag
    half = COLOUR_STEP_MAG / 2
    by_bv = (
        magnitude(rates(v, bv + half, vi, kind) / rates(v, bv - half, vi, kind)) / COLOUR_STEP_MAG
    )
    by_vi = (
        magnitude(rates(v, bv, vi + half, kind) / rates(v, bv, vi - half, kind)) / COLOUR_STEP_MAG
    )
    of_bv = by_bv * np.where(by_bv == 0, 0, facts["sigma_bv_mag"])
    of_vi = by_vi * np.where(by_vi == 0, 0, facts["sigma_vi_mag"])
    return np.sqrt(sigma_v_mag(facts, bv) ** 2 + of_bv**2 + of_vi**2)


def _distances(
    stars: Catalog, facts: dict[str, Any], light: dict[str, Column]
) -> dict[str, Column]:
    parallax = stars.parallax_mas
    sigma = facts["sigma_parallax_mas"]
    sure = (parallax > 0) & ~(parallax < MIN_PARALLAX_SIGMAS * sigma)
    modulus = 10 - 5 * np.log10(np.where(sure, parallax, np.nan))
    return {
        "absolute_mag": Column(
            stars.v_mag - modulus, "mag", "phys.magAbs;em.opt.V", "absolute V, without extinction"
        ),
        "absolute_bolometric_mag": Column(
            light["bolometric_mag"].values - modulus,
            "mag",
            "phys.magAbs.bol",
            "absolute bolometric magnitude",
        ),
    }


def _company(
    every: Catalog, rows: npt.NDArray[np.intp], facts: dict[str, Any], epoch_jyear: float
) -> dict[str, Column]:
    stars = every.taken(rows)
    difference = facts["difference_hp_mag"]
    brighter = stars.v_mag + 2.5 * np.log10(1 + 10 ** (-0.4 * difference))
    neighbour, arcsec = nearest_neighbours(every, rows, epoch_jyear)
    return {
        "double": Column(
            stars.multiple.astype(np.str_),
            "",
            "meta.code.multip",
            "flag H59 of CDS I/239: C G O V X",
        ),
        "separation_arcsec": Column(
            _decimals(stars.separation_arcsec),
            "arcsec",
            "pos.angDistance",
            "of a pair in one entry",
        ),
        "component_a_mag": Column(
            brighter,
            "mag",
            "phot.mag",
            "brighter component, of V of both and their difference in Hp",
        ),
        "component_b_mag": Column(brighter + difference, "mag", "phot.mag", "fainter component"),
        "neighbour": Column(
            np.array([every.name(k) for k in neighbour.tolist()], dtype=np.str_),
            *(
                "",
                "meta.id",
                f"nearest entry less than {FAINTER_MAG:g} mag fainter, of the whole catalogue",
            ),
        ),
        "neighbour_arcsec": Column(arcsec, "arcsec", "pos.angDistance", "its distance"),
        "neighbour_v_mag": Column(every.v_mag[neighbour], "mag", "phot.mag;em.opt.V", "its V"),
    }


def nearest_neighbours(
    every: Catalog, rows: npt.NDArray[np.intp], epoch_jyear: float
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """For the stars at `rows` (n,) the nearest other star brighter than their V + FAINTER_MAG, and
    its distance, arcsec.

    A star without one has itself, at NaN.
    """
    from scipy.spatial import cKDTree

    vectors = unit_vectors_icrs(every, epoch_jyear)
    tree = cKDTree(vectors)
    neighbours = rows.copy()
    chord = np.full(len(rows), np.nan)
    rest = np.arange(len(rows))
    count = 8
    while len(rest):
        count = min(count, len(every))
        far, near = (
            np.atleast_2d(part)
            for part in tree.query(vectors[rows[rest]], k=np.arange(1, count + 1))
        )
        fits = (every.v_mag[near] < every.v_mag[rows[rest], None] + FAINTER_MAG) & (
            near != rows[rest, None]
        )
        first = fits.argmax(axis=1)
        has = fits[np.arange(len(rest)), first]
        neighbours[rest[has]] = near[has, first[has]]
        chord[rest[has]] = far[has, first[has]]
        if count == len(every):
            break
        rest = rest[~has]
        count = count * 4
    return neighbours, 2 * np.arcsin(chord / 2) * ARCSEC_PER_RAD


def write_catalogue(path: Path, catalogue: InstrumentCatalogue) -> None:
    """Write a CSV, a FITS table, a VOTable or a Parquet file by the name's ending. Raises
    InputError or MachineError.
    """
    from astropy.table import Table

    if path == STDOUT:
        ending = ".csv"
    else:
        ending = path.suffix.lower()
    table = Table({name: column.values for name, column in catalogue.columns.items()})
    for name, column in catalogue.columns.items():
        table[name].unit, table[name].description = column.unit or None, column.words
        table[name].meta["ucd"] = column.ucd
    if ending == ".parquet":
        _write_parquet(path, catalogue)
    elif ending == ".csv":
        texts = []
        for name, column in catalogue.columns.items():
            if name in ("ra_deg", "dec_deg"):
                form = f".{DECIMALS}f"
            elif column.values.dtype.kind == "f":
                form = ".6g"
            else:
                form = ""
            texts.append([format(value, form) for value in column.values.tolist()])
        # MK types such as "S5,1" have commas
        write_csv(path, list(catalogue.columns), zip(*texts, strict=True))
    elif ending == ".vot":
        from astropy.io.votable import from_table

        with whole_file(path) as file:
            from_table(table).to_xml(file)
    else:
        with whole_file(path) as file:
            _fits(table, catalogue).writeto(file)


def _fits(table: Any, catalogue: InstrumentCatalogue) -> Any:
    from astropy.io import fits

    hdu = fits.table_to_hdu(table)
    hdu.header["EPOCH"] = (catalogue.epoch_jyear, "Julian year of the places")
    for system, zero in catalogue.zero_points.items():
        hdu.header[f"ZP{system.upper()}"] = (zero, "mag of one electron per second")
    for number, column in enumerate(catalogue.columns.values(), start=1):
        hdu.header[f"TUCD{number}"] = column.ucd
        hdu.header.comments[f"TTYPE{number}"] = column.words[:45]
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
        metadata = {"unit": column.unit, "ucd": column.ucd, "description": column.words}
        fields.append(pa.field(name, array.type, metadata=metadata))
        arrays.append(array)
    table = pa.table(arrays, schema=pa.schema(fields))
    with whole_file(path) as file:
        pq.write_table(table, file)
