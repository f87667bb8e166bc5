"""Each reader of a file that somebody names refuses one that is larger than any of its kind,
before it reads it: the file is one byte over, and has no block on the disk.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hilstar.attitude.logs.log_file import read_log
from hilstar.attitude.logs.telemetry import read_telemetry
from hilstar.attitude.wire.keys import load_secret
from hilstar.display.calibration import read_grid, read_response, read_toml
from hilstar.display.geometry import load_distortion, load_geometry, monitor_camera
from hilstar.display.primaries import read_primaries
from hilstar.instruments.calibrate.attitude_pairs import read_pairs
from hilstar.instruments.calibrate.first_light.context import SESSION_FILE, read_session
from hilstar.instruments.calibrate.geometric.dots import read_plan as read_dots
from hilstar.instruments.calibrate.geometric.observed import read_exposed, read_observed
from hilstar.instruments.calibrate.latency import read_edges
from hilstar.instruments.calibrate.measurements import read_measurements
from hilstar.instruments.calibrate.reference import read_readings
from hilstar.instruments.calibrate.sensor import import_emva
from hilstar.instruments.campaign.acceptance_plan import read_acceptance_plan
from hilstar.instruments.campaign.plan import read_plan
from hilstar.instruments.compare.compare_skies import read_frame_fits, read_truth_csv
from hilstar.instruments.confront.images import read_photographs
from hilstar.instruments.confront.measured_bench import read_tracker_file
from hilstar.optics.glass.psf_file import read_glass
from hilstar.optics.glass.zernike import glass_of_pupil
from hilstar.optics.layers.stray_light import read_map
from hilstar.optics.psf import read_psf
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.certificate_file import read_certificate
from hilstar.server.bench.moving_sky import orbit_file
from hilstar.server.bench.scenario import read_scenario
from hilstar.sky.catalog import read_hip_main
from hilstar.sky.diffuse import read_diffuse_map
from hilstar.sky.spectrum import read_curve_csv
from hilstar.sky.table_reader import read_table
from tests.support.refusals import assert_file_refused

CAMERA = monitor_camera((320, 240), 57.65, 60.0, np.array([1.0, 0.0, 0.0, 0.0]))
BENCH = Path("bench.toml")
AEM, STK, CIC = (f"{word}\n" for word in ("CCSDS_AEM_VERS = 2.0", "stk.v.11.0", "CIC_AEM_VERS = 1"))
KB, MB = 10**3, 10**6
# What is read, the file's name, its limit, and what it begins with where that says what it is.
READERS: list[tuple[Callable[[Path], object], str, int, str]] = [
    (read_bench_file, "bench.toml", 200 * KB, ""),
    (read_scenario, "faults.toml", 200 * KB, ""),
    (read_toml, "calibration.toml", 200 * KB, ""),
    (read_plan, "plan.toml", 200 * KB, ""),
    (lambda path: read_acceptance_plan(path, BENCH, False, None), "plan.toml", 200 * KB, ""),
    (read_tracker_file, "tracker.toml", 200 * KB, ""),
    (partial(load_geometry, resolution_px=(320, 240)), "geometry.toml", MB, ""),
    (partial(load_distortion, camera=CAMERA), "lens.toml", MB, ""),
    (partial(glass_of_pupil, per_px=4, tolerance=0.01), "pupil.toml", MB, ""),
    (read_curve_csv, "qe.csv", MB, ""),
    (read_primaries, "rgb.csv", MB, ""),
    (read_primaries, "display.ccss", MB, ""),
    (import_emva, "emva.csv", MB, ""),
    (import_emva, "emva.json", MB, ""),
    (partial(read_response, bits=8), "response.csv", 10 * MB, ""),
    (lambda path: read_grid(path, []), "grid.csv", 10 * MB, ""),
    (partial(read_measurements, bits=8), "measured.csv", 10 * MB, ""),
    (partial(read_readings, camera=None), "readings.csv", 10 * MB, ""),
    (read_psf, "psf.fits", 20 * MB, ""),
    (read_edges, "edges.csv", 20 * MB, ""),
    (read_dots, "dots.csv", 20 * MB, ""),
    (lambda path: read_session(path.parent), SESSION_FILE, 20 * MB, ""),
    (partial(orbit_file, utc_ns=0, day=False), "orbit.txt", 20 * MB, ""),
    (read_certificate, "certificate.json", 50 * MB, ""),
    (read_truth_csv, "truth.csv", 50 * MB, ""),
    (read_log, "log.aem", 50 * MB, AEM),
    (read_log, "log.a", 50 * MB, STK),
    (read_log, "log.cic", 50 * MB, CIC),
    (read_hip_main, "hip_main.dat", 100 * MB, ""),
    (read_observed, "dots_seen.csv", 100 * MB, ""),
    (read_pairs, "pairs.csv", 200 * MB, ""),
    (read_map, "map.npy", 200 * MB, ""),
    (read_log, "log.csv", 500 * MB, ""),
    (read_log, "log.jsonl", 500 * MB, ""),
    (read_telemetry, "telemetry.csv", 500 * MB, ""),
    (read_glass, "glass.fits", 500 * MB, ""),
    (lambda path: read_photographs(path, (9, 9), None), "photo.fits", 500 * MB, ""),
    (read_exposed, "exposed.fits", 500 * MB, ""),
    (read_frame_fits, "frame.fits", 600 * MB, ""),
    (read_diffuse_map, "map.fits", 1000 * MB, ""),
    (read_table, "stars.csv", 4000 * MB, ""),
]
SAID = {200 * KB: "200 kB", MB: "1 MB", 1000 * MB: "1 GB", 4000 * MB: "4 GB"}


@pytest.mark.parametrize(
    ("read", "name", "limit_bytes", "begin"), READERS, ids=[name for _, name, _, _ in READERS]
)
def test_a_file_of_one_byte_over_its_limit_is_not_read(tmp_path, read, name, limit_bytes, begin):
    path = tmp_path / name
    path.write_text(begin)
    os.truncate(path, limit_bytes + 1)
    said = SAID.get(limit_bytes, f"{limit_bytes // MB} MB")
    assert_file_refused(read, path, f"and at most {said} are read")


def test_a_secret_key_s_file_has_sixteen_kibibytes_at_most(tmp_path):
    path = tmp_path / "a.key_secret"
    path.touch(0o600)
    os.truncate(path, 2**14 + 1)
    assert_file_refused(load_secret, path, "and at most 16.38 kB are read")
