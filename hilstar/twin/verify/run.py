"""The twin over random fields, from a bench file to a verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.faults.scenario import Scenario
from hilstar.monitor.quantise import MASK_TURNS
from hilstar.twin.verify.faulty_fields import FaultyFields
from hilstar.twin.verify.measure import Comparison
from hilstar.twin.verify.twin import Twin
from hilstar.twin.verify.verdict import Verdict, judge


def verify(
    file: BenchFile,
    fields: int,
    rng: np.random.Generator,
    on_field: Callable[[int], None] = lambda done: None,
    scenario: Scenario | None = None,
) -> Verdict:
    """Show `fields` random attitudes and judge the bench by them; then each fault of a scenario, which is only measured.

    Raises InputError (see `Twin`, `FaultView.prepare`).
    """
    # Separate streams: the noise draws a number of values that depends on the light, and all benches shall see the same fields.
    attitudes, noise, of_faults = rng.spawn(3)
    with Twin(file) as twin:
        comparison = Comparison(twin)
        faulty = None if scenario is None else FaultyFields(twin, scenario, of_faults)
        for number in range(fields):
            q = attitudes.normal(size=4)
            first_frame = int(attitudes.integers(0, MASK_TURNS))
            comparison.add(twin.field(q / np.linalg.norm(q), first_frame), noise)
            on_field(number + 1)
        verdict = judge(comparison.measured())
        return verdict if faulty is None else replace(verdict, faults=faulty.seen())
