"""Judges a tracker's answers as they arrive: when the tracker looked, how large the error is, and
the statistics of the last minute; no I/O.

**When.** Where the tracker stamps answers on a clock of its own, `SenderClock` fits that clock to
the arrival times, as it does for a sender's. The fit leaves one time unknown: the shortest delay D
from the middle of an exposure to the arrival of its answer. The motion reveals D: if the lit
attitude is read too late by delta, the residual turns by omega delta, so that e_i = b + omega_i
delta. The bias b and delta are fitted together to the answers of the last minute. Until the rate
has changed enough, D is assumed to be half an exposure plus GUESSED_DELAY_S.

**Laws.** Answers of finite numbers, whatever their values and order, never end the judging. Only
finite numbers are stored. A fit that is not finite, that has too few answers near it, or whose
delay is over MAX_DELAY_S is dropped, and the previous delay stays. If answers are no longer right
under a fitted delay, the assumed delay replaces it.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import msgspec
import numpy as np

from hilstar.attitude.clock.sender_clock import SenderClock
from hilstar.basics.arrays import FloatArray
from hilstar.basics.process.scheduling import HOST_CLOCK, UnixOffset
from hilstar.basics.units import ARCSEC_PER_RAD, MAD_TO_SIGMA, NS_PER_S
from hilstar.server.answers.answer import JUMP_NS, Answer, StampOrder
from hilstar.server.answers.pairing import KEPT_NS, Lit, LitFrames, residual_arcsec

if TYPE_CHECKING:
    from hilstar.server.bench.config import BenchConfig

Verdict = Literal["right", "wrong", "invalid", "unpaired", "unjudged"]
Stamp = Literal["start", "middle", "end", "arrival"]
TO_MIDDLE = {"start": 0.5, "middle": 0.0, "end": -0.5}  # stamp to exposure's middle, in exposures
WINDOW_S = 60.0
MAX_IN_WINDOW = 4096  # above 68 answers a second these cover less than WINDOW_S
GUESSED_DELAY_S, GUESSED_SIGMA_S = 0.1, 0.1
FIT_EACH_NS, MIN_FITTED = NS_PER_S, 10
MAX_ROUNDS = 8  # of the fit, which ends earlier where a round selects the same answers again
CUT_SIGMAS = 8.0
# Smallest noise that the fit assumes: answers without noise still have the errors of the pairing.
MIN_NOISE_ARCSEC = 0.1
# Under a longer delay the frames of an exposure are soon older than KEPT_NS, and forgotten.
MAX_DELAY_S = KEPT_NS / NS_PER_S / 2
# An error that the unknown time explains does not count against the tracker: SURE sigmas of that
# time, at most MAX_EXCUSED_S, times the rate.
SURE, MAX_EXCUSED_S = 3.0, 0.3
KNOWN_AGAIN_NS = NS_PER_S  # between two readings of this host's Unix offset
JUMPS = 3  # so many answers in a row that are late by over JUMP_NS: the tracker's clock was set
# A tracker is silent after SILENT_S or SILENT_CYCLES answer periods, the longer of the two, without
# an answer; before its first answer after FIRST_S.
SILENT_S, SILENT_CYCLES, FIRST_S = 1.0, 5.0, 3.0
VERDICTS: tuple[Verdict, ...] = ("right", "wrong", "invalid", "unpaired", "unjudged")
# Columns of an answer's row: host time, s; index in VERDICTS; total time without a sky until then,
# s; residual, arcsec; rate, arcsec/s.
HOST_S, VERDICT, DARK_S, ERROR, RATE, COLUMNS = 0, 1, 2, slice(3, 6), slice(6, 9), 9


@dataclass(frozen=True, slots=True)
class AnswerRules:
    """The bench file's rules for judging answers: the exposure, s; where in it the stamp stands
    (`stamp`) and on which `clock`; the error above which an answer is wrong, arcsec; and the delay
    `latency_s` from the exposure's middle to the answer, None where it is not known.
    """

    exposure_s: float
    stamp: Stamp = "middle"
    clock: Literal["own", "unix", "host"] = "own"
    wrong_arcsec: float = 3600.0
    latency_s: float | None = None

    @classmethod
    def of(cls, config: "BenchConfig") -> Self:
        """The rules of a bench file; the defaults where it has no `[answers]`."""
        settings = config.answers
        exposure_s = config.tracker.exposure_s
        if settings is None:
            return cls(exposure_s)
        if settings.latency_ms is None:
            latency_s = None
        else:
            latency_s = settings.latency_ms / 1e3
        return cls(exposure_s, settings.stamp, settings.clock, settings.wrong_arcsec, latency_s)


class Judged(NamedTuple):
    """A judged answer: its verdict, the middle of its exposure (host time, ns, with its sigma, s),
    what was lit during the exposure, and the residual (3,), arcsec, camera axes. `lit` and
    `residual` are None where the answer is compared with nothing.
    """

    answer: Answer
    verdict: Verdict
    middle_ns: int
    sigma_s: float
    lit: Lit | None = None
    residual: FloatArray | None = None


def unjudged(answer: Answer) -> Judged:
    """The answer with the verdict "unjudged" and no comparison. Its exposure is not known, so that
    its arrival stands for the exposure's middle.
    """
    return Judged(answer, "unjudged", answer.host_ns, 0.0)


class TrackerFigures(msgspec.Struct, frozen=True, kw_only=True):
    """The statistics of a tracker's answers: counts over the run, the newest answer, and figures of
    the last minute. Errors are in arcsec about the camera's x, y and z.

    `out_of_order` counts answers whose stamp lies before the stamp of an earlier arrival,
    `unjudged` answers for which the judging failed. `rms_arcsec` is about zero, `sigma3_arcsec`
    three standard deviations about the mean, both of right answers. `latency_ms` is from the
    exposure's middle to the last byte, `latency_sigma_ms` its sigma (null: not known).
    `availability` is the number of right answers over the number due while a sky was shown. `age_s`
    is the time since the newest answer. `silent` is a line of text where the tracker does not
    answer, else ""; `trouble` names the present fault of its line, "" without one.
    """

    answers: int = 0
    right: int = 0
    wrong: int = 0
    invalid: int = 0
    unpaired: int = 0
    unjudged: int = 0
    out_of_order: int = 0
    refused: dict[str, int] = {}
    residual_arcsec: list[float] | None = None
    verdict: str = ""
    mode: str = ""
    stars: int | None = None
    rate_hz: float | None = None
    availability: float | None = None
    mean_arcsec: list[float] | None = None
    rms_arcsec: list[float] | None = None
    sigma3_arcsec: list[float] | None = None
    latency_ms: float | None = None
    latency_sigma_ms: float | None = None
    age_s: float | None = None
    silent: str = ""
    trouble: str = ""


class AnswerTimes:
    """Finds when the tracker looked: the middle of an answer's exposure on the host's clock.

    `delay_s` is the present delay from the exposure's middle to the answer, `sigma_s` its sigma,
    `guess_s` the delay that is assumed at the start. `fits` says that the delay is to be found from
    the motion.
    """

    def __init__(
        self, rules: AnswerRules, unix_offset: Callable[[], UnixOffset] = HOST_CLOCK.unix_offset
    ) -> None:
        self._rules = rules
        self._unix_offset = unix_offset
        self._known = UnixOffset(0, 0)
        self._known_ns = -KNOWN_AGAIN_NS
        self._clock = SenderClock()
        self._late = 0
        self.order = StampOrder()
        self.guess_s = (
            rules.exposure_s / 2 + GUESSED_DELAY_S if rules.latency_s is None else rules.latency_s
        )
        self.fits = rules.latency_s is None and (rules.clock == "own" or rules.stamp == "arrival")
        self.delay_s, self.sigma_s = self.guess_s, GUESSED_SIGMA_S if self.fits else 0.0

    def shift(self, delay: "DelayFit") -> None:
        """Change the delay by the result of a fit to the motion."""
        self.delay_s += delay.shift_s
        self.sigma_s = delay.sigma_s

    def give_up(self) -> None:
        """Return to the assumed delay, because under the fitted one answers are not right."""
        self.delay_s = self.guess_s
        self.sigma_s = GUESSED_SIGMA_S

    def middle(self, answer: Answer) -> tuple[int, float]:
        """The middle of the answer's exposure, host time, ns, and its sigma, s."""
        rules = self._rules
        if answer.t_ns is not None:
            self.order.take(answer.t_ns)
        if answer.t_ns is None or rules.stamp == "arrival":
            return answer.host_ns - round(self.delay_s * NS_PER_S), self.sigma_s
        t_ns = answer.t_ns + round(TO_MIDDLE[rules.stamp] * rules.exposure_s * NS_PER_S)
        if rules.clock == "host":
            return t_ns, 0.0
        if rules.clock == "unix":
            if answer.host_ns - self._known_ns >= KNOWN_AGAIN_NS:
                self._known = self._unix_offset()
                self._known_ns = answer.host_ns
            return t_ns + self._known.offset_ns, self._known.error_ns / NS_PER_S
        late_ns = self._clock.latency_ns(t_ns, answer.host_ns)
        self._late = self._late + 1 if late_ns is not None and late_ns > JUMP_NS else 0
        if self._late == JUMPS:
            self._clock = SenderClock()
            self._late = 0
        self._clock.observe(t_ns, answer.host_ns)
        late_ns = max(self._clock.latency_ns(t_ns, answer.host_ns) or 0.0, 0.0)
        known_ms = self._clock.summary().uncertainty_ms
        sigma_s = self.sigma_s + (0.0 if known_ms is None else known_ms / 1e3)
        return answer.host_ns - round(late_ns + self.delay_s * NS_PER_S), sigma_s


