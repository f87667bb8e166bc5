"""The drawings of the documentation as SVG, in the colours of the charts, light or dark as the
reader's page is.

`python tools/make_pages.py` writes them; tests/docs fails where one is not what this makes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from html import escape

WIDTH = 760
LINE_PX = 17
STYLE = """text{font:13px system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif;fill:#1f2328}
.head{font-weight:650}.note{fill:#5c6570;font-size:12px}.middle{text-anchor:middle}
.box{fill:#ffffff;stroke:#5c6570}.own{fill:#0b62a4;fill-opacity:.1;stroke:#0b62a4}
.light{fill:#c2500b;fill-opacity:.1;stroke:#c2500b}.dash{stroke-dasharray:4 4}
.line{stroke:#5c6570;fill:none}.ray{stroke:#c2500b;fill:none;stroke-width:1.2}.tip{fill:#5c6570}.raytip{fill:#c2500b}
@media (prefers-color-scheme:dark){text{fill:#e6e8eb}.note{fill:#a3acb8}.box{fill:#1e2129;stroke:#a3acb8}
.own{fill:#6cb6ff;stroke:#6cb6ff}.light{fill:#ff9e5e;stroke:#ff9e5e}
.line{stroke:#a3acb8}.ray{stroke:#ff9e5e}.tip{fill:#a3acb8}.raytip{fill:#ff9e5e}}"""


@dataclass(slots=True)
class Drawing:
    """An SVG that is being drawn, `height` px high; `title` is read to who cannot see it."""

    title: str
    height: int
    parts: list[str] = field(default_factory=list)

    def text(self, x: float, y: float, line: str, kind: str = "") -> None:
        """A line of text."""
        self.parts.append(f'<text x="{x:g}" y="{y:g}" class="{kind}">{escape(line)}</text>')

    def box(
        self, at: tuple[float, float], size: tuple[float, float], lines: str, kind: str = "box"
    ) -> None:
        """A box with a heading and notes below it, each a line, in its middle."""
        (x, y), (w, h) = at, size
        self.parts.append(
            f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="8" class="{kind}"/>'
        )
        texts = lines.split("\n")
        top = y + h / 2 - LINE_PX * (len(texts) - 1) / 2 + 4.5
        for k, line in enumerate(texts):
            self.text(x + w / 2, top + k * LINE_PX, line, "middle note" if k else "middle head")

    def arrow(self, *points: tuple[float, float], kind: str = "line", tip: str = "tip") -> None:
        """A line through the points, with a tip at its end."""
        (a, b), (x, y) = points[-2:]
        length = ((x - a) ** 2 + (y - b) ** 2) ** 0.5
        u, v = (x - a) / length, (y - b) / length
        path = " ".join(
            f"{'ML'[k > 0]}{p:g} {q:g}"
            for k, (p, q) in enumerate((*points[:-1], (x - 6 * u, y - 6 * v)))
        )
        corners = [
            (x, y),
            (x - 9 * u + 4 * v, y - 9 * v - 4 * u),
            (x - 9 * u - 4 * v, y - 9 * v + 4 * u),
        ]
        self.parts.append(f'<path d="{path}" class="{kind}"/>')
        self.parts.append(
            f'<polygon points="{" ".join(f"{p:.1f},{q:.1f}" for p, q in corners)}" class="{tip}"/>'
        )

    def line(self, *points: tuple[float, float], kind: str = "line") -> None:
        """A line through the points."""
        path = " ".join(f"{'ML'[k > 0]}{p:g} {q:g}" for k, (p, q) in enumerate(points))
        self.parts.append(f'<path d="{path}" class="{kind}"/>')

    def span(self, x0: float, x1: float, y: float, words: str) -> None:
        """A distance along x, with its name below it."""
        middle = (x0 + x1) / 2
        self.arrow((middle, y), (x0, y))
        self.arrow((middle, y), (x1, y))
        for k, line in enumerate(words.split("\n")):
            self.text(middle, y + LINE_PX * (k + 1), line, "middle note" if k else "middle")

    def svg(self) -> str:
        """The file."""
        size = f'viewBox="0 0 {WIDTH} {self.height}" width="{WIDTH}" height="{self.height}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img">'
        body = "\n".join(self.parts)
        return (
            f"{head}\n<title>{escape(self.title)}</title>\n<style>{STYLE}</style>\n{body}\n</svg>\n"
        )


def chain() -> str:
    """index.md: from an attitude to light, and where each figure of it stands."""
    d = Drawing(
        "From an attitude to light: attitude, stars, light, codes, monitor, lens, tracker",
        300,
    )
    steps = (
        ("Attitude in", "ZeroMQ, UDP,\nserial, logs"),
        ("At the moment of light", "the sender’s clock,\npredicted"),
        ("Stars", "pixel, fraction,\nelectrons/s"),
        ("Light", "electrons/s per\nmonitor pixel"),
        ("Codes", "what the monitor\nis given"),
    )
    widths, x = (104, 184, 120, 120, 120), 8.0
    for k, ((head, note), w) in enumerate(zip(steps, widths, strict=True)):
        d.box((x, 96), (w, 74), f"{head}\n{note}", "own" if k else "box")
        if k < len(steps) - 1:
            d.arrow((x + w, 133), (x + w + 24, 133))
        x += w + 24
    d.box((308, 8), (124, 56), "Catalogue\nspectra, bodies")
    d.arrow((370, 64), (370, 96))
    for x0, width, words in (
        (628, 124, "Monitor\nphotons"),
        (444, 148, "Collimating lens\na star at infinity"),
        (284, 124, "Star tracker\nyours"),
    ):
        d.box((x0, 222), (width, 60), words, "light")
    d.arrow((690, 170), (690, 222))
    d.arrow((628, 252), (592, 252), kind="ray", tip="raytip")
    d.arrow((444, 252), (408, 252), kind="ray", tip="raytip")
    d.arrow((284, 252), (62, 252), (62, 170), kind="line dash")
    d.text(76, 244, "its answers, to your simulator", "note")
    d.text(8, 24, "blue: hilstar", "note")
    d.text(8, 24 + LINE_PX, "orange: the bench", "note")
    return d.svg()


def bench() -> str:
    """first-day.md: the bench seen from the side, with the README's distances."""
    d = Drawing(
        "The bench from the side: monitor, one focal length, collimating lens, parallel light, star"
        " tracker",
        320,
    )
    d.line((20, 36), (740, 36), (740, 236), (20, 236), (20, 36), kind="line dash")
    d.text(28, 28, "dark box, or a dark room; black cloth round the beam", "note")
    d.parts.append('<rect x="60" y="62" width="14" height="148" class="box"/>')
    d.text(56, 56, "monitor", "head")
    d.parts.append('<ellipse cx="404" cy="136" rx="13" ry="74" class="box"/>')
    d.text(404, 56, "collimating lens", "middle head")
    d.parts.append('<rect x="610" y="96" width="96" height="80" rx="8" class="box"/>')
    d.parts.append('<rect x="596" y="112" width="14" height="48" class="box"/>')
    d.text(658, 134, "tracker", "middle head")
    d.text(658, 134 + LINE_PX, "focused", "middle note")
    d.text(658, 134 + 2 * LINE_PX - 3, "at infinity", "middle note")
    # one star: rays of a pixel leave the lens in the direction from the pixel to the lens's middle
    slope = 20 / 330
    for y1 in (86, 104, 122, 140, 176):
        end = (594, y1 + slope * 190)
        if 112 < end[1] < 160:
            d.arrow((74, 116), (404, y1), end, kind="ray", tip="raytip")
        else:
            d.line((74, 116), (404, y1), end, kind="ray")
    d.parts.append('<circle cx="84" cy="196" r="5" class="light"/>')
    d.line((84, 201), (84, 222), (150, 222))
    d.text(156, 226, "photodiode, on a square of the screen’s corner (step 3)", "note")
    d.span(74, 404, 256, "one focal length, here 350 mm\nset by focusing: a step of first-light")
    d.span(404, 596, 256, "short: so all of the\nfield’s light meets the aperture")
    d.text(74, 312, "a pixel of 57.65 µm is 57.65 µm / 350 mm = 34 arcsec of sky", "note")
    return d.svg()


def packet_life() -> str:
    """attitude-in.md: what happens to a packet until it is light, and what each stage takes."""
    d = Drawing(
        "A packet's life: sent, arrived, checked, on the timeline, predicted, drawn, swapped,"
        " light",
        250,
    )
    steps = (
        ("Sent", "t_ns: the\nsender’s clock"),
        ("Arrived", "stamped with\nthe host’s clock"),
        ("Checked", "CRC, norm,\nrate, age"),
        ("Timeline", "newest samples,\nclock’s offset"),
        ("Drawn", "predicted to the\nmoment of light"),
        ("Light", "swap, then\nthe panel’s delay"),
    )
    w, gap = 110, 17
    for k, (head, note) in enumerate(steps):
        x = 6 + k * (w + gap)
        d.box((x, 62), (w, 74), f"{head}\n{note}", "light" if k == 5 else "own" if k else "box")
        if k < 5:
            d.arrow((x + w, 99), (x + w + gap, 99))
    d.arrow((315, 136), (315, 176), kind="line dash")
    d.text(315, 192, "refused: counted by reason, in the ledger", "middle note")
    for k, words in (
        (0, "wire\n64 bytes: 5.7 ms at 115 200 baud"),
        (3, "wait\nfor the next frame"),
        (4, "draw\n2.2 ms for 1000 stars, CPU"),
    ):
        middle = 6 + k * (w + gap) + w + gap / 2 + 20 * (k == 4)
        head, note = words.split("\n")
        d.text(max(middle, 108), 28, head, "middle head")
        d.text(max(middle, 108), 28 + LINE_PX, note, "middle note")
    d.span(
        6,
        742,
        214,
        "age at light: from t_ns to the light, less the minimum delay of the road, which a one-way"
        " stream cannot measure",
    )
    return d.svg()


def heads() -> str:
    """bench-pc.md: several heads, one attitude."""
    d = Drawing(
        "One source of the body's attitude; a process, a monitor, a ledger and a page for each"
        " head",
        250,
    )
    d.box((8, 92), (136, 66), "Body’s attitude\none sender,\none clock")
    d.box(
        (166, 84), (168, 82), "hilstar serve\nheads.toml: one link,\ntime requests answered", "own"
    )
    d.arrow((144, 125), (166, 125))
    for k, name in enumerate(("plus-x", "minus-y", "zenith")):
        y = 14 + 78 * k
        d.arrow((334, 125), (372, y + 31))
        d.box((372, y), (158, 62), f"{name}\nq_body_to_cam,\nits own moment of light", "own")
        d.arrow((530, y + 31), (566, y + 31), kind="ray", tip="raytip")
        d.box(
            (566, y),
            (186, 62),
            f"monitor, lens, tracker {k + 1}\nrun.{name}.mcap\nits own page",
            "light",
        )
    return d.svg()


def separated() -> str:
    """answers.md: what an answer's error is separated into."""
    d = Drawing(
        "What the error of an answer is separated into: clock, bias, field-of-view error, pixel"
        " error, noise",
        268,
    )
    d.box((4, 92), (166, 74), "Error of an answer\nanswer less command,\nas a rotation vector")
    rows = (
        ("clock", "offset and drift: what turns with the rate"),
        ("bias", "the same everywhere"),
        ("field-of-view error", "comes back with the place in the field"),
        ("pixel error", "comes back with the place within a pixel"),
        ("noise (NEA)", "the rest"),
    )
    for k, (name, words) in enumerate(rows):
        y = 8 + 42 * k
        d.arrow((170, 129), (204, y + 17))
        d.box((204, y), (164, 34), name, "own")
        d.text(382, y + 22, words, "note")
    d.arrow((83, 166), (83, 238), (204, 238), kind="line dash")
    d.box((204, 221), (164, 34), "apart", "light")
    d.text(382, 243, "wrong answers, outages, frames that were changed or hidden", "note")
    return d.svg()


def theory_bench() -> str:
    """theory.md: the bench with its frames' axes and pixels."""
    d = Drawing(
        "The bench and its frames: monitor pixels, cam and mon axes, the tracker's pixels, the sky"
        " at infinity",
        372,
    )
    d.text(20, 24, "monitor", "head")
    d.text(20, 24 + LINE_PX, "pixel (0, 0) is the centre of the top left one", "note")
    d.parts.append('<rect x="40" y="64" width="176" height="112" rx="2" class="box"/>')
    d.parts.append('<rect x="40" y="64" width="10" height="10" class="own"/>')
    d.arrow((45, 69), (118, 69))
    d.text(122, 74, "x right", "note")
    d.arrow((45, 69), (45, 128))
    d.text(52, 134, "y down", "note")
    d.parts.append('<circle cx="150" cy="128" r="4" class="light"/>')
    d.text(140, 154, "a star’s pixels", "middle note")
    d.text(20, 202, "seen as the tracker sees it", "note")
    d.line((262, 120), (740, 120), kind="line dash")
    d.parts.append('<rect x="262" y="72" width="10" height="96" class="box"/>')
    d.text(267, 62, "monitor", "middle head")
    d.parts.append('<ellipse cx="452" cy="120" rx="11" ry="58" class="box"/>')
    d.text(452, 52, "collimator", "middle head")
    d.parts.append('<rect x="620" y="82" width="84" height="76" rx="8" class="box"/>')
    d.parts.append('<rect x="606" y="96" width="14" height="48" class="box"/>')
    d.text(665, 62, "tracker", "middle head")
    slope = 20 / 180  # from the pixel to the lens's middle: the direction behind the lens
    for y1 in (86, 104, 122):
        d.arrow((272, 100), (452, y1), (604, y1 + slope * 152), kind="ray", tip="raytip")
    d.arrow((665, 120), (560, 120), kind="line", tip="tip")
    d.text(496, 176, "+z boresight", "note")
    d.line((530, 164), (566, 124), kind="line dash")
    d.arrow((665, 120), (665, 196))
    d.text(672, 194, "+y down", "note")
    d.parts.append('<circle cx="665" cy="120" r="6" class="box"/>')
    d.line((661, 116), (669, 124))
    d.line((661, 124), (669, 116))
    d.text(714, 92, "+x into", "note")
    d.text(714, 92 + 15, "page", "note")
    d.span(272, 452, 190, "focal length f")
    rows = (
        ("icrs", "stars at the epoch", "box"),
        ("cam", "+z boresight, +x right, +y down", "own"),
        ("mon", "the monitor’s own, at the lens", "own"),
        ("pixel", "x = x₀ + (f / pitch) · X / Z; y alike", "light"),
    )
    for k, (name, words, kind) in enumerate(rows):
        x = 12 + 186 * k
        d.box((x, 262), (150, 40), name, kind)
        d.text(x + 75, 322 + LINE_PX * (k % 2), words, "middle note")
        if k < len(rows) - 1:
            d.arrow((x + 150, 282), (x + 186, 282))
    for k, words in enumerate(("q_icrs_to_cam", "q_cam_to_mon", "lens, tilt")):
        d.text(180 + 186 * k, 252, words, "middle note")
    d.text(180, 236, "the stream", "middle")
    d.text(366, 236, "misalignment", "middle")
    d.text(552, 236, "geometry", "middle")
    return d.svg()


def theory_light() -> str:
    """theory.md: from a catalogue's magnitude to the light that the tracker receives."""
    d = Drawing(
        "The light chain: magnitude and colour, electron rate, sprite, linear image, level, code,"
        " light, tracker",
        300,
    )
    rows = (
        (
            ("V, B-V, V-I", "Hipparcos, or\nyour table"),
            ("Spectrum", "by colour,\nscaled to V"),
            ("Electron rate", "optics, QE:\none number a star"),
            ("Sprite", "pixel, fraction,\nelectrons/s"),
            ("Linear image", "electrons/s that\na pixel must cause"),
        ),
        (
            ("Level", "index into the\nresponse"),
            ("Code", "what the monitor\nis given"),
            ("Light", "response, black,\nuniformity"),
            ("Collimator", "a direction\nfor each pixel"),
            ("Tracker", "its own PSF,\nnoise and ADC"),
        ),
    )
    w, gap = 128, 27
    for row, steps in enumerate(rows):
        y = 40 + 142 * row
        for k, (head, note) in enumerate(steps):
            x = 6 + k * (w + gap)
            kind = ("box" if k == 0 else "own") if row == 0 else ("own" if k < 2 else "light")
            d.box((x, y), (w, 74), f"{head}\n{note}", kind)
            if k < len(steps) - 1:
                d.arrow(
                    (x + w, y + 37),
                    (x + w + gap, y + 37),
                    kind="ray" if row and k > 1 else "line",
                    tip="raytip" if row and k > 1 else "tip",
                )
    d.arrow((690, 114), (690, 148), (70, 148), (70, 182))
    d.text(380, 141, "quantiser: round, dither, exact or temporal", "middle note")
    d.text(6, 24, "blue: computed by hilstar in electrons per second of the tracker", "note")
    d.text(
        6,
        288,
        "orange: hardware; the twin and the virtual tracker model it, the display adds none of it",
        "note",
    )
    return d.svg()


def theory_frame() -> str:
    """theory.md: packets, clocks and frames on one axis of time."""
    d = Drawing(
        "The frame loop in time: packets, offset, prediction, drawing, swap, scan-out, light, over"
        " three refreshes",
        392,
    )
    left, period = 128.0, 190.0

    def at(refreshes: float) -> float:
        return left + period * refreshes

    for k in range(4):
        d.line((at(k), 34), (at(k), 342), kind="line dash")
        d.text(at(k), 26, f"refresh {k}" if k < 3 else "t", "middle note")
    for y, head, note in (
        (58, "sender", "its clock, t_ns"),
        (118, "host", "arrival, stamped"),
        (178, "frame loop", "CPU and GPU"),
        (238, "swap", "vertical blank"),
        (298, "panel", "rows, top to bottom"),
    ):
        d.text(8, y, head, "head")
        d.text(8, y + LINE_PX - 2, note, "note")
    for k in range(9):
        x = at(0.05 + 0.31 * k)
        d.line((x, 48), (x, 66))
        d.line((x, 66), (x + 14 + 5 * (k % 3), 108), kind="ray")
        d.line((x + 14 + 5 * (k % 3), 108), (x + 14 + 5 * (k % 3), 126))
    for k in range(2):
        begin, end = at(k + 0.62), at(k + 0.78)
        d.parts.append(
            f'<rect x="{begin:g}" y="166" width="{end - begin:g}" height="28" class="own"/>'
        )
        d.text((begin + end) / 2, 184, "draw", "middle note")
        d.arrow((end, 180), (at(k + 1), 226))
        d.arrow((at(k + 1), 240), (at(k + 1) + 18, 268), kind="ray", tip="raytip")
        x0, top, bottom = at(k + 1) + 18, 272.0, 332.0
        slant, edge = 0.86 * period, 744.0
        corners = [
            (x0, top),
            (x0 + period, top),
            (x0 + period + slant, bottom),
            (x0 + slant, bottom),
        ]
        if corners[2][0] > edge:
            cut = top + (edge - corners[1][0]) / slant * (bottom - top)
            corners[2:3] = [(edge, cut), (edge, bottom)]
        points = " ".join(f"{x:g},{y:g}" for x, y in corners)
        d.parts.append(f'<polygon points="{points}" class="light"/>')
        d.text(x0 + 92, 308, f"light of frame {k + 1}", "note")
    d.parts.append(f'<circle cx="{at(1) + 18 + 0.43 * period:g}" cy="302" r="4" class="raytip"/>')
    d.line((at(1) + 18 + 0.43 * period, 306), (at(1) + 18 + 0.43 * period, 352))
    d.text(
        at(1) + 18 + 0.43 * period,
        366,
        "the attitude is predicted to here: the middle row’s first light",
        "middle",
    )
    d.text(at(1) + 18 + 0.43 * period, 382, "swap + panel_delay_ms + scanout_ms / 2", "middle note")
    d.text(at(0.62), 212, "latest packets in", "middle note")
    return d.svg()


DRAWINGS = {
    "drawing-chain.svg": chain,
    "drawing-bench.svg": bench,
    "drawing-packet.svg": packet_life,
    "drawing-heads.svg": heads,
    "drawing-errors.svg": separated,
    "drawing-theory-bench.svg": theory_bench,
    "drawing-theory-light.svg": theory_light,
    "drawing-theory-frame.svg": theory_frame,
}
