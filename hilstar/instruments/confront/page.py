"""The page of a confrontation: each photograph, its prediction and residual to blink between,
and charts; one file.
"""

import base64
import io
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, INK, MUTED, ORANGE, panels_of
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
    escaped,
    figures_of,
    list_of,
    page_of,
    paragraph,
    table_of,
)
from hilstar.instruments.confront.excess import Excess
from hilstar.instruments.confront.judge import (
    LISTED_SNR,
    NOT_COUNTED,
    StarRow,
)
from hilstar.instruments.confront.judge import Verdict as PhotoVerdict
from hilstar.instruments.confront.light import BRIGHT_V_MAG
from hilstar.instruments.confront.report import Confronted
from hilstar.instruments.confront.session import Session
from hilstar.sky.catalog import label_of

MAX_SIDE_PX = 1200
# Sigmas of the background between which a picture's greys lie: the sky's noise is nearly black.
BLACK, WHITE = 2.0, 30.0
RESIDUAL = 5.0
JPEG_QUALITY = 82
MAX_ROWS = 40
MAX_NAMED = 12  # of the brightest stars, by which a reader finds his way
NAME_SIZE = 55  # a picture's width over the height of its names
GRID, TILE_PER_PX, TILE_HALF_PX = 5, 8, 3
VIEWS = ("photograph", "prediction", "residual")
STYLE, SCRIPT = (Path(__file__).with_suffix(ending) for ending in (".css", ".js"))


@dataclass(frozen=True, slots=True)
class Pictures:
    """A photograph, its prediction and its residual as JPEG, and the map of squared residuals
    (rows, columns).
    """

    views: tuple[bytes, ...]
    chi2_map: FloatArray


def page_pictures(session: Session, verdict: PhotoVerdict) -> Pictures:
    """The pictures of a verdict, before its arrays are dropped."""
    shot = verdict.shot
    noise = np.sqrt(session.pixels.variance_dn2(shot.level.level))
    in_sigmas = [(part - shot.level.level) / noise for part in (shot.photo.dn, verdict.predicted)]
    top = math.asinh(WHITE)
    greys = []
    for part in in_sigmas:
        above = np.clip(brightest(part, MAX_SIDE_PX) - BLACK, 0, None)
        greys.append(255 * np.clip(np.arcsinh(above) / top, 0, 1))
    greys.append(255 * np.clip(verdict.residual / (2 * RESIDUAL) + 0.5, 0, 1))
    height, width = verdict.residual.shape
    rows = np.linspace(0, height, 13).astype(int)
    columns = np.linspace(0, width, 17).astype(int)
    clipped = np.minimum(verdict.residual**2, 25.0)
    sums = np.add.reduceat(np.add.reduceat(clipped, rows[:-1], axis=0), columns[:-1], axis=1)
    return Pictures(
        tuple(_jpeg(grey) for grey in greys), sums / np.outer(np.diff(rows), np.diff(columns))
    )


def brightest(image: FloatArray, max_side_px: int) -> FloatArray:
    """An image (h, w) made smaller by a whole factor, until it fits: each point is the brightest
    of its pixels, for a mean would lose the stars.
    """
    factor = math.ceil(max(image.shape) / max_side_px)
    if factor == 1:
        return image
    edges = [np.arange(0, size, factor) for size in image.shape]
    rows = np.maximum.reduceat(image, edges[0], axis=0)
    return np.asarray(np.maximum.reduceat(rows, edges[1], axis=1))


def _jpeg(grey: FloatArray) -> bytes:
    from PIL import Image

    picture = Image.fromarray(np.rint(grey).astype(np.uint8))
    if max(picture.size) > MAX_SIDE_PX:
        picture.thumbnail((MAX_SIDE_PX, MAX_SIDE_PX), Image.Resampling.BOX)
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=JPEG_QUALITY)
    return data.getvalue()


