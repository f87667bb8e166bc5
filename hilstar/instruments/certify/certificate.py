"""From a budget to a certificate: figures with their intervals, conformity by the decision rule,
files, dates, its number.
"""

import datetime
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.reading import MAX_TOML_BYTES, parse_toml, read_bytes, read_text
from hilstar.basics.version import __version__
from hilstar.display.calibration import BUILT_IN
from hilstar.display.identity import MonitorIdentity, sha256_of
from hilstar.instruments.certify.assembly import Assembled, assemble, read_bench
from hilstar.instruments.certify.budget import (
    MAX_DOF,
    BudgetTrials,
    Combined,
    Input,
    by_trials,
    first_order,
    why_they_differ,
)
from hilstar.instruments.certify.check import take_check
from hilstar.instruments.certify.model import THIRDS, ReferenceStar, true_deviations
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
SMALLEST = 1e-300  # of all contributions together, so that none have no share
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
    read = reference = monitor = None
    read_by = "nothing was read: by the calibration files"
    if reader is not None:
        read = read_bench(file, reader)
        reference = msgspec.json.encode(take_check(file, reader))
        read_by = reader.identity
        monitor = reader.monitor
    budget = assemble(file, read, warm_up, checked)
    combined = first_order(budget.model, budget.inputs)
    max_trials = QUICK_TRIALS if quick else MAX_TRIALS
    drawn = by_trials(budget.model, budget.inputs, np.random.default_rng(SEED), max_trials)
    truth = None
    if reader is not None and reader.truth is not None:
        true = true_deviations(budget.figures, reader.truth)
        truth = budget.figures.of(true)[0]
    figures = list(_figures(file, budget, combined, drawn, truth))
    judged = [figure.conforms for figure in figures if figure.conforms is not None]
    settings = file.config.certify
    files = files_of(file)
    utc = now.astimezone(datetime.UTC)
    made = utc.isoformat(timespec="seconds")
    core = sha256_of(msgspec.json.encode([file.sha256, files, made, figures]))
    expires = utc.date() + datetime.timedelta(days=settings.valid_days)
    collimator = msgspec.to_builtins(file.config.collimator)
    collimator["file"] = file.config.collimator.geometry
    instrument = {}
    if settings.instrument.name:
        instrument = msgspec.to_builtins(settings.instrument)
    reference_sha256 = None
    if reference is not None:
        reference_sha256 = sha256_of(reference)
    conforms = None
    if judged:
        conforms = all(judged)
    certificate = Certificate(
        kind=KIND,
        number=f"H{made[:10].replace('-', '')}-{core[:8]}",
        made=made,
        valid_until=expires.isoformat(),
        hilstar=__version__,
        bench=file.path.name,
        bench_sha256=file.sha256,
        files=files,
        monitor=_monitor(file, monitor),
        collimator={key: value for key, value in collimator.items() if value is not None},
        read_by=read_by,
        who=settings.who,
        where=settings.where,
        ambient=settings.ambient,
        traceability=settings.traceability,
        instrument=instrument,
        decision=settings.decision,
        conforms=conforms,
        trials=drawn.trials,
        two_digits_stand=drawn.settled,
        inputs=[_input_row(budget_input) for budget_input in budget.inputs],
        figures=figures,
        not_assessed=[*budget.not_assessed, *_never_assessed(settings)],
        measurands=MEASURANDS,
        reference_sha256=reference_sha256,
        replaces=replaces,
    )
    certificate = msgspec.structs.replace(certificate, cube=cube_to_boresight(file, certificate))
    return certificate, reference


def _input_row(budget_input: Input) -> InputRow:
    """An input as the certificate has it."""
    dof = None
    if math.isfinite(budget_input.dof):
        dof = budget_input.dof
    return InputRow(
        name=budget_input.name,
        distribution=budget_input.distribution,
        standard_uncertainty=_rounded(budget_input.standard),
        unit=budget_input.unit,
        dof=dof,
        source=budget_input.source,
    )


def _never_assessed(settings: CertifySettings) -> list[str]:
    """What no certificate assesses, and what `[certify]` does not say."""
    reasons = [
        "focus, stray light and the shape of stars: the figures are of their light and middle"
    ]
    for key in ("who", "where", "ambient", "traceability"):
        if not getattr(settings, key):
            reasons.append(f"{key} is not written in [certify]")
    return reasons


