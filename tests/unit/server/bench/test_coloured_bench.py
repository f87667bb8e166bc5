"""A small screen whose primaries are driven apart: each star's light and place in the sum of its
sub-pixels, and which clip.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilstar.basics.arrays import FloatArray
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.optics.extended import LightMap
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.primary_panels import primary_panels
from tests.support.benches import Tables, bench_text
from tests.support.spectra import NM, PANELS, bump, channel_keys, write_channels, write_panel

# V, B-V, right ascension and declination; the fourth is beside the screen
STARS = (
    (2.0, 1.7, 84.25, 10.1),
    (2.2, -0.2, 83.8, 9.9),
    (3.5, 0.6, 83.95, 10.15),
    (1.0, 0.6, 95.0, 10.0),
)
THIRD = 1 / 3
SPLINE_PX = 1e-3  # a third of a pixel by cubic splines, of a spot of 2 px sigma
PLACES_PX = ((-THIRD, 0.0), (0.0, 0.0), (THIRD, 0.0))
Q = from_radec_roll_deg(84.0, 10.0, 17.0)


@pytest.fixture
def coloured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Bench]:
    """A bench of red, green and blue stripes before three channels of 12 bits, but for changes."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    rows = [f"{ra},{dec},{v_mag},{bv_mag}" for v_mag, bv_mag, ra, dec in STARS]
    (tmp_path / "stars.csv").write_text("\n".join(["ra,dec,v,bv", *rows]) + "\n")
    write_panel(tmp_path / "panel.csv", PANELS["oled"])
    bands = {"r": bump(620, 50), "g": bump(540, 55), "b": bump(460, 45)}
    write_channels(tmp_path, NM, bands)
    tables = {
        "tracker": channel_keys("rgb"),
        "monitor": {"resolution_px": [96, 64], "pixel_pitch_um": 50.0, "bits": 12},
        "monitor.primaries": {"file": "panel.csv", "layout": "rgb-stripe"},
        "collimator": {"focal_length_mm": 300.0},
        "sky": {"catalogue": "stars.csv", "catalogue_epoch_jyear": 2026.0, "epoch_jyear": 2026.0},
        "render": {"colour": "star", "quantisation": "exact", "brightest_v_mag": 0.0},
    }

    def made(*changes: Tables) -> Bench:
        return open_bench(bench_file_of(tmp_path / "bench.toml", bench_text(tables, *changes)))

    return made


def light_of(bench: Bench, codes: FloatArray) -> FloatArray:
    """What a tracker detects of each sub-pixel (height, width, 3), e-/s, by sRGB's formula."""
    signal = codes / (2.0**bench.config.monitor.bits - 1)
    shown = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    return shown * bench.colours.of_white * bench.flux_at_white_e_per_s


def assert_panels_are_of_their_calibration(bench: Bench) -> None:
    """The panels of primaries have white together, by the formula that is named."""
    own, named = (
        primary_panels(bench.file, bench.colours, 5.0, None, name) for name in (None, "gamma2.2")
    )
    for panels in (own, named):
        whites = [panel.flux_at_white_e_per_s for panel in panels]
        assert sum(whites) == pytest.approx(5.0)
        assert len(set(whites)) == 3
    half = 2**11
    # of 4095: by each formula
    for panels, share in (
        (own, ((half / 4095 + 0.055) / 1.055) ** 2.4),
        (named, (half / 4095) ** 2.2),
    ):
        for panel in panels:
            assert panel.response.light[half] == pytest.approx(share, rel=1e-3)


def test_each_star_has_its_light_and_its_place_in_the_sum_of_its_stripes(coloured) -> None:
    with coloured() as bench:
        frame = bench.frame(Q)
        light = light_of(bench, frame.codes)
        y, x = np.indices(light.shape[:2])
        assert len(frame.truth) == 3
        red = []
        for row in frame.truth:
            part = light * (np.hypot(x - row["x_px"], y - row["y_px"]) < 10)[..., None]
            total = part.sum()
            assert total == pytest.approx(row["electrons_per_s"], rel=4e-3)
            at_x = sum((part[..., k] * (x + PLACES_PX[k][0])).sum() for k in range(3)) / total
            at_y = (part.sum(axis=2) * y).sum() / total
            assert (at_x, at_y) == pytest.approx((row["x_px"], row["y_px"]), abs=0.01)
            red.append((part[..., 0].sum() / total, row["v_mag"]))
        # of the B-V of 1.7, 0.6 and -0.2
        assert [round(float(v_mag), 2) for _, v_mag in sorted(red)] == [2.2, 3.5, 2.0]
        assert_panels_are_of_their_calibration(bench)
        assert not frame.truth["clipped"].any()


