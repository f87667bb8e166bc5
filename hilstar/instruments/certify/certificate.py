"""From a budget to a certificate: figures with their intervals, conformity by the decision rule,
files, dates, its number.
"""

import datetime
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.basics.reading import MAX_TOML_BYTES, parse_toml, read_bytes, read_text
from hilstar.basics.version import __version__
from hilstar.display.calibration import BUILT_IN
from hilstar.display.identity import MonitorIdentity, sha256_of
from hilstar.instruments.certify.assembly import Assembled, assemble, read_bench
from hilstar.instruments.certify.budget import (
    MAX_DOF,
    BudgetTrials,
    Combined,
    by_trials,
    first_order,
    why_they_differ,
)
from hilstar.instruments.certify.check import take_check
from hilstar.instruments.certify.model import THIRDS, true_deviations
from hilstar.instruments.certify.readings import Reader
from hilstar.server.bench.alignment import cube_to_boresight
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.certificate_file import (
    KIND,
    ByTrials,
    Certificate,
    CertifiedFigure,
    Contribution,
    InputRow,
)
from hilstar.server.bench.config import CertifySettings
from hilstar.server.bench.measured_on import measured_on

MAX_TRIALS, QUICK_TRIALS = 200_000, 10_000
MAX_FILE_BYTES = 500_000_000
SEED = 11
DIGITS = 6
MEASURANDS = {
    "flux": (
        "light that the star's codes make at its place, over what the bench file says they make,"
        " mag (fainter > 0)"
    ),
    "place_along": (
        "direction in which the star is shown, less the one commanded, along the image's x, arcsec"
    ),
    "place_across": "the same along the image's y, arcsec",
    "attitude_x": (
        "rotation vector from the commanded to the reported attitude by the field's stars, about"
        " cam x, arcsec"
    ),
    "attitude_y": "the same about cam y, arcsec",
    "attitude_z": "the same about the boresight, arcsec",
    "latency": "from the buffer swap to the light of the first row, ms",
    "star_flux": (
        "flux, with what the codes lose, and the errors of the catalogue and of the spectrum, mag"
    ),
    "star_place_along": "the same as along x, with the catalogue's error, arcsec",
    "star_place_across": "the same as along y, with the catalogue's error, arcsec",
}
UNKNOWN = {
    "latency": ("latency",),
    "flux": ("flux", "star_flux"),
    "place and attitude": tuple(
        name for name in MEASURANDS if "place" in name or "attitude" in name
    ),
}
LIMITS = {
    "flux": "max_flux_mag",
    "place_along": "max_place_arcsec",
    "place_across": "max_place_arcsec",
    "attitude_x": "max_attitude_arcsec",
    "attitude_y": "max_attitude_arcsec",
    "attitude_z": "max_roll_arcsec",
    "latency": "max_latency_ms",
}


def certify(
    file: BenchFile,
    reader: Reader | None,
    now: datetime.datetime,
    *,
    quick: bool = False,
    warm_up: float | None = None,
    checked: dict[str, float] | None = None,
    replaces: str | None = None,
) -> tuple[Certificate, bytes | None]:
    """Certify a bench, by readings where there is a reader, else by its files; and the readings
    that checks refer to, as JSON.

    `warm_up` and `checked` are as in `assemble`. Raises InputError, MachineError.
    """
    if reader is None:
        read = None
    else:
        read = read_bench(file, reader)
    if reader is None:
        reference = None
    else:
        reference = msgspec.json.encode(take_check(file, reader))
    budget = assemble(file, read, warm_up, checked)
    combined = first_order(budget.model, budget.inputs)
    drawn = by_trials(
        budget.model,
        budget.inputs,
        np.random.default_rng(SEED),
        QUICK_TRIALS if quick else MAX_TRIALS,
    )
    truth = None
    if reader is not None and reader.truth is not None:
        truth = budget.figures.of(true_deviations(budget.figures, reader.truth))[0]
    figures = _figures(file, budget, combined, drawn, truth)
    judged = [figure.conforms for figure in figures if figure.conforms is not None]
    config = file.config
    settings = file.config.certify
    files = files_of(file)
    made = now.astimezone(datetime.UTC).isoformat(timespec="seconds")
    core = msgspec.json.encode([file.sha256, files, made, figures])
    settings_of = msgspec.to_builtins(config.collimator) | {"file": config.collimator.geometry}
    certificate = Certificate(
        kind=KIND,
        number=f"H{made[:10].replace('-', '')}-{sha256_of(core)[:8]}",
        made=made,
        valid_until=(
            now.astimezone(datetime.UTC).date() + datetime.timedelta(days=settings.valid_days)
        ).isoformat(),
        hilstar=__version__,
        bench=file.path.name,
        bench_sha256=file.sha256,
        files=files,
        monitor=_monitor(file, None if reader is None else reader.monitor),
        collimator={key: value for key, value in settings_of.items() if value is not None},
        read_by="nothing was read: by the calibration files" if reader is None else reader.identity,
        who=settings.who,
        where=settings.where,
        ambient=settings.ambient,
        traceability=settings.traceability,
        instrument=msgspec.to_builtins(settings.instrument) if settings.instrument.name else {},
        decision=settings.decision,
        conforms=all(judged) if judged else None,
        trials=drawn.trials,
        two_digits_stand=drawn.settled,
        inputs=[
            InputRow(
                name=figure.name,
                distribution=figure.distribution,
                standard_uncertainty=_rounded(figure.standard),
                unit=figure.unit,
                dof=figure.dof if math.isfinite(figure.dof) else None,
                source=figure.source,
            )
            for figure in budget.inputs
        ],
        figures=figures,
        not_assessed=[*budget.not_assessed, *_never_assessed(settings)],
        measurands=MEASURANDS,
        reference_sha256=None if reference is None else sha256_of(reference),
        replaces=replaces,
    )
    certificate = msgspec.structs.replace(certificate, cube=cube_to_boresight(file, certificate))
    return certificate, reference


