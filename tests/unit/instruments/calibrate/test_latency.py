"""A photodiode's edges with the frames that caused them."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.instruments.calibrate.latency import Edges, pair
from hilstar.server.screen.screen import marker_light

PERIOD_NS = 1e9 / 60


@pytest.mark.parametrize("latency_ms", [3.0, 21.0, 68.5, 250.0])
def test_any_latency_is_found_again_through_jitter_lost_edges_and_noise(latency_ms, rng):
    level = np.array([marker_light(k, "code") for k in range(600)])
    swap_ns = 5_000_000_000 + np.round(np.arange(600) * PERIOD_NS).astype(np.int64)
    changed = np.flatnonzero(np.diff(level)) + 1
    shown_edges = Edges(swap_ns[changed], level[changed])
    jitter_ns = np.round(rng.normal(0, 2e5, len(changed))).astype(np.int64)
    seen_ns = shown_edges.host_ns + round(latency_ms * 1e6) + jitter_ns
    kept = np.sort(rng.choice(len(changed), len(changed) * 4 // 5, replace=False))
    noise_ns = rng.integers(swap_ns[0], swap_ns[-1], 20)
    seen = Edges(
        np.concatenate([seen_ns[kept], noise_ns]),
        np.concatenate([level[changed][kept], rng.integers(0, 2, 20)]),
    )
    paired = pair(seen, shown_edges, PERIOD_NS)
    assert not paired.ambiguous
    assert np.median(paired.latency_ns) == pytest.approx(latency_ms * 1e6, abs=1e5)
    assert paired.unmatched < 20


def test_edges_of_another_run_are_refused(rng):
    swap_ns = np.round(np.arange(400) * PERIOD_NS).astype(np.int64)
    shown_edges = Edges(swap_ns, np.arange(400) % 2)
    seen = Edges(np.sort(rng.integers(0, swap_ns[-1], 200)), rng.integers(0, 2, 200))
    with pytest.raises(InputError, match="edges fit"):
        pair(seen, shown_edges, PERIOD_NS / 4)
