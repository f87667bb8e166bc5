"""The pictures of docs/console.md: the page of a run, single pixels of it, and the run's report, in
Debian's chromium.

`python tools/make_screenshot.py` writes focus.png, console.png, pixels.png, report.png and
first-light.png into docs, and each again as NAME-light.png. The run goes by the clock, so that no two are alike.
The page is taken once it has been on time for a minute; on a machine that is too busy for that, the
picture shows and says what was missed.
"""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from selenium.common.exceptions import TimeoutException

DOCS = Path(__file__).resolve().parents[1] / "docs"
sys.path.insert(0, str(DOCS.parent))

from tests.support.browser import Browser, browser  # noqa: E402 - the checkout's own tests
from tests.support.senders import free_port  # noqa: E402

SIZE_PX, FOCUS_SIZE_PX = (1366, 1400), (800, 700)
COLOURS = 256  # size of the palette
CALM_S = 60.0  # within which a minute without a missed frame may come
ON_TIME = "/fresh, frames on time/.test(document.getElementById('health-reasons').textContent)"
HILSTAR = [sys.executable, "-m", "hilstar"]
WARM_UP = "\n[certify.virtual]\ncold_percent = 4.0\nwarm_up_min = 4.0\n"
RING_PX, AT_A_PLACE_S = (2.2, 1.7, 1.3, 1.0, 0.9, 1.1), 4
PSF = "psf_sigma_px = [{0}, {0}]"
SIRIUS = "101.287,-16.716,25"


def keep(data: bytes, name: str) -> None:
    """A PNG as a small one of the documentation."""
    Image.open(io.BytesIO(data)).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(
        DOCS / name, optimize=True
    )


def keep_both(page: Browser, selector: str, name: str) -> None:
    """An element of the page, or all of it for "", in the dark colours and in the light ones."""
    for theme, ending in (("light", "-light"), ("dark", "")):
        page.prefer(color_scheme=theme)
        page.until(f"document.documentElement.dataset.theme === '{theme}'")
        time.sleep(1.0)  # for pictures and charts to be drawn again
        keep(
            page.find(selector).screenshot_as_png if selector else page.get_screenshot_as_png(),
            f"{name}{ending}.png",
        )


def watch(page: Browser, folder: Path) -> None:
    """A run about Sirius, which clips."""
    port = free_port()
    text = (
        (DOCS.parent / "configs" / "demo.toml")
        .read_text()
        .replace("tcp://127.0.0.1:*", f"tcp://127.0.0.1:{port}")
    )
    (folder / "bench.toml").write_text(
        text.replace('quantisation = "exact"', 'quantisation = "round"')
    )
    serve = [
        "serve",
        "bench.toml",
        "--headless",
        "--console",
        "127.0.0.1:0",
        "--control",
        "--ledger",
        "run.mcap",
    ]
    send = [
        "send",
        "--spin",
        "0,0,1,0.3",
        "--radec",
        SIRIUS,
        "--to",
        f"tcp://127.0.0.1:{port}",
        "--connect",
    ]
    with (
        subprocess.Popen(
            [*HILSTAR, *serve],
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        ) as run,
        subprocess.Popen([*HILSTAR, *send, "--rate", "100"], stdout=subprocess.DEVNULL) as sender,
    ):
        assert run.stderr is not None
        page.get(
            next(
                found[1]
                for line in run.stderr
                if (found := re.search(r"page is at (http://\S+)", line))
            )
        )
        page.until("document.getElementById('picture').dataset.frame")
        time.sleep(60.0)  # the charts' minute
        with contextlib.suppress(TimeoutException):
            page.until(ON_TIME, CALM_S)
        page.find("#mark-text").send_keys("baffle on")
        page.press("#control-mark")
        page.run("scrollTo(0, 0)")
        page.until("document.body.dataset.ok === 'true'")
        keep_both(page, "", "console")
        page.find("#zoom-pixels").click()
        page.run("scrollTo(0, 0)")
        keep_both(page, "#stage", "pixels")
        sender.terminate()
        page.until("document.body.dataset.ok === 'false'")
        time.sleep(1.0)
        run.terminate()


def turn_the_ring(page: Browser, folder: Path) -> None:
    """The focus by star widths that the virtual tracker's answers report, as its PSF changes."""
    port = free_port()
    feed = f"tcp://127.0.0.1:{free_port()}"
    answers = (
        f'[answers]\nsource = "udp"\nbind = "127.0.0.1:{port}"\nclock = "host"\nformat = "json"\n'
    )
    text = (DOCS.parent / "configs" / "demo.toml").read_text()
    (folder / "ring.toml").write_text(text + answers)
    words = ["calibrate", "focus", "ring.toml", "--answers", "--star", "Alnilam", "--headless"]
    words += ["--feed", feed, "--console", "127.0.0.1:0"]
    with subprocess.Popen(
        [*HILSTAR, *words], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as run:
        assert run.stderr is not None
        page.get(
            next(
                found[1]
                for line in run.stderr
                if (found := re.search(r"page is at (http://\S+)", line))
            )
        )
        for sigma_px in RING_PX:
            place = folder / f"ring-{sigma_px}.toml"
            place.write_text(text.replace(PSF.format(0.55), PSF.format(sigma_px)))
            tracker = [
                "tracker",
                place.name,
                "--watch",
                feed,
                "--answer",
                f"udp://127.0.0.1:{port}",
            ]
            tracker += ["--format", "json", "--solver", "truth", "--duration", str(AT_A_PLACE_S)]
            subprocess.run([*HILSTAR, *tracker], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        keep_both(page, "#focus", "focus")
        run.terminate()


def first_light(page: Browser, folder: Path) -> None:
    """The page of a session before a monitor that warms up."""
    for name in ("demo.toml", "truth-example.toml"):
        text = (
            (DOCS.parent / "configs" / name)
            .read_text()
            .replace("[monitor]", "[monitor]\nphotodiode_px = 40", 1)
        )
        (folder / name).write_text(text + ("" if name == "demo.toml" else WARM_UP))
    words = [
        "first-light",
        "demo.toml",
        "-o",
        "session",
        "--virtual",
        str(folder / "truth-example.toml"),
    ]
    subprocess.run([*HILSTAR, *words], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    take_session(page, folder / "session" / "first-light.html")


def take_session(page: Browser, path: Path) -> None:
    """A session's verdict, and its cards from the focus on."""
    page.size(1100, 1240)
    for theme, ending in (("light", "-light"), ("dark", "")):
        page.prefer(color_scheme=theme)
        page.get(path.as_uri())
        page.run(
            "for (const name of ['machine', 'display', 'orientation'])"
            " document.getElementById(name).remove()"
        )
        keep(page.get_screenshot_as_png(), f"first-light{ending}.png")


def main() -> None:
    """Watch a run, and look at its report; then bring up a bench."""
    with tempfile.TemporaryDirectory() as scratch, browser() as page:
        page.prefer(color_scheme="dark")
        page.size(*FOCUS_SIZE_PX)
        turn_the_ring(page, Path(scratch))
        page.size(*SIZE_PX)
        watch(page, Path(scratch))
        subprocess.run(
            [*HILSTAR, "report", "run.mcap", "-o", "report"],
            cwd=scratch,
            check=True,
            stdout=subprocess.DEVNULL,
        )
        page.size(1366, 1700)
        page.get((Path(scratch) / "report" / "report.html").as_uri())
        page.until("document.body.dataset.ready === 'true'")
        page.press("#chart-age .plot")
        keep_both(page, "#charts", "report")
        first_light(page, Path(scratch))


if __name__ == "__main__":
    main()