def _figures(
    file: BenchFile,
    budget: Assembled,
    combined: Combined,
    drawn: BudgetTrials,
    truth: FloatArray | None,
) -> Iterator[CertifiedFigure]:
    """The figures that were assessed, each with the interval by first order, and by trials where
    the two differ; `truth` (figures,) is that of a virtual bench.
    """
    missing: set[str] = set()
    for reason in budget.not_assessed:
        missing.update(UNKNOWN.get(reason.partition(":")[0], ()))
    for number, (quantity, which, unit) in enumerate(budget.names):
        if quantity in missing:
            continue
        star, field, region = _place_of(budget.figures.stars, quantity, which)
        standard = float(combined.standard[number])
        why = why_they_differ(combined, drawn, budget.inputs, number)
        interval: Combined | BudgetTrials = combined
        if why:
            interval = drawn
        lower = float(interval.lower[number])
        upper = float(interval.upper[number])
        value = float(combined.value[number])
        k = 0.0
        if standard:
            k = float(combined.upper[number] - value) / standard
        dof = None
        if combined.dof[number] < MAX_DOF:
            dof = round(float(combined.dof[number]), 1)
        limit, conforms = _judged(file, quantity, value, (lower, upper))
        true = None
        if truth is not None and number < len(truth):
            true = _rounded(float(truth[number]))
        yield CertifiedFigure(
            quantity=quantity,
            region=region,
            star=star,
            field=field,
            value=_rounded(value),
            standard_uncertainty=_rounded(standard),
            k=_rounded(k),
            lower=_rounded(lower),
            upper=_rounded(upper),
            unit=unit,
            dof=dof,
            limit=limit,
            conforms=conforms,
            truth=true,
            by_trials=ByTrials(
                standard_uncertainty=_rounded(float(drawn.standard[number])),
                lower=_rounded(float(drawn.lower[number])),
                upper=_rounded(float(drawn.upper[number])),
                differs=why,
            ),
            contributions=_contributions(budget.inputs, combined.contribution[number]),
        )


def _place_of(
    stars: list[ReferenceStar], quantity: str, which: int
) -> tuple[int | None, int | None, str]:
    """The star (HIP), the field and the region of a figure."""
    if quantity == "latency":
        return None, None, "screen"
    if quantity.startswith("attitude"):
        field = -1 - which
        return None, field, f"field {field}"
    star = stars[which]
    return star.hip, star.field, THIRDS[star.third]


def _judged(
    file: BenchFile, quantity: str, value: float, interval: tuple[float, float]
) -> tuple[float | None, bool | None]:
    """The limit of a figure, and whether it conforms by the decision rule; None without a limit."""
    settings = file.config.certify
    limit: float | None = None
    if quantity in LIMITS:
        limit = getattr(settings, LIMITS[quantity])
    if limit is None:
        return None, None
    nominal = 0.0
    if quantity == "latency":
        nominal = file.config.monitor.panel_delay_ms
    ends: tuple[float, ...] = interval
    if settings.decision == "simple":
        ends = (value,)
    return limit, all(abs(end - nominal) <= limit for end in ends)


def _contributions(inputs: list[Input], shares: FloatArray) -> list[Contribution]:
    """What each input that counts contributes to a figure, the largest first."""
    total = max(float((shares**2).sum()), SMALLEST)
    contributions = []
    for k in np.argsort(-shares, kind="stable"):
        size = float(shares[k])
        if size > 0:
            contribution = Contribution(
                input=inputs[k].name,
                standard_uncertainty=_rounded(size),
                share=round(size**2 / total, 4),
            )
            contributions.append(contribution)
    return contributions


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
        *config.tracker.quantum_efficiencies.values(),
        config.tracker.transmission,
        config.sky.catalogue,
    ]
    for name in named:
        if not isinstance(name, str) or name in BUILT_IN:
            continue
        path = file.folder / name
        if not path.is_file():
            continue
        hashes[name] = sha256_of(read_bytes(path, "", MAX_FILE_BYTES))
        if path.suffix == ".toml":
            for inner in _named_in(path):
                data = read_bytes(path.parent / inner, "", MAX_FILE_BYTES)
                hashes[str(Path(name).parent / inner)] = sha256_of(data)
    return hashes


def _named_in(path: Path) -> Iterator[str]:
    """The files beside a calibration file that it names."""
    tables = parse_toml(path, read_text(path, "", MAX_TOML_BYTES))
    for table, key in (("calibration", "response"), ("uniformity", "file")):
        name = tables.get(table, {}).get(key)
        if isinstance(name, str) and (path.parent / name).is_file():
            yield name


def _monitor(file: BenchFile, now: MonitorIdentity | None) -> dict[str, Any]:
    """The monitor's mode by the bench file, and its identity: that which was read, else that of
    the calibration files.
    """
    monitor = file.config.monitor
    identity = now
    if identity is None:
        named = [origin.identity for origin in measured_on(file) if origin.identity is not None]
        identity = next(iter(named), None)
    return {
        "resolution_px": list(monitor.resolution_px),
        "refresh_hz": monitor.refresh_hz,
        "calibration": monitor.calibration,
        "identity": {} if identity is None else identity.known(),
    }
