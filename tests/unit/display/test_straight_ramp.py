"""Which gamma ramps pass as straight: half a code of the table's own depth."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.display.window.watch import is_straight, ramp_bits, straight_ramp


def entries(curve: np.ndarray, bits: int) -> np.ndarray:
    """A curve (steps,) from 0 to 1 as a driver of so many bits gives it back: 16 bits, its own
    repeated to fill them.
    """
    full = 2**bits - 1
    codes = np.rint(curve * full)
    return np.rint(codes / full * 65535).astype(np.uint16)


def three(column: np.ndarray) -> bytes:
    return np.tile(column, (3, 1)).tobytes()


@pytest.mark.parametrize("steps", [256, 1024, 4096])
@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_the_identity_is_straight_at_each_depth_and_size(steps, bits):
    assert is_straight(three(entries(np.linspace(0, 1, steps), bits)))


@pytest.mark.parametrize("steps", [2, 256, 1024, 4096])
def test_the_ramp_that_is_set_ends_at_full_light_and_rises_evenly(steps):
    ramp = np.array(straight_ramp(steps))
    assert (ramp[0], ramp[-1]) == (0.0, 1.0)
    assert ramp * (steps - 1) == pytest.approx(np.arange(steps), abs=1e-9)
    assert is_straight(np.tile(ramp, (3, 1)))
    if steps > 2:
        assert not is_straight(np.tile(ramp * (1 - 1 / steps), (3, 1)))  # white a step too dark


@pytest.mark.parametrize("steps", [256, 1024, 4096])
@pytest.mark.parametrize("gamma", [1.005, 0.995, 1.05])
def test_a_gamma_that_a_fine_table_holds_is_not_straight(steps, gamma):
    curve = np.linspace(0, 1, steps) ** gamma
    assert not is_straight(three(entries(curve, 16)))
    assert not is_straight(np.tile(curve, (3, 1)))


def test_a_coarse_table_that_rounds_a_small_gamma_away_is_straight():
    """0.005 / e is under half a code of 8 bits: each entry is that of the identity."""
    assert is_straight(three(entries(np.linspace(0, 1, 256) ** 1.005, 8)))
    assert not is_straight(three(entries(np.linspace(0, 1, 256) ** 1.02, 8)))
    assert not is_straight(b"")


def test_the_depth_is_the_coarsest_that_holds_each_entry():
    for bits in (8, 10, 12):
        assert ramp_bits(entries(np.linspace(0, 1, 4096), bits)[None] / 65535) == bits


@pytest.mark.parametrize("off", [-300, -3, 3, 300])
def test_one_entry_above_or_below_a_coarse_grid_makes_it_a_finer_one(off):
    """Of 8 bits, whose codes are 257 of 65 535 apart; rounding to 16 bits takes at most 1."""
    column = entries(np.linspace(0, 1, 1024), 8).astype(float)
    column[500] += off
    assert ramp_bits(column[None] / 65535) > 8
