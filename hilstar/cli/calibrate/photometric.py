"""hilstar calibrate photometric: the monitor's response, fitted to measured patches."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from hilstar.cli.options import Json, check_files
from hilstar.console.terminal import print_json
from hilstar.files import PNG, TOML, check_ending


def photometric(
    measured: Annotated[Path, typer.Argument(metavar="MEASURED.csv", help="code,channel,value; see configs/CALIBRATION.md.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="MONITOR.toml", help="The calibration file.")],
    bits: Annotated[int | None, typer.Option(help="Bits per code; by default from the codes measured.", min=1, max=16)] = None,
    who: Annotated[str, typer.Option(help="Who made the measurements.")] = "",
    when: Annotated[str, typer.Option(help="Date of the measurements; today by default.")] = "",
    instrument: Annotated[str, typer.Option(help="Instrument used.")] = "",
    unit: Annotated[str, typer.Option(help="Unit of the values, such as cd/m2 or DN.")] = "",
    plot: Annotated[Path | None, typer.Option(metavar="OUT.png", help="The response and its residuals.")] = None,
    as_json: Json = False,
) -> None:
    """Fit the monitor's response to measured patches."""
    from hilstar.calibrate.photometric import Provenance, calibrate_photometric, draw_calibration

    check_ending("-o", output, TOML)
    check_ending("--plot", plot, PNG)
    check_files([measured], [output, output.with_suffix(".csv"), plot])
    found = calibrate_photometric(measured, output, Provenance(who, when, instrument, unit), bits)
    written = list(found.written)
    if plot is not None:
        draw_calibration(measured, plot, bits)
        written.append(str(plot))
    if as_json:
        print_json(found.json() | {"written": written})
        return
    black, held = found.first.black_level.relative, found.first.holdout
    contrast = f"1 : {1 / black:.0f}" if black > 0 else "unknown: no light at code 0"
    drift = "not known" if found.drift_percent is None else f"{found.drift_percent:+.2f} %"
    typer.echo(f"{'measured':20}{found.first.codes} codes above black, {found.bits} bits; drift {drift}")
    typer.echo(f"{'black level':20}{black:.3e} of white, contrast {contrast}")
    typer.echo(f"{'noise':20}{100 * found.noise_relative:.2f} % of a reading")
    typer.echo(
        f"{'held-out levels':20}{held.rms_percent:.2f} / {held.p95_percent:.2f} / {held.max_percent:.2f} %"
        f" (rms / 95 % / max), {held.max_mag:.4f} mag maximum"
    )
    typer.echo(f"{'written':20}{', '.join(written)}")
    typer.echo(f"{'in the bench file':20}[monitor] calibration = {json.dumps(output.name)}")
