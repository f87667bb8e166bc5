"""The budget: every input with its distribution, propagated to every figure by GUM and by its
Supplement 1.

An input is a number of standardised variables that share one estimate of their spread. To first
order (JCGM 100, 5.2) its contribution to a figure is the root of the squares of the figure's slopes
by them, correlations included; degrees of freedom by Welch-Satterthwaite (G.4.1), coverage 95 % by
Student's t. By Supplement 1 (JCGM 101, 7.9) trials of the whole model are drawn in batches until
two digits of every figure stand, or the largest number of trials is reached.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from hilstar.basics.arrays import FloatArray

Distribution = Literal["normal", "Student t", "rectangular", "triangular"]
COVERAGE = 0.95
STEP = 1e-3  # in a standardised variable, for slopes
BATCH = 5000
# relative to the expanded uncertainty: both ways are shown where an end of the interval differs by
# more
DIFFER = 0.05
SMALLEST = 1e-12
SMALLEST_SQUARE = 1e-300  # of all contributions together, so that none have no share
# a Student's t of few degrees of freedom shows from one per cent of the variance on
FEW_DOF, FEW_SHARE = 10.0, 0.01
MAX_DOF = 1e6


@dataclass(frozen=True, slots=True)
class Input:
    """An input of the budget: `size` standardised variables (mean 0, standard deviation 1) of one
    distribution.

    `standard` and `unit` state its standard uncertainty for a reader, and `source` where it is
    from.
    """

    name: str
    distribution: Distribution
    source: str
    size: int
    standard: float
    unit: str
    dof: float = math.inf

    def draw(self, trials: int, rng: np.random.Generator) -> FloatArray:
        """Trials (trials, size)."""
        shape = trials, self.size
        if self.distribution == "rectangular":
            half = math.sqrt(3)
            return np.asarray(rng.uniform(-half, half, shape))
        if self.distribution == "triangular":
            half = math.sqrt(6)
            return np.asarray(rng.triangular(-half, 0.0, half, shape))
        normal = rng.standard_normal(shape)
        if math.isfinite(self.dof):
            # Variables of one input share the estimate of their spread.
            normal /= np.sqrt(rng.chisquare(self.dof, trials) / self.dof)[:, None]
        return np.asarray(normal)


# variables of each input (b, size) to figures (b, figures)
Model = Callable[[list[FloatArray]], FloatArray]


@dataclass(frozen=True, slots=True)
class Combined:
    """Figures by first order: value, standard uncertainty, freedom, interval (figures,);
    contributions (figures, inputs).
    """

    value: FloatArray
    standard: FloatArray
    dof: FloatArray
    lower: FloatArray
    upper: FloatArray
    contribution: FloatArray


@dataclass(frozen=True, slots=True)
class BudgetTrials:
    """Figures by trials: mean, standard deviation and the shortest-tailed interval (figures,),
    and whether two digits stand.
    """

    mean: FloatArray
    standard: FloatArray
    lower: FloatArray
    upper: FloatArray
    trials: int
    settled: bool


def first_order(model: Model, inputs: list[Input]) -> Combined:
    """Combine the inputs by the slopes of the model."""
    value = model([np.zeros((1, budget_input.size)) for budget_input in inputs])[0]
    contribution = np.zeros((len(value), len(inputs)))
    for number in range(len(inputs)):
        contribution[:, number] = np.linalg.norm(_slopes(model, inputs, number), axis=0)
    standard = np.sqrt((contribution**2).sum(axis=1))
    inverse_dof = np.array([1 / budget_input.dof for budget_input in inputs])
    with np.errstate(divide="ignore", invalid="ignore"):
        dof = standard**4 / (contribution**4 @ inverse_dof)
    dof = np.minimum(np.nan_to_num(dof, nan=MAX_DOF, posinf=MAX_DOF), MAX_DOF)
    k = stdtrit(dof, (1 + COVERAGE) / 2)
    return Combined(value, standard, dof, value - k * standard, value + k * standard, contribution)


def _slopes(model: Model, inputs: list[Input], number: int) -> FloatArray:
    """The slopes (size, figures) of the model by the variables of one input."""
    size = inputs[number].size
    steps = STEP * np.concatenate([np.eye(size), -np.eye(size)])
    moved = [np.zeros((len(steps), budget_input.size)) for budget_input in inputs]
    moved[number] = steps
    high, low = np.split(model(moved), 2)
    return np.asarray((high - low) / (2 * STEP))


def by_trials(
    model: Model, inputs: list[Input], rng: np.random.Generator, max_trials: int
) -> BudgetTrials:
    """Draw trials until two digits of every standard uncertainty and interval stand, or
    `max_trials` are drawn.
    """
    tails = (1 - COVERAGE) / 2, (1 + COVERAGE) / 2
    batches: list[FloatArray] = []
    settled = False
    while len(batches) * BATCH < max_trials and not settled:
        figures = model([budget_input.draw(BATCH, rng) for budget_input in inputs])
        low, high = np.quantile(figures, tails, axis=0)
        batches.append(np.stack([figures.mean(axis=0), figures.std(axis=0, ddof=1), low, high]))
        settled = len(batches) > 1 and _settled(np.stack(batches))
    mean, standard, low, high = np.stack(batches).mean(axis=0)
    return BudgetTrials(mean, standard, low, high, len(batches) * BATCH, settled)


def _settled(batches: FloatArray) -> bool:
    """Whether two digits of each figure's standard deviation and of both ends stand, by the batches
    (n, 4, figures): mean, standard deviation, lower and upper end.
    """
    error = 2 * batches.std(axis=0, ddof=1) / math.sqrt(len(batches))
    standard = batches[:, 1].mean(axis=0)
    tolerance = 0.5 * 10.0 ** (np.floor(np.log10(np.maximum(standard, SMALLEST))) - 1)
    return bool((error[1:] <= tolerance)[:, standard > SMALLEST].all())


def why_they_differ(
    combined: Combined, drawn: BudgetTrials, inputs: list[Input], number: int
) -> str:
    """Why the intervals of a figure by both ways differ; "" where they agree within DIFFER of
    their half width.
    """
    half = (combined.upper[number] - combined.lower[number]) / 2
    below = drawn.lower[number] - combined.lower[number]
    above = drawn.upper[number] - combined.upper[number]
    if half <= SMALLEST or max(abs(below), abs(above)) <= DIFFER * half:
        return ""
    squares = combined.contribution[number] ** 2
    share = squares / max(float(squares.sum()), SMALLEST_SQUARE)
    largest = inputs[int(np.argmax(share))]
    middle = (drawn.upper[number] + drawn.lower[number]) / 2
    if abs(middle - combined.value[number]) > DIFFER * half:
        return (
            "the model is not linear over the inputs' range: its interval is not even about the"
            " value"
        )
    if largest.distribution in ("rectangular", "triangular") and share.max() > 0.5:
        return (
            f"the largest input ({largest.name}) is {largest.distribution}, whose tails are short"
        )
    few = []
    for budget_input, part in zip(inputs, share, strict=True):
        if budget_input.dof < FEW_DOF and part > FEW_SHARE:
            few.append(budget_input.name)
    if few:
        return f"few readings ({', '.join(few)}): Welch-Satterthwaite's freedom is an approximation"
    return "the model is not linear over the inputs' range"
