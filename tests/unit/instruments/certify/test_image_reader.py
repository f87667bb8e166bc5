"""A bench read by images of its tracker: the light of its codes, the places of its dots and its
delay, by a virtual bench whose truth is written here.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.instruments.calibrate.first_light.image_sources import VirtualBench
from hilstar.instruments.certify import readings
from hilstar.instruments.certify.readings import ImageReader, dot_places, geometry_of
from hilstar.server.bench.bench_file import read_bench_file

WIDTH, HEIGHT = 480, 300
TRUE_WHITE_E_PER_S, TRUE_DELAY_MS = 2.2e6, 12.5
BENCH = """[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = 13
resolution_px = [256, 200]
quantum_efficiency = "ccd47-20"
[tracker.detector]
read_noise_e = 5
gain_e_per_dn = 2.5
[sky]
epoch_jyear = 2026.0
[monitor]
resolution_px = [480, 300]
pixel_pitch_um = 57.65
calibration = "srgb"
panel_delay_ms = {delay_ms}
photodiode_px = 40
[collimator]
focal_length_mm = 350
[render]
flux_at_white_e_per_s = {white}
sprite_sigma_px = [0.85, 0.85]
[certify]
fields = 1
"""
CODES = np.array([0, 255, 128, 0, 255, 60])
# Of lattices of some hundred dots: a reading's own noise is a thousandth of its light.
LIGHT_WITHIN = 0.01
PLACE_WITHIN_PX = 0.05


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ImageReader]:
    folder = tmp_path_factory.mktemp("images")
    (folder / "bench.toml").write_text(BENCH.format(delay_ms=8.0, white=2.6e6))
    truth = BENCH.format(delay_ms=TRUE_DELAY_MS, white=TRUE_WHITE_E_PER_S)
    (folder / "truth.toml").write_text(truth)
    bench = read_bench_file(folder / "bench.toml")
    true = read_bench_file(folder / "truth.toml")
    images = folder / "seen"
    images.mkdir()
    with closing(VirtualBench(bench, true, 0)) as source:
        yield ImageReader(bench, source, images, true)


def test_codes_have_the_light_of_the_true_screen_in_the_order_in_which_they_were_asked(
    reader: ImageReader,
) -> None:
    """sRGB's curve from 0 to white; what readings share shifts black with them, and so no black."""
    read = reader.light(CODES)
    assert read.code.tolist() == CODES.tolist()
    assert (np.diff(read.t_s) > 0).all()
    signal = CODES / 255
    share = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    black = CODES == 0
    above = read.light - read.light[black].mean()
    lit = ~black
    assert above[lit] == pytest.approx(TRUE_WHITE_E_PER_S * share[lit], rel=LIGHT_WITHIN)
    assert read.noise is not None
    assert (read.noise[lit] < LIGHT_WITHIN * read.light[lit]).all()
    assert read.common is not None
    assert not read.common[black].any()
    left, top, side = read.square_px
    assert 0 <= left < left + side <= WIDTH
    assert 0 <= top < top + side <= HEIGHT
    assert read.beside is not None
    assert read.beside.ratio == pytest.approx(1.0, abs=6 * read.beside.error)


def test_dots_are_seen_where_the_geometry_has_them_with_light_alike(reader: ImageReader) -> None:
    geometry = geometry_of(reader.file)
    x_px, y_px = dot_places(geometry)
    read = reader.dots(x_px, y_px, 2)
    assert len(read.x_px) > 0.9 * len(x_px)
    expected_x_px, expected_y_px = geometry.to_tracker(read.x_px, read.y_px)
    off_px = np.stack([read.seen_x_px - expected_x_px, read.seen_y_px - expected_y_px])
    assert np.abs(np.median(off_px, axis=1)).max() < PLACE_WITHIN_PX / 5
    assert off_px.std(axis=1).max() < PLACE_WITHIN_PX
    assert read.light.std() < 0.02 * read.light.mean()
    assert 0.3 < read.psf_px < 1.0
    assert 0 < read.psf_u_px < 0.1
    # the lattice is as wide as what the tracker sees, and no dot stands beyond it
    width, height = geometry.tracker.resolution_px
    at_x_px, at_y_px = geometry.to_tracker(x_px.astype(float), y_px.astype(float))
    assert 0 < at_x_px.min() < 30 < width - 30 < at_x_px.max() < width - 1
    assert 0 < at_y_px.min() < 30 < height - 30 < at_y_px.max() < height - 1


def test_dots_that_the_image_s_edge_cuts_are_left_out(reader: ImageReader) -> None:
    geometry = geometry_of(reader.file)
    x_px, y_px = dot_places(geometry)
    beside = geometry.to_monitor(np.full(4, 0.3), np.linspace(40.0, 160.0, 4))
    edge_x_px, edge_y_px = (np.rint(place).astype(np.intp) for place in beside)
    assert not np.isin(edge_x_px, x_px).any()
    read = reader.dots(np.append(x_px, edge_x_px), np.append(y_px, edge_y_px), 1)
    assert len(read.x_px) > 0.9 * len(x_px)
    assert not np.isin(edge_x_px, read.x_px).any()


def test_a_photodiode_sees_the_true_delay(reader: ImageReader) -> None:
    delays_ms = reader.delays_ms()
    assert len(delays_ms) > 20
    assert delays_ms.mean() == pytest.approx(TRUE_DELAY_MS, abs=0.1)


def test_too_few_dots_and_those_that_stand_elsewhere_are_refused(
    reader: ImageReader, monkeypatch: pytest.MonkeyPatch
) -> None:
    x_px, y_px = dot_places(geometry_of(reader.file))
    with pytest.raises(InputError, match=r"^20 dots are in the image and 60 are needed"):
        reader.dots(x_px[:20], y_px[:20], 1)
    # none is within a millionth of a pixel
    monkeypatch.setattr(readings, "APART_TRACKER_PX", 2e-6)
    with pytest.raises(InputError, match=r"^0 dots are where the bench file has them"):
        reader.dots(x_px, y_px, 1)
