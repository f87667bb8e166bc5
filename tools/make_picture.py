"""README's picture, Orion's belt three times: code values, stretched, and the virtual tracker's
image.

`python tools/make_picture.py [OUT.png]` writes readme.png, or OUT.png.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

ROOT = Path(__file__).resolve().parents[1]
BENCH = ROOT / "configs" / "demo.toml"
RADEC = "84.057,-1.2,0"
# The middle of the belt on the monitor, and the piece of it that is shown.
MIDDLE_PX = (955.0, 531.0)
PIECE_PX = (300, 260)
SCALE = 2
STRIP_PX, GAP_PX = 44, 12
# The codes that are written out: those about the star on the boresight, Alnilam.
STAR_PX = (960, 540)
CLOSE_PX, CELL_PX, MARGIN_PX = 7, 36, 16
INK, GROUND, LINES = (235, 235, 235), (24, 26, 30), (90, 95, 105)
TITLES = (
    "what the monitor is given: code values",
    "the same, stretched for a person",
    "the virtual tracker's image of the same sky",
)


def run(*arguments: str | Path) -> None:
    """One hilstar command."""
    subprocess.run(
        [sys.executable, "-m", "hilstar", *map(str, arguments)],
        check=True,
        stdout=subprocess.DEVNULL,
    )


def pictures(folder: Path) -> tuple[Image.Image, Image.Image, Image.Image]:
    """Codes, preview, and the tracker's image of the same sky."""
    codes, preview, tracker = (folder / f"{name}.png" for name in ("codes", "preview", "tracker"))
    run("frame", BENCH, "--radec", RADEC, "--codes", codes, "--preview", preview)
    run("simulate", BENCH, "--radec", RADEC, "--png", tracker)
    opened = (Image.open(path).convert("L") for path in (codes, preview, tracker))
    return next(opened), next(opened), next(opened)


def piece(image: Image.Image, middle_px: tuple[float, float], zoom: float) -> Image.Image:
    """The part about a place, `zoom` times as large in pixels as PIECE_PX says, enlarged to the
    panel.
    """
    width, height = (side / zoom for side in PIECE_PX)
    x, y = middle_px
    box = (x + 0.5 - width / 2, y + 0.5 - height / 2, x + 0.5 + width / 2, y + 0.5 + height / 2)
    size = (PIECE_PX[0] * SCALE, PIECE_PX[1] * SCALE)
    return image.resize(size, Image.Resampling.NEAREST, box=box).convert("RGB")


def tracker_view(tracker: Image.Image, monitor_px: tuple[int, int]) -> Image.Image:
    """The same part of the sky, which the tracker has at its own scale."""
    # demo.toml: 13 um behind 70 mm against 57.65 um behind 350 mm.
    zoom = (13 / 70) / (57.65 / 350)
    offset = (MIDDLE_PX[k] - (monitor_px[k] - 1) / 2 for k in (0, 1))
    x, y = ((side - 1) / 2 + off / zoom for side, off in zip(tracker.size, offset, strict=True))
    return piece(tracker, (x, y), zoom)


def codes_in_figures(codes: Image.Image) -> Image.Image:
    """The codes about STAR_PX, as numbers."""
    (x, y), half = STAR_PX, CLOSE_PX // 2
    close = np.asarray(codes)[y - half : y + half + 1, x - half : x + half + 1]
    made = Image.new("RGB", (CLOSE_PX * CELL_PX + 1,) * 2)
    draw, font = ImageDraw.Draw(made), ImageFont.load_default(16)
    for (i, j), code in np.ndenumerate(close):
        box = (j * CELL_PX, i * CELL_PX, (j + 1) * CELL_PX, (i + 1) * CELL_PX)
        draw.rectangle(box, fill=(int(code),) * 3, outline=LINES)
        ink = (110, 114, 122) if code == 0 else INK if code < 120 else GROUND
        draw.text(
            ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2),
            str(code),
            fill=ink,
            font=font,
            anchor="mm",
        )
    return made


def with_figures(panel: Image.Image, codes: Image.Image) -> Image.Image:
    """The panel of the codes with some of them written out, and a line to where they are."""
    left, top = (m + 0.5 - p / 2 for m, p in zip(MIDDLE_PX, PIECE_PX, strict=True))
    half = CLOSE_PX / 2
    star = [SCALE * (c + 0.5 - o) for c, o in zip(STAR_PX, (left, top), strict=True)]
    box = (
        star[0] - SCALE * half,
        star[1] - SCALE * half,
        star[0] + SCALE * half,
        star[1] + SCALE * half,
    )
    close = codes_in_figures(codes)
    panel.paste(close, (MARGIN_PX, MARGIN_PX))
    draw = ImageDraw.Draw(panel)
    draw.rectangle(box, outline=LINES)
    draw.line((MARGIN_PX + close.width, MARGIN_PX + close.height, box[0], box[1]), fill=LINES)
    return panel


def picture() -> Image.Image:
    """The three panels, side by side."""
    with tempfile.TemporaryDirectory() as folder:
        codes, preview, tracker = pictures(Path(folder))
    panels = [
        with_figures(piece(codes, MIDDLE_PX, 1), codes),
        piece(preview, MIDDLE_PX, 1),
        tracker_view(tracker, codes.size),
    ]
    width, height = panels[0].size
    whole = Image.new("RGB", (3 * width + 2 * GAP_PX, height + STRIP_PX), GROUND)
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(26)
    for k, (panel, title) in enumerate(zip(panels, TITLES, strict=True)):
        left = k * (width + GAP_PX)
        whole.paste(panel, (left, STRIP_PX))
        draw.text((left + width / 2, STRIP_PX / 2), title, fill=INK, font=font, anchor="mm")
    return whole


if __name__ == "__main__":
    picture().save(sys.argv[1] if len(sys.argv) > 1 else ROOT / "readme.png", optimize=True)
