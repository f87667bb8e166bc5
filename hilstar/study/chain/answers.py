"""What to set for a bench and a scene, and what to expect of it: the answers that a chain's rows give.

An answer is the simplest choice whose error is near the smallest one's. Choices that are right over an exposure only
(`temporal`), and those that cost more than another and leave more (`dither`), are no answers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from hilstar.charts import two_digits
from hilstar.monitor.quantisers import Quantisation
from hilstar.study.chain.choices import Prediction
from hilstar.study.chain.measuring import RSS, WHOLE, CombinationRow, ErrorPart
from hilstar.study.sweep import Load

# The codes that are an answer, the cheaper first (results/quantisation_time.csv).
ANSWERS: tuple[Quantisation, ...] = ("round", "exact")
# A simpler choice is taken where its error is at most this many times the smallest, and its light within a tenth of the limit
# of `verify`, 0.05 mag, where the smallest is not larger.
NEAR, NEAR_MAG = 1.1, 0.005
PREDICTED: tuple[Prediction, ...] = ("rate", "two samples", "held")
WAYS: dict[str, str] = {"rate": "by the packets' rates", "two samples": "by two samples", "held": "the newest attitude held"}
# What to do about the step that most of a turning scene's error comes from.
ADVICE: dict[str, str] = {
    "refresh": "no key of [render] mends it: a faster panel, or one that flashes ([monitor] refresh_hz, hold_ms), does",
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
STEP_WORDS = {"refresh": "the panel's refresh", "codes": "quantisation", "sprites": "cutting sprites"}


@dataclass(frozen=True, slots=True)
class Given:
    """What a bench and its sender give: whether the panel's primaries are known in the tracker's colours, and rates."""

    primaries: bool
    rates: bool


@dataclass(frozen=True, slots=True)
class Answer:
    """The choice for a scene, and the largest part of what `effort = "auto"` leaves there."""

    row: CombinationRow
    largest: ErrorPart

    @property
    def setting(self) -> str:
        """The keys of [render] that make the choice."""
        stealing = ", bit_stealing = true" if self.row.bit_stealing == "true" else ""
        return f'quantisation = "{self.row.quantisation}"{stealing}'

    @property
    def expected(self) -> str:
        """The error of a star's place and light, rms."""
        return f"{two_digits(self.row.error_arcsec)} arcsec, {two_digits(self.row.error_mag)} mag"


def answers_among(rows: Sequence[CombinationRow]) -> list[CombinationRow]:
    """The rows of a scene that may be an answer: whole depth, sprites within the tolerance, paths, each frame right."""
    deepest = max(row.faintest_v_mag for row in rows)
    return [
        row
        for row in rows
        if row.faintest_v_mag == deepest and row.sprite == "cut" and row.smear == "path" and row.quantisation in ANSWERS
    ]


def allowed(rows: Sequence[CombinationRow], given: Given) -> list[CombinationRow]:
    """The answers of a scene for what is given: with rates those predicted by them, without them all others."""
    kept = []
    for row in answers_among(rows):
        by_rate = row.prediction == "rate"
        if row.bit_stealing == "true" and not given.primaries:
            continue
        if row.rate_deg_s and by_rate != given.rates:
            continue
        kept.append(row)
    return kept


def simplest(rows: Sequence[CombinationRow]) -> CombinationRow:
    """The simplest of rows whose error is near the smallest one's: without bit stealing first, then the cheaper codes."""
    smallest_arcsec = min(row.error_arcsec for row in rows)
    near = [row for row in rows if row.error_arcsec <= NEAR * smallest_arcsec]
    smallest_mag = min(row.error_mag for row in near)
    near = [row for row in near if row.error_mag <= max(NEAR_MAG, NEAR * smallest_mag)]
    return min(near, key=lambda row: (row.bit_stealing == "true", ANSWERS.index(row.quantisation), row.error_arcsec))


def largest_part(budget: Sequence[ErrorPart], scene: str) -> ErrorPart:
    """The step that most of a scene's error comes from."""
    parts = [part for part in budget if part.scene == scene and part.step not in (RSS, WHOLE)]
    return max(parts, key=lambda part: part.error_arcsec)


def answer(rows: Sequence[CombinationRow], budget: Sequence[ErrorPart], given: Given) -> Answer:
    """The answer for one scene's rows."""
    row = simplest(allowed(rows, given))
    return Answer(row, largest_part(budget, row.scene))


def scenes_of(rows: Sequence[CombinationRow]) -> list[list[CombinationRow]]:
    """The rows of each scene: the first at rest, then those that turn, the slowest first."""
    names = list(dict.fromkeys(row.scene for row in rows))
    scenes = [[row for row in rows if row.scene == name] for name in names]
    still = [scene for scene in scenes if not scene[0].rate_deg_s]
    turning = [scene for scene in scenes if scene[0].rate_deg_s]
    return [*still[:1], *sorted(turning, key=lambda scene: scene[0].rate_deg_s)]


