"""Light and codes."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.monitor.photometry import encode, srgb_light, srgb_response
from hilstar.render.encoder import code_table


def test_srgb_light_has_the_standard_s_values():
    # IEC 61966-2-1: code 128 of 255 is 0.21586 of white; the two branches meet at 0.04045.
    assert srgb_light(np.array([0.0, 128 / 255, 1.0])) == pytest.approx([0, 0.2158605, 1], abs=5e-8)
    low, high = srgb_light(np.array([0.04045, np.nextafter(0.04045, 1)]))
    assert high - low < 1e-7  # the standard's own rounding of its constants


@pytest.mark.parametrize("bits", [1, 6, 8, 10, 12, 16])
def test_a_code_s_own_light_is_encoded_as_that_code(bits):
    response = srgb_response(bits)
    codes = encode((response.light * 1e6).astype(np.float32), response, 1e6)
    assert np.array_equal(codes, np.arange(2**bits))
    assert codes.dtype == (np.uint8 if bits <= 8 else np.uint16)


@pytest.mark.parametrize("bits", [8, 10])
def test_the_nearest_code_is_chosen(bits, rng):
    response = srgb_response(bits)
    light = rng.uniform(0, 1, 20_000)
    signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055) * response.white
    clear = np.abs(signal - np.floor(signal) - 0.5) > 1e-3  # not at a tie, which float32 may turn
    codes = encode(light.astype(np.float32), response, 1.0)
    assert np.array_equal(codes[clear], np.rint(signal)[clear])


def test_what_is_over_white_is_white_and_darkness_is_black():
    response = srgb_response(8)
    assert encode(np.array([0, 1e-9, 1, 1.0001, 1e12, np.inf], np.float32), response, 1.0).tolist() == [
        0,
        0,
        255,
        255,
        255,
        255,
    ]


@pytest.mark.parametrize("bits", [1, 2, 8, 12, 16])
@pytest.mark.parametrize("white", [1e-3, 1.0, 4.1e7, 1e12])
def test_the_renderer_s_table_counts_thresholds(bits, white, rng):
    """What encode.frag does with the table, in NumPy, against a plain search."""
    thresholds = srgb_response(bits).thresholds_e_per_s(white)
    table = code_table(thresholds)
    edges = np.concatenate([thresholds, np.nextafter(thresholds, 0), np.nextafter(thresholds, np.inf)])
    light = np.concatenate([edges, np.float32(white) * rng.uniform(0, 1.1, 5000) ** 4, [0]]).astype(np.float32)
    place = np.clip((light.view(np.int32) >> table.bin_shift) - table.first_bin, 0, len(table.first_code) - 1)
    codes = table.first_code[place].astype(int)
    for _ in range(len(thresholds)):
        more = codes < len(thresholds)
        more[more] = light[more] >= thresholds[codes[more]]
        if not more.any():
            break
        codes[more] += 1
    assert np.array_equal(codes, np.searchsorted(thresholds, light, side="right"))
