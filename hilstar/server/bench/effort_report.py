"""The choices of a bench's effort, for a person (a table) and for a program ("effort" of
--json).
"""

import json
import math
from typing import Any

from hilstar.server.bench.effort import Effort
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.least_psf import Choice
from hilstar.server.bench.would_do import Remedy, would_do

JOIN = " and "  # between the two keys of a remedy
HEAD = ("part", "choice", "error", "of the tolerance", "saves")


def effort_lines(bench: Bench) -> list[str]:
    """A table of the choices and their sum, notes, and what would do where that is over the
    tolerance.
    """
    effort = bench.effort
    rows = [HEAD]
    for choice in effort.choices:
        rows.append((choice.part, choice.choice, *_errors(effort, choice), _saved(choice)))
    saved_ms = sum(choice.saved_ms for choice in effort.choices)
    together = Choice("together", "", effort.error_mag, effort.error_px, 0.0, saved_ms)
    rows.append((together.part, _verdict(effort), *_errors(effort, together), _saved(together)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join(cells).rstrip())
    lines += [f"{choice.part}: {choice.note}" for choice in effort.choices if choice.note]
    for remedy in would_do(bench):
        lines.append(f"{_remedy_head(remedy)}: {_remedy_text(remedy)}")
    return lines


def _verdict(effort: Effort) -> str:
    render = effort.asked
    within = "within" if effort.within else "OVER"
    return f"{within} {render.tolerance_mag:g} mag, {render.tolerance_px:g} px"


def _errors(effort: Effort, choice: Choice) -> tuple[str, str]:
    """The errors of a choice, and the larger of their shares of the tolerance."""
    render = effort.asked
    share = max(choice.error_mag / render.tolerance_mag, choice.error_px / render.tolerance_px)
    text = f"{choice.error_mag:.4f} mag, {choice.error_px:.4f} px"
    if not math.isfinite(share):
        return "a star shows nothing", "over"
    return text, f"{share:.0%}"


def _saved(choice: Choice) -> str:
    if choice.saved_ms:
        return f"{choice.saved_ms:.2f} ms"
    return "-"


def _remedy_head(remedy: Remedy) -> str:
    if not remedy.within:
        return "would not do alone"
    if len(remedy.changes) > 1:
        return "would do together"
    return "would do"


def _remedy_text(remedy: Remedy) -> str:
    # JSON and TOML write these values alike
    shown = JOIN.join(f"{change.key} = {json.dumps(change.value)}" for change in remedy.changes)
    if not math.isfinite(remedy.error_mag + remedy.error_px):
        return f"{shown} (a star shows nothing)"
    return f"{shown} ({remedy.error_mag:.4f} mag, {remedy.error_px:.4f} px)"


def effort_keys(bench: Bench) -> dict[str, Any]:
    """The object "effort" of --json. An error is null where a star shows nothing."""
    effort = bench.effort
    return {
        "within": effort.within,
        "quantisation": effort.quantisation,
        "error_mag": _number(effort.error_mag),
        "error_px": _number(effort.error_px),
        "tolerance_mag": effort.asked.tolerance_mag,
        "tolerance_px": effort.asked.tolerance_px,
        "choices": [_choice_keys(choice) for choice in effort.choices],
        "would_do": [_remedy_keys(remedy) for remedy in would_do(bench)],
    }


def _choice_keys(choice: Choice) -> dict[str, Any]:
    return {
        "part": choice.part,
        "choice": choice.choice,
        "error_mag": _number(choice.error_mag),
        "error_px": _number(choice.error_px),
        "ms": round(choice.ms, 4),
    }


def _remedy_keys(remedy: Remedy) -> dict[str, Any]:
    """The remedy as an object: `key` and `value`; of two keys both names in one, and a list."""
    values = [change.value for change in remedy.changes]
    return {
        "key": JOIN.join(change.key for change in remedy.changes),
        "value": values if len(values) > 1 else values[0],
        "error_mag": _number(remedy.error_mag),
        "error_px": _number(remedy.error_px),
        "within": remedy.within,
    }


def _number(error: float) -> float | None:
    return error if math.isfinite(error) else None
