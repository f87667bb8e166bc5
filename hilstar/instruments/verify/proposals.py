"""The change of a bench file that makes a failing bench pass: each one is tried on the twin, the
fewest keys first.

A change is proposed only if the bench file with it is read, drawn and passes over the same fields.
Among as many keys, those come first that cost time alone (`quantisation`, `bit_stealing`), then the
one that clips bright stars, then the one that drops faint ones. Of magnitudes the largest change is
tried first, and the smallest that passes is proposed.

What a proposal says to a person, and the bench file with it.
"""

import difflib
import json
import math
import os
import stat
from collections.abc import Callable
from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np

from hilstar.basics.error_spread import ErrorSpread
from hilstar.basics.errors import InputError, cannot_write
from hilstar.basics.files import write_whole
from hilstar.basics.reading import MAX_TOML_BYTES, read_text
from hilstar.display.quantisers import BY_COST
from hilstar.instruments.verify.summary import summarise, verify
from hilstar.instruments.verify.verdict import Verdict, p95
from hilstar.server.bench.bench_file import BenchFile, bench_file_of, with_key
from hilstar.server.bench.config import DEFAULT_BRIGHTEST_V_MAG

# Further than this a change is another test: full scale 4 times fainter, or a third of the stars.
BRIGHTER_MAG = (0.5, 1.0, 1.5)
FAINTER_MAG = (-0.5, -1.0, -1.5, -2.0)
STEPS_PER_MAG = 2
MIN_STARS = 6  # fewer of those that were measured would say little


@dataclass(frozen=True, slots=True)
class KeyProposal:
    """One key of a bench file with another value."""

    table: str
    key: str
    value: float | str | bool


@dataclass(frozen=True, slots=True)
class Verified:
    """The twin's verdict on a bench file with changes."""

    fields: int
    stars: int
    lost: int
    clipped: int
    not_shown: int
    flux_error_mag: ErrorSpread
    centroid_error_px: ErrorSpread
    passed: bool
    reasons: list[str]


@dataclass(frozen=True, slots=True)
class BenchProposal:
    """The changes that make a bench pass, with what the twin said of it so changed; the fields are
    keys of the JSON object.

    `changes` is empty where none passes: then `verified` is of the best of those that were tried
    (None without any), `best` is that one, and `cannot` says what cannot be met.
    """

    changes: tuple[KeyProposal, ...]
    verified: Verified | None
    best: tuple[KeyProposal, ...]
    tried: int
    cannot: str | None


@dataclass(frozen=True, slots=True)
class _Key:
    """A key, and the values that it may be given, the mildest first."""

    table: str
    key: str
    values: tuple[float | str | bool, ...]

    def at(self, place: int) -> KeyProposal:
        """The key with one of its values."""
        return KeyProposal(self.table, self.key, self.values[place])


def propose(
    file: BenchFile,
    verdict: Verdict,
    fields: int,
    seed: int,
    on_try: Callable[[int], None] = lambda tried: None,
) -> BenchProposal:
    """The fewest changes with which the bench of `file`, judged as `verdict`, passes over the same
    fields.

    `on_try` hears how many changes have been tried. Raises MachineError where the twin does.
    """
    if not codes_at_fault(verdict):
        cannot = (
            "the codes are within the limits, and no key of the light mends the rest:"
            f" {verdict.reasons[0]}"
        )
        return BenchProposal((), None, (), 0, cannot)
    rest = _not_the_codes(verdict)
    if rest is not None:
        return BenchProposal(
            (), None, (), 0, f"no key of the light mends what the codes do not cause: {rest}"
        )
    trials = _Trials(file, fields, seed, on_try)
    keys = _keys(verdict)
    for count in range(1, len(keys) + 1):
        for chosen in combinations(keys, count):
            changes = tuple(key.at(-1) for key in chosen)
            if not trials.passes(changes):
                continue
            # each brought to its mildest value that passes, the last key first
            for place in reversed(range(count)):
                for step in range(len(chosen[place].values) - 1):
                    milder = (*changes[:place], chosen[place].at(step), *changes[place + 1 :])
                    if trials.passes(milder):
                        changes = milder
                        break
            return BenchProposal(
                changes, _verified(trials.verdicts[changes]), (), trials.tried, None
            )
    judged = [changes for changes, one in trials.verdicts.items() if one.errors.stars]
    if not judged:
        return BenchProposal(
            (),
            None,
            (),
            trials.tried,
            f"none of {trials.tried} changes can be judged: {verdict.reasons[0]}",
        )
    best = min(judged, key=lambda changes: _excess(trials.verdicts[changes]))
    cannot = f"none of {trials.tried} changes passes; {_what_fails(trials.verdicts[best])}"
    return BenchProposal((), _verified(trials.verdicts[best]), best, trials.tried, cannot)


