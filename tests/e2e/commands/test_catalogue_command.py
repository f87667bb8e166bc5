"""hilstar catalogue: its columns, formats and refusals."""

from __future__ import annotations

import json
import re

import numpy as np
import pyarrow.parquet
import pytest

from tests.support.benches import bench_text
from tests.support.commands import assert_refused, run_hilstar_here
from tests.support.tables import csv_rows

pytestmark = pytest.mark.e2e
# design: names that other programs read.
NAMES = {
    "hip",
    "v_mag",
    "spectral_type",
    "r_mag",
    "dec_deg",
    "g_mag",
    "sigma_ra_mas",
    "instrument_mag_ab",
    "b_v_mag",
    "v_i_mag",
    "sigma_dec_mas",
    "sigma_v_mag",
    "pm_ra_mas_yr",
    "pm_dec_mas_yr",
    "instrument_mag_vega",
    "electrons_per_s",
    "u_mag",
    "ra_deg",
    "temperature_k",
    "b_mag",
    "parallax_mas",
    "i_mag",
}


@pytest.fixture
def faint_bench(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(bench_text({"collimator": {"focal_length_mm": 350}}))
    return path


def test_every_format_has_the_same_stars(faint_bench, tmp_path):
    from astropy.io import fits
    from astropy.table import Table

    for ending in ("csv", "fits", "vot", "parquet"):
        done = run_hilstar_here(
            f"catalogue {faint_bench} -o {tmp_path}/s.{ending} --faintest 2 --epoch 2030 --json"
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert json.loads(done.stdout)["epoch_jyear"] == 2030
    rows = csv_rows(tmp_path / "s.csv")
    assert set(rows[0]) >= NAMES
    assert all(float(row["v_mag"]) <= 2 for row in rows)
    vega = next(row for row in rows if row["hip"] == "91262")
    assert (vega["spectral_type"], vega["luminosity_class"], len(vega["ra_deg"].split(".")[1])) == (
        "A0Vvar",
        "V",
        9,
    )
    # by its colours: CALSPEC_LIMIT of test_pickles
    assert float(vega["instrument_mag_vega"]) == pytest.approx(0.03, abs=0.03)
    assert float(vega["absolute_mag"]) == pytest.approx(0.03 + 5 + 5 * np.log10(0.12893), abs=1e-4)
    with fits.open(tmp_path / "s.fits") as hdus:
        table, header = hdus[1].data, hdus[1].header
        assert [str(n) for n in table["hip"]] == [row["hip"] for row in rows]
        place = table.names.index("ra_deg") + 1
        assert (header[f"TUNIT{place}"], header[f"TUCD{place}"]) == ("deg", "pos.eq.ra;meta.main")
    assert len(Table.read(tmp_path / "s.vot")) == len(rows)
    assert pyarrow.parquet.read_table(tmp_path / "s.parquet").column_names == list(rows[0])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("-o", "s.txt"), "ends in .csv, .fits, .parquet, .vot"),
        (("-o", "s.csv", "--faintest", "-5"), "no star of the catalogue is brighter than V = -5"),
    ],
)
def test_bad_input_is_one_line(faint_bench, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    done = run_hilstar_here("catalogue", faint_bench, *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_an_ending_may_be_in_capitals_and_the_bench_file_is_no_output(
    faint_bench, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    done = run_hilstar_here("catalogue", faint_bench, "-o", "S.CSV", "--faintest", "0")
    assert done.returncode == 0, done.stderr
    count, worth, wrote = done.stdout.strip().split("; ")
    rows = csv_rows(tmp_path / "S.CSV")
    assert (count, wrote) == (f"{len(rows)} stars at J2026", "wrote S.CSV")
    zeros_mag = re.fullmatch(
        r"an electron per second is ([\d.]+) mag \(Vega\), ([\d.]+) mag \(AB\)", worth
    ).groups()
    for zero_mag, system in zip(zeros_mag, ("vega", "ab"), strict=True):
        told_mag = float(rows[0][f"instrument_mag_{system}"])
        light_mag = -2.5 * np.log10(float(rows[0]["electrons_per_s"]))
        assert float(zero_mag) == pytest.approx(told_mag - light_mag, abs=2e-4)
    bench = faint_bench.rename(tmp_path / "bench.csv")
    refused = run_hilstar_here("catalogue", bench, "-o", bench)
    assert_refused(refused, 2, "bench.csv")
    assert "[tracker]" in bench.read_text()


def test_b_and_i_are_given_as_measured_beside_the_spectrum_s(faint_bench, tmp_path):
    """`b_mag` is up to 4 mag from V + (B-V): its description says why, and both are given."""
    from astropy.io.votable import parse_single_table

    done = run_hilstar_here("catalogue", faint_bench, "-o", tmp_path / "s.vot", "--faintest", "6")
    assert done.returncode == 0, done.stderr
    table = parse_single_table(tmp_path / "s.vot")
    rows, words = table.array, {field.name: field.description for field in table.fields}
    assert np.asarray(rows["b_measured_mag"]) == pytest.approx(
        np.asarray(rows["v_mag"] + rows["b_v_mag"]), abs=1e-9
    )
    assert np.asarray(rows["i_measured_mag"]) == pytest.approx(
        np.asarray(rows["v_mag"] - rows["v_i_mag"]), abs=1e-9
    )
    assert np.abs(rows["b_mag"] - rows["b_measured_mag"]).max() > 0.5
    assert "not V + (B-V)" in words["b_mag"] and "chosen by V-I" in words["b_mag"]
