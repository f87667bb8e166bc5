"""hilstar doctor: what this machine has, and what it lacks."""

from __future__ import annotations

from dataclasses import asdict

import typer

from hilstar.cli.options import Json
from hilstar.console.terminal import print_json


def doctor(as_json: Json = False) -> None:
    """Check this machine's OpenGL, displays, links and files, and say what is missing."""
    from hilstar.run.doctor import examine

    result = examine()
    if as_json:
        print_json(asdict(result))
    else:
        for check in result.checks:
            mark = "ok" if check.ok else "MISSING" if check.required else "none"
            typer.echo(f"{mark:8}{check.name:12}{check.detail}")
    if not result.ok:
        raise typer.Exit(3)
