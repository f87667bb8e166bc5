"""Frames as files."""

from __future__ import annotations

import numpy as np
import png
import pytest
from astropy.io import fits
from PIL import Image
from scipy.ndimage import gaussian_filter, maximum_filter

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.frame_files import (
    PREVIEW_BLUR_PX,
    PREVIEW_POWER,
    PREVIEW_RADIUS_PX,
    png_of,
    write_frame_fits,
    write_preview_png,
)
from tests.support.benches import bench_text


def preview_by_filters(codes):
    """For each radius, a maximum over a disc of all pixels bright enough for it: nine filters of
    the whole frame.
    """
    signal = codes.astype(np.float32) / np.float32(codes.max())
    picture = np.zeros_like(signal)
    reach = np.arange(-PREVIEW_RADIUS_PX, PREVIEW_RADIUS_PX + 1)
    for radius in range(1, PREVIEW_RADIUS_PX + 1):
        bright = np.where(signal >= ((radius - 1) / PREVIEW_RADIUS_PX) ** 2, signal, 0)
        disc = np.hypot(*np.meshgrid(reach, reach)) <= radius
        picture = np.maximum(picture, maximum_filter(bright, footprint=disc))
    return (255 * np.clip(gaussian_filter(picture**PREVIEW_POWER, PREVIEW_BLUR_PX), 0, 1)).astype(
        np.uint8
    )


@pytest.mark.parametrize("lit", [0.002, 0.3])
def test_a_preview_has_a_disc_for_each_lit_pixel_to_the_edges(tmp_path, lit):
    rng = np.random.default_rng(4)
    codes = np.where(rng.random((90, 120)) < lit, rng.integers(1, 256, (90, 120)), 0).astype(
        np.uint8
    )
    codes[0, 0] = codes[89, 60] = 255
    write_preview_png(tmp_path / "preview.png", codes)
    assert np.array_equal(
        np.asarray(Image.open(tmp_path / "preview.png")), preview_by_filters(codes)
    )


def test_a_frame_s_header_says_where_it_looks_and_what_it_is_of(tmp_path):
    text = bench_text({"sky": {"faintest_v_mag": 3.0, "epoch_jyear": 2027.5}})
    file = bench_file_of(tmp_path / "bench.toml", text)
    with open_bench(file) as bench:
        frame = bench.frame(from_radec_roll_deg(283.021, 35.349, 30.0))
        write_frame_fits(tmp_path / "frame.fits", bench, frame)
    header = fits.getheader(tmp_path / "frame.fits")
    assert [header[name] for name in ("RA_PNT", "DEC_PNT", "ROLL_PNT")] == pytest.approx(
        [283.021, 35.349, 30.0], abs=1e-9
    )
    # the convention's check value, of seven digits
    assert [header[name] for name in ("QW", "QX", "QY", "QZ")] == pytest.approx(
        [0.3257559, -0.0677680, -0.4540152, 0.8265354], abs=6e-8
    )
    assert header["NSTARS"] == len(frame.truth) > 0
    assert header["WHITE"] == bench.flux_at_white_e_per_s
    assert (header["EPOCHJYR"], header["BENCHSHA"]) == (2027.5, file.sha256)
    assert (header["CALNAME"], header["CALSHA"]) == (
        bench.calibration.name,
        bench.calibration.sha256,
    )
    assert header["CALSHA"] != file.sha256


@pytest.mark.parametrize("radius_px", [8, 20, 45])
def test_a_body_has_its_own_size_in_a_preview(tmp_path, radius_px):
    """Each pixel of the Moon was a disc of its own, by which it grew by 9 px on all sides."""
    rows, columns = np.mgrid[:120, :160]
    body = np.hypot(rows - 60, columns - 80) <= radius_px
    codes = np.where(body, 255, 0).astype(np.uint8)
    codes[5, 5] = 200
    write_preview_png(tmp_path / "preview.png", codes)
    picture = np.asarray(Image.open(tmp_path / "preview.png"))
    lit = picture[:, 30:] > 127
    radius_seen_px = np.sqrt(lit.sum() / np.pi)
    assert abs(radius_seen_px - radius_px) < 1
    assert (picture[:30, :30] > 127).sum() > 100  # a star has its disc


def test_a_preview_of_a_dark_frame_is_dark(tmp_path):
    write_preview_png(tmp_path / "preview.png", np.zeros((20, 30), np.uint8))
    assert not np.asarray(Image.open(tmp_path / "preview.png")).any()


@pytest.mark.parametrize("shape", [(3, 5), (4, 7, 3)])
@pytest.mark.parametrize(("kind", "meant"), [(np.uint8, None), (np.uint16, 12)])
def test_a_png_has_the_values_that_another_reader_finds(rng, shape, kind, meant):
    """pypng, which reads colours of 16 bits too; the image is a view whose rows are not in
    memory's order.
    """
    image = rng.integers(0, np.iinfo(kind).max, shape[1::-1] + shape[2:], kind).swapaxes(0, 1)
    width, height, rows, told = png.Reader(bytes=png_of(image, meant)).read()
    assert np.array_equal(np.vstack([*rows]).reshape(shape), image)
    assert (width, height, told["bitdepth"]) == (*shape[1::-1], 8 * np.dtype(kind).itemsize)
