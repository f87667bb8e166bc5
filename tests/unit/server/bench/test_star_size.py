"""The star of a bench against that of the sky: the limit, what would bring it within that, and
who says so.
"""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scipy.stats import norm

from hilstar.basics.arrays import FloatArray
from hilstar.server.bench.bench_file import bench_file_of, read_bench_file
from hilstar.server.bench.cameras import bench_camera, fields_of_view
from hilstar.server.bench.star_size import FINEST, PANELS, star_size
from tests.support.benches import ROOT, TWIN, bench_text
from tests.support.commands import run_hilstar_here

SHIPPED = sorted([*(ROOT / "configs").glob("*.toml"), *(ROOT / "examples").glob("*bench.toml")])
# A 27-inch office monitor behind 500 mm before a tracker of 50 mm: a monitor pixel is 4.2 of the
# tracker's.
WIDE = {
    "tracker": {"focal_length_mm": 50, "pixel_pitch_um": 5.5, "resolution_px": [2048, 2048]},
    "monitor": {"resolution_px": [2560, 1440], "pixel_pitch_um": 233.1},
    "collimator": {"focal_length_mm": 500},
}
EXACT = 1e-9  # of lengths that are one quotient each
SMOOTH_PX, SMOOTH_MAG = 0.02, 0.03  # where the coarser squares take over


def size(folder, *changes):
    file = bench_file_of(folder / "bench.toml", bench_text(*changes))
    return star_size(file.config, folder, bench_camera(file.config, folder))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_the_star_of_every_bench_that_ships_is_within_the_limit(path):
    file = read_bench_file(path)
    found = star_size(file.config, file.folder, bench_camera(file.config, file.folder))
    assert found.fault() is None
    assert 1.2 < found.sigma_ratio < 1.7  # as the key's text has it


def test_a_bench_with_the_collimator_or_the_panel_that_would_do_is_at_the_limit(tmp_path):
    wide = size(tmp_path, WIDE)
    assert wide.too_wide and wide.would_do is not None
    longer = size(tmp_path, WIDE, {"collimator": {"focal_length_mm": wide.would_do.collimator_mm}})
    assert longer.sigma_ratio == pytest.approx(wide.limit, rel=EXACT)
    panel = {
        "pixel_pitch_um": wide.would_do.pixel_pitch_um,
        "resolution_px": list(wide.would_do.resolution_px),
    }
    finer = bench_file_of(tmp_path / "bench.toml", bench_text(WIDE, {"monitor": panel}))
    assert star_size(
        finer.config, tmp_path, bench_camera(finer.config, tmp_path)
    ).sigma_ratio == pytest.approx(2.0, rel=EXACT)
    # Its pixels hold the whole of the tracker's field.
    assert fields_of_view(finer.config, tmp_path).field_on_screen == 1.0


def test_what_a_longer_collimator_leaves_of_the_field_on_the_screen_is_counted(tmp_path):
    would_do = size(tmp_path, WIDE).would_do
    height_mm, field_mm = 1440 * 0.2331, 2048 * 0.0055 / 50 * would_do.collimator_mm
    assert not would_do.field_fits
    assert would_do.field_on_screen == pytest.approx(height_mm / field_mm, rel=EXACT)
    small = size(tmp_path, WIDE, {"tracker": {"resolution_px": [512, 512]}}).would_do
    assert small.field_fits and small.text().startswith(
        "a collimator of 1857 mm would do, or a panel of "
    )


def test_a_limit_under_the_lens_itself_is_met_by_nothing(tmp_path):
    blurred = {"collimator": {"psf_sigma_px": 3.0}, "verify": {"star_sigma_ratio": 1.0}}
    found = size(tmp_path, WIDE, blurred).would_do
    assert found.collimator_mm is None
    assert "no collimator and no panel would do" in found.text()


