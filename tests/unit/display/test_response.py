"""Light and codes."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.display.render.encoder import code_table
from hilstar.display.response import (
    bit_stealing_response,
    code_dtype,
    encode,
    gamma_response,
    mixed_response,
    srgb_light,
    srgb_response,
    table_response,
)


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
    signal = (
        np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        * response.white
    )
    clear = np.abs(signal - np.floor(signal) - 0.5) > 1e-3  # not at a tie, which float32 may turn
    codes = encode(light.astype(np.float32), response, 1.0)
    assert np.array_equal(codes[clear], np.rint(signal)[clear])


def test_what_is_over_white_is_white_and_darkness_is_black():
    response = srgb_response(8)
    assert encode(
        np.array([0, 1e-9, 1, 1.0001, 1e12, np.inf], np.float32), response, 1.0
    ).tolist() == [
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
    edges = np.concatenate(
        [thresholds, np.nextafter(thresholds, 0), np.nextafter(thresholds, np.inf)]
    )
    light = np.concatenate([edges, np.float32(white) * rng.uniform(0, 1.1, 5000) ** 4, [0]]).astype(
        np.float32
    )
    place = np.clip(
        (light.view(np.int32) >> table.bin_shift) - table.first_bin, 0, len(table.first_code) - 1
    )
    codes = table.first_code[place].astype(int)
    for _ in range(len(thresholds)):
        more = codes < len(thresholds)
        more[more] = light[more] >= thresholds[codes[more]]
        if not more.any():
            break
        codes[more] += 1
    assert np.array_equal(codes, np.searchsorted(thresholds, light, side="right"))


@pytest.mark.parametrize("bits", [1, 2, 8, 10, 12])
@pytest.mark.parametrize("white", [1e-3, 1.0, 4.1e7, 1e12])
def test_one_word_a_bin_says_the_level(bits, white, rng):
    """What encode.frag does with `steps`, in NumPy, against a plain search: at each threshold
    and next to it.
    """
    thresholds = srgb_response(bits).thresholds_e_per_s(white)
    table = code_table(thresholds)
    steps = table.steps()
    edges = np.concatenate(
        [thresholds, np.nextafter(thresholds, 0), np.nextafter(thresholds, np.inf)]
    )
    light = np.concatenate(
        [edges, np.float32(white) * rng.uniform(0, 1.1, 5000) ** 4, [0, 1e-38, 3e38]]
    ).astype(np.float32)
    lowest, shift = (table.first_bin - 1) << table.bin_shift, table.bin_shift
    found = np.clip(
        light.view(np.int32).astype(np.int64), lowest, lowest + (len(steps) << shift) - 1
    )
    word = steps[(found - lowest) >> shift].astype(np.int64)
    level = (word >> (shift + 1)) + ((found & ((1 << shift) - 1)) >= (word & ((2 << shift) - 1)))
    assert np.array_equal(level, np.searchsorted(thresholds, light, side="right"))


def test_thresholds_too_close_for_a_bin_each_have_no_such_words():
    assert code_table(np.array([1.0, 1.0000001, 2.0], dtype=np.float32)).steps() is None


def test_gamma_is_a_power_law_with_thresholds_at_half_codes():
    response = gamma_response(8)
    assert response.light[128] == pytest.approx((128 / 255) ** 2.2)
    assert response.threshold[127] == pytest.approx((127.5 / 255) ** 2.2)
    assert (response.light[0], response.light[-1], response.white, response.black) == (0, 1, 255, 0)


def test_a_table_is_rounded_to_the_nearest_light(rng):
    light = np.sort(rng.uniform(0, 1, 256)) ** 3
    light = (light - light[0]) / (light[-1] - light[0])
    wanted = rng.uniform(0, 1, 5000)
    codes = encode(wanted.astype(np.float32), table_response(8, light), 1.0)
    nearest = np.abs(wanted[:, None] - light).min(axis=1)
    # a float32 tie may go either way
    assert np.all(np.abs(wanted - light[codes]) <= nearest + 1e-7)


def test_bit_stealing_has_six_levels_between_greys():
    grey = srgb_response(8)
    response = bit_stealing_response((grey, grey, grey), (0.2126, 0.7152, 0.0722))
    assert len(response.light) == 255 * 7 + 1
    assert np.all(np.diff(response.light) > 0)
    assert np.all(np.ptp(response.rgb.astype(int), axis=1) <= 1)
    assert np.array_equal(response.rgb[::7], np.repeat(np.arange(256)[:, None], 3, axis=1))
    mixed = grey.light[response.rgb] @ [0.2126, 0.7152, 0.0722]
    assert response.light == pytest.approx(mixed)
    codes = encode((response.light * 1e6).astype(np.float32), response, 1e6)
    assert codes.dtype == np.uint16
    assert np.array_equal(codes, np.arange(1786))


@pytest.mark.parametrize(
    ("weights", "levels"), [((1, 1, 1), 255 * 3 + 1), ((1, 0, 0), 256), ((2, 2, 1), 255 * 5 + 1)]
)
def test_triples_of_the_same_light_are_one_level_and_greys_stay(weights, levels):
    grey = gamma_response(8)
    response = bit_stealing_response((grey, grey, grey), weights)
    assert len(response.light) == levels
    assert np.all(np.diff(response.light) > 0)
    greys = {tuple(triple) for triple in response.rgb.tolist() if len(set(triple)) == 1}
    assert len(greys) == 256


def test_bit_stealing_beyond_uint16_is_refused():
    grey = srgb_response(14)
    with pytest.raises(InputError, match="13 bits"):
        bit_stealing_response((grey, grey, grey), (1, 1, 1))


def test_channels_are_mixed_as_the_tracker_weighs_them():
    channels = (gamma_response(8, 2.0), gamma_response(8, 2.2), gamma_response(8, 2.4))
    mixed = mixed_response(channels, (1, 2, 1), black=0.001)
    signal = 100 / 255
    assert mixed.light[100] == pytest.approx((signal**2.0 + 2 * signal**2.2 + signal**2.4) / 4)
    assert (mixed.light[0], mixed.light[-1], mixed.black) == (0, pytest.approx(1), 0.001)


@pytest.mark.parametrize("response", [srgb_response(8), gamma_response(10)])
def test_light_at_a_threshold_is_the_level_above_it(response):
    """And the next smaller number of float32 that below; codes are as deep as their monitor."""
    thresholds = response.thresholds_e_per_s(1e5)
    levels = np.arange(1, response.white + 1)
    assert np.array_equal(encode(thresholds, response, 1e5), levels)
    below = np.nextafter(thresholds, np.float32(0))
    assert np.array_equal(encode(below, response, 1e5), levels - 1)
    assert (code_dtype(8), code_dtype(9)) == (np.uint8, np.uint16)
