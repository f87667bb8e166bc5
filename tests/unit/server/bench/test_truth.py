"""The truth table: what the catalogue says of each star, and blanks for what is in no catalogue."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.optics.layers.truth import truth_table, with_errors
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import load
from hilstar.server.bench.frame_files import write_truth_csv
from hilstar.sky.catalog import load_catalog
from hilstar.sky.stars import make_stars, unit_vectors_icrs
from tests.support.benches import bench_text


def test_each_star_has_its_own_variability_and_companion():
    catalog = load_catalog().brighter_than(3.5)
    ones = np.ones(len(catalog))
    stars = make_stars(catalog, unit_vectors_icrs(catalog, 2026.0), ones, ones)
    every = np.arange(len(stars))
    truth = truth_table(stars, every, ones, ones)
    by_hip = {int(row["hip"]): row for row in truth}
    mizar = by_hip[65378]
    assert (mizar["double"], mizar["separation_arcsec"], mizar["variable"]) == ("C", 14.431, "")
    algol = by_hip[14576]
    assert (algol["variable"], algol["range_mag"], algol["double"]) == ("P", 0.14, "O")
    assert np.isnan(algol["period_d"])

    # rows in any order, that of the catalogue's first star among them, are those of their stars
    order = np.roll(every[::-1], 3)
    again = truth_table(stars, order, ones, ones)
    for name in truth.dtype.names:
        np.testing.assert_array_equal(again[name], truth[name][order], name)
    first = truth[np.flatnonzero(stars.row == 0)[0]]
    alone = load_catalog().brighter_than(3.5)
    assert (first["variable"], first["double"]) == (
        alone.variable[0].decode(),
        alone.multiple[0].decode(),
    )

    unlisted = replace(stars, row=np.where(stars.hip == 65378, -1, stars.row))
    row = truth_table(unlisted, np.flatnonzero(stars.hip == 65378), ones[:1], ones[:1])[0]
    assert (row["double"], row["variable"]) == ("", "")
    assert np.isnan([row["separation_arcsec"], row["range_mag"], row["period_d"]]).all()


def test_a_written_table_has_the_errors_of_its_epoch():
    """Mizar in CDS I/239: 0.49 and 0.51 mas of place, 0.48 and 0.48 mas a year; a body and a
    star of a table have no errors.
    """
    catalog = load_catalog().brighter_than(3.5)
    ones, mizar = np.ones(len(catalog)), catalog.hip == 65378
    stars = make_stars(catalog, unit_vectors_icrs(catalog, 2026.0), ones, ones)
    truth = truth_table(stars, np.arange(len(stars)), ones, ones)
    row = truth["hip"] == 65378
    assert np.isnan([truth["sigma_pos_mas"], truth["sigma_mag"]]).all()
    at_start = with_errors(truth, catalog, 1991.25)[row]
    assert at_start["sigma_pos_mas"] == pytest.approx(np.hypot(0.49, 0.51) / np.sqrt(2), abs=5e-5)
    # of V from Hp, and its scatter about Hp
    assert at_start["sigma_mag"] == pytest.approx(np.hypot(0.0088, 0.004), abs=5e-5)
    # 34.75 years of 0.48 mas a year; the correlations of place and motion take 0.1 from it.
    assert with_errors(truth, catalog, 2026.0)["sigma_pos_mas"][row] == pytest.approx(
        0.48 * 34.75, abs=0.12
    )
    truth["hip"][~row] = 0
    assert (
        np.isnan(with_errors(truth, catalog, 2026.0)["sigma_pos_mas"]).tolist() == (~row).tolist()
    )
    other = replace(catalog, epoch_jyear=np.where(mizar, 2016.0, catalog.epoch_jyear))
    assert np.isnan(with_errors(truth, other, 2026.0)["sigma_pos_mas"]).all()


def test_a_frame_that_writes_no_truth_table_reads_no_facts(tmp_path, monkeypatch):
    def no_facts():
        raise AssertionError("hipparcos_facts.npz was read")

    monkeypatch.setattr("hilstar.sky.facts._packaged", no_facts)
    path = tmp_path / "bench.toml"
    path.write_text(
        bench_text({"collimator": {"focal_length_mm": 350}, "sky": {"faintest_v_mag": 4.0}})
    )
    with load(path) as bench:
        shot = bench.frame(from_radec_roll_deg(84.0, -1.2, 0.0))
    assert len(shot.rows)
    with pytest.raises(AssertionError, match="was read"):
        print(shot.truth)


def test_the_table_that_python_has_is_the_one_that_is_written(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(
        bench_text({"collimator": {"focal_length_mm": 350}, "sky": {"faintest_v_mag": 4.0}})
    )
    with load(path) as bench:
        shot = bench.frame(from_radec_roll_deg(84.0, -1.2, 0.0))
    write_truth_csv(tmp_path / "truth.csv", shot)
    written = np.genfromtxt(
        tmp_path / "truth.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    for name in ("sigma_pos_mas", "sigma_mag"):
        assert np.isfinite(shot.truth[name]).all()
        assert written[name].tolist() == shot.truth[name].tolist()
    with Simulator(read_bench_file(path)) as simulator:
        exposure = simulator.expose(
            simulator.view(from_radec_roll_deg(84.0, -1.2, 0.0), np.zeros(3)), None
        )
    is_listed = exposure.truth["hip"] > 0
    assert np.isfinite(exposure.truth["sigma_pos_mas"][is_listed]).all()
    # a centroid asks for no error, and a process is handed the truth with them
    assert np.isnan(exposure.rows["sigma_pos_mas"]).all()
    handed_on = pickle.loads(pickle.dumps(exposure))
    assert handed_on.truth.tobytes() == exposure.truth.tobytes()
