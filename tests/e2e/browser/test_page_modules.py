"""The modules of the operator's page, one by one in a browser: what they write, where on the map
and in the picture they put a place, and what a hand does to the view.
"""

from __future__ import annotations

import functools
import http.server
import json
import math
import shutil
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from selenium.webdriver.common.action_chains import ActionChains

from hilstar.basics.rotation import from_radec_roll_deg, to_matrix, to_radec_roll_deg
from hilstar.server.console.report import PAGE_DIR
from tests.support.browser import Browser

pytestmark = pytest.mark.e2e
BARE = "bare.html"
BARE_PAGE = (
    '<!doctype html><meta charset="utf-8"><title>bare</title><link rel="icon" href="data:,">'
    '<body style="margin: 0"><div><canvas id="picture" width="320" height="240"'
    ' style="display: block"></canvas></div><p id="pixel"></p>'
)
ROUNDING = 1e-9
# 64 x 48 px on a canvas of 320 x 240: the whole picture is at 5 canvas pixels a pixel
SCREEN_PX, CANVAS_PX, FIT = (64, 48), (320, 240), 5
NEAR_PX = 0.3  # the pointer goes by whole pixels of a canvas on which a pixel is 20


class QuietHandler(http.server.SimpleHTTPRequestHandler):
    """Says nothing of its requests."""

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture(scope="module")
def page_url(tmp_path_factory) -> Iterator[str]:
    """The page's modules beside a page without any."""
    folder = tmp_path_factory.mktemp("modules") / "page"
    shutil.copytree(PAGE_DIR, folder)
    (folder / BARE).write_text(BARE_PAGE, encoding="utf-8")
    handler = functools.partial(QuietHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        yield f"http://127.0.0.1:{server.server_port}/{BARE}"
        server.shutdown()
        serving.join()


@pytest.fixture
def bare(page: Browser, page_url: str) -> Browser:
    """The page without modules, at one canvas pixel a CSS pixel."""
    page.get(page_url)
    return page


def of_module(page: Browser, module: str, script: str, values: Any = None) -> Any:
    """What a script gives that has a module's exports as `it`, and `values`."""
    words = (
        f"const values = {json.dumps(values)}; import('./{module}').then((it) => {{ {script} }})"
    )
    return page.run_async(f"{words}.catch((error) => done(String(error)))")


WRITTEN = [
    ("fixed(-3.21, 1)", "\u22123.2"),
    ("fixed(null, 1)", "\u2013"),
    ("fixed(NaN)", "\u2013"),
    ("withUnit(2.345, 'px', 2)", "2.35 px"),
    ("withUnit(undefined, 'px')", "\u2013"),
    ("count(1234567)", "1\u202f234\u202f567"),
    ("count(0)", "0"),
    ("bytes(999)", "999 B"),
    ("bytes(1000)", "1.0 kB"),
    ("bytes(2.54e9)", "2.5 GB"),
    ("duration(0.25)", "250 ms"),
    ("duration(-0.25, 1)", "\u2212250.0 ms"),
    ("duration(0.9994)", "999 ms"),
    ("duration(0.9996)", "1.0 s"),
    ("duration(5.234, 2)", "5.23 s"),
    ("duration(59.94)", "59.9 s"),
    ("duration(59.96)", "1 min 00 s"),
    ("duration(119.9)", "1 min 59 s"),
    ("duration(-75)", "\u22121 min 15 s"),
    ("duration(3661)", "1 h 01 min"),
    ("duration(Infinity)", ""),
    ("quantity(1500, 'ms', 1)", "1.5 s"),
    ("quantity(20.04, '%', 1)", "20.0 %"),
    ("clock('2026-11-30T20:12:15.250Z')", "20:12:15"),
    ("clock('2026-11-30T20:12:15.250Z', 2)", "20:12:15.25"),
    ("clock('no time')", ""),
    ("hours(83.822)", "05h 35m 17.28s"),
    ("hours(-1)", "23h 56m 00.00s"),
    ("hours(359.99999)", "00h 00m 00.00s"),
    ("degreesMinutes(-5.391)", "\u221205\u00b0 23\u2032 27.6\u2033"),
    ("degreesMinutes(0.99999)", "+01\u00b0 00\u2032 00.0\u2033"),
    ("signed(0.04, 1)", "+0.0"),
    ("signed(-3.21, 1)", "\u22123.2"),
    ("signed(null, 1)", "\u2013"),
]


def test_numbers_times_and_angles_are_written_as_an_engineer_reads_them(bare):
    calls = ", ".join(f"it.{call}" for call, _ in WRITTEN)
    told = of_module(bare, "format.js", f"done([{calls}])")
    words = [text.replace("\u00a0", " ") for text in told]
    assert dict(zip([call for call, _ in WRITTEN], words, strict=True)) == dict(WRITTEN)


POINTINGS = [
    (84.057, -1.2, 0.0),
    (283.021, 35.349, 30.0),
    (0.5, 88.0, 200.0),
    (359.0, -60.0, 300.0),
]


def test_the_page_reads_an_attitude_as_hilstar_does(bare):
    attitudes = [from_radec_roll_deg(*pointing).tolist() for pointing in POINTINGS]
    script = """
const v = [0.3, -0.2, 0.93];
done(values.map((q) => [it.radecRollOf(q), it.toIcrs(it.axesOf(q), v), it.toCam(it.axesOf(q), v)]));
"""
    v = np.array([0.3, -0.2, 0.93])
    for q, (radec_roll, icrs, cam) in zip(
        attitudes, of_module(bare, "sphere.js", script, attitudes), strict=True
    ):
        turn = to_matrix(np.array(q))
        assert radec_roll == pytest.approx(to_radec_roll_deg(np.array(q)), abs=1e-8)
        assert icrs == pytest.approx(turn.T @ v, abs=ROUNDING)
        assert cam == pytest.approx(turn @ v, abs=ROUNDING)


def hammer(ra_deg: float, dec_deg: float) -> tuple[float, float]:
    """Hammer's projection (Snyder 1987, eq. 25-7), RA 0 in the middle and growing to the left."""
    longitude = -math.radians((ra_deg + 180) % 360 - 180)
    latitude = math.radians(dec_deg)
    scale = math.sqrt(2 / (1 + math.cos(latitude) * math.cos(longitude / 2)))
    x = 2 * scale * math.cos(latitude) * math.sin(longitude / 2)
    return x, scale * math.sin(latitude)


def test_the_map_of_the_sky_is_hammer_s_with_right_ascension_to_the_left(bare):
    places = [(0, 0), (90, 0), (270, 0), (30, 60), (200, -45), (359, 89), (179, 10), (181, 10)]
    script = (
        "done(values.map(([ra, dec]) => [it.hammer(ra, dec), it.radecOf(it.vectorOf(ra, dec))]))"
    )
    told = of_module(bare, "sphere.js", script, places)
    for place, (xy, radec) in zip(places, told, strict=True):
        assert xy == pytest.approx(hammer(*place), abs=ROUNDING)
        assert radec == pytest.approx(place, abs=1e-9)


SKY = """
const canvas = document.getElementById("picture");
canvas.getContext("2d", { willReadFrequently: true });
const ink = { theme: "dark", skyGround: "#101010", star: "#ffffff", field: "#00ff00" };
const sky = new it.Sky(canvas, ink);
const ground = () => Array.from(sky.context.getImageData(...sky.at(345, 15).map(Math.round), 1, 1).data);
sky.setSky({ stars: [[84, -1, 1.7, "Alnilam"], [79, -8, 0.1, "Rigel"], [84.1, -1.2, 4.0, "faint"], [84, -1.1, 2, ""]] });
sky.draw();
const dark = ground();
Object.assign(ink, { theme: "light", skyGround: "#f0f0f0" });
sky.draw();
const light = ground();
done([dark, light, values.map((q) => sky.nearest(q)), sky.at(0, 0), sky.at(90, 0), sky.at(0, 30)]);
"""


def test_the_map_names_the_nearest_landmark_and_takes_the_page_s_theme(bare):
    """A star that is too faint for a landmark, or has no name, is none however near it is."""
    pointings = [(84.0, -1.2, 0.0), (79.5, -7.0, 0.0), (200.0, 0.0, 0.0)]
    attitudes = [from_radec_roll_deg(*pointing).tolist() for pointing in pointings]
    dark, light, nearest, middle, east, north = of_module(bare, "sky.js", SKY, attitudes)
    assert (dark[0], light[0]) == (0x10, 0xF0)
    assert nearest == ["Alnilam", "Rigel", ""]
    assert middle == [160, 80]
    assert east[0] < 160 and east[1] == pytest.approx(80) and north[1] < 80


VIEW = """
const canvas = document.getElementById("picture");
window.view = new it.View(canvas, () => {});
view.setSize(64, 48);
done([view.fitted, view.scale, view.toCanvas(31.5, 23.5), view.toMonitor(0, 0)]);
"""


@pytest.fixture
def viewed(bare: Browser) -> Browser:
    """A view of a picture of 64 x 48 px, as `view`."""
    whole = of_module(bare, "view.js", VIEW)
    # (0, 0) is the centre of the top left pixel
    assert whole == [True, FIT, [160, 120], [-0.5, -0.5]]
    return bare


@pytest.mark.parametrize("place_px", [(20.0, 10.0), (45.25, 30.5)])
def test_a_zoom_keeps_the_place_that_it_is_about(viewed, place_px):
    script = """
const place = arguments[0];
const before = view.toCanvas(...place);
view.setZoom(20, place);
const after = view.toCanvas(...place);
return [before, after, view.scale, view.toMonitor(...after)];
"""
    before, after, scale, back = viewed.run(script, place_px)
    assert after == pytest.approx(before, abs=ROUNDING)
    assert scale == 4 * FIT
    assert back == pytest.approx(place_px, abs=ROUNDING)


def test_a_zoom_is_between_the_whole_picture_and_single_pixels(viewed):
    zooms = viewed.run(
        "return [0.1, 1000].map((zoom) => (view.setZoom(zoom), [view.fitted, view.scale]))"
    )
    assert zooms == [[True, FIT], [False, 96]]


@pytest.mark.parametrize(("dx_px", "dy_px"), [(40, 0), (0, -30), (-25, 35)])
def test_a_picture_goes_with_the_hand_that_drags_it(viewed, dx_px, dy_px):
    viewed.run("view.setZoom(20, [31.5, 23.5])")
    pointed = viewed.run("return view.toMonitor(160, 120)")
    canvas = viewed.find("#picture")
    drag = ActionChains(viewed).move_to_element(canvas).click_and_hold()
    drag.move_by_offset(dx_px, dy_px).release().perform()
    under_hand = viewed.run("return view.toMonitor(...arguments)", 160 + dx_px, 120 + dy_px)
    assert under_hand == pytest.approx(pointed, abs=NEAR_PX)
    assert viewed.run("return view.pointers.size") == 0


def test_arrows_move_the_view_and_nothing_beyond_the_picture_is_seen(viewed):
    script = """
view.setZoom(20, [31.5, 23.5]);
const seen = () => [...view.toMonitor(0, 0), ...view.toMonitor(320, 240)];
view.pan(1, 0);
const right = seen();
view.pan(-1, 1);
const down = seen();
for (let k = 0; k < 50; k += 1) view.pan(-1, -1);
const corner = seen();
for (let k = 0; k < 50; k += 1) view.pan(1, 1);
return [right, down, corner, seen()];
"""
    right, down, corner, other = viewed.run(script)
    # a step is 0.15 of the view: 48 and 36 canvas pixels of 20 a pixel
    middle = np.array([31.5 - 8, 23.5 - 6, 31.5 + 8, 23.5 + 6])
    assert right == pytest.approx(middle + np.array([2.4, 0, 2.4, 0]), abs=ROUNDING)
    assert down == pytest.approx(middle + np.array([0, 1.8, 0, 1.8]), abs=ROUNDING)
    assert corner[:2] == pytest.approx([-0.5, -0.5], abs=ROUNDING)
    assert other[2:] == pytest.approx([63.5, 47.5], abs=ROUNDING)


def test_the_wheel_zooms_a_zoomed_picture_about_the_pointer_and_scrolls_a_whole_one(viewed):
    script = """
const wheel = (deltaY) => {
  const event = new WheelEvent("wheel", { deltaY, clientX: 80, clientY: 60, cancelable: true });
  view.canvas.dispatchEvent(event);
  return event.defaultPrevented;
};
const whole = wheel(-100);
view.setZoom(20, [31.5, 23.5]);
const before = view.toMonitor(80, 60);
const zoomed = wheel(-100);
return [whole, zoomed, view.scale, before, view.toMonitor(80, 60)];
"""
    whole, zoomed, scale, before, after = viewed.run(script)
    assert (whole, zoomed) == (False, True)
    assert scale == pytest.approx(20 * math.exp(0.2))
    assert after == pytest.approx(before, abs=ROUNDING)


PINCH = """
view.canvas.setPointerCapture = () => {}; // these pointers are no hand's
const touch = (kind, pointerId, clientX, clientY) => view.canvas.dispatchEvent(new PointerEvent(kind, { pointerId, clientX, clientY }));
view.setZoom(10, [31.5, 23.5]);
touch("pointerdown", 1, 140, 120);
touch("pointerdown", 2, 180, 120);
const before = view.scale;
touch("pointermove", 2, 220, 120);
return [before, view.scale];
"""


def test_two_fingers_that_part_twice_as_far_show_a_pixel_twice_as_large(viewed):
    before, after = viewed.run(PINCH)
    assert after == pytest.approx(2 * before)


PICTURE = """
const canvas = document.getElementById("picture");
const picture = new it.Picture(canvas, () => {});
const [w, h, zoom] = values;
const levels = new Uint8Array(w * h);
levels[22 * w + 30] = 255; // a star at (30, 22)
levels[22 * w + 31] = 64;
picture.setScreen([w, h], 255);
picture.show(levels, w, h, 5);
canvas.width = 320;
canvas.height = 240;
if (zoom) picture.view.setZoom(zoom, [30, 22], true);
else picture.view.fit();
picture.draw();
const data = picture.context.getImageData(0, 0, 320, 240).data;
const lit = [];
for (let k = 0; k < 320 * 240; k += 1) if (data[4 * k] === 255) lit.push([k % 320, Math.floor(k / 320)]);
const truth = { frame: 5, stars: [[30.2, 21.9, 1.7, 26311, "Alnilam", 0, ""]] };
picture.showPixels(truth);
const followed = picture.followed;
picture.follow({ frame: 5, stars: [[40.4, 20.2, 1.7, 26311, "Alnilam", 0, ""]] });
const centre = [picture.view.cx, picture.view.cy];
picture.follow({ frame: 4, stars: [[30, 22, 1.7, 26311, "Alnilam", 0, ""]] });
done([lit, [picture.levelAt(30, 22), picture.levelAt(31, 22), picture.levelAt(-1, 0), picture.levelAt(w, 0)], followed, centre, [picture.view.cx, picture.view.cy]]);
"""


@pytest.mark.parametrize("zoom", [0, 8])
def test_a_lit_pixel_is_where_the_view_puts_it_and_its_star_is_followed(bare, zoom):
    """A picture that is larger than it is, whole and zoomed; marks of another frame move nothing."""
    lit, levels, followed, centre, still = of_module(
        bare, "picture.js", PICTURE, [*SCREEN_PX, zoom]
    )
    scale = zoom or FIT
    if zoom:
        left, top = 160 - scale / 2, 120 - scale / 2
    else:
        left, top = 30 * scale, 22 * scale
    x, y = np.array(lit).T
    assert (x.min(), y.min()) == (left, top)
    assert (x.max(), y.max()) == (left + scale - 1, top + scale - 1)
    assert len(lit) == scale**2
    assert levels == [255, 64, None, None]
    assert followed == 26311
    assert centre == still == [40, 20]


def test_of_a_picture_that_is_made_smaller_each_point_shows_its_brightest_pixel(bare):
    """640 x 480 px on 320 x 240: the star's pixel (30, 22) is in the point (15, 11)."""
    lit, *_ = of_module(bare, "picture.js", PICTURE, [640, 480, 0])
    assert lit == [[15, 11]]


def test_codes_go_from_black_to_white_and_clipped_ones_are_red(bare):
    script = """
const grey = (table) => Array.from(table).map((value) => value & 0xff);
const red = it.colourTable("linear", 200, 256, 200);
done([["linear", "log", "asinh"].map((name) => grey(it.colourTable(name, 200, 256, 256))), red[199].toString(16), red[200].toString(16)]);
"""
    tables, below, clipped = of_module(bare, "picture.js", script)
    level = np.arange(256)
    for table, stretched in zip(
        tables,
        (level / 200, np.log1p(level) / np.log1p(200), np.arcsinh(4 * level) / np.arcsinh(800)),
        strict=True,
    ):
        assert np.abs(np.array(table) - 255 * np.minimum(stretched, 1)).max() <= 0.5 + ROUNDING
    assert (below, clipped) == ("fffefefe", "ff4d4dff")


def test_charts_count_back_from_the_newest_point_by_clock_times(bare):
    script = """
const times = [[-3.24, 1], [-90, 30], [-90, 60], [-119.7, 1], [-3599.6, 1], [7325, 600]];
done([it.timesOf([{ t_s: 10 }, { t_s: 69.5 }, { t_s: 70 }]), it.timesOf([]), times.map(([s, step]) => it.timeText(s, step))]);
"""
    back_s, of_none, texts = of_module(bare, "charts.js", script)
    assert back_s == [-60, -0.5, 0] and of_none == []
    assert [text.replace("\u2212", "-") for text in texts] == [
        "-3.2", "-90", "-1:30", "-2:00", "-1:00:00", "2:02:05",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("largest", "top"), [(0, 1), (0.9, 1), (1.01, 1.5), (7, 8), (13, 15), (100, 100), (230, 300)]
)
def test_an_axis_ends_at_a_round_number_above_its_values(bare, largest, top):
    assert of_module(bare, "charts.js", f"done(it.niceTop({largest}))") == pytest.approx(top)


def test_marks_are_those_of_the_picture_s_frame_and_the_last_twelve_are_kept(bare):
    script = """
const overlays = new it.Overlays(document.createElement("canvas"), {}, () => {});
for (let frame = 1; frame <= 20; frame += 1) overlays.add({ frame });
done([15, 20, 9, 8, 99].map((frame) => overlays.of(frame).frame));
"""
    # of a frame without marks those of the newest
    assert of_module(bare, "overlays.js", script) == [15, 20, 9, 20, 20]