def write_page(path: Path, found: Confronted, pictures: Sequence[Pictures]) -> None:
    """Write the page, which needs no other file. Raises InputError where it cannot be written."""
    parts = [f"<style>{STYLE.read_text()}</style>", figures_of(_figures(found.verdicts))]
    parts += [card.html() for card in _cards(found, pictures)]
    title = "Photographs against the simulator"
    write_whole(path, page_of(title, _verdict(found), parts, SCRIPT.read_text()))


def _verdict(found: Confronted) -> Verdict:
    camera = "Its camera was fitted to them."
    if found.session.fixed:
        camera = "Its camera was not fitted to them."
    if found.failures:
        return Verdict(BAD, "Beyond the limits", f"{'; '.join(found.failures)}. {camera}")
    return Verdict(OK, "The simulator explains these photographs", camera)


def _figures(verdicts: Sequence[PhotoVerdict]) -> Iterator[KeyFigure]:
    """Stars, how far they are off, and what is missing on either side; of all photographs."""
    counted = sum(verdict.counted for verdict in verdicts)
    yield KeyFigure(str(counted), f"stars to V = {BRIGHT_V_MAG:g}")
    yield KeyFigure(f"{_worst(verdict.rms_px for verdict in verdicts)} px", "rms off their places")
    yield KeyFigure(f"{_worst(verdict.rms_mag for verdict in verdicts)} mag", "rms off their light")
    yield _count(
        sum(len(verdict.unexplained) for verdict in verdicts), "sources that nothing explains"
    )
    yield _count(sum(len(verdict.missing) for verdict in verdicts), "stars that are missing")


def _worst(values: Iterable[float]) -> str:
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return DASH
    return f"{max(known):.2g}"


def _count(count: int, of: str) -> KeyFigure:
    if count:
        return KeyFigure(str(count), of, WARN)
    return KeyFigure("0", of, OK)


def _cards(found: Confronted, pictures: Sequence[Pictures]) -> Iterator[Card]:
    """The photographs with their stars, the charts, what is odd; then how it was found."""
    for verdict, views in zip(found.verdicts, pictures, strict=True):
        yield Card(verdict.shot.photo.name, words=[_frame(verdict, views)])
    for title, chart in _charts(found, pictures):
        yield Card(title, words=[chart])
    yield from _lists(found.verdicts)
    if found.excess is not None:
        yield _excess(found.excess)
    yield Card("Each photograph", words=[_summary(found.verdicts)])
    yield Card("What was fitted", words=[list_of(found.lines)])
    if found.notes:
        yield Card("Notes", words=[list_of(found.notes)])


def _excess(excess: Excess) -> Card:
    """What the scatter is made of."""
    texts = []
    for unit, whole, parts in (
        ("mag", excess.rms_mag, excess.light),
        ("px", excess.rms_px, excess.places),
    ):
        rows: list[tuple[object, ...]] = [("all", whole, "")]
        for part in parts:
            rms = None
            if math.isfinite(part.rms):
                rms = part.rms
            rows.append((part.name, rms, part.how))
        texts.append(table_of(rows, ("part", f"rms, {unit}", "how it is told apart"), 3))
    return Card("What the scatter is made of", words=texts)


def _summary(verdicts: Sequence[PhotoVerdict]) -> str:
    header = (
        "photograph",
        f"stars to V = {BRIGHT_V_MAG:g}",
        "rms, px",
        "rms, mag",
        "background chi²",
        "star chi²",
        "unexplained",
        "missing",
    )
    rows = []
    for verdict in verdicts:
        chi2 = (verdict.background_chi2, verdict.star_chi2)
        counts = (len(verdict.unexplained), len(verdict.missing))
        rms = (verdict.rms_px, verdict.rms_mag)
        rows.append((verdict.shot.photo.name, verdict.counted, *rms, *chi2, *counts))
    return table_of(rows, header, 3)


