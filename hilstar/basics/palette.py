"""The colours of every page, by theme, in one place: palette.toml."""

import tomllib
from pathlib import Path

PALETTE = Path(__file__).with_suffix(".toml")
THEMES = ("dark", "light")


def colours_of(theme: str) -> dict[str, str]:
    """A theme's colours by name, as CSS writes them."""
    tables: dict[str, dict[str, str]] = tomllib.loads(PALETTE.read_text(encoding="utf-8"))
    return tables[theme]


def declarations(theme: str) -> str:
    """A theme's colours as declarations of custom properties."""
    return " ".join(f"--{name}: {colour};" for name, colour in colours_of(theme).items())


def palette_css() -> str:
    """The style sheet of a page with a switch: dark, unless its root says `data-theme="light"`;
    light on paper.
    """
    dark, light = (declarations(theme) for theme in THEMES)
    dark_root = f":root {{ color-scheme: dark; {dark} }}"
    light_root = f':root[data-theme="light"] {{ color-scheme: light; {light} }}'
    on_paper = f"@media print {{ :root, :root[data-theme] {{ color-scheme: light; {light} }} }}"
    return f"{dark_root}\n{light_root}\n{on_paper}\n"
