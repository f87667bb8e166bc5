"""The page of a confrontation: each photograph, its prediction and residual to blink between,
and charts; one file.
"""

import base64
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.arrays import BoolArray, FloatArray
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
    SourceRow,
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
MAP_ROWS, MAP_COLUMNS = 12, 16
JPEG_QUALITY = 82
MAX_ROWS = 40
MAX_NAMED = 12  # of the brightest stars, by which a reader finds his way
NAME_SIZE = 55  # a picture's width over the height of its names
GRID, TILE_PER_PX, TILE_HALF_PX = 5, 8, 3
VIEWS = ("photograph", "prediction", "residual")
STYLE = Path(__file__).with_suffix(".css")
SCRIPT = Path(__file__).with_suffix(".js")


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
    noise_dn = np.sqrt(session.pixels.variance_dn2(shot.level.level))
    predicted_dn = verdict.predicted - shot.level.level
    residual_grey = 255 * np.clip(verdict.residual / (2 * RESIDUAL) + 0.5, 0, 1)
    views = (
        _jpeg(_grey(shot.above_dn / noise_dn)),
        _jpeg(_grey(predicted_dn / noise_dn)),
        _jpeg(residual_grey),
    )
    return Pictures(views, _chi2_map(verdict.residual))


def _grey(sigmas: FloatArray) -> FloatArray:
    """Greys of 0 to 255 of an image in sigmas, no larger than the page shows; faint stars are
    raised by an inverse hyperbolic sine.
    """
    above = np.clip(brightest(sigmas, MAX_SIDE_PX) - BLACK, 0, None)
    share = np.arcsinh(above) / math.asinh(WHITE)
    return np.asarray(255 * np.clip(share, 0, 1))


def _chi2_map(residual: FloatArray) -> FloatArray:
    """Mean squares (MAP_ROWS, MAP_COLUMNS) of an image's residuals in sigmas."""
    height, width = residual.shape
    rows = np.linspace(0, height, MAP_ROWS + 1).astype(int)
    columns = np.linspace(0, width, MAP_COLUMNS + 1).astype(int)
    clipped = np.minimum(residual**2, RESIDUAL**2)
    by_row = np.add.reduceat(clipped, rows[:-1], axis=0)
    sums = np.add.reduceat(by_row, columns[:-1], axis=1)
    areas = np.outer(np.diff(rows), np.diff(columns))
    return np.asarray(sums / areas)


def brightest(image: FloatArray, max_side_px: int) -> FloatArray:
    """An image (h, w) made smaller by a whole factor, until it fits: each point is the brightest
    of its pixels, for a mean would lose the stars.
    """
    factor = math.ceil(max(image.shape) / max_side_px)
    if factor == 1:
        return image
    height, width = image.shape
    rows = np.maximum.reduceat(image, np.arange(0, height, factor), axis=0)
    return np.asarray(np.maximum.reduceat(rows, np.arange(0, width, factor), axis=1))


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
    for card in _cards(found, pictures):
        parts.append(card.html())
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
    unexplained = sum(len(verdict.unexplained) for verdict in verdicts)
    missing = sum(len(verdict.missing) for verdict in verdicts)
    worst_px = _worst([verdict.rms_px for verdict in verdicts])
    worst_mag = _worst([verdict.rms_mag for verdict in verdicts])
    yield KeyFigure(str(counted), f"stars to V = {BRIGHT_V_MAG:g}")
    yield KeyFigure(f"{worst_px} px", "rms off their places")
    yield KeyFigure(f"{worst_mag} mag", "rms off their light")
    yield _count(unexplained, "sources that nothing explains")
    yield _count(missing, "stars that are missing")


