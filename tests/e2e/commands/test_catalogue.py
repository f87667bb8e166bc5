"""A bench with a table of stars: what a user types, sees and is refused."""

from __future__ import annotations

import json

import pytest

from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import bench_text
from tests.support.commands import run_hilstar_here
from tests.support.tables import csv_rows

pytestmark = pytest.mark.e2e
HEAD = "source_id,ra,dec,ref_epoch,pmra,pmdec,phot_g_mean_mag,bp_rp\n"
SOURCE = 3216486443742786048
ROWS = f"{SOURCE},84.1233,-1.1122,2016.0,1.2,-3.4,7.31,0.42\n321648647810195008,83.9018,-1.3217,2016.0,,,7.0,\n"


@pytest.fixture
def stars_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "stars.csv").write_text(HEAD + ROWS)
    keys = {"catalogue": "stars.csv", "with_hipparcos": True}
    (tmp_path / "bench.toml").write_text(
        bench_text({"sky": keys, "collimator": {"focal_length_mm": 350}})
    )
    return tmp_path


def belt_frame(folder, *words):
    """`hilstar frame` of Orion's belt, with its truth table."""
    truth = folder / "t.csv"
    bench = folder / "bench.toml"
    return run_hilstar_here("frame", bench, "--radec", "84.057,-1.2,0", "--truth", truth, *words)


def test_the_table_s_star_is_in_the_frame_beside_hipparcos(stars_folder):
    done = belt_frame(stars_folder, "--explain")
    assert done.returncode == 0, done.stderr
    assert "stars.csv: 1 stars of 2 rows, V and V-I from Gaia's G, BP and RP" in done.stderr
    assert "1 stars added to Hipparcos' 116812" in done.stderr
    rows = {int(row["hip"]): row for row in csv_rows(stars_folder / "t.csv")}
    assert {0, 26311} <= set(rows)  # Alnilam is Hipparcos'
    assert (rows[0]["name"], rows[26311]["name"]) == (f"Gaia DR3 {SOURCE}", "")
    # G - V of Riello et al. 2021, table C.2, at BP - RP = 0.42, by hand.
    assert float(rows[0]["v_mag"]) == pytest.approx(
        7.31 + 0.02704 - 0.0059808 + 0.03803184 - 0.00105649, abs=1e-6
    )


def test_a_star_without_a_hip_number_clips_by_name(stars_folder):
    with (stars_folder / "bench.toml").open("a") as file:
        file.write("[render]\nflux_at_white_e_per_s = 1000\n")
    done = belt_frame(stars_folder, "--json")
    summary = json.loads(done.stdout)
    assert {26311, f"Gaia DR3 {SOURCE}"} <= set(summary["clipped"])
    assert summary["clipped_mag"][f"Gaia DR3 {SOURCE}"] > 0


def test_the_bench_s_hash_covers_the_table(stars_folder):
    before = read_bench_file(stars_folder / "bench.toml").sha256
    assert read_bench_file(stars_folder / "bench.toml").sha256 == before
    (stars_folder / "stars.csv").write_text(HEAD + ROWS.replace("7.31", "7.32"))
    assert read_bench_file(stars_folder / "bench.toml").sha256 != before


def test_a_table_that_cannot_be_used_is_one_line(stars_folder):
    (stars_folder / "stars.csv").write_text("ra,dec,mass\n1,2,3\n")
    done = belt_frame(stars_folder)
    assert done.returncode == 2
    assert "has no magnitude with a colour among its columns (ra, dec, mass)" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (stars_folder / "t.csv").exists()
