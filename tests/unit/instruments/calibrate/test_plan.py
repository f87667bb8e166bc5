"""Which patches are measured, in which order, and their pictures."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from PIL import Image

from hilstar.instruments.calibrate.plan import (
    FAINT_LIGHT,
    MIN_PLANNED_LIGHT,
    Patch,
    PlanSettings,
    is_filled_in,
    patch_image,
    plan_patches,
    planned_codes,
    write_patches,
    write_plan,
)
from tests.support.refusals import refusal


def read_png(path):
    with Image.open(path) as image:
        return np.asarray(image)


def test_a_plan_is_random_reproducible_and_can_be_filled_in(tmp_path):
    plans = [plan_patches(PlanSettings(8), np.random.default_rng(seed)) for seed in (1, 1, 2)]
    for k, planned in enumerate(plans):
        write_plan(tmp_path / f"{k}.csv", planned)
    texts = [(tmp_path / f"{k}.csv").read_text() for k in range(3)]
    assert texts[0] == texts[1] != texts[2]
    rows = list(csv.DictReader(texts[0].splitlines()))
    assert len(rows) == len(plans[0])
    codes = [int(row["code"]) for row in rows]
    assert [int(row["order"]) for row in rows] == [*range(1, len(rows) + 1)]
    assert [row["value"] for row in rows] == [""] * len(rows)
    assert codes.count(0) >= 20
    # black comes back within every eight patches and three
    assert max(np.diff(np.flatnonzero(np.array(codes) == 0))) <= 11


@pytest.mark.parametrize(
    ("bits", "levels"), [(1, 2), (2, 4), (8, 32), (8, 256), (10, 32), (16, 64)]
)
def test_planned_codes_are_distinct_from_black_to_white(bits, levels):
    codes = planned_codes(bits, levels)
    assert len(codes) == levels
    assert (codes[0], codes[-1]) == (0, 2**bits - 1)
    assert np.all(np.diff(codes) > 0)


@pytest.mark.parametrize(("bits", "code", "stored"), [(8, 255, 255), (10, 1023, 1023 << 6)])
def test_patches_are_written_as_the_codes_of_frames_are(bits, code, stored, tmp_path):
    write_patches(
        tmp_path / "patches",
        plan_patches(PlanSettings(bits, 8), np.random.default_rng(1)),
        (60, 40),
        bits,
    )
    image = read_png(tmp_path / "patches" / f"w-{code:05d}.png")
    assert image.shape == (40, 60)
    assert image[20, 30] == stored
    assert image[0, 0] == 0
    # half is a reference, and may be a level
    assert len(list((tmp_path / "patches").iterdir())) in (8, 9)


def test_a_patch_of_one_primary_lights_that_primary(tmp_path):
    planned = plan_patches(PlanSettings(8, 8, channels="rg"), np.random.default_rng(1))
    write_patches(tmp_path / "patches", planned, (60, 40), 8)
    assert read_png(tmp_path / "patches" / "g-00255.png")[20, 30].tolist() == [0, 255, 0]


HEAD = "order,code,channel,value"


@pytest.mark.parametrize(
    ("lines", "is_filled"),
    [
        ([], False),
        (["1,0,w,", "2,9,w,"], False),
        (["1,0,w,3.5", "2,9,w,"], True),
        (["1,0,w,", "2,9,w,0"], True),
        (["1,0,w,", " ", ""], False),
    ],
)
def test_a_plan_is_filled_in_by_the_first_value_wherever_it_stands(tmp_path, lines, is_filled):
    path = tmp_path / "plan.csv"
    assert not is_filled_in(path)
    path.write_text("\n".join([HEAD, *lines]) + "\n")
    assert is_filled_in(path) == is_filled
    # what cannot be read may hold measurements
    path.write_bytes(b"\xff\xfe\x00")
    assert is_filled_in(path)


def test_codes_are_even_in_the_log_light_of_srgb_by_colour_science():
    """Light of codes by IEC 61966-2-1, as a monitor decodes it: steps of a 62nd of 3.2 decades."""
    codes = np.array(planned_codes(16, 64))[1:]
    signal = codes / 65535
    light = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    assert light[0] == pytest.approx(MIN_PLANNED_LIGHT, rel=1e-3)
    # a code of 16 bits is 0.2 % of the faintest light
    np.testing.assert_allclose(np.diff(np.log10(light)), 3.2 / 62, atol=2e-3)


def test_faint_levels_are_planned_twice_as_often_between_references(rng):
    patches = plan_patches(PlanSettings(8, 12, repeats=2, channels="gb"), rng)
    codes = planned_codes(8, 12)
    references = [Patch(code, name) for name in "gb" for code in (0, 127, 255)]
    assert patches[:6] == patches[-6:] == references
    rounds = -(-len(patches) // 22)
    for name in "gb":
        for code in codes:
            count = patches.count(Patch(code, name))
            is_faint = (code / 255) ** 2.2 < FAINT_LIGHT
            is_reference = Patch(code, name) in references
            assert count == 2 * (1 + is_faint) + is_reference * (
                rounds + 1 - (len(patches) % 22 == 6)
            )


@pytest.mark.parametrize(("size_px", "side"), [((90, 60), 20), ((60, 90), 20), ((2, 2), 1)])
def test_a_patch_is_a_third_of_the_smaller_side_in_the_middle(size_px, side):
    image = patch_image(Patch(7, "w"), size_px, 8)
    assert image.shape == size_px[::-1]
    rows, columns = np.nonzero(image)
    assert len(rows) == side**2
    for places, size in ((columns, size_px[0]), (rows, size_px[1])):
        assert (places.min(), places.max()) == ((size - side) // 2, (size - side) // 2 + side - 1)


def test_colours_of_more_than_8_bits_are_no_pictures(tmp_path, rng):
    planned = plan_patches(PlanSettings(10, 8, channels="wr"), rng)
    words = refusal(write_patches, tmp_path / "patches", planned, (60, 40), 10)
    assert "for up to 8 bits" in words
