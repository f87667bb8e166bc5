"""Which patches are measured, in which order, and their pictures."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from PIL import Image

from hilstar.instruments.calibrate.plan import (
    PlanSettings,
    plan_patches,
    planned_codes,
    write_patches,
    write_plan,
)


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
