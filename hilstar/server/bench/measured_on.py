"""Whether a bench's calibration files are of the monitor that is there: another monitor, mode or
setting, or too old a file.
"""

import contextlib
import datetime
import logging
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec

from hilstar.basics.errors import MachineError
from hilstar.display.calibration import BUILT_IN, read_toml
from hilstar.display.geometry import load_notes
from hilstar.display.identity import MonitorIdentity, differences
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.certificate_file import bench_certificate

WAYS = "add --force, or measure it again: hilstar certify --again"
SHOWN_ANYWAY = "shown anyway (--force)"


@dataclass(frozen=True, slots=True)
class MeasuredOn:
    """What a calibration or geometry file says of its origin: the monitor, and the date; None
    for what it does not say.
    """

    name: str
    identity: MonitorIdentity | None = None
    date: datetime.date | None = None
    built_in: bool = False

    @property
    def lacks(self) -> str:
        """What the file does not say of its origin, in words; "" where it names both monitor and
        date.
        """
        if self.built_in:
            return f'[monitor] calibration = "{self.name}" is built in'
        lacking = []
        for what, stated in (("monitor", self.identity), ("date", self.date)):
            if stated is None:
                lacking.append(what)
        if lacking:
            return f"{self.name} names no {' and no '.join(lacking)}"
        return ""


@dataclass(frozen=True, slots=True)
class MonitorCheck:
    """The monitor that is there (None: not known), what is wrong with a bench's files for it,
    and what cannot be told.
    """

    now: MonitorIdentity | None
    fault: str = ""
    notice: str = ""

    def refuse(self, force: bool) -> None:
        """Raise MachineError for a fault, unless it is forced."""
        if self.fault and not force:
            raise MachineError(f"{self.fault}; {WAYS}")

    def told(self, log: logging.Logger) -> list[str]:
        """The forced fault, if there is one; it is logged, and the notice."""
        for line in filter(None, (self.fault and f"{self.fault}: {SHOWN_ANYWAY}", self.notice)):
            log.warning("%s", line)
        return [self.fault] * bool(self.fault)


def measured_on(file: BenchFile) -> Iterator[MeasuredOn]:
    """The origins of a bench's calibration and geometry files; a built-in curve has none. Raises
    InputError.
    """
    certificate = bench_certificate(file)
    # Whoever certified it by readings looked at that monitor; one made from the files alone would
    # make old files fresh.
    if (
        certificate is not None
        and certificate.reference_sha256
        and certificate.monitor.get("identity")
    ):
        identity = msgspec.convert(certificate.monitor["identity"], MonitorIdentity)
        yield MeasuredOn(f"certificate {certificate.number}", identity, _date(certificate.made))
        return
    calibration = file.config.monitor.calibration
    geometry = file.config.collimator.geometry
    if calibration in BUILT_IN:
        yield MeasuredOn(calibration, built_in=True)
    else:
        light = read_toml(file.folder / calibration)
        yield MeasuredOn(calibration, light.monitor_identity, _date(light.calibration.when))
    if geometry is not None:
        notes = load_notes(file.folder / geometry)
        yield MeasuredOn(geometry, notes.identity, _date(notes.made.when))


def check_monitor(
    file: BenchFile, now: MonitorIdentity | None, today: datetime.date
) -> MonitorCheck:
    """Compare a bench's files with the monitor that is there (None: not known), and their dates
    with `today`.

    Raises InputError for a file that cannot be read.
    """
    days = file.config.monitor.calibration_valid_days
    origins = list(measured_on(file))
    faults = []
    unknown = [origin.lacks for origin in origins if origin.lacks]
    doubts = []
    for origin in origins:
        if origin.identity is not None and now is not None:
            doubts.append(now.doubt)
            if origin.identity.brightness is not None and now.brightness is None:
                doubts.append("the monitor's own settings cannot be read now (DDC/CI)")
            changes = ", ".join(differences(origin.identity, now))
            if changes:
                faults.append(
                    f"{origin.name} was measured on {origin.identity.name()}, and this is"
                    f" {now.name()}: {changes}"
                )
        if origin.date is None:
            continue
        age_days = (today - origin.date).days
        if age_days > days:
            faults.append(
                f"{origin.name} was measured {age_days} days ago, on {origin.date}: [monitor]"
                f" calibration_valid_days = {days:g}"
            )
    if now is None:
        unknown = ["this display does not say which monitor it is"]
    if unknown:
        notice = [
            f"{'; '.join(unknown)}: whether this is the monitor that was measured is not known"
        ]
    else:
        notice = []
    # what two files have in common is said once
    lines = dict.fromkeys(filter(None, (*notice, *doubts)))
    return MonitorCheck(now, "; ".join(faults), "; ".join(lines))


def _date(when: str) -> datetime.date | None:
    """The date at the beginning of a text that a person may have written."""
    with contextlib.suppress(ValueError):
        return datetime.date.fromisoformat(when.strip()[:10])
    return None
