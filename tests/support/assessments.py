"""A whole assessment of a few answers, made of numbers that all differ: no run, no fit."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from hilstar.attitude.logs.telemetry import Telemetry
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.assess.assessment import (
    Acquisition,
    Assessment,
    Lock,
    Outage,
    RunLedger,
    WrongAnswer,
)
from hilstar.instruments.assess.bench_effects import DisplayCost, GlassCost, Slice
from hilstar.instruments.assess.budget import Axes, DecomposedRun, Intervals
from hilstar.instruments.assess.clock import ClockFit
from hilstar.instruments.assess.components import Component, Components
from hilstar.instruments.assess.figure_rows import FigureRow
from hilstar.instruments.assess.further import FurtherFigures
from hilstar.server.bench.certificate_file import CubeToBoresight
from hilstar.server.record.commanded import Commanded
from hilstar.server.record.commanded_run import CommandedRun
from hilstar.server.record.ledger_records import config_of
from tests.support.benches import bench_text
from tests.support.certificates import a_certificate

VALID = np.array([True, True, False, True, True, True, True, False, True, True, True, True])
RIGHT = np.array([0, 1, 2, 4, 6, 7, 8, 9])  # of the ten valid ones; 3 is wrong, 5 was held
T_S = 10.0 + 0.25 * np.arange(12) + 0.001 * np.arange(12) ** 2


def a_run() -> RunLedger:
    """The ledger of a run that missed 6 refresh periods in two holds."""
    text = bench_text({"tracker": {"resolution_px": [800, 600]}})
    head = {"bench_text": text, "bench_file": "bench.toml"}
    config = config_of(head)
    assert config is not None
    frames_s = np.arange(9.0, 14.0, 0.05)
    q = np.tile(from_radec_roll_deg(84.0, -1.2, 0.0), (len(frames_s), 1))
    held_s = np.array([[10.5, 10.6], [12.0, 12.25]])
    commanded = Commanded(frames_s, q, held_s, np.array([0.0625, 0.1875]))
    return RunLedger(Path("run.mcap"), head, config, CommandedRun(commanded, 0, 0, missed=6))


def some_components() -> Components:
    """Parts of eight residuals, three times as large about the boresight as along y, twice x."""
    rng = np.random.default_rng(5)
    sizes = np.array([1.0, 2.0, 6.0])
    of_field = sizes * rng.uniform(-1, 1, (8, 3))
    of_pixel = 0.3 * sizes * rng.uniform(-1, 1, (8, 3))
    left = 0.5 * sizes * rng.uniform(-1, 1, (8, 3))
    return Components(
        mean=np.zeros(3),
        fov=Component(sizes**2 / 3, of_field, 2.0, detail="what repeats over 99 px"),
        pixel=Component(sizes**2 / 33, of_pixel, 1.0, detail="the phase of a test"),
        noise_variance=np.array([0.25, 1.0, 9.0]),
        left=left,
        extent_px=300.0,
    )


def a_clock() -> ClockFit:
    """A clock 1.75 ms ahead at the run's start, and 12.5 ppm fast."""
    return ClockFit(
        offset_s=0.00125,
        drift=12.5e-6,
        sigma_offset_s=0.0001,
        sigma_drift=2e-6,
        sigma_bias_arcsec=np.ones(3),
        rotation=np.array([1.0, 0.0, 0.0, 0.0]),
        moments=None,  # type: ignore[arg-type]
        t_s=T_S[VALID],
        residual_arcsec=np.zeros((10, 3)),
        used=np.ones(10, dtype=bool),
        offset_told=True,
        drift_told=True,
    )


