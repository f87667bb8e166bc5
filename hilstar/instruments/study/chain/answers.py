"""What to set for a bench and a scene, and what to expect: the answers that a chain's rows give.

An answer is the simplest choice whose error is near the smallest one's. Choices that are right
over an exposure only (`temporal`), and those that cost more than another and leave more
(`dither`), are no answers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

from hilstar.basics.charts import two_digits
from hilstar.display.quantise import Quantisation
from hilstar.instruments.study.chain.choices import Prediction
from hilstar.instruments.study.chain.measuring import RSS, WHOLE, CombinationRow, ErrorPart
from hilstar.instruments.study.sweep import Load

BY_ARCSEC, BY_MAG = attrgetter("error_arcsec"), attrgetter("error_mag")
BY_DEPTH = attrgetter("faintest_v_mag")
# The codes that are an answer, the cheaper first (results/quantisation_time.csv).
ANSWERS: tuple[Quantisation, ...] = ("round", "exact")
# A simpler choice is taken where its error is at most this many times the smallest, and its light
# within a tenth of the limit of `verify`, 0.05 mag, where the smallest is not larger.
NEAR, NEAR_MAG = 1.1, 0.005
PREDICTED: tuple[Prediction, ...] = ("rate", "two samples", "held")
WAYS: dict[str, str] = {
    "rate": "by the packets' rates",
    "two samples": "by two samples",
    "held": "the newest attitude held",
}
# What to do about the step that most of a turning scene's error comes from.
ADVICE: dict[str, str] = {
    "refresh": (
        "no key of [render] mends it: a faster or a flashing panel does (refresh_hz, hold_ms)"
    ),
    "smear": 'draw paths ([render] motion = "on")',
    "depth": "write a larger [sky] faintest_v_mag",
    "codes": "more bits, or bit stealing",
    "sprites": "write a smaller [render] tolerance_px",
}
# What to ask of the sender, by the prediction that leaves least.
PREDICTION_ADVICE: dict[str, str] = {
    "rate": "send rates",
    "two samples": "send no rates, which carry such a vibration on",
    "held": "[attitude] max_extrapolation_ms = 0",
}
STEP_WORDS = {
    "refresh": "the panel's refresh",
    "codes": "quantisation",
    "sprites": "cutting sprites",
}


@dataclass(frozen=True, slots=True)
class Given:
    """Whether a bench knows its primaries in the tracker's colours, and whether its sender gives
    rates.
    """

    primaries: bool
    rates: bool


@dataclass(frozen=True, slots=True)
class Answer:
    """The choice for a scene, and the largest part of the error of `effort = "auto"` there."""

    row: CombinationRow
    largest: ErrorPart

    @property
    def setting(self) -> str:
        """The keys of [render] that make the choice."""
        if self.row.bit_stealing == "true":
            stealing = ", bit_stealing = true"
        else:
            stealing = ""
        return f'quantisation = "{self.row.quantisation}"{stealing}'

    @property
    def expected(self) -> str:
        """The error of a star's place and light, rms."""
        return f"{two_digits(self.row.error_arcsec)} arcsec, {two_digits(self.row.error_mag)} mag"


def answers_among(rows: Sequence[CombinationRow]) -> list[CombinationRow]:
    """The rows of a scene that may be an answer: the whole catalogue, sprites within tolerance,
    paths.
    """
    deepest = max(rows, key=BY_DEPTH).faintest_v_mag
    whole = [row for row in rows if row.faintest_v_mag == deepest and row.quantisation in ANSWERS]
    return [row for row in whole if row.sprite == "cut" and row.smear == "path"]


def is_allowed(row: CombinationRow, given: Given) -> bool:
    """Whether a choice is possible with what bench and sender give. Given rates are used."""
    if row.bit_stealing == "true" and not given.primaries:
        return False
    by_rate = row.prediction == "rate"
    return not row.rate_deg_s or by_rate == given.rates


def allowed(rows: Sequence[CombinationRow], given: Given) -> list[CombinationRow]:
    """The answers of a scene for what is given."""
    return [row for row in answers_among(rows) if is_allowed(row, given)]


def simplicity(row: CombinationRow) -> tuple[bool, int, float]:
    """The order of choices: no bit stealing before bit stealing, then the cheaper codes."""
    return row.bit_stealing == "true", ANSWERS.index(row.quantisation), row.error_arcsec


def simplest(rows: Sequence[CombinationRow]) -> CombinationRow:
    """The simplest row whose errors of place and light are near the smallest ones."""
    limit_arcsec = NEAR * min(rows, key=BY_ARCSEC).error_arcsec
    near = [row for row in rows if row.error_arcsec <= limit_arcsec]
    limit_mag = max(NEAR_MAG, NEAR * min(near, key=BY_MAG).error_mag)
    return min((row for row in near if row.error_mag <= limit_mag), key=simplicity)


def parts_of(budget: Sequence[ErrorPart], scene: str) -> dict[str, ErrorPart]:
    """The steps of a scene's error by name, RSS and WHOLE among them."""
    return {part.step: part for part in budget if part.scene == scene}


def largest_part(budget: Sequence[ErrorPart], scene: str) -> ErrorPart:
    """The step that contributes most to a scene's error."""
    steps = parts_of(budget, scene)
    del steps[RSS], steps[WHOLE]
    return max(steps.values(), key=BY_ARCSEC)