def answer_lines(rows: Sequence[CombinationRow], budget: Sequence[ErrorPart], load: Load) -> list[str]:
    """What a person can do, a line each: codes, bit stealing, each turn whose largest part changes, and depth."""
    scenes = scenes_of(rows)
    lines: list[str] = []
    if not scenes[0][0].rate_deg_s:
        lines += rest_lines(scenes[0], load)
    lines += turn_lines([scene for scene in scenes if scene[0].rate_deg_s], budget)
    return [*lines, depth_line(scenes[0])]


def rest_lines(rows: Sequence[CombinationRow], load: Load) -> list[str]:
    """Which codes to take at rest, and what bit stealing adds."""
    plain = simplest(allowed(rows, Given(primaries=False, rates=True)))
    words = f'at rest on {plain.bits} bits: set quantisation = "{plain.quantisation}", {two_digits(plain.error_arcsec)} arcsec'
    others = [row for row in allowed(rows, Given(primaries=False, rates=True)) if row is not plain]
    for other in others:
        words += f" ({other.quantisation}: {two_digits(other.error_arcsec)}{time_words(other, plain, load)})"
    stealing = [row for row in allowed(rows, Given(primaries=True, rates=True)) if row.bit_stealing == "true"]
    if not stealing:
        return [words, "bit stealing: not on this panel, whose calibration has no primaries in the tracker's colours"]
    best = min(stealing, key=lambda row: row.error_arcsec)
    change = f"{two_digits(plain.error_arcsec)} arcsec to {two_digits(best.error_arcsec)}{time_words(best, plain, load)}"
    if best.error_arcsec * NEAR >= plain.error_arcsec:
        return [words, f"bit stealing: brings nothing at rest ({change})"]
    return [
        words,
        f"bit stealing, if the primaries are known in the tracker's colours: takes {change}, with {best.quantisation}",
    ]


def time_words(row: CombinationRow, to: CombinationRow, load: Load) -> str:
    """A row's time as a share of another's; nothing on a busy machine."""
    if load.busy:
        return ""
    return f" in {row.time_ms / to.time_ms:.2f} of the time"


def turn_lines(scenes: Sequence[Sequence[CombinationRow]], budget: Sequence[ErrorPart]) -> list[str]:
    """A line for each turn from which on another step is the largest part of the error, and what to do about it."""
    lines, last = [], ""
    for rows in scenes:
        part = largest_part(budget, rows[0].scene)
        if part.step == last:
            continue
        last = part.step
        whole = next(other for other in budget if other.scene == part.scene and other.step == WHOLE)
        share = f"{two_digits(part.error_arcsec)} of {two_digits(whole.error_arcsec)} arcsec"
        step = STEP_WORDS.get(part.step, part.step)
        advice = prediction_words(rows) if part.step == "prediction" else ADVICE[part.step]
        lines.append(f"from {rows[0].rate_deg_s:g} deg/s on {step} is the largest part ({share}): {advice}")
    return lines


def prediction_words(rows: Sequence[CombinationRow]) -> str:
    """What each prediction leaves of a scene with the best codes, and what to ask of the sender."""
    deepest = max(row.faintest_v_mag for row in rows)
    plain = [row for row in rows if row.faintest_v_mag == deepest and row.bit_stealing == "false"]
    errors: dict[str, float] = {}
    for prediction in PREDICTED:
        ways = [row.error_arcsec for row in plain if row.prediction == prediction and row.quantisation in ANSWERS]
        if ways:
            errors[prediction] = min(ways)
    best = min(errors, key=lambda prediction: errors[prediction])
    words = ", ".join(f"{WAYS[prediction]} {two_digits(error)}" for prediction, error in errors.items())
    return f"{PREDICTION_ADVICE[best]} ({words} arcsec)"


def depth_line(rows: Sequence[CombinationRow]) -> str:
    """What a shallower catalogue costs at rest, or in the slowest turn."""
    deepest = max(row.faintest_v_mag for row in rows)
    shallow = [row for row in rows if row.faintest_v_mag < deepest]
    if not shallow:
        return f"depth: faintest_v_mag = {deepest:g} was measured alone"
    fewest = min(shallow, key=lambda row: row.error_arcsec)
    if fewest.lost:
        return (
            f"depth: keep faintest_v_mag = {deepest:g}; with {fewest.faintest_v_mag:g} the tracker loses {fewest.lost} of"
            f" {fewest.stars} stars"
        )
    return f"depth: faintest_v_mag = {fewest.faintest_v_mag:g} is enough; it loses none of {fewest.stars} stars"
