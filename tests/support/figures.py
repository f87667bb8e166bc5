"""What every chart has to be, whatever its data: read at the width of its page, with nothing
over anything else.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from hilstar.basics import charts

PAGE_PX = 700  # the narrowest column of the documentation that a figure is read in
MIN_TEXT_PX = 11.0  # at that width
MAX_TITLE_LINES = 2
TOUCH_PX = 1.5  # boxes are whole pixels of a hinted font: this much is no overlap
# A figure of a title that stands alone: no part of a name, no power of ten.
TITLE_FIGURE = re.compile(r"(?<![\w.\-·⁻])\d+(?:\.\d+)?(?![\w·⁻]|-\d|\.\d)")
# Charts whose titles have figures that are found from what is drawn and not drawn themselves, and
# how.
DERIVED = {
    "economy": "the ratio of two bars",
    "prediction_jitter": "where two lines cross, and the largest ratio of two",
    "weak_perspective": "between two points of a line, and a ratio of two",
    "passbands": "table 2.5 beside the spectrum that is drawn",
    "turns": "half a turn",
    "rapp_ccd47-20": "a point of a line",
    "tradeoff_smear": "a count in a method's name",
    "lyra": "the thesis's figures, by number",
    "rosetta": "the thesis's figures, by number",
    "orion": "the thesis's figures, by number",
    "lyra_as_published": "the thesis's figures, by number",
    "rosetta_as_published": "the thesis's figures, by number",
    "orion_as_published": "the thesis's figures, by number",
    "frames": "a count of stars, each a point",
    "confront": "the limit of the stars that count",
}
# a share is told in percent, a second in ms, electrons in millions
DRAWN_AS = (1.0, 1e2, 1e3, 1e-6)
# of axes and of what a text beside it names
PLAIN = {charts.INK, charts.MUTED, charts.GRID, charts.PAPER}


def two_lines(spoil: Callable[[Axes], object] = lambda axes: None) -> Figure:
    """A chart that is as it should be, after what a test does to it."""
    with charts.panels_of("One line is twice the other", note="Of nothing.") as (axes,):
        for name, k in (("once", 1), ("twice", 2)):
            axes.plot([1, 10, 100], [k, 10 * k, 100 * k], label=name)
        axes.set(xscale="log", yscale="log", xlabel="time [s]", ylabel="place [m]")
        charts.label_ends(axes)
        spoil(axes)
    return axes.figure


def assert_legible(figure: Figure, *, drawn: bool = False) -> None:
    """No text overlaps another, leaves the canvas or is small; no curve leaves its axes or lies
    under a legend.

    `drawn`: at the figure's own resolution, so that its texts are where they belong.
    """
    if not drawn:
        figure.draw_without_rendering()
    assert figure.get_suptitle(), "a chart has no finding"
    assert len(figure.get_suptitle().splitlines()) <= MAX_TITLE_LINES, figure.get_suptitle()
    texts = [(text, box(text)) for text in seen(figure)]
    for text, extent in texts:
        words, inside = text.get_text(), Bbox.from_bounds(*figure.bbox.bounds).padded(TOUCH_PX)
        assert inside.containsx(extent.x0) and inside.containsx(extent.x1), (
            f"{words!r} leaves the canvas"
        )
        assert inside.containsy(extent.y0) and inside.containsy(extent.y1), (
            f"{words!r} leaves the canvas"
        )
        size_px = text.get_fontsize() / 72 * PAGE_PX / figure.get_figwidth()
        assert size_px >= MIN_TEXT_PX, f"{words!r} is {size_px:.1f} px high"
        assert not re.search(r"\de[+-]\d\d", words), f"{words!r} is a computer's figure"
    for (one, a), (other, b) in itertools.combinations(texts, 2):
        assert not touch(a, b), f"{one.get_text()!r} lies over {other.get_text()!r}"
    named = named_colours(figure, [text for text, _ in texts])
    for axes in figure.axes:
        assert_capital(axes)
        assert_lines(axes, named)


def assert_title_is_drawn(figure: Figure, stem: str) -> None:
    """Each figure of a title stands in the chart: as a word, or as a value that is drawn,
    rounded as the title rounds it.
    """
    if stem in DERIVED:
        return
    title = figure.get_suptitle()
    words = " ".join(text.get_text() for text in seen(figure) if text.get_text() != title)
    values = np.abs(drawn_values(figure))
    for match in TITLE_FIGURE.finditer(title):
        figure_words = match[0]
        if re.search(rf"(?<![\d.]){re.escape(figure_words)}(?!\d|\.\d)", words):
            continue
        half_digit = 0.505 * 10.0 ** -len(figure_words.partition(".")[2])
        off = min(
            float(np.abs(values * scale - float(figure_words)).min(initial=np.inf))
            for scale in DRAWN_AS
        )
        assert off <= half_digit, f"{stem}: {figure_words} of the title {title!r} is not drawn"


def drawn_values(figure: Figure) -> np.ndarray:
    """Every finite number that a figure draws: of lines, bars and areas."""
    values: list[np.ndarray] = [np.zeros(0)]
    for axes in figure.axes:
        values += [np.asarray(line.get_xydata(), dtype=float).ravel() for line in axes.get_lines()]
        values += [
            np.array([patch.get_height(), patch.get_width()])
            for patch in axes.patches
            if hasattr(patch, "get_height")
        ]
        values += [
            path.vertices.ravel()
            for collection in axes.collections
            for path in collection.get_paths()
        ]
    every = np.concatenate(values)
    return every[np.isfinite(every)]


def seen(figure: Figure) -> Iterator[Text]:
    """Every text that is drawn."""
    spare = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            drawn = axis._update_ticks()  # matplotlib keeps ticks that it does not draw now
            for tick in (*axis.majorTicks, *axis.minorTicks):
                if tick not in drawn or not axes.axison:
                    spare |= {tick.label1, tick.label2}
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and text not in spare:
            yield text  # type: ignore[misc]


def box(text: Text) -> Bbox:
    """The box of a text alone, without its arrow."""
    return Text.get_window_extent(text)


def touch(a: Bbox, b: Bbox) -> bool:
    """Whether two boxes lie over each other."""
    return (
        min(a.x1, b.x1) - max(a.x0, b.x0) > TOUCH_PX
        and min(a.y1, b.y1) - max(a.y0, b.y0) > TOUCH_PX
    )


def assert_capital(axes: Axes) -> None:
    """Titles and labels begin alike."""
    for words in (
        axes.get_xlabel(),
        axes.get_ylabel(),
        axes.get_title(loc="left"),
        axes.get_title(),
    ):
        assert words == charts.capital(words), words


def named_colours(figure: Figure, texts: list[Text]) -> set[str]:
    """Colours that a text has, or a legend names."""
    found = {to_hex(text.get_color()) for text in texts}
    for legend in legends(figure):
        found |= {
            to_hex(colour) for handle in legend.legend_handles for colour in handle_colours(handle)
        }
    return found


def legends(figure: Figure) -> list:
    """Every legend, of the figure and of its axes."""
    return [
        *figure.legends,
        *(axes.get_legend() for axes in figure.axes if axes.get_legend() is not None),
    ]


def handle_colours(handle) -> Iterator:
    """The colours of one entry of a legend."""
    for name in ("get_color", "get_facecolor", "get_edgecolor", "get_markeredgecolor"):
        if hasattr(handle, name):
            colour = getattr(handle, name)()
            yield from colour if isinstance(colour, np.ndarray) and colour.ndim == 2 else [colour]


def assert_lines(axes: Axes, named: set[str]) -> None:
    """Each line in view, and of a colour that something names; no legend over one."""
    legend = axes.get_legend()
    over = None if legend is None else legend.get_window_extent()
    for line in axes.get_lines():
        x_is_data, y_is_data = line.get_transform().contains_branch_seperately(axes.transData)
        drawn = line.get_transform().transform(np.asarray(line.get_xydata(), dtype=float))
        drawn = drawn[np.isfinite(drawn).all(axis=1)]
        if not len(drawn) or not line.get_visible():
            continue
        colour = to_hex(line.get_color())
        assert colour in PLAIN or colour in named, (
            f"nothing names the line {line.get_label()!r} in {colour}"
        )
        assert line.get_label() == "" or colour in charts.DARK, (
            f"{line.get_label()!r} has the colour {colour}, which has no dark one"
        )
        if x_is_data and y_is_data and line.get_gid() != "cut":
            low, high = axes.bbox.y0 - TOUCH_PX, axes.bbox.y1 + TOUCH_PX
            assert (drawn[:, 1] >= low).all() and (drawn[:, 1] <= high).all(), (
                f"{line.get_label()!r} leaves its axes"
            )
        if over is not None:
            steps = np.linspace(0, 1, 50)[:, None]
            if line.get_linestyle() not in ("None", "none", "") and len(drawn) < 500:
                drawn = np.concatenate(
                    [a + steps * (b - a) for a, b in itertools.pairwise(drawn)] or [drawn]
                )
            inside = (drawn > [over.x0, over.y0]).all(axis=1) & (drawn < [over.x1, over.y1]).all(
                axis=1
            )
            assert not inside.any(), f"{line.get_label()!r} lies under the legend"
