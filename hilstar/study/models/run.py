"""What the brightness models make of a star: DGS against AGS, temperatures, zero points, black body against real spectra."""

from __future__ import annotations

from pathlib import Path

from hilstar.charts import write_csv
from hilstar.study.models.choices import choices
from hilstar.study.models.finding import Finding
from hilstar.study.models.rapp import rapp
from hilstar.study.models.settings import SENSORS
from hilstar.study.models.spectra import spectra
from hilstar.study.models.temperatures import temperature_scales
from hilstar.study.models.zero_points import zero_points


def run(directory: Path) -> list[Finding]:
    """Write every chart (PNG) and its table (CSV) into `directory`, and `findings.csv`. Raises InputError."""
    findings = [rapp(directory, sensor) for sensor in SENSORS]
    findings += [chart_of(directory) for chart_of in (temperature_scales, zero_points, choices, spectra)]
    write_csv(directory / "findings.csv", ("figure", "finding"), [(f.figure, f.text) for f in findings])
    return findings