def test_a_star_clips_where_one_of_its_primaries_is_over_white(coloured) -> None:
    """Though its light as a whole is under it."""
    with coloured() as bench:
        shares = bench.colours.shares_of(bench.stars, np.arange(len(bench.stars)))
        drive = (shares / bench.colours.of_white).max(axis=1)
        peaks = bench.stars.electrons_per_s * bench.psf.peak_share
        names = bench.stars.v_mag.round(1).tolist()
    wanted = dict(zip(names, peaks * drive, strict=True))
    assert drive[names.index(2.0)] > 1.3 and drive.min() > 0.999
    bright = sorted([wanted[2.0], wanted[2.2]])
    for white, clipped in ((1.02 * bright[1], set()), (0.85 * bright[0], {2.0, 2.2})):
        keys = {"brightest_v_mag": None, "flux_at_white_e_per_s": float(white)}
        with coloured({"render": keys}) as bench:
            frame = bench.frame(Q)
            light = light_of(bench, frame.codes)
        rows = frame.truth
        assert set(rows["v_mag"][rows["clipped"]].round(1).tolist()) == clipped
        y, x = np.indices(light.shape[:2])
        for row in rows:
            near = (np.hypot(x - row["x_px"], y - row["y_px"]) < 10)[..., None]
            lacks = 1 - (light * near).sum() / row["electrons_per_s"]
            assert row["clipped"] == (lacks > 0.004)


def test_a_red_star_is_drawn_where_its_red_alone_lights_a_pixel(coloured) -> None:
    """A white star of as much light would be too faint."""
    with coloured() as bench:
        red = bench.stars.v_mag.round(1).tolist().index(2.0)
        shares = bench.colours.shares_of(bench.stars, np.array([red]))
        (drive,) = (shares / bench.colours.of_white).max(axis=1)
        of_white = bench.faintest_shown_e_per_s / bench.flux_at_white_e_per_s
        red_e_per_s = float(bench.stars.electrons_per_s[red])
    for factor, shown in ((1 + 0.5 * (drive - 1), True), (1.05 * drive, False)):
        keys = {"brightest_v_mag": None, "flux_at_white_e_per_s": factor * red_e_per_s / of_white}
        with coloured({"render": keys}) as bench:
            assert (2.0 in bench.shown_stars.v_mag.round(1)) is shown
            assert (2.0 in bench.faint_stars.v_mag.round(1)) is not shown


def test_each_frame_s_wide_light_is_its_own_and_the_same_objects_are_moved_once(coloured) -> None:
    """A spot of light in one frame, elsewhere in the next: each primary's stands where its stripe
    is not.
    """
    y, x = np.mgrid[:21, :21]
    spot = np.exp(-((x - 10) ** 2 + (y - 10) ** 2) / 8).astype(np.float32)
    with coloured() as bench:
        stars = bench.light(bench.view(Q))
        assert stars is not None
        for corner_px in ((5, 6), (50, 30), (5, 6)):
            frame = replace(stars, extended=(LightMap(spot, corner_px),))
            driven = bench.colours.driven(frame, bench.shown_stars)
            for (part,), (stripe_x, stripe_y) in zip(driven.lights, PLACES_PX, strict=True):
                rows, columns = np.indices(part.image.shape)
                light = part.image.sum()
                at_x = (part.image * (columns + part.corner_px[0])).sum() / light
                at_y = (part.image * (rows + part.corner_px[1])).sum() / light
                wanted = (corner_px[0] + 10 - stripe_x, corner_px[1] + 10 - stripe_y)
                assert (at_x, at_y) == pytest.approx(wanted, abs=SPLINE_PX)
            again = bench.colours.driven(frame, bench.shown_stars)
            assert again.lights is driven.lights
