"""The fenced blocks of a Markdown page, and what a reader does with them. CONTRIBUTING.md says how
pages are written for this.

A block with `title="NAME"` is saved under that name. A console block's lines after `$ ` are run in
that folder, those that end in `&` beside the next ones until the block's end; the lines between are
what they print on stdout. Python is run. A bench file's tables are read. Only `<!-- not run: REASON
-->` on the line before a block leaves it out.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

FENCE = re.compile(
    r"(?:^<!-- (?P<note>[^\n]*) -->\n)?^```(?P<language>\w*)(?:"
    r" title=\"(?P<title>[^\"]+)\")?[^\n]*\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
# the first is a version, as 3.11.2
NUMBER = re.compile(r"(?<![\w.])(?:\d+(?:\.\d+){2,}|-?\d+(?:\.\d+)?(?:e[-+]?\d+)?)")
RELATIVE_ERROR = 0.01  # of a figure with a decimal point: drivers and processors round differently


@dataclass(frozen=True)
class Step:
    """A command of a console block, and the lines on stdout that the page shows for it."""

    command: str
    printed: str
    beside: bool


@dataclass(frozen=True)
class Block:
    """A fenced block of a page, `line` its first line there."""

    line: int
    language: str
    text: str
    title: str | None = None
    not_run: str | None = None
    figures_vary: bool = False
    steps: list[Step] = field(default_factory=list)


def blocks_of(page: str) -> list[Block]:
    """The blocks in their order."""
    found = []
    for fence in FENCE.finditer(page):
        note, language = fence["note"] or "", fence["language"]
        reason = re.fullmatch(r"not run:(.*)", note)
        found.append(
            Block(
                line=page.count("\n", 0, fence.start("language")) + 1,
                language=language,
                text=fence["text"],
                title=fence["title"],
                not_run=reason[1].strip() if reason else None,
                figures_vary=note == "figures vary",
                steps=steps_of(fence["text"]) if language == "console" else [],
            )
        )
    return found


def steps_of(text: str) -> list[Step]:
    """The commands of a console block; a backslash at a line's end joins the next to it."""
    head, *parts = re.split(r"(?m)^\$ ", text)
    if head or not parts:
        raise ValueError("a console block begins with a command: $ hilstar ...")
    steps = []
    for part in parts:
        command, _, printed = part.replace("\\\n", " ").partition("\n")
        steps.append(
            Step(command.removesuffix("&").strip(), printed, command.rstrip().endswith("&"))
        )
    return steps


def differs(shown: str, printed: str, figures_vary: bool) -> str | None:
    """Why `printed` is not what a page shows, or None where it is.

    A line `...` stands for any lines, `...` within a line for any text. Whole numbers and versions
    must be the same, others within RELATIVE_ERROR; with `figures_vary` any number will do.
    """
    pattern = "".join(
        r"(?:.*\n)*?" if line == "..." else line_pattern(line) + "\n" for line in shown.splitlines()
    )
    match = re.fullmatch(pattern, printed)
    if match is None:
        return "other lines"
    if figures_vary:
        return None
    for wanted, got in zip(NUMBER.findall(shown), match.groups(), strict=True):
        exact = wanted.count(".") != 1
        if (
            (wanted != got)
            if exact
            else abs(float(wanted) - float(got)) > RELATIVE_ERROR * abs(float(wanted))
        ):
            return f"{got} where the page has {wanted}"
    return None


def line_pattern(line: str) -> str:
    """A line's words as they stand, its numbers as groups."""
    words = (r".*".join(map(re.escape, text.split("..."))) for text in NUMBER.split(line))
    return r"(-?[\d.]+(?:e[-+]?\d+)?|nan)".join(words)


def slugs_of(page: str) -> set[str]:
    """What a link to a heading of the page has after its `#`."""
    headings = re.findall(r"(?m)^#+ (.*)$", re.sub(r"(?ms)^```.*?^```$", "", page))
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }


def links_of(page: str) -> list[str]:
    """Where the links and pictures of a page lead."""
    prose = re.sub(r"(?ms)^```.*?^```$", "", page)
    prose = re.sub(r"`[^`\n]*`", "", prose)
    return re.findall(r"\[[^\]]*\]\(([^)\s]+)[^)]*\)", prose) + re.findall(
        r"<(?:img|a) [^>]*?(?:src|href)=\"([^\"]+)\"", prose
    )
