"""What the charts of studies say, and that nothing of it is cut off or without a name."""

from __future__ import annotations

import pytest
from matplotlib.figure import Figure

from hilstar import charts
from hilstar.study.economy import Comparison, Outcome, economy_finding
from hilstar.study.speed import report as benchmark_report
from hilstar.study.speed.result import Machine, Result, Spread, Timing
from hilstar.tracker.centroiders import FAMILY
from hilstar.twin.budget import budget
from hilstar.twin.budget_report import write_report


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """The figures that are written, laid out."""
    kept: list[Figure] = []

    def keep(figure, path):
        figure.draw_without_rendering()
        kept.append(figure)

    monkeypatch.setattr(charts, "save", keep)
    monkeypatch.setattr(benchmark_report, "save", keep)
    return kept


def outcome(frame_ms: float, worst_mag: float = 0.01) -> Outcome:
    return Outcome("a scene", "auto", "round", 10, frame_ms, worst_mag, 0.01, 5, 0.1, *[0.01] * len(FAMILY))


@pytest.mark.parametrize(
    ("times_ms", "said"),
    [
        (((2.0, 1.0), (10.8, 2.0)), "is 2.0 to 5.4 times as fast as full effort, within tolerance"),
        (
            ((0.7, 1.0), (10.8, 2.0)),
            "is up to 5.4 times as fast in another, within tolerance",
        ),
        (((0.5, 1.0), (0.8, 1.0)), "takes 1.2 to 2.0 times as long as full effort, within tolerance"),
    ],
)
def test_economy_says_longer_where_it_took_longer(times_ms, said):
    comparisons = [Comparison(outcome(full), outcome(auto)) for full, auto in times_ms]
    assert economy_finding(comparisons).endswith(said)


def test_economy_does_not_call_within_tolerance_what_is_over_it():
    assert economy_finding([Comparison(outcome(2.0), outcome(1.0, 0.5))]).endswith("1 of 1 scenes OVER tolerance")


@pytest.mark.parametrize("sizes", [((1920, 1080),), ((640, 480), (1920, 1080))])
@pytest.mark.parametrize("methods", [("numpy",), ("numpy", "numba", "galsim", "photutils")])
def test_the_legend_of_the_benchmark_is_whole(figures, tmp_path, sizes, methods):
    ours = [("hilstar", kind) for kind in ("whole_frame", "turning", "linear_only")]
    kinds = [*ours, *((method, "linear_only") for method in methods)]
    rows = [
        Timing(w, h, stars, method, kind, Spread(median=1.0, min=0.9, max=1.2))
        for w, h in sizes
        for stars in (100, 1000)
        for method, kind in kinds
    ]
    machine = Machine(cpu="EPYC", cores=2, load=0.1, python="3.11", numpy="2.4")
    result = Result(machine, "llvmpipe (LLVM 15.0.6, 256 bits)", rows)
    benchmark_report.write(result, tmp_path)
    (figure,) = figures
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.width
    assert len(legend.get_texts()) == len(kinds)


def test_every_line_of_the_budget_has_a_name_that_is_whole(figures, bench_with, tmp_path):
    write_report(tmp_path, budget(bench_with()))
    (figure,) = figures
    for axis in figure.axes:
        assert all(not str(line.get_label()).startswith("_") for line in axis.get_lines())
        legend = axis.get_legend()
        assert legend is not None and len(legend.get_texts()) == len(axis.get_lines())
        assert legend.get_window_extent().x1 <= figure.bbox.width
