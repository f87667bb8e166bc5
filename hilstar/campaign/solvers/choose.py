"""From the words after --solver to a solver."""

from __future__ import annotations

from pathlib import Path

from hilstar.campaign.plan.tables import Centroiding
from hilstar.campaign.solvers.answer import Solver
from hilstar.campaign.solvers.centroids import CentroidSolver
from hilstar.campaign.solvers.command import CommandSolver
from hilstar.campaign.solvers.function import FunctionSolver

CENTROIDS = "centroids"


def choose_solver(text: str, settings: Centroiding, folder: Path, timeout_s: float) -> Solver:
    """The solver that `text` names; relative names start in `folder`. Raises InputError for one that there is not."""
    if text == CENTROIDS:
        return CentroidSolver(settings)
    if text.startswith("python:"):
        return FunctionSolver(text, folder, timeout_s)
    return CommandSolver(text, folder, timeout_s)
