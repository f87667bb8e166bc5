"""What the charts of studies say, and that nothing of it is cut off or without a name."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from hilstar.basics import charts
from hilstar.instruments.simulate.budget import (
    CENTROID_LIMIT_PX,
    FLUX_LIMITS_MAG,
    budget,
    write_report,
)
from hilstar.instruments.study.speed import report as benchmark_report
from hilstar.instruments.study.speed.report import Machine, MethodTiming, Result, TimeSpread
from hilstar.tracker.centroiders import FAMILY
from tests.support.figures import assert_legible, assert_title_is_drawn, two_lines


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """The figures that are written, laid out."""
    kept: list[Figure] = []

    def keep(figure, path):
        figure.draw_without_rendering()
        kept.append(figure)

    monkeypatch.setattr(charts, "save", keep)
    return kept


def test_the_looks_of_a_chart_are_looked_at():
    assert_legible(two_lines())


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda axes: axes.annotate(
                "here", (0.01, 0.5), xycoords="figure fraction", color=charts.INK
            ),
            "lies over",
        ),
        (
            lambda axes: axes.annotate("far", (0.99, 0.4), xycoords="figure fraction"),
            "leaves the canvas",
        ),
        (lambda axes: axes.text(2, 100, "small", fontsize=7), "px high"),
        (lambda axes: axes.plot([1, 2], [3, 4], color=charts.RED), "nothing names"),
        (
            lambda axes: (
                axes.plot([1, 2], [3, 4], color="C0", label="red") and axes.legend(loc="lower left")
            ),
            "under the legend",
        ),
        (lambda axes: axes.set_ylim(1, 100), "leaves its axes"),
        (
            lambda axes: (
                axes.plot([1, 2], [3, 4], color="tab:red", label="a red") and axes.legend()
            ),
            "has no dark one",
        ),
        (lambda axes: axes.figure.suptitle("a\nb\nc"), "a\nb"),
    ],
)
def test_what_is_wrong_with_a_chart_is_seen(spoil, said):
    with pytest.raises(AssertionError, match=said):
        assert_legible(two_lines(spoil))


def test_a_title_with_a_figure_that_is_not_drawn_is_seen():
    """As `choices` once told 0.16 mag of one line beside another line at 0.31."""
    for title, is_drawn in (
        ("The line is at 0.31 mag, within 4.2·10⁻⁸", True),
        ("The line is at 0.16 mag", False),
    ):
        with charts.panels_of(title) as (axes,):
            axes.plot([1, 2], [0.3082, 0.3079], color=charts.BLUE, label="a line")
            charts.label_ends(axes)
        if is_drawn:
            assert_title_is_drawn(axes.figure, "planted")
        else:
            with pytest.raises(AssertionError, match=r"0\.16 of the title"):
                assert_title_is_drawn(axes.figure, "planted")


@pytest.mark.parametrize("sizes", [((1920, 1080),), ((640, 480), (1920, 1080))])
@pytest.mark.parametrize("methods", [("numpy",), ("numpy", "numba", "galsim", "photutils")])
def test_the_legend_of_the_benchmark_is_whole(figures, tmp_path, sizes, methods):
    ours = [("hilstar", kind) for kind in ("whole_frame", "turning", "linear_only")]
    kinds = [*ours, *((method, "linear_only") for method in methods)]
    rows = [
        MethodTiming(w, h, stars, method, kind, TimeSpread(median=1.0, min=0.9, max=1.2))
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


def test_every_line_of_the_budget_has_a_name_where_it_ends(figures, bench_with, tmp_path):
    write_report(tmp_path, budget(bench_with()))
    (figure,) = figures
    assert_legible(figure)
    for axis in figure.axes:
        named = [
            str(line.get_label())
            for line in axis.get_lines()
            if not str(line.get_label()).startswith("_")
        ]
        assert sorted(text.get_text() for text in axis.texts) == sorted(named)
    note = " ".join(figure.get_supxlabel().split())
    flux, place, each = figure.axes
    clips, nothing = (line.get_xdata()[0] for line in flux.get_lines()[-2:])
    assert clips < nothing
    assert f"first grey line stars clip (V = {clips:.2f})" in note
    assert f"they show nothing (V = {nothing:.2f})" in note
    for axis, limits in ((flux, FLUX_LIMITS_MAG), (place, (CENTROID_LIMIT_PX,))):
        drawn = {str(line.get_label()): np.asarray(line.get_ydata()) for line in axis.get_lines()}
        assert (np.diff(drawn["largest to V"]) >= 0).all() and (
            drawn["largest to V"] >= drawn["rms"]
        ).all()
        assert sum(name.startswith("limit") for name in drawn) == len(limits)
    assert {text.get_text() for text in each.texts} == set(FAMILY)