def test_each_panel_is_at_the_limit_with_the_shorter_collimator_and_shows_the_field_with_the_longer(
    tmp_path,
):
    wide = size(tmp_path, WIDE).would_do
    assert len(wide.panels) == len(PANELS)
    pitches_um = {one.panel: one.pixel_pitch_um for one in wide.panels}
    assert pitches_um["27-inch 2560 x 1440"] == pytest.approx(233.5, abs=0.1)
    assert pitches_um["15.6-inch 4K"] == pytest.approx(89.9, abs=0.1)  # as makers state them
    lengths = {one.panel: one for one in wide.panels if one.collimator_mm is not None}
    assert "27-inch 5K" in lengths and "27-inch 2560 x 1440" not in lengths
    for one in lengths.values():
        its = {
            "monitor": {
                "resolution_px": list(one.resolution_px),
                "pixel_pitch_um": one.pixel_pitch_um,
            }
        }
        shorter, longer = one.collimator_mm
        at_limit = size(tmp_path, WIDE, its, {"collimator": {"focal_length_mm": shorter}})
        assert at_limit.sigma_ratio == pytest.approx(2.0, rel=EXACT)
        fits = bench_file_of(
            tmp_path / "b.toml", bench_text(WIDE, its, {"collimator": {"focal_length_mm": longer}})
        )
        assert fields_of_view(fits.config, tmp_path).field_on_screen == 1.0
        assert star_size(
            fits.config, tmp_path, bench_camera(fits.config, tmp_path)
        ).sigma_ratio == pytest.approx(one.sigma_ratio, rel=EXACT)


def test_a_display_that_draws_the_trackers_psf_is_wider_by_its_own_pixels_alone(tmp_path):
    found = size(tmp_path, {"render": {"psf": "tracker"}})
    ratio = (57.65 / 60) / (13 / 70)
    assert found.sigma_px == pytest.approx(math.sqrt(0.55**2 + ratio**2 / 6), rel=1e-4)


def test_a_monitor_pixel_of_many_tracker_pixels_is_summed_up_in_coarser_squares(tmp_path):
    # the collimator, mm, at which a monitor pixel is one of the tracker's
    at = 60 * (57.65 / 60) / (13 / 70)
    below, above = (
        size(
            tmp_path,
            {
                "collimator": {"focal_length_mm": at / FINEST * step},
                "tracker": {"resolution_px": [64, 64]},
            },
        )
        for step in (1.001, 0.999)
    )
    assert above.peak_loss_mag == pytest.approx(below.peak_loss_mag, abs=SMOOTH_MAG)
    assert above.shared_px == pytest.approx(below.shared_px, rel=SMOOTH_PX)


def test_each_command_states_the_star_and_warns_once(tmp_path):
    # as wide, and quicker
    few = {"tracker": {"resolution_px": [512, 512]}, "monitor": {"resolution_px": [640, 480]}}
    (tmp_path / "bench.toml").write_text(bench_text(TWIN, WIDE, few))
    line = (
        "star 4.0 px sigma, of the sky 0.55; brightest pixel 3.9 mag fainter; 199.2 px share it, of"
        " the sky 4.5"
    )
    drawn = ("frame", "bench.toml", "--radec", "84.057,-1.2,0", "-o", "o.fits")
    for words in (drawn, ("doctor", "bench.toml"), ("budget", "bench.toml")):
        told = run_hilstar_here(*words, cwd=tmp_path)
        assert line in told.stdout
        assert (told.stdout + told.stderr).count("a star is 6.5 times as wide as the sky's") == 1
        assert (told.stdout + told.stderr).count("a panel of 62.75 um") == 1
        assert "check the units" not in told.stderr
    for words in (drawn, ("doctor", "bench.toml")):
        found = json.loads(run_hilstar_here(*words, "--json", cwd=tmp_path).stdout)
        found = found["benches"]["bench.toml"] if words[0] == "doctor" else found
        assert found["star"]["sigma_ratio"] == pytest.approx(6.51, abs=0.01)
        assert found["star"]["would_do"]["collimator_mm"] == pytest.approx(1857, abs=1)
    served = run_hilstar_here(
        "serve", "bench.toml", "--headless", "--duration", "0.1", "--json", cwd=tmp_path
    )
    assert line in served.stderr
    assert served.stderr.count("a star is 6.5 times") == 1
    assert json.loads(served.stdout)["star"]["limit"] == 2.0