def changed_text(text: str, changes: tuple[KeyProposal, ...]) -> str:
    """The text of a bench file with changes; comments and all else stay."""
    for change in changes:
        text = with_key(text, change.table, change.key, change.value)
    return text


def codes_at_fault(verdict: Verdict) -> bool:
    """Whether the codes alone would exceed a limit, were everything else as assumed."""
    limits, errors = verdict.measured.config.verify, verdict.errors
    if not errors.looked_for:
        return False
    beyond = (
        p95(np.abs(errors.of("codes_mag"))) > limits.flux_mag
        or p95(errors.of("codes_px")) > limits.centroid_px
    )
    # A star that the codes lose even as assumed has no error of theirs.
    lost = sum(not math.isfinite(star.codes_mag) for star in errors.lost)
    return (
        beyond
        or abs(errors.codes_zero_point_mag) > limits.flux_mag
        or lost > limits.lost_share * errors.looked_for
    )


def _not_the_codes(verdict: Verdict) -> str | None:
    """The first limit that is exceeded even without the codes' share (errors add in squares);
    None if all are met.
    """
    limits, errors = verdict.measured.config.verify, verdict.errors
    wide = verdict.measured.star.fault()
    if wide is not None:
        return wide
    elsewhere = sum(math.isfinite(star.codes_mag) for star in errors.lost)
    if elsewhere > limits.lost_share * errors.looked_for:
        return f"{elsewhere} of {errors.looked_for} stars are lost that the codes alone would show"
    for what, unit, whole, codes, limit in (
        ("centroids are", "px", errors.centroid_px(), errors.of("codes_px"), limits.centroid_px),
        (
            "flux is",
            "mag",
            np.abs(errors.of("flux_mag")),
            np.abs(errors.of("codes_mag")),
            limits.flux_mag,
        ),
    ):
        left = math.sqrt(max(p95(whole) ** 2 - p95(codes) ** 2, 0.0))
        if left > limit:
            return f"{what} {left:.3f} {unit} off at 95 % without them (limit {limit:g})"
    return None


class _Trials:
    """The verdicts on a bench file with changes, each found once over the same fields."""

    def __init__(
        self, file: BenchFile, fields: int, seed: int, on_try: Callable[[int], None]
    ) -> None:
        self.file, self.fields, self.seed, self.on_try = file, fields, seed, on_try
        self.tried = 0
        self.verdicts: dict[tuple[KeyProposal, ...], Verdict] = {}

    def passes(self, changes: tuple[KeyProposal, ...]) -> bool:
        """Whether the bench passes with the changes; False where its file is refused with them."""
        if changes not in self.verdicts:
            self.tried += 1
            try:
                file = bench_file_of(self.file.path, changed_text(self.file.text, changes))
                # `with_key` cannot set a key of a table that is not in plain form.
                if any(
                    getattr(getattr(file.config, one.table), one.key) != one.value
                    for one in changes
                ):
                    return False
                self.verdicts[changes] = verify(file, self.fields, np.random.default_rng(self.seed))
            except InputError:
                return False
            finally:
                self.on_try(self.tried)
        return self.verdicts[changes].passed


def _keys(verdict: Verdict) -> list[_Key]:
    """The keys that a bench's calibration and settings leave to change, those that cost least
    first.
    """
    measured = verdict.measured
    render = measured.config.render
    calibrations = [
        one for one in (measured.calibration, measured.true_calibration) if one is not None
    ]
    keys = (
        [] if render.quantisation == BY_COST[-1] else [_Key("render", "quantisation", BY_COST[-1:])]
    )
    if not render.bit_stealing and all(one.can_steal_bits for one in calibrations):
        keys.append(_Key("render", "bit_stealing", (True,)))
    if render.flux_at_white_e_per_s is None:  # a measured scale is not changed
        brightest = (
            DEFAULT_BRIGHTEST_V_MAG if render.brightest_v_mag is None else render.brightest_v_mag
        )
        keys.append(
            _Key(
                "render",
                "brightest_v_mag",
                tuple(round(brightest + step, 3) for step in BRIGHTER_MAG),
            )
        )
    # Smaller magnitude limits of the sky, the largest first, that leave enough of the stars that
    # were looked for.
    v_mag = np.array([star.v_mag for star in verdict.errors.stars + verdict.errors.lost])
    seen = math.ceil(float(v_mag.max()) * STEPS_PER_MAG) / STEPS_PER_MAG
    faintest = (
        round(min(measured.config.sky.faintest_v_mag, seen) + step, 3) for step in FAINTER_MAG
    )
    limits = tuple(limit for limit in faintest if (v_mag <= limit).sum() >= MIN_STARS)
    return [*keys, _Key("sky", "faintest_v_mag", limits)] if limits else keys