class DelayFit(NamedTuple):
    """The change of the delay that a fit finds, s, and its standard deviation, s."""

    shift_s: float
    sigma_s: float


def fitted_delay(
    error_arcsec: FloatArray, rate_arcsec_s: FloatArray, pull_s: float
) -> DelayFit | None:
    """The change of the delay, fitted together with a bias to residuals (n, 3), arcsec, and rates
    (n, 3), arcsec/s, camera axes; None where fewer than MIN_FITTED answers agree, or the fit has no
    finite result.

    `pull_s` is the assumed delay minus the present one: the assumption, with its sigma
    GUESSED_SIGMA_S, is one more measurement in the fit. The noise is estimated for each axis,
    because a tracker's roll is many times as noisy as its cross axes. Answers over CUT_SIGMAS of
    that noise from the fit are left out.
    """
    design = np.zeros((len(error_arcsec), 3, 4))
    design[:, range(3), range(3)], design[:, :, 3] = 1.0, rate_arcsec_s
    precision = np.array([0.0, 0.0, 0.0, GUESSED_SIGMA_S**-2])
    off = error_arcsec - np.median(error_arcsec, axis=0)
    near_before = None
    for _ in range(MAX_ROUNDS):
        noise = np.maximum(MAD_TO_SIGMA * np.median(np.abs(off), axis=0), MIN_NOISE_ARCSEC)
        near = ((off / noise) ** 2).sum(axis=1) < CUT_SIGMAS**2
        if near.sum() < MIN_FITTED:
            return None
        if near_before is not None and np.array_equal(near, near_before):
            break
        scaled = design[near] / noise[:, None] ** 2
        normal = np.einsum("nij,nik->jk", scaled, design[near]) + np.diag(precision)
        pulled = np.einsum("nij,ni->j", scaled, error_arcsec[near]) + precision * pull_s
        try:
            fitted = np.linalg.solve(normal, pulled)
            variance = np.linalg.inv(normal)[3, 3]
        except np.linalg.LinAlgError:
            return None
        off = error_arcsec - design @ fitted
        near_before = near
        if not (np.isfinite(off).all() and np.isfinite(variance) and variance >= 0):
            return None
    return DelayFit(float(fitted[3]), float(np.sqrt(variance)))