def test_verify_does_not_pass_a_bench_whose_star_is_too_wide(tmp_path):
    wide = {"collimator": {"focal_length_mm": 40}}
    (tmp_path / "bench.toml").write_text(bench_text(TWIN, wide))
    failed = run_hilstar_here(
        "verify", "bench.toml", "--fields", 1, "--strict", "--json", cwd=tmp_path
    )
    assert failed.returncode == 1
    found = json.loads(failed.stdout)
    assert any("[verify] star_sigma_ratio = 2" in reason for reason in found["reasons"])
    assert found["star"]["sigma_ratio"] > 2.0
    (tmp_path / "bench.toml").write_text(
        bench_text(TWIN, wide, {"verify": {"star_sigma_ratio": 5.0}})
    )
    allowed = run_hilstar_here("verify", "bench.toml", "--fields", 1, "--json", cwd=tmp_path)
    assert not any("star_sigma_ratio" in reason for reason in json.loads(allowed.stdout)["reasons"])


def light_by_pixel(sprite_px: float, lens_px: float, ratio: float) -> FloatArray:
    """The light of a star's row of tracker pixels, along one axis: a Gaussian summed up in monitor
    pixels, each an even bar of `ratio` tracker pixels, through a Gaussian lens.
    """
    monitor = np.arange(-12, 13)
    weights = norm.cdf(monitor + 0.5, 0, sprite_px) - norm.cdf(monitor - 0.5, 0, sprite_px)
    half = round(13 * ratio + 8 * lens_px) + 2
    pixels = np.arange(-half, half + 1)

    def until(edge_px: FloatArray) -> FloatArray:
        """The integral of a normal distribution's integral."""
        return edge_px * norm.cdf(edge_px, 0, lens_px) + lens_px**2 * norm.pdf(edge_px, 0, lens_px)

    off_px = pixels[:, None] - ratio * monitor
    bar = until(off_px + 0.5 + ratio / 2) - until(off_px - 0.5 + ratio / 2)
    bar -= until(off_px + 0.5 - ratio / 2) - until(off_px - 0.5 - ratio / 2)
    return bar @ weights / ratio


# the light of monitor pixels under 1e-4 of the brightest is left out, and squares are summed up
# at points: both together move no figure by more
SUMMED = 0.01


@pytest.mark.parametrize("ratio", [0.7, 2.6, 7.3, 1.6 * FINEST])
def test_an_oval_star_is_as_bright_and_as_large_as_its_integral_says(tmp_path, ratio):
    sprite_px, lens_px = (0.9, 0.55), (0.8, 0.45)
    # of the bench that has one tracker pixel to a monitor pixel
    at_mm = 60 * (57.65 / 60) / (13 / 70) / ratio
    found = size(
        tmp_path,
        {"render": {"sprite_sigma_px": list(sprite_px)}, "collimator": {"focal_length_mm": at_mm}},
        {"tracker": {"psf_sigma_px": list(lens_px), "resolution_px": [64, 64]}},
    )
    x, y = (light_by_pixel(*sigmas, ratio) for sigmas in zip(sprite_px, lens_px, strict=True))
    assert x.sum() == pytest.approx(1.0) and y.sum() == pytest.approx(1.0)
    assert found.shared_px == pytest.approx(1 / ((x**2).sum() * (y**2).sum()), rel=SUMMED)
    sky = [norm.cdf(np.arange(-5.5, 6.5), 0, sigma_px) for sigma_px in lens_px]
    sky_x, sky_y = (np.diff(edges) for edges in sky)
    loss_mag = -2.5 * math.log10(x.max() * y.max() / (sky_x.max() * sky_y.max()))
    assert found.peak_loss_mag == pytest.approx(loss_mag, abs=1.0857 * SUMMED)
    assert found.sky_shared_px == pytest.approx(1 / ((sky_x**2).sum() * (sky_y**2).sum()), rel=1e-3)