def answer(rows: Sequence[CombinationRow], budget: Sequence[ErrorPart], given: Given) -> Answer:
    """The answer for one scene's rows."""
    row = simplest(allowed(rows, given))
    return Answer(row, largest_part(budget, row.scene))


def scenes_of(rows: Sequence[CombinationRow]) -> list[list[CombinationRow]]:
    """The rows of each scene: the first at rest, then those that turn, the slowest first."""
    scenes: dict[str, list[CombinationRow]] = {}
    for row in rows:
        scenes.setdefault(row.scene, []).append(row)
    rising = sorted(scenes.values(), key=lambda scene: scene[0].rate_deg_s)
    turning = [scene for scene in rising if scene[0].rate_deg_s]
    still = rising[: len(rising) - len(turning)]
    return still[:1] + turning


def answer_lines(
    rows: Sequence[CombinationRow],
    budget: Sequence[ErrorPart],
    load: Load,
) -> list[str]:
    """What a person can do, a line each: codes, bit stealing, turns, depth."""
    scenes = scenes_of(rows)
    lines: list[str] = []
    if not scenes[0][0].rate_deg_s:
        lines += rest_lines(scenes[0], load)
    lines += turn_lines(scenes, budget)
    return [*lines, depth_line(scenes[0])]


def rest_lines(rows: Sequence[CombinationRow], load: Load) -> list[str]:
    """Which codes to take at rest, and what bit stealing adds."""
    choices = allowed(rows, Given(primaries=False, rates=True))
    plain = simplest(choices)
    line = f'at rest on {plain.bits} bits: set quantisation = "{plain.quantisation}",'
    line += f" {two_digits(plain.error_arcsec)} arcsec"
    for other in choices:
        if other is not plain:
            line += f" ({other.quantisation}: {change_words(other, plain, load)})"
    return [line, stealing_line(rows, plain, load)]


def stealing_line(rows: Sequence[CombinationRow], plain: CombinationRow, load: Load) -> str:
    """What bit stealing adds to the choice without it."""
    choices = allowed(rows, Given(primaries=True, rates=True))
    stealing = [row for row in choices if row.bit_stealing == "true"]
    if not stealing:
        return "bit stealing: not on this panel, whose primaries the tracker's colours do not know"
    best = min(stealing, key=BY_ARCSEC)
    change = f"{two_digits(plain.error_arcsec)} arcsec to {change_words(best, plain, load)}"
    if best.error_arcsec * NEAR >= plain.error_arcsec:
        return f"bit stealing: brings nothing at rest ({change})"
    known = "if the primaries are known in the tracker's colours"
    return f"bit stealing, {known}: takes {change}, with {best.quantisation}"


def change_words(row: CombinationRow, to: CombinationRow, load: Load) -> str:
    """A row's error, and its time as a share of another's; no time on a busy machine."""
    arcsec = two_digits(row.error_arcsec)
    if load.busy:
        return arcsec
    return f"{arcsec} in {row.time_ms / to.time_ms:.2f} of the time"


def turn_lines(
    scenes: Sequence[Sequence[CombinationRow]],
    budget: Sequence[ErrorPart],
) -> list[str]:
    """A line for each turn at which another step becomes the largest part, and what to do."""
    lines = []
    last = ""
    for rows in scenes:
        scene = rows[0]
        part = largest_part(budget, scene.scene)
        if not scene.rate_deg_s or part.step == last:
            continue
        last = part.step
        whole = parts_of(budget, scene.scene)[WHOLE]
        share = f"{two_digits(part.error_arcsec)} of {two_digits(whole.error_arcsec)} arcsec"
        step = STEP_WORDS.get(part.step, part.step)
        advice = ADVICE.get(part.step) or prediction_words(rows)
        turn = f"from {scene.rate_deg_s:g} deg/s on"
        lines.append(f"{turn} {step} is the largest part ({share}): {advice}")
    return lines


def prediction_words(rows: Sequence[CombinationRow]) -> str:
    """What to ask of the sender, and the error of each prediction with the best codes."""
    deepest = max(rows, key=BY_DEPTH).faintest_v_mag
    errors: dict[str, float] = {}
    for row in rows:
        plain = row.bit_stealing == "false" and row.quantisation in ANSWERS
        if plain and row.faintest_v_mag == deepest:
            before = errors.get(row.prediction, row.error_arcsec)
            errors[row.prediction] = min(before, row.error_arcsec)
    best = min(errors, key=lambda prediction: errors[prediction])
    ways = [f"{WAYS[way]} {two_digits(errors[way])}" for way in PREDICTED if way in errors]
    return f"{PREDICTION_ADVICE[best]} ({', '.join(ways)} arcsec)"


def depth_line(rows: Sequence[CombinationRow]) -> str:
    """What a shallower catalogue costs at rest, or in the slowest turn."""
    deepest = max(rows, key=BY_DEPTH).faintest_v_mag
    shallow = [row for row in rows if row.faintest_v_mag < deepest]
    if not shallow:
        return f"depth: faintest_v_mag = {deepest:g} was measured alone"
    best = min(shallow, key=BY_ARCSEC)
    if best.lost:
        loses = f"with {best.faintest_v_mag:g} the tracker loses {best.lost} of {best.stars} stars"
        return f"depth: keep faintest_v_mag = {deepest:g}; {loses}"
    enough = f"faintest_v_mag = {best.faintest_v_mag:g} is enough"
    return f"depth: {enough}; it loses none of {best.stars} stars"
