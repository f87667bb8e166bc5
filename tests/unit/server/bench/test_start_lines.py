"""What a run says of its bench when it starts: the stars that clip, by hand from three stars' light,
and how the stars are drawn and weighed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from hilstar.basics.errors import InputError
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.frame import (
    Bench,
    checked_quaternion,
    clipping_hip,
    clipping_line,
    colour_line,
    drawn_line,
    named,
    shares_line,
)
from tests.support.benches import bench_text

STARS = "hip,ra,dec,v,bv\n11,84.0,10.0,2.0,0.6\n7,85.5,10.9,0.5,0.6\n29,83.1,8.9,3.0,0.6\n"
SKY = {"catalogue": "stars.csv", "catalogue_epoch_jyear": 2026.0, "epoch_jyear": 2026.0}


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "stars.csv").write_text(STARS)
    keys = {"sky": SKY, "render": {"brightest_v_mag": 2.5}}
    with open_bench(bench_file_of(tmp_path / "bench.toml", bench_text(keys))) as opened:
        yield opened


@pytest.mark.parametrize(
    ("found", "count", "words"),
    [
        ([], 3, "none"),
        ([32349], 1, "HIP 32349"),
        (["Moon", 32349, 27989, 5, 6, 7], 3, "Moon, HIP 32349, 27989 and 3 more"),
        ([3, "Jupiter", 2], 3, "Jupiter, HIP 3, 2"),
        (["Moon", "Venus"], 3, "Moon, Venus"),
        (["Moon", "Venus", 9], 2, "Moon, Venus and 1 more"),
        ([4, 5, 6], 2, "HIP 4, 5 and 1 more"),
    ],
)
def test_what_is_found_is_named_bodies_first(found, count, words):
    assert named(found, count) == words


def test_the_stars_that_clip_are_those_over_white_at_their_peak_the_brightest_first(bench):
    """White is that of `brightest_v_mag`: of V 0.5, 2 and 3 the first two are over it at 2.5."""
    assert clipping_hip(bench) == [7, 11]
    assert clipping_line(bench) == (
        "2 stars of the sky are brighter than white and clip in view: HIP 7, 11 ([render]"
        " brightest_v_mag = 2.5)"
    )


def test_a_star_clips_where_its_peak_is_over_the_white_of_the_darkest_pixel(bench):
    """The peaks of V 0.5, 2 and 3 are as 4, 1 and 0.4, nearly."""
    peak_e_per_s = np.sort(bench.stars.electrons_per_s)[1] * bench.psf.peak_share
    for darkest, white, clipped in (
        (0.5, 2.002, [7]),  # the star of V 2 is a thousandth fainter
        (0.5, 1.998, [7, 11]),
        (0.25, 15.5, [7]),
        (0.25, 16.5, []),
    ):
        other = replace(bench, flux_at_white_e_per_s=white * peak_e_per_s, darkest=darkest)
        assert clipping_hip(other) == clipped, white


def test_one_star_that_clips_is_said_by_the_key_that_sets_white(bench):
    config = structs.replace(
        bench.config, render=structs.replace(bench.config.render, brightest_v_mag=None)
    )
    peak_e_per_s = np.max(bench.stars.electrons_per_s) * bench.psf.peak_share
    other = replace(bench, config=config, flux_at_white_e_per_s=0.99 * peak_e_per_s, darkest=1.0)
    assert clipping_line(other) == (
        "1 star of the sky is brighter than white and clip in view: HIP 7 ([render]"
        " flux_at_white_e_per_s)"
    )
    assert clipping_line(replace(other, flux_at_white_e_per_s=peak_e_per_s)) is None


@pytest.mark.parametrize("steals", [True, False])
@pytest.mark.parametrize(("name", "is_formula"), [("gamma2.2", True), ("measured", False)])
@pytest.mark.parametrize("weights", [None, (0.25, 0.7, 0.05)])
def test_a_formula_s_shares_are_said_where_bits_are_stolen_by_them(
    bench, steals, name, is_formula, weights
):
    render = structs.replace(bench.config.render, bit_stealing=steals)
    calibration = replace(bench.calibration, name=name, weights=weights)
    other = replace(
        bench, config=structs.replace(bench.config, render=render), calibration=calibration
    )
    line = shares_line(other)
    if not (steals and is_formula and weights):
        assert line is None
    else:
        assert line.startswith('[render] bit_stealing with calibration = "gamma2.2" assumes')
        assert "sees white as 0.25, 0.7, 0.05 of red, green and blue" in line
    assert drawn_line(other) is None and colour_line(other) is None


@pytest.mark.parametrize("q", [(1.0, 0, 0), (1.002, 0, 0, 0), (0.998, 0, 0, 0), (np.nan, 0, 0, 1)])
def test_a_quaternion_off_unit_by_over_a_thousandth_is_refused(q):
    with pytest.raises(InputError, match="write"):
        checked_quaternion(q)


def test_a_quaternion_nearly_unit_is_made_so():
    assert checked_quaternion((0.0, 0.6003, 0.0, -0.8004)) == pytest.approx((0, 0.6, 0, -0.8))
