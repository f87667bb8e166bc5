"""[sky] variables = "phase": the light of a table's variable stars at a date, and the mean of
all others.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.star_light import bench_stars
from tests.support.benches import bench_text

# JD 2461000.5 is 2025-11-21T00:00:00 UTC. The second star is at its faintest then, the third a
# quarter of its period later.
TABLE = """ra,dec,v_mag,bv_mag,epoch_jyear,epoch_jd,period_d,amplitude_mag
10,0,5.0,0.6,2000,2461000.5,10,0.4
20,0,5.0,0.6,2000,2460995.5,10,0.4
30,0,5.0,0.6,2000,2460998.0,10,0.4
40,0,5.0,0.6,2000,,10,0.4
50,0,5.0,0.6,2000,,,
"""
JD_LIMIT_MAG = 0.002  # the Julian year of UTC keeps the date to a minute, the period is float32


def variable_stars(folder, **sky):
    (folder / "stars.csv").write_text(TABLE)
    path = folder / "bench.toml"
    path.write_text(
        bench_text(
            {"collimator": {"focal_length_mm": 350}, "sky": {"catalogue": "stars.csv", **sky}}
        )
    )
    file = read_bench_file(path)
    return bench_stars(file.config, file.folder)


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def by_row(found):
    return dict(zip(found.names(np.arange(len(found))), found.v_mag.tolist(), strict=True))


def test_a_table_s_stars_have_the_light_of_the_date(tmp_path):
    date = {"epoch_utc": "2025-11-21T00:00:00Z"}
    mean, phase = (
        variable_stars(tmp_path, **date),
        variable_stars(tmp_path, variables="phase", **date),
    )
    assert list(by_row(mean).values()) == [5.0] * 5
    wanted = {
        "stars row 1": 4.6,
        "stars row 2": 5.4,
        "stars row 3": 5.0,
        "stars row 4": 5.0,
        "stars row 5": 5.0,
    }
    assert by_row(phase) == pytest.approx(wanted, abs=JD_LIMIT_MAG)
    assert phase.electrons_per_s.max() / phase.electrons_per_s.min() == pytest.approx(
        10**0.32, rel=2 * JD_LIMIT_MAG
    )
    half_later = variable_stars(tmp_path, variables="phase", epoch_utc="2025-11-26T00:00:00Z")
    assert by_row(half_later)["stars row 1"] == pytest.approx(5.4, abs=JD_LIMIT_MAG)


def test_hipparcos_alone_stays_at_its_mean_and_a_line_says_so(tmp_path):
    sky = {"catalogue": "hipparcos", "faintest_v_mag": 4.0, "epoch_utc": "2025-11-21T00:00:00Z"}
    mean, phase = (
        variable_stars(tmp_path, **sky),
        variable_stars(tmp_path, variables="phase", **sky),
    )
    assert phase.v_mag.tolist() == mean.v_mag.tolist()
    assert any("without an epoch of phase have their mean" in note for note in phase.catalog.notes)


def test_phase_needs_a_date(tmp_path):
    with pytest.raises(InputError, match=r"needs a date; write \[sky\] epoch_utc"):
        variable_stars(tmp_path, variables="phase")