def _worst(values: Sequence[float]) -> str:
    """The largest of the values that are known, in words."""
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
    photo = verdict.shot.photo
    height, width = photo.dn.shape
    marks = [_name(row, width) for row in _brightest(verdict)]
    for source in verdict.unexplained:
        corner = f'x="{source.x_px - 9:.0f}" y="{source.y_px - 9:.0f}"'
        marks.append(f'<rect {corner} width="18" height="18" stroke="#ff9e5e"/>')
    for row in verdict.missing:
        middle = f'cx="{row.x_predicted_px:.0f}" cy="{row.y_predicted_px:.0f}"'
        marks.append(f'<circle {middle} r="10" stroke="#6cb6ff"/>')
    view = f'viewBox="-0.5 -0.5 {width} {height}" fill="none" stroke-width="1.5"'
    over = f'<svg {view} aria-hidden="true">{"".join(marks)}</svg>'
    images = ""
    for name, data in zip(VIEWS, pictures.views, strict=True):
        encoded = base64.b64encode(data).decode()
        source_url = f"data:image/jpeg;base64,{encoded}"
        images += f'<img alt="{name} of {escaped(photo.name)}" src="{source_url}">'
    buttons = ""
    for name in (*VIEWS, "blink", "side by side"):
        buttons += f'<button type="button">{name}</button> '
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


def _charts(found: Confronted, pictures: Sequence[Pictures]) -> Iterator[tuple[str, str]]:
    """Titles and charts."""
    rows = []
    for verdict in found.verdicts:
        for row in verdict.stars:
            if row.dn > 0 and row.dn_predicted > 0 and row.stands_alone:
                rows.append(row)
    if rows:
        yield "Flux and colour", _flux(found, rows)
        yield "Places", _places(rows)
    yield "Point spread function", _psf_grid(found.session)
    if len(found.session.pixels.points):
        yield "Photon transfer", _transfer(found.session)
    yield "Squared residuals over the field", _chi2_maps(found.verdicts, pictures)


def _flux(found: Confronted, rows: Sequence[StarRow]) -> str:
    """Flux against V, and how far off it is against V and colour."""
    v_mag = np.array([row.v_mag for row in rows])
    bv_mag = np.array([row.b_v_mag for row in rows])
    instrument_mag = -2.5 * np.log10(np.array([row.dn for row in rows]))
    off_mag = np.array([row.off_mag for row in rows])
    light = found.session.light
    counted = np.array([row.counted for row in rows])
    rms_mag = math.nan
    if counted.any():
        rms_mag = math.sqrt(float((off_mag[counted] ** 2).mean()))
    finding = f"Stars to V = 6.5 are {rms_mag:.3f} mag rms off their prediction"
    note = (
        "Stars that stand alone and are not saturated. Filled: to V = 6.5. Off: seen less"
        " predicted, up where too faint."
    )
    with panels_of(finding, 1, 3, share_x=False, note=note, height_inch=3.9) as panels:
        by_flux, by_v, by_colour = panels
        _draw_stars(by_flux, v_mag, instrument_mag, counted)
        by_flux.set(xlabel="V [mag]", ylabel="-2.5 log10 DN")
        _draw_stars(by_v, v_mag, off_mag, counted)
        by_v.set(xlabel="V [mag]", ylabel="off [mag]", ylim=(-1, 1))
        _draw_stars(by_colour, bv_mag, off_mag, counted)
        by_colour.set(xlabel="B-V [mag]", ylabel="off [mag]", ylim=(-1, 1))
        for axes in (by_v, by_colour):
            axes.axhline(0, color=INK, lw=1)
        if math.isfinite(light.zero_point_mag):
            ends_mag = np.array([v_mag.min(), v_mag.max()])
            colour_mag = light.colour_term * float(np.nanmedian(bv_mag))
            fitted_mag = ends_mag - light.zero_point_mag + colour_mag
            by_flux.plot(ends_mag, fitted_mag, color=ORANGE, lw=1.2)
    return drawing_of(
        panels[0].figure, "flux against V, and what is left of it against V and colour"
    )


def _draw_stars(axes: Any, x: FloatArray, y: FloatArray, counted: BoolArray) -> None:
    """Stars that count are filled, the others open."""
    others = {"ms": 2.5, "mfc": "none", "color": MUTED, "rasterized": True}
    axes.plot(x[~counted], y[~counted], "o", **others)
    axes.plot(x[counted], y[counted], "o", ms=3.5, color=BLUE)


