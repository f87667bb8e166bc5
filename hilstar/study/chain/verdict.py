"""What a scene's table says in one line: where `auto` stands, and if it is not on the front, why."""

from __future__ import annotations

from collections.abc import Sequence

from hilstar.study.chain.budget import RSS, WHOLE
from hilstar.study.chain.table import AUTO, BudgetRow, Row, StageRow, auto_of, beating

MAX_REASONS = 2
NOT_JUDGED = "the times were taken on a busy machine: no combination is named the faster"


def scene_line(rows: Sequence[Row], budget: Sequence[BudgetRow], stages: Sequence[StageRow], busy: bool = False) -> str:
    """What `auto` takes in a scene and is off by, whether it is on the front, and what its error and time are made of."""
    own, stands = rows[auto_of(rows)], NOT_JUDGED if busy else standing(rows)
    steps = [part for part in budget if part.step not in (RSS, WHOLE)]
    largest, longest = max(steps, key=lambda part: part.error_arcsec), max(stages, key=lambda one: one.time_ms)
    share = longest.time_ms / max(sum(one.time_ms for one in stages), 1e-9)
    return (
        f"{own.scene}: {AUTO} ({words(own)}) is {own.error_arcsec:.3g} arcsec and {own.error_mag:.2g} mag off over"
        f" {own.stars} stars{f', {own.lost} of them lost' if own.lost else ''}, in {own.time_ms:.3g} ms; {stands};"
        f" error: {largest.step} {largest.error_arcsec:.2g} arcsec; time: {longest.stage} {share:.0%}"
    )


def headline(rows: Sequence[Row], busy: bool = False) -> str:
    """What the whole table says of `auto`; nothing on a `busy` machine."""
    if busy:
        return f"The errors hold; {NOT_JUDGED}"
    scenes = [[row for row in rows if row.scene == name] for name in dict.fromkeys(row.scene for row in rows)]
    beaten = [own[0].scene for own in scenes if beating(own)[0]]
    where = f"in {len(scenes) - len(beaten)} of {len(scenes)} scenes"
    said = f", not in {', '.join(beaten)}" if beaten else ""
    return f'The choice of effort = "auto" is on the front of error against time, or within its noise, {where}{said}'


def is_right(rows: Sequence[Row]) -> bool:
    """Whether `auto` is on the front of what effort may choose, or within the noise of it."""
    return not beating(rows, as_filed=True)[0]


def standing(rows: Sequence[Row]) -> str:
    """Whether `auto` is on the front of all, or within the noise of it; else what beats it, why, and how it is without that."""
    beyond, within = beating(rows)
    own = rows[auto_of(rows)]
    if not beyond:
        return f"on the front within the noise: {_compared(own, _nearest(within))}" if within else "on the front"
    best = _nearest(beyond)
    said = f"not on the front: {_compared(own, best)}: {why_not(own, best)}"
    if best in (own_beyond := beating(rows, as_filed=True)[0]):
        return said
    if own_beyond:
        nearest = _nearest(own_beyond)
        return f"{said}; nor of what effort may choose: {_compared(own, nearest)}: {why_not(own, nearest)}"
    return f"{said}; on the front of what effort may choose{', within the noise' if beating(rows, as_filed=True)[1] else ''}"


def words(row: Row) -> str:
    """A row's combination in a few words."""
    stealing = " with bit stealing" if row.bit_stealing == "true" else ""
    moving = f", {row.smear}s, {row.prediction}" if row.rate_deg_s else ""
    return f"{row.quantisation}{stealing}, {row.sprite} sprites{moving}"


def why_not(own: Row, other: Row) -> str:
    """Why `effort = "auto"` does not take what beats it."""
    reasons = []
    if other.bit_stealing != own.bit_stealing:
        reasons.append(
            "bit stealing is the bench file's choice, for a panel whose primaries are known as the tracker sees them"
        )
    if other.prediction != own.prediction and own.prediction == "held":
        reasons.append("[attitude] max_extrapolation_ms = 0 is the bench file's choice")
    elif other.prediction != own.prediction:
        reasons.append(f"prediction by {other.prediction} is the sender's choice (whether its packets have rates)")
    if other.faintest_v_mag != own.faintest_v_mag:
        reasons.append("the catalogue's depth is the bench file's choice")
    if other.quantisation == "temporal":
        reasons.append("temporal is right over an exposure, and effort asks for light that is right in each frame")
    elif other.quantisation != own.quantisation:
        reasons.append(
            f"effort compares {own.quantisation} and {other.quantisation} by their worst star at any sub-pixel phase, not by a"
            " field's rms"
        )
    if other.sprite != own.sprite:
        reasons.append(
            "coarse sprites are beyond the tolerance" if other.sprite == "coarse" else "cut sprites save nothing here"
        )
    if other.smear != own.smear:
        reasons.append(f"{other.smear}s instead of {own.smear}s")
    return "; ".join(reasons)


def _nearest(rows: Sequence[Row]) -> Row:
    """Of what beats `auto`, that with the smallest error, and of these the fastest."""
    return min(rows, key=lambda row: (row.error_arcsec, row.time_ms))


def _compared(own: Row, other: Row) -> str:
    faster = own.time_ms - other.time_ms
    noise = (own.noise_ms**2 + other.noise_ms**2) ** 0.5
    return f"{words(other)} is {other.error_arcsec:.3g} arcsec off and {faster:.2g} ms faster (noise {noise:.2g} ms)"