def _frame(verdict: PhotoVerdict, pictures: Pictures) -> str:
    """A photograph, its prediction and residual, with marks and names."""
    height, width = verdict.shot.photo.dn.shape
    marks = [_name(row, width) for row in _brightest(verdict)]
    for source in verdict.unexplained:
        corner = f'x="{source.x_px - 9:.0f}" y="{source.y_px - 9:.0f}"'
        marks.append(f'<rect {corner} width="18" height="18" stroke="#ff9e5e"/>')
    for row in verdict.missing:
        middle = f'cx="{row.x_predicted_px:.0f}" cy="{row.y_predicted_px:.0f}"'
        marks.append(f'<circle {middle} r="10" stroke="#6cb6ff"/>')
    view = f'viewBox="-0.5 -0.5 {width} {height}" fill="none" stroke-width="1.5"'
    over = f'<svg {view} aria-hidden="true">{"".join(marks)}</svg>'
    images = "".join(
        f'<img alt="{name} of {escaped(verdict.shot.photo.name)}"'
        f' src="data:image/jpeg;base64,{base64.b64encode(data).decode()}">'
        for name, data in zip(VIEWS, pictures.views, strict=True)
    )
    names = (*VIEWS, "blink", "side by side")
    buttons = "".join(f'<button type="button">{name}</button> ' for name in names)
    note = paragraph(
        f"Names: the {MAX_NAMED} brightest stars. Squares: sources over {LISTED_SNR:g} sigmas that"
        f" nothing explains. Circles: stars that are missing. Black is {BLACK:g} sigmas"
        f" above the sky, white {WHITE:g} more; of the residual -{RESIDUAL:g} and +{RESIDUAL:g}"
        " sigmas. In a smaller picture each point is the brightest of its pixels.",
        "small",
    )
    views = f'<div class="views">{images}{over}</div>'
    return f'<div class="frame"><p role="group" aria-label="View">{buttons}</p>{views}</div>{note}'


def _brightest(verdict: PhotoVerdict) -> list[StarRow]:
    """The brightest stars that were seen."""
    visible = [row for row in verdict.stars if row.dn > 0]
    return sorted(visible, key=lambda row: row.v_mag)[:MAX_NAMED]


def _name(row: StarRow, width: int) -> str:
    """A star's name beside it; at the left where there is no room at the right."""
    size = width / NAME_SIZE
    x = row.x_px + size
    anchor = "start"
    if row.x_px > 0.85 * width:
        x = row.x_px - size
        anchor = "end"
    place = f'x="{x:.0f}" y="{row.y_px + size / 3:.0f}" font-size="{size:.1f}"'
    name = label_of(row.hip) or row.name
    return f'<text {place} text-anchor="{anchor}" fill="#ffd24a">{escaped(name)}</text>'


def _charts(found: Confronted, pictures: Sequence[Pictures]) -> list[tuple[str, str]]:
    rows = [
        row
        for verdict in found.verdicts
        for row in verdict.stars
        if row.dn > 0 and row.dn_predicted > 0
    ]
    good = [row for row in rows if not NOT_COUNTED & set(row.flags)]
    if good:
        charts = [("Flux and colour", _flux(found, good))]
    else:
        charts = []
    if good:
        charts.append(("Places", _places(good)))
    charts.append(("Point spread function", _psf_grid(found.session)))
    if len(found.session.pixels.points):
        charts.append(("Photon transfer", _transfer(found.session)))
    charts.append(("Squared residuals over the field", _chi2_maps(found.verdicts, pictures)))
    return charts