def _never_assessed(settings: CertifySettings) -> list[str]:
    reasons = [
        "focus, stray light and the shape of stars: the figures are of their light and middle",
        "pixels that change each other's light: a star's is taken as the sum of its pixels, each as"
        " it is read among others of its code or of black",
    ]
    reasons += [
        f"{what} is not written in [certify]"
        for what in ("who", "where", "ambient", "traceability")
        if not getattr(settings, what)
    ]
    return reasons


def _figures(
    file: BenchFile,
    budget: Assembled,
    combined: Combined,
    drawn: BudgetTrials,
    truth: np.ndarray[Any, Any] | None,
) -> list[CertifiedFigure]:
    rows, settings = [], file.config.certify
    unknown = {reason.partition(":")[0] for reason in budget.not_assessed}
    missing = {name for key, names in UNKNOWN.items() if key in unknown for name in names}
    for number, (quantity, which, unit) in enumerate(budget.names):
        if quantity in missing:
            continue
        star = (
            budget.figures.stars[which]
            if quantity.removeprefix("star_") in ("flux", "place_along", "place_across")
            else None
        )
        field = (
            -1 - which if quantity.startswith("attitude") else None if star is None else star.field
        )
        region = (
            "screen"
            if quantity == "latency"
            else f"field {field}"
            if star is None
            else THIRDS[star.third]
        )
        standard = float(combined.standard[number])
        shares = combined.contribution[number]
        ranked = [k for k in np.argsort(-shares, kind="stable") if shares[k] > 0]
        key = LIMITS.get(quantity)
        limit = None if key is None else getattr(settings, key)
        why = why_they_differ(combined, drawn, budget.inputs, number)
        lower, upper = (drawn.lower, drawn.upper) if why else (combined.lower, combined.upper)
        value = float(combined.value[number])
        nominal = file.config.monitor.panel_delay_ms if quantity == "latency" else 0.0
        ends = (value,) if settings.decision == "simple" else (lower[number], upper[number])
        dof = float(combined.dof[number])
        rows.append(
            CertifiedFigure(
                quantity=quantity,
                region=region,
                star=None if star is None else star.hip,
                field=field,
                value=_rounded(value),
                standard_uncertainty=_rounded(standard),
                k=_rounded(float(combined.upper[number] - value) / standard) if standard else 0.0,
                lower=_rounded(float(lower[number])),
                upper=_rounded(float(upper[number])),
                unit=unit,
                dof=round(dof, 1) if dof < MAX_DOF else None,
                limit=limit,
                conforms=(
                    None if limit is None else all(abs(end - nominal) <= limit for end in ends)
                ),
                truth=(
                    _rounded(float(truth[number]))
                    if truth is not None and number < len(truth)
                    else None
                ),
                by_trials=ByTrials(
                    standard_uncertainty=_rounded(float(drawn.standard[number])),
                    lower=_rounded(float(drawn.lower[number])),
                    upper=_rounded(float(drawn.upper[number])),
                    differs=why,
                ),
                contributions=[
                    Contribution(
                        input=budget.inputs[k].name,
                        standard_uncertainty=_rounded(float(shares[k])),
                        share=round(float(shares[k] ** 2 / max(standard**2, 1e-300)), 4),
                    )
                    for k in ranked
                ],
            )
        )
    return rows


def _rounded(value: float) -> float:
    """A figure with DIGITS digits: more are noise in a file that people read."""
    return float(f"{value:.{DIGITS}g}")


def files_of(file: BenchFile) -> dict[str, str]:
    """The SHA-256 of a bench file and of each file that it names, by name."""
    config = file.config
    hashes = {file.path.name: sha256_of(file.text.encode())}
    named: list[str | float | None] = [
        config.monitor.calibration,
        config.collimator.geometry,
        config.tracker.distortion,
        config.tracker.optics.psf,
    ]
    named += [
        *config.tracker.quantum_efficiencies.values(),
        config.tracker.transmission,
        config.sky.catalogue,
    ]
    for name in named:
        if not isinstance(name, str) or name in BUILT_IN or not (file.folder / name).is_file():
            continue
        path = file.folder / name
        hashes[name] = sha256_of(read_bytes(path, "", MAX_FILE_BYTES))
        if path.suffix == ".toml":
            table = parse_toml(path, read_text(path, "", MAX_TOML_BYTES))
            for inner in (
                table.get("calibration", {}).get("response"),
                table.get("uniformity", {}).get("file"),
            ):
                if isinstance(inner, str) and (path.parent / inner).is_file():
                    hashes[str(Path(name).parent / inner)] = sha256_of(
                        read_bytes(path.parent / inner, "", MAX_FILE_BYTES)
                    )
    return hashes


def _monitor(file: BenchFile, now: MonitorIdentity | None) -> dict[str, Any]:
    """The monitor's mode by the bench file, and its identity: that which was read, else that of
    the calibration files.
    """
    monitor = file.config.monitor
    if now is not None:
        named = [now]
    else:
        named = [origin.identity for origin in measured_on(file) if origin.identity is not None]
    return {
        "resolution_px": list(monitor.resolution_px),
        "refresh_hz": monitor.refresh_hz,
        "calibration": monitor.calibration,
        "identity": named[0].known() if named else {},
    }
