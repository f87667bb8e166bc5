"""Angles between heads, solved from what their trackers would see."""

from __future__ import annotations

import pytest

from hilstar.instruments.simulate.heads import verify_heads
from hilstar.server.bench.bench_file import read_heads
from tests.support.claims import holds
from tests.support.heads import heads_file

# The README's bench at half the pixels of a side: fewer stars, so half as near.
BENCH = {
    "tracker": {"resolution_px": [512, 512], "transmission": None},
    "monitor": {"resolution_px": [640, 480]},
    "collimator": {"focal_length_mm": 175},
    "render": {"quantisation": "exact"},
}


@pytest.mark.gpu
def test_heads_agree_on_the_body_from_linear_light_and_nearly_from_codes(tmp_path, rng):
    pairs = verify_heads(read_heads(heads_file(tmp_path, 5599, BENCH)), 2, rng)
    assert [(pair.first, pair.second) for pair in pairs] == [("a", "b"), ("a", "c"), ("b", "c")]
    for pair in pairs:
        told = pair.summary()
        assert told["fields"] == 2
        linear, codes = (told[name]["max"] for name in ("linear_arcsec", "codes_arcsec"))
        holds("heads-linear", linear)
        holds("heads-codes", codes)
        assert linear < codes
