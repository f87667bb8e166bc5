"""The twin over random fields, from a bench file to a verdict."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hilstar.bench.bench_file import BenchFile
from hilstar.monitor.quantise import MAX_CYCLE_FRAMES
from hilstar.twin.verify.measure import Comparison
from hilstar.twin.verify.twin import Twin
from hilstar.twin.verify.verdict import Verdict, judge


def verify(
    file: BenchFile, fields: int, rng: np.random.Generator, on_field: Callable[[int], None] = lambda done: None
) -> Verdict:
    """Show `fields` random attitudes and judge the bench by them. Raises InputError (see `Twin`)."""
    # Separate streams: the noise draws a number of values that depends on the light, and all benches shall see the same fields.
    attitudes, noise = rng.spawn(2)
    with Twin(file) as twin:
        comparison = Comparison(twin)
        for number in range(fields):
            q = attitudes.normal(size=4)
            first_frame = int(attitudes.integers(0, MAX_CYCLE_FRAMES))
            comparison.add(twin.field(q / np.linalg.norm(q), first_frame), noise)
            on_field(number + 1)
        return judge(comparison.measured())