def _flux(found: Confronted, rows: Sequence[Any]) -> str:
    v, bv, dn, off = (
        np.array([getattr(row, name) for row in rows])
        for name in ("v_mag", "b_v_mag", "dn", "off_mag")
    )
    light = found.session.light
    counted = np.array([row.counted for row in rows])
    if counted.any():
        rms = math.sqrt(float((off[counted] ** 2).mean()))
    else:
        rms = math.nan
    finding = f"Stars to V = 6.5 are {rms:.3f} mag rms off their prediction"
    note = (
        "Stars that stand alone and are not saturated. Filled: to V = 6.5. Off: seen less"
        " predicted, up where too faint."
    )
    with panels_of(finding, 1, 3, share_x=False, note=note, height_inch=3.9) as panels:
        for axes, x, y, names in (
            (panels[0], v, -2.5 * np.log10(dn), ("V [mag]", "-2.5 log10 DN")),
            (panels[1], v, off, ("V [mag]", "off [mag]")),
            (panels[2], bv, off, ("B-V [mag]", "off [mag]")),
        ):
            axes.plot(
                x[~counted], y[~counted], "o", ms=2.5, mfc="none", color=MUTED, rasterized=True
            )
            axes.plot(x[counted], y[counted], "o", ms=3.5, color=BLUE)
            axes.set(xlabel=names[0], ylabel=names[1])
        for axes in panels[1:]:
            axes.axhline(0, color=INK, lw=1)
            axes.set_ylim(-1, 1)
        if math.isfinite(light.zero_point_mag):
            line = np.array([v.min(), v.max()])
            panels[0].plot(
                line,
                line - light.zero_point_mag + light.colour_term * float(np.nanmedian(bv)),
                color=ORANGE,
                lw=1.2,
            )
    return drawing_of(
        panels[0].figure, "flux against V, and what is left of it against V and colour"
    )


def _places(rows: Sequence[Any]) -> str:
    some = [row for row in rows if row.dn > 20 * row.sigma_dn]
    x, y = (
        np.array([getattr(row, name) for row in some])
        for name in ("x_predicted_px", "y_predicted_px")
    )
    dx = np.array([row.x_px - row.x_predicted_px for row in some])
    dy = np.array([row.y_px - row.y_predicted_px for row in some])
    if some:
        rms = math.sqrt(float((dx**2 + dy**2).mean() / 2))
    else:
        rms = math.nan
    with panels_of(
        f"Stars of 20 sigmas and more are {rms:.3f} px rms an axis off their places",
        height_inch=4.6,
    ) as panels:
        axes = panels[0]
        arrows = axes.quiver(
            x, y, dx, dy, angles="xy", color=BLUE, width=0.003, scale=2.0, scale_units="width"
        )
        axes.quiverkey(arrows, 0.86, 0.04, 0.1, "0.1 px", labelpos="E")
        axes.set(xlabel="x [px]", ylabel="y [px]", aspect="equal")
        axes.invert_yaxis()
    return drawing_of(panels[0].figure, "places seen less predicted over the field")


def _psf_grid(session: Session) -> str:
    psf = session.psf
    width, height = psf.size_px
    places = [
        (x, y) for y in np.linspace(0, height - 1, GRID) for x in np.linspace(0, width - 1, GRID)
    ]
    fwhm = psf.fwhm_px(*np.array(places).T)
    finding = f"Full width at half maximum {fwhm.min():.2f} to {fwhm.max():.2f} px, pixel included"
    tiles = np.array([np.sqrt(psf.samples(x, y, TILE_PER_PX, TILE_HALF_PX)) for x, y in places])
    side = tiles.shape[-1]
    mosaic = tiles.reshape(GRID, GRID, side, side).swapaxes(1, 2).reshape(GRID * side, GRID * side)
    with panels_of(
        finding,
        note="Width and height of each tile: 6 px. Numbers: place and width, px.",
        height_inch=6.6,
    ) as panels:
        axes = panels[0]  # one picture: 25 panels of their own take a second
        axes.imshow(mosaic, cmap="gray_r", extent=(0, GRID, GRID, 0))
        for number, ((x, y), wide) in enumerate(zip(places, fwhm, strict=True)):
            axes.text(
                number % GRID + 0.03,
                number // GRID + 0.97,
                f"{x:.0f}, {y:.0f}: {wide:.2f}",
                fontsize=7,
                color=MUTED,
            )
        axes.set_xticks(range(GRID + 1), [""] * (GRID + 1))
        axes.set_yticks(range(GRID + 1), [""] * (GRID + 1))
    return drawing_of(panels[0].figure, "point spread functions over the field")


