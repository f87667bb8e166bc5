"""Make the pictures of docs/confronted.md from the raw frames in tests/data/confront, by
`hilstar confront`'s own page.
"""

from __future__ import annotations

import base64
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from hilstar.cli import run_command

ROOT = Path(__file__).resolve().parents[1]
FRAMES = sorted((ROOT / "tests/data/confront").glob("*.tiff"))
CHARTS = {  # by the text that stands for a chart on the page
    "flux against V": "confronted_flux.svg",
    "places seen less": "confronted_places.svg",
    "point spread functions": "confronted_psf.svg",
    "photon transfer": "confronted_transfer.svg",
}
SHOWN = 1  # the frame of docs/confronted_views.jpg
CROP_PX = (330, 250, 650, 490)


def main() -> None:
    """Confront the frames, and write the charts and one frame's part beside its prediction and
    residual.
    """
    import io

    from PIL import Image

    with TemporaryDirectory() as name:
        folder = Path(name)
        words = [
            "confront",
            str(FRAMES[0].parent / "guess.toml"),
            *map(str, FRAMES),
            "-o",
            str(folder / "out"),
        ]
        if code := run_command(words):
            sys.exit(code)
        page = (folder / "out/index.html").read_text(encoding="utf-8")
    for alt, data in re.findall(
        r'<img alt="([^"]*)" src="data:image/svg\+xml;base64,([^"]*)"', page
    ):
        for begin, file in CHARTS.items():
            if alt.startswith(begin):
                (ROOT / "docs" / file).write_bytes(base64.b64decode(data))
    views = re.findall(r'src="data:image/jpeg;base64,([^"]*)"', page)[3 * SHOWN : 3 * SHOWN + 3]
    parts = [Image.open(io.BytesIO(base64.b64decode(data))).crop(CROP_PX) for data in views]
    width, height = parts[0].size
    whole = Image.new("L", (3 * width + 20, height), 255)
    for number, part in enumerate(parts):
        whole.paste(part, (number * (width + 10), 0))
    whole.save(ROOT / "docs/confronted_views.jpg", quality=85)


if __name__ == "__main__":
    main()
