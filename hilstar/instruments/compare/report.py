"""What `hilstar compare -o DIR` writes: a table of all stars, a chart of errors against magnitude,
and one page with both.
"""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilstar.basics.charts import (
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PURPLE,
    RED,
    SMALL_PT,
    capital,
    chart,
    title_lines,
    two_digits,
    write_csv,
)
from hilstar.basics.files import write_whole
from hilstar.basics.pages import (
    BAD,
    DASH,
    OK,
    WARN,
    Card,
    KeyFigure,
    Verdict,
    drawing_of,
    figures_of,
    list_of,
    page_of,
    paragraph,
)
from hilstar.basics.units import magnitude
from hilstar.instruments.compare.sky_comparison import SkyComparison, StarDifference, finding

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.text import Annotation
    from matplotlib.transforms import Bbox

PAGE_FILE = "compare.html"
MAX_LISTED = 40  # stars on the page; the table has all
COUNT_STATES = {True: WARN, False: OK}
COMMON_CURE = "Compare attitude, lens and full scale of the two first: they move or dim all stars."
MAX_NAMES = 6  # stars named in each panel; the table has all
MAX_TRIED = 60  # names that are tried for room
ROOM_PX = 3.0  # between two names
MIN_ERROR = 1e-8  # as drawn: a tenth of float32's rounding
STYLES = (
    ("same", ".", MUTED),
    ("changed", "o", RED),
    ("missing", "v", PURPLE),
    ("extra", "^", ORANGE),
)
COLUMNS = (
    *(
        "kind",
        "hip",
        "x_px",
        "y_px",
        "flux_e_per_s",
        "flux_error_mag",
        "dx_px",
        "dy_px",
        "centroid_error_px",
    ),
    # 1 where the star differs from what is common to all
    *("flux_limit_mag", "centroid_limit_px", "differs"),
)


def draw(path: Path, comparison: SkyComparison) -> Any:
    """Write the chart, and return its figure. Raises InputError where that fails."""
    title = finding(comparison)
    while title_lines(title).count("\n") > 1 and ";" in title:
        title = title.rpartition(";")[0]
    with chart(path, title, 2, height_inch=7.4) as axes:
        names: list[list[Annotation]] = []
        for axis, what, unit in ((axes[0], "flux error", "mag"), (axes[1], "place error", "px")):
            panel = ChartPanel(comparison, unit)
            panel.draw(axis)
            names.append(panel.name_stars(axis))
            less = " beyond what is common" if panel.common else ""
            axis.set(yscale="log", ylabel=f"{what}{less} [{unit}]")
            axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
        axes[1].set_xlabel("magnitudes below the brightest star [mag]")
        # Remove the names that overlap those of worse stars, and those that are too many.
        figure = axes[0].get_figure(root=True)
        if figure is not None:
            figure.draw_without_rendering()
        for texts in names:
            _keep_apart(texts)
    return axes[0].figure


def _keep_apart(texts: "list[Annotation]") -> None:
    """Remove names (worst star first) that overlap one before, or are more than MAX_NAMES."""
    boxes: list[Bbox] = []
    for text in texts:
        box = text.get_window_extent().padded(ROOM_PX)
        if len(boxes) == MAX_NAMES or any(box.overlaps(other) for other in boxes):
            text.remove()
        else:
            boxes.append(box)