def _verified(verdict: Verdict) -> Verified:
    summary = summarise(verdict)
    return Verified(**{entry.name: summary[entry.name] for entry in fields(Verified)})


def _excess(verdict: Verdict) -> float:
    """The largest of a verdict's errors as a multiple of its limit."""
    limits, errors = verdict.measured.config.verify, verdict.errors
    lost = len(errors.lost) / errors.looked_for
    shares = (
        p95(np.abs(errors.of("flux_mag"))) / limits.flux_mag,
        p95(errors.centroid_px()) / limits.centroid_px,
    )
    return max(
        *shares, lost / limits.lost_share if limits.lost_share else math.inf * lost if lost else 0.0
    )


def _what_fails(verdict: Verdict) -> str:
    """The magnitudes whose stars exceed a limit, and on how many bits."""
    limits, monitor = verdict.measured.config.verify, verdict.measured.config.monitor
    failing = [
        row
        for row in summarise(verdict)["by_magnitude"]
        if (row["flux_error_mag"].p95 or 0.0) > limits.flux_mag
        or (row["centroid_error_px"].p95 or 0.0) > limits.centroid_px
    ]
    if not failing:
        return f"at best: {verdict.reasons[0]}"
    return (
        f"{monitor.bits} bits cannot show stars of V {failing[0]['v_from']} to"
        f" {failing[-1]['v_to']} within the limits"
    )


def proposal_lines(file: BenchFile, proposal: BenchProposal) -> list[str]:
    """The proposal for a person, with the difference that it makes in the bench file."""
    verified = proposal.verified
    if not proposal.changes:
        lines = [f"{'proposal':20}none: {proposal.cannot}"]
        if verified is not None:
            lines.append(f"{'':20}the best is {_words(proposal.best)}: {_figures(verified)}")
        return lines
    said = "" if verified is None else f": passes, {_figures(verified)}"
    return [f"{'proposal':20}{_words(proposal.changes)}{said}", *difference(file, proposal)]


def difference(file: BenchFile, proposal: BenchProposal) -> list[str]:
    """The lines that a proposal changes in the bench file, as a unified diff."""
    before, after = file.text.splitlines(), changed_text(file.text, proposal.changes).splitlines()
    return list(
        difflib.unified_diff(before, after, str(file.path), str(file.path), n=1, lineterm="")
    )


def check_writable(file: BenchFile) -> None:
    """Refuse (InputError) a bench file that may not be written, before anything is tried."""
    try:
        status = file.path.stat()
    except OSError as error:
        raise cannot_write(file.path, error) from error
    if not stat.S_ISREG(status.st_mode):
        raise cannot_write(
            file.path, "it is no regular file", "leave --write out, and change the file yourself"
        )
    # Root may write what nobody should: a file without any write permission was protected by
    # somebody.
    protected = not status.st_mode & (stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH)
    if protected or not os.access(file.path, os.W_OK):
        raise cannot_write(file.path, "it is read-only", "copy it, and verify the copy")


def write_proposal(file: BenchFile, proposal: BenchProposal) -> None:
    """Make the changes in the bench file. Raises InputError where it cannot be written, or has
    changed since it was read.
    """
    check_writable(file)
    if read_text(file.path, "give the path of a bench file", MAX_TOML_BYTES) != file.text:
        raise InputError(f"{file.path}: has changed since it was read; run verify again")
    write_whole(file.path, changed_text(file.text, proposal.changes))


def _words(changes: tuple[KeyProposal, ...]) -> str:
    return ", ".join(
        f"[{change.table}] {change.key} = {json.dumps(change.value)}" for change in changes
    )


def _figures(verified: Verified) -> str:
    flux, centroid = verified.flux_error_mag.p95, verified.centroid_error_px.p95
    at_95 = (
        f"{flux:.3f} mag and {centroid:.3f} px at 95 %, "
        if flux is not None and centroid is not None
        else ""
    )
    return (
        f"{at_95}{verified.stars} stars, {verified.lost} lost, {verified.clipped} clipped,"
        f" {verified.not_shown} not shown"
    )