def _places(rows: Sequence[StarRow]) -> str:
    """Arrows from predicted places to those seen."""
    bright = [row for row in rows if row.dn >= 20 * row.sigma_dn]
    x = np.array([row.x_predicted_px for row in bright])
    y = np.array([row.y_predicted_px for row in bright])
    off_px = np.array([row.off_px for row in bright]).reshape(-1, 2)
    dx, dy = off_px.T
    rms_px = math.nan
    if bright:
        rms_px = math.sqrt(float((dx**2 + dy**2).mean() / 2))
    finding = f"Stars of 20 sigmas and more are {rms_px:.3f} px rms an axis off their places"
    with panels_of(finding, height_inch=4.6) as panels:
        axes = panels[0]
        arrows = axes.quiver(
            x, y, dx, dy, angles="xy", color=BLUE, width=0.003, scale=2.0, scale_units="width"
        )
        axes.quiverkey(arrows, 0.86, 0.04, 0.1, "0.1 px", labelpos="E")
        axes.set(xlabel="x [px]", ylabel="y [px]", aspect="equal")
        axes.invert_yaxis()
    return drawing_of(panels[0].figure, "places seen less predicted over the field")


def _psf_grid(session: Session) -> str:
    """The PSF at GRID by GRID places of the field, in one picture: 25 panels of their own take a
    second.
    """
    psf = session.psf
    width, height = psf.size_px
    columns, rows = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    x_px = columns.ravel()
    y_px = rows.ravel()
    fwhm_px = psf.fwhm_px(x_px, y_px)
    tiles = []
    for x, y in zip(x_px, y_px, strict=True):
        # a root: the wings show beside the core
        tiles.append(np.sqrt(psf.samples(x, y, TILE_PER_PX, TILE_HALF_PX)))
    side = tiles[0].shape[-1]
    grid = np.array(tiles).reshape(GRID, GRID, side, side)
    mosaic = grid.swapaxes(1, 2).reshape(GRID * side, GRID * side)
    finding = (
        f"Full width at half maximum {fwhm_px.min():.2f} to {fwhm_px.max():.2f} px, pixel included"
    )
    note = "Width and height of each tile: 6 px. Numbers: place and width, px."
    with panels_of(finding, note=note, height_inch=6.6) as panels:
        axes = panels[0]
        axes.imshow(mosaic, cmap="gray_r", extent=(0, GRID, GRID, 0))
        for number, (x, y, wide) in enumerate(zip(x_px, y_px, fwhm_px, strict=True)):
            row, column = divmod(number, GRID)
            text = f"{x:.0f}, {y:.0f}: {wide:.2f}"
            axes.text(column + 0.03, row + 0.97, text, fontsize=7, color=MUTED)
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
    unexplained = []
    named: list[tuple[object, ...]] = []
    missing: list[tuple[object, ...]] = []
    for verdict in verdicts:
        photograph = verdict.shot.photo.name
        for source in verdict.unexplained:
            x, y = round(source.x_px, 1), round(source.y_px, 1)
            unexplained.append((photograph, x, y, source.snr))
        for source in verdict.sources:
            if _is_named(source):
                x, y = round(source.x_px, 1), round(source.y_px, 1)
                named.append((photograph, x, y, source.snr, source.explained_by))
        for star in verdict.missing:
            x, y = round(star.x_predicted_px, 1), round(star.y_predicted_px, 1)
            missing.append((photograph, star.name, star.v_mag, x, y))
    unexplained.sort(key=lambda row: -row[3])
    place = ("x, px", "y, px")
    yield from _list("Sources that nothing explains", unexplained, ("photograph", *place, "sigmas"))
    header = ("photograph", *place, "sigmas", "what")
    yield from _list("Sources that are no stars", named, header)
    yield from _list("Stars that are missing", missing, ("photograph", "star", "V, mag", *place))


def _is_named(source: SourceRow) -> bool:
    """Whether a source is something that is no star, and stands out."""
    is_star = source.explained_by.startswith("HIP ")
    return bool(source.explained_by) and not is_star and source.snr >= LISTED_SNR


def _list(
    title: str, rows: Sequence[tuple[object, ...]], header: tuple[str, ...]
) -> Iterator[Card]:
    """A card with the first MAX_ROWS rows; none without rows."""
    if not rows:
        return
    texts = [table_of(rows[:MAX_ROWS], header)]
    if len(rows) > MAX_ROWS:
        texts.append(paragraph(f"{len(rows) - MAX_ROWS} more in the tables."))
    yield Card(title, words=texts)