class ChartPanel:
    """Errors and limits of one kind; stars that only one image has are in rows above."""

    def __init__(self, comparison: SkyComparison, unit: str) -> None:
        common = comparison.common
        self.unit = unit
        self.comparison = comparison
        self.stars = comparison.stars if common is None else common.beyond + common.alone
        self.worst = comparison.differing
        self.brightest = max(star.flux_e_per_s for star in comparison.stars)
        self.common = 0.0
        if unit == "mag":
            self.limit = comparison.limits.flux_mag
            if common is not None:
                self.common = abs(common.flux_mag)
        else:
            self.limit = comparison.limits.centroid_px
            if common is not None:
                self.common = math.hypot(*common.shift_px)
        highest = max(self.limit, self.common)
        for star in self.of("same", "changed"):
            _, error, star_limit = self.point(star)
            highest = max(highest, error, star_limit)
        self.row = 4 * highest
        self.rows = {"missing": self.row, "extra": 8 * self.row}

    def of(self, *kinds: str) -> list[StarDifference]:
        """The stars of these kinds that are drawn."""
        return [star for star in self.stars if star.kind in kinds]

    def point(self, star: StarDifference) -> tuple[float, float, float]:
        """Magnitudes below the brightest star, error, and the star's own limit."""
        mag = magnitude(star.flux_e_per_s / self.brightest)
        if self.unit == "mag":
            return mag, max(abs(star.flux_error_mag), MIN_ERROR), star.limits.flux_mag
        return mag, max(star.centroid_error_px, MIN_ERROR), star.limits.centroid_px

    def label(self, kind: str, drawn: int) -> str:
        """How many stars are of a kind. Missing and extra ones are all counted, as on the
        terminal and in the table.
        """
        count = len(self.comparison.of(kind)) if kind in self.rows else drawn
        label = f"{kind}: {count}"
        if count != drawn:
            label += f"\n({count - drawn} by what is common)"
        return label

    def draw(self, axis: "Axes") -> None:
        """Draw the stars, the limits and the legend."""
        for kind, marker, colour in STYLES:
            points = [self.point(star) for star in self.of(kind)]
            mags = [mag for mag, _, _ in points]
            if kind in self.rows:
                heights = [self.rows[kind]] * len(mags)
            else:
                heights = [error for _, error, _ in points]
            size = 5 if kind == "same" else 7
            label = self.label(kind, len(mags))
            axis.plot(mags, heights, marker, color=colour, ms=size, label=label)
        limit_label = f"limit: {self.limit:g} {self.unit}"
        axis.axhline(self.limit, color=INK, ls="--", lw=1.2, label=limit_label)
        if self.common:
            common_label = f"in common: {self.common:.3g} {self.unit}"
            axis.axhline(self.common, color=GREEN, lw=1.2, label=common_label)
        wide_mags = []
        wide_limits = []
        for star in self.of("same", "changed"):
            mag, _, star_limit = self.point(star)
            if star_limit > self.limit:
                wide_mags.append(mag)
                wide_limits.append(star_limit)
        if wide_mags:
            wide_label = f"a star's own limit: {len(wide_mags)}"
            axis.plot(wide_mags, wide_limits, "_", color=INK, ms=8, label=wide_label)
        axis.set_ylim(MIN_ERROR / 2, 300 * self.row)
        axis.set_xlim(right=axis.get_xlim()[1] + 0.5)

    def name_stars(self, axis: "Axes") -> "list[Annotation]":
        """Names of the worst stars. Missing and extra ones are named in the panel of flux alone."""
        names = []
        for star in self.worst:
            mag, error, star_limit = self.point(star)
            is_named = error > star_limit
            if star.kind in self.rows:
                is_named = self.unit == "mag"
            if is_named:
                name = star.name if star.hip else f"({star.x_px:.0f}, {star.y_px:.0f})"
                place = mag, self.rows.get(star.kind, error)
                text = axis.annotate(
                    name, place, xytext=(6, 5), textcoords="offset points", fontsize=SMALL_PT
                )
                names.append(text)
        return names[:MAX_TRIED]


def write_report(directory: Path, comparison: SkyComparison) -> None:
    """compare.csv, a row for each star; the chart compare, errors against magnitude, as PNG and
    SVG; and the page compare.html.

    Raises InputError where one cannot be written.
    """
    odd = {(star.hip, star.x_px, star.y_px) for star in comparison.differing}
    rows = []
    for star in comparison.stars:
        hips = " ".join(map(str, star.hip))
        differs = int((star.hip, star.x_px, star.y_px) in odd)
        rows.append(
            (
                *(star.kind, hips, star.x_px, star.y_px, star.flux_e_per_s),
                *(star.flux_error_mag, star.dx_px, star.dy_px, star.centroid_error_px),
                *(star.limits.flux_mag, star.limits.centroid_px, differs),
            )
        )
    write_csv(directory / "compare.csv", COLUMNS, rows)
    figure = draw(directory / "compare", comparison)
    parts = [figures_of(_figures(comparison))]
    parts += [card.html() for card in _cards(comparison, figure)]
    write_whole(directory / PAGE_FILE, page_of("Two skies compared", _verdict(comparison), parts))


def _verdict(comparison: SkyComparison) -> Verdict:
    _, _, how = finding(comparison).partition(": ")
    if comparison.same:
        return Verdict(OK, "The same sky", capital(how))
    return Verdict(BAD, "Not the same sky", capital(how))


def _figures(comparison: SkyComparison) -> Iterator[KeyFigure]:
    """How many stars there are, how far they are off at 95 %, and what only one image has."""
    limits = comparison.limits
    yield KeyFigure(str(comparison.star_count), "stars compared")
    flux = comparison.flux_error_mag.p95
    place = comparison.centroid_error_px.p95
    yield _error(flux, "mag", f"flux error at 95 %; limit {limits.flux_mag:g} mag")
    yield _error(place, "px", f"place error at 95 %; limit {limits.centroid_px:g} px")
    for kind in ("missing", "extra"):
        count = len(comparison.of(kind))
        yield KeyFigure(str(count), f"{kind} stars", COUNT_STATES[count > 0])


def _error(value: float | None, unit: str, of: str) -> KeyFigure:
    if value is None:
        return KeyFigure(DASH, of)
    return KeyFigure(f"{two_digits(value)} {unit}", of)


def _cards(comparison: SkyComparison, figure: Any) -> Iterator[Card]:
    """What all stars have in common, the chart, and the stars that differ."""
    common = comparison.common
    if common is not None:
        yield Card("In common", words=[paragraph(f"{capital(common.line())}.")], cure=COMMON_CURE)
    drawing = drawing_of(figure, "errors of light and place against magnitude")
    yield Card("Errors against magnitude", words=[drawing])
    differing = comparison.differing
    if differing:
        texts = [list_of(star.line() for star in differing[:MAX_LISTED])]
        if len(differing) > MAX_LISTED:
            texts.append(paragraph(f"{len(differing) - MAX_LISTED} more in compare.csv."))
        yield Card(f"{len(differing)} stars that differ, the worst first", words=texts)
