"""What is written beside a campaign's table once it is whole: budget, costs and charts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hilstar.bench.config import BenchConfig
from hilstar.campaign.results.budget import case_budget, write_budget
from hilstar.campaign.results.columns import read_cases
from hilstar.campaign.results.sensitivity import costs, draw_costs, finding, write_costs


def write_results(table: Path, config: BenchConfig, seed: int) -> dict[str, Any]:
    """Write `budget.csv`, `sensitivity.csv` and a chart for each measure that varies; the budget, and what was found.

    Raises InputError where the table cannot be read, or a file not be written.
    """
    cases = read_cases(table)
    budget = case_budget(cases, config, np.random.default_rng(seed))
    write_budget(table.with_name("budget.csv"), budget)
    found = costs(cases)
    write_costs(table.with_name("sensitivity.csv"), found)
    findings = []
    for measure in dict.fromkeys(cost.measure for cost in found):
        of_it = [cost for cost in found if cost.measure == measure]
        if max(float(cost.level.max()) for cost in of_it) > 0:
            draw_costs(table.with_name(f"sensitivity_{measure}.png"), of_it)
            findings.append(finding(of_it))
    del budget["intervals"]
    return budget | {"findings": findings}