class AnswerJudge:
    """Judges answers against the frames that were lit, and computes the statistics of the last
    minute. `counts` has the number of answers of each verdict over the run.
    """

    def __init__(self, rules: AnswerRules, frames: LitFrames) -> None:
        self.counts: Counter[Verdict] = Counter()
        self.times = AnswerTimes(rules)
        self._rules = rules
        self._frames = frames
        self._rows = np.zeros((MAX_IN_WINDOW, COLUMNS))
        self._count = 0
        self._fitted_ns = 0
        self._newest: Judged | None = None
        self._begun_ns: int | None = None

    def judge(self, answer: Answer) -> Judged:
        """Compare an answer with the attitude that was lit during its exposure, and count it."""
        middle_ns, sigma_s = self.times.middle(answer)
        verdict: Verdict = "invalid"
        lit = residual = None
        half_ns = round(self._rules.exposure_s * NS_PER_S / 2)
        if answer.valid and answer.q_icrs_to_cam is not None:
            verdict = "unpaired"
            lit = self._frames.over(middle_ns - half_ns, middle_ns + half_ns)
            if lit is not None:
                residual = residual_arcsec(answer.q_icrs_to_cam, lit.q)
                verdict = self._verdict(residual, lit, sigma_s)
        if verdict == "unjudged":
            lit = residual = None
        judged = Judged(answer, verdict, middle_ns, sigma_s, lit, residual)
        self._keep(judged)
        if self.times.fits and abs(answer.host_ns - self._fitted_ns) > FIT_EACH_NS:
            self._fitted_ns = answer.host_ns
            self._fit(answer.host_ns)
        return judged

    def pass_over(self, answer: Answer) -> Judged:
        """Count an answer as "unjudged" after `judge` has failed on it."""
        judged = unjudged(answer)
        self._keep(judged)
        return judged

    def _verdict(self, residual: FloatArray, lit: Lit, sigma_s: float) -> Verdict:
        """The verdict: "right" where the residual (3,), arcsec, is within the bench file's limit,
        else "wrong"; "unjudged" for numbers that are not finite. `sigma_s` is the sigma of the
        exposure's time: the motion during this uncertainty adds to the limit.
        """
        off_arcsec = float(np.linalg.norm(residual))
        rate_arcsec_s = ARCSEC_PER_RAD * float(np.linalg.norm(lit.rate_rad_s))
        if not math.isfinite(off_arcsec) or not math.isfinite(rate_arcsec_s):
            return "unjudged"
        excused_s = min(SURE * sigma_s, MAX_EXCUSED_S)
        bound_arcsec = self._rules.wrong_arcsec + excused_s * rate_arcsec_s
        return "wrong" if off_arcsec > bound_arcsec else "right"

    def _keep(self, found: Judged) -> None:
        """Count an answer and store its row. Without a comparison its error and rate are 0; they
        are read of right answers only.
        """
        row = self._rows[self._count % MAX_IN_WINDOW]
        row[:] = 0.0
        row[:3] = (
            found.answer.host_ns / NS_PER_S,
            VERDICTS.index(found.verdict),
            self._frames.dark_ns / NS_PER_S,
        )
        if found.lit is not None and found.residual is not None:
            row[ERROR], row[RATE] = found.residual, ARCSEC_PER_RAD * found.lit.rate_rad_s
        self._count += 1
        self.counts[found.verdict] += 1
        self._newest = found

    def _lately(self, now_ns: int) -> FloatArray:
        at = self._count % MAX_IN_WINDOW
        if self._count < MAX_IN_WINDOW:
            rows = self._rows[: self._count]
        else:
            rows = np.roll(self._rows, -at, axis=0)
        return rows[rows[:, HOST_S] >= now_ns / NS_PER_S - WINDOW_S]

    def _fit(self, now_ns: int) -> None:
        """Fit the delay and the bias to the right answers of the last minute."""
        rows = self._lately(now_ns)
        times = self.times
        right = rows[rows[:, VERDICT] == VERDICTS.index("right")]
        if len(right) < MIN_FITTED:
            wrong = rows[:, VERDICT] == VERDICTS.index("wrong")
            if wrong.sum() >= MIN_FITTED:
                before_s = times.delay_s
                times.give_up()
                self._turn_errors(times.delay_s - before_s)
            return
        delay_fit = fitted_delay(right[:, ERROR], right[:, RATE], times.guess_s - times.delay_s)
        if delay_fit is None or times.delay_s + delay_fit.shift_s > max(MAX_DELAY_S, times.guess_s):
            return
        # An answer cannot arrive before its exposure ends, half an exposure after its middle.
        shift_s = max(delay_fit.shift_s, self._rules.exposure_s / 2 - times.delay_s)
        times.shift(DelayFit(shift_s, delay_fit.sigma_s))
        self._turn_errors(shift_s)

    def _turn_errors(self, shift_s: float) -> None:
        """Correct the stored errors for a delay that is longer by `shift_s`."""
        self._rows[:, ERROR] -= self._rows[:, RATE] * shift_s

    def figures(self, now_ns: int, refused: dict[str, int], trouble: str = "") -> TrackerFigures:
        """The statistics at the host time `now_ns`. `refused` counts data that was no answer, by
        reason; `trouble` is the present fault of the tracker's line. Both go into the result.
        """
        self._begun_ns = now_ns if self._begun_ns is None else self._begun_ns
        rows = self._lately(now_ns)
        newest = self._newest
        figure_values: dict[str, Any] = {verdict: self.counts[verdict] for verdict in VERDICTS}
        figure_values["out_of_order"] = self.times.order.fallen
        cycle_s = cycle_of(rows[:, HOST_S])
        since_s = (
            now_ns - (self._begun_ns if newest is None else newest.answer.host_ns)
        ) / NS_PER_S
        if newest is None:
            limit_s = FIRST_S
        else:
            limit_s = max(SILENT_S, SILENT_CYCLES * (cycle_s or 0.0))
        if newest is not None:
            late_s = (newest.answer.host_ns - newest.middle_ns) / NS_PER_S
            figure_values |= {
                "mode": newest.answer.mode,
                "stars": newest.answer.star_count,
                "verdict": newest.verdict,
            }
            figure_values |= {
                "latency_ms": round(1e3 * late_s, 3),
                "latency_sigma_ms": round(1e3 * newest.sigma_s, 3),
            }
            figure_values |= {
                "residual_arcsec": None if newest.residual is None else _rounded(newest.residual),
                "age_s": round(since_s, 3),
            }
        error = rows[rows[:, VERDICT] == 0][:, ERROR]
        if len(error):
            figure_values |= {
                "mean_arcsec": _rounded(error.mean(axis=0)),
                "rms_arcsec": _rounded(np.sqrt((error**2).mean(axis=0))),
            }
        if len(error) > 1:
            figure_values |= {"sigma3_arcsec": _rounded(3 * error.std(axis=0, ddof=1))}
        # An answer counts as due half a cycle after its time: arrivals jitter by less than that.
        if cycle_s is not None:
            dark_s = self._frames.dark_ns / NS_PER_S - rows[0, DARK_S]
            due = math.floor((now_ns / NS_PER_S - rows[0, HOST_S] - dark_s) / cycle_s - 0.5) + 1
            figure_values |= {
                "rate_hz": round(1 / cycle_s, 3),
                "availability": round(min(len(error) / max(due, 1), 1.0), 4),
            }
        silence_text = "the tracker has not answered" + (
            " yet" if newest is None else f" for {since_s:.1f} s"
        )
        silence_text += f" ({trouble})" if trouble else ""
        return TrackerFigures(
            answers=sum(self.counts.values()),
            refused=refused,
            silent=silence_text if since_s > limit_s else "",
            trouble=trouble,
            **figure_values,
        )


def cycle_of(at_s: FloatArray) -> float | None:
    """The median time between answers, s, from their rising times (n,), s; None for fewer than
    three answers.
    """
    if len(at_s) > 2:
        return max(float(np.median(np.diff(at_s))), 1e-4)
    return None


def _rounded(values: FloatArray) -> list[float]:
    return [round(value, 3) for value in values.tolist()]