def a_budget() -> DecomposedRun:
    """A budget whose parts all differ, by eight answers that see a field of a degree."""
    q = [from_radec_roll_deg(84.0 + 0.1 * k, -1.2 + 0.01 * k**2, 0.0) for k in range(8)]
    return DecomposedRun(
        bias_arcsec=np.array([-3.0, 4.0, -11.0]),
        fov_arcsec=Axes(2.5, 7.5),
        pixel_arcsec=Axes(0.75, 1.25),
        noise_arcsec=Axes(0.875, 3.5),
        components=some_components(),
        intervals=Intervals(
            bias=np.array([[-3.5, 3.25, -13.0], [-2.5, 4.75, -9.0]]),
            fov=np.array([[2.0, 7.0], [3.25, 8.5]]),
            pixel=np.array([[0.5, 1.0], [1.0, 1.75]]),
            noise=np.array([[0.5, 2.5], [0.75, 3.25]]),
        ),
        row=RIGHT,
        wrong=np.array([3]),
        commanded_q=np.array(q),
        rate_rad_s=np.full((8, 3), 0.001),
        notes=(),
        clock=a_clock(),
        held=np.array([5]),
    )


def further_figures() -> FurtherFigures:
    """A figure of two axes, of which one is not told, one of none, and a share."""
    rows = [
        FigureRow("rate bias", "cross", 0.0125, "deg/s", 0.01, 0.016),
        FigureRow("rate bias", "roll", None, "deg/s"),
        FigureRow("stamp jitter", "", 0.0004, "s", 0.0003, None),
        FigureRow("rate scale", "cross", 0.02, "1", 0.01, 0.03),
    ]
    return FurtherFigures(rows, {"rate lag": "no acceleration", "rate bias": "too few turns"})


def an_assessment() -> Assessment:
    """The assessment of these; nothing in it was computed."""
    telemetry = Telemetry(
        Path("telemetry.csv"),
        np.round(1e9 * (T_S - 3.0)).astype(np.int64),
        np.tile([1.0, 0.0, 0.0, 0.0], (12, 1)),
        VALID,
        np.arange(12) + 2,
    )
    lock = Lock(
        cycle_s=0.25,
        due=16,
        right=9,
        availability=9 / 16,
        outages=(Outage(10.5, 0.625, False, 3, 1), Outage(11.75, 1.25, True, 5, 2)),
        acquisitions=(Acquisition(10.0, 0.125), Acquisition(11.5, None), Acquisition(12.0, 0.5)),
    )
    glass = {
        "total": Axes(5.5, 15.5),
        "without_distortion": Axes(4.5, 14.5),
        "without_colour": Axes(3.5, 13.5),
        "without_both": Axes(2.25, 12.5),
    }
    rms_px = {"total": 0.5, "without_distortion": 0.4, "without_colour": 0.3, "without_both": 0.2}
    boresight = (0.001, -0.002, 0.9999975)
    return Assessment(
        run=a_run(),
        telemetry=telemetry,
        found=a_budget(),
        noise_arcsec=Axes(0.625, 2.875),
        offset_s=0.00175,
        lock=lock,
        wrong=(WrongAnswer(6, 8.016, 11.016, 33.25),),
        display=DisplayCost(0.375, 1.125, 7, seen=0.8125, sigma_seen=0.125),
        limit_arcsec=Axes(0.3125, 1.0625),
        glass=GlassCost("PSF file", "window", 321, 40, rms_px, glass),
        by_rate=(
            Slice(0.125, 0.25, 21, 1.5, 2.5, 3.5, 4.5),
            Slice(0.25, 2, 22, 5.5, 6.5, 7.5, 8.5),
        ),
        by_magnitude=(Slice(3.25, 4.5, 43, 1.25, 2.25, 3.25, 4.25),),
        t_s=T_S,
        notes=("a note of a test",),
        certificate=a_certificate(),
        out_of_order=3,
        cube=CubeToBoresight(
            reference="cube 7",
            boresight=boresight,
            q_tracker_to_reference=(1.0, 0.0, 0.0, 0.0),
            cross_arcsec=4.25,
            roll_arcsec=9.75,
        ),
        further=further_figures(),
    )


def as_json(value: object) -> object:
    """What a reader of its JSON gets."""
    return msgspec.json.decode(msgspec.json.encode(value))