def _transfer(session: Session) -> str:
    pixels = session.pixels
    level, variance = pixels.points.T
    finding = (
        f"{pixels.gain_words}, {pixels.read_noise_e:.2f} e- of read noise at"
        f" {pixels.pedestal_dn:.0f} DN"
    )
    with panels_of(finding, height_inch=3.8) as panels:
        axes = panels[0]
        axes.plot(level, variance, ".", ms=2.5, color=MUTED, rasterized=True)
        line = np.array([min(pixels.pedestal_dn, level.min()), level.max()])
        axes.plot(line, pixels.variance_dn2(line), color=ORANGE)
        axes.set(xlabel="background level [DN]", ylabel="variance between neighbours [DN²]")
        axes.set_ylim(0, 2 * float(np.median(variance)))
    return drawing_of(panels[0].figure, "photon transfer")


def _chi2_maps(verdicts: Sequence[PhotoVerdict], pictures: Sequence[Pictures]) -> str:
    from matplotlib.colors import TwoSlopeNorm

    about_one = TwoSlopeNorm(1.0, 0.5, 2.0)  # white where the noise explains the residuals
    chi2 = [verdict.background_chi2 for verdict in verdicts]
    columns = min(len(verdicts), 4)
    rows = math.ceil(len(verdicts) / columns)
    finding = f"The background's chi² is {min(chi2):.3f} to {max(chi2):.3f}"
    note = (
        "Mean square of all residuals in a part of the image, stars among them, each up to 5"
        " sigmas."
    )
    with panels_of(
        finding, rows, columns, share_x=False, note=note, height_inch=1.2 + 2.1 * rows
    ) as panels:
        for axes, verdict, views in zip(panels, verdicts, pictures, strict=False):
            drawn = axes.imshow(views.chi2_map, norm=about_one, cmap="RdBu_r", aspect="auto")
            axes.set_xticks([])
            axes.set_yticks([])
            axes.grid(visible=False)
            axes.set_xlabel(f"photograph {verdict.number + 1}")
        for axes in panels[len(verdicts) :]:
            axes.set_axis_off()
        panels[0].figure.colorbar(drawn, ax=panels, label="chi²", shrink=0.7)
    return drawing_of(panels[0].figure, "squared residuals over the field")


def _lists(verdicts: Sequence[PhotoVerdict]) -> Iterator[Card]:
    """What was seen and is no star, and what is missing."""
    sources: list[tuple[object, ...]] = [
        (v.shot.photo.name, round(s.x_px, 1), round(s.y_px, 1), s.snr)
        for v in verdicts
        for s in v.unexplained
    ]
    sources.sort(key=lambda row: -float(str(row[3])))
    named: list[tuple[object, ...]] = [
        (v.shot.photo.name, round(s.x_px, 1), round(s.y_px, 1), s.snr, s.explained_by)
        for v in verdicts
        for s in v.sources
        if s.explained_by and not s.explained_by.startswith("HIP ") and s.snr >= LISTED_SNR
    ]
    missing: list[tuple[object, ...]] = [
        (v.shot.photo.name, r.name, r.v_mag, round(r.x_predicted_px, 1), round(r.y_predicted_px, 1))
        for v in verdicts
        for r in v.missing
    ]
    for title, rows, header in (
        ("Sources that nothing explains", sources, ("photograph", "x, px", "y, px", "sigmas")),
        ("Sources that are no stars", named, ("photograph", "x, px", "y, px", "sigmas", "what")),
        ("Stars that are missing", missing, ("photograph", "star", "V, mag", "x, px", "y, px")),
    ):
        if not rows:
            continue
        texts = [table_of(rows[:MAX_ROWS], header)]
        if len(rows) > MAX_ROWS:
            texts.append(paragraph(f"{len(rows) - MAX_ROWS} more in the tables."))
        yield Card(title, words=texts)
