"""The codes of both ways to draw stars: on the CPU, and by points of any OpenGL."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.notices import Notice, Notices
from hilstar.display.panel import Panel
from hilstar.display.quantise import Quantisation
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.backend import Backend
from hilstar.display.render.context import create_context
from hilstar.display.render.numpy_backend import open_backend
from hilstar.display.render.target import SpriteSide, Target
from hilstar.display.render.way import WAY_VARIABLE
from hilstar.display.response import gamma_response, srgb_response
from hilstar.optics.extended import LightMap
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import FrameLight, pack_sprites
from hilstar.server.bench.build import load
from hilstar.server.record.ledger import Ledger, LedgerSwitch
from hilstar.server.replay import DrawnBy, Wanted, plan_play, replay
from hilstar.server.serve import Outlet
from tests.support.benches import bench_text
from tests.support.waiting import PATIENCE_S

SIZE, WHITE, FRAMES = (640, 480), 1e6, 3
USUAL = (0.85, 0.85)
SRGB8 = srgb_response(8)


def stars_or_paths(count: int, sigma_px, rng, per_star: int = 1) -> FrameLight:
    """Stars all over the image and its edges, many faint ones and few that clip, or paths of
    `per_star` sprites.
    """
    place = rng.uniform([-5, -5], [SIZE[0] + 5, SIZE[1] + 5], size=(count, 2))
    rate = 10**6.5 * 10 ** (-0.4 * 8 * rng.uniform(0, 1, count) ** 0.4)
    along = np.arange(per_star)
    x, y = (place[:, :1] + 0.6 * along).ravel(), (place[:, 1:] + 0.35 * along).ravel()
    number = np.repeat(np.arange(count), per_star)
    packed = pack_sprites(
        x, y, np.repeat(rate / per_star, per_star), number, SIZE, GaussianPsf(sigma_px).footprint_px
    )
    return replace(packed, per_star=per_star)


def opened(target: Target) -> closing[Backend]:
    return closing(open_backend(target, create_context()))


def drawn_frames(target: Target, frames: list[FrameLight]) -> list[np.ndarray]:
    with opened(target) as gl:
        found = []
        for number, sprites in enumerate(frames):
            gl.draw(sprites, number)
            found.append(gl.levels().copy())
        assert gl.fault() == ""
    return found


def both_ways(
    target: Target, frames: list[FrameLight], monkeypatch
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The codes of frames on the CPU, and by points."""
    monkeypatch.setenv(WAY_VARIABLE, "cpu")
    with opened(target) as gl:
        if not gl.path.startswith("CPU"):
            pytest.skip(f"{gl.gl_renderer}, OpenGL {gl.gl_version}, shares no memory for `exact`")
    on_cpu = drawn_frames(target, frames)
    monkeypatch.setenv(WAY_VARIABLE, "gl")
    with opened(target) as gl:
        assert gl.path.startswith("points")
    return on_cpu, drawn_frames(target, frames)


def assert_same_codes(
    quantisation: Quantisation, on_cpu: list[np.ndarray], by_points: list[np.ndarray]
) -> None:
    """Both add the same whole units, whose last bits a driver's exp2 decides: of few pixels is the
    light that near a threshold, and `exact` has ties (see `Quantiser.other_codes`).
    """
    other = sum(np.count_nonzero(a != b) for a, b in zip(on_cpu, by_points, strict=True))
    lit = sum(np.count_nonzero(codes) for codes in on_cpu)
    assert lit > 1000
    assert other <= QUANTISERS[quantisation].other_codes * lit
    apart = zip(on_cpu, by_points, strict=True)
    assert all(np.abs(a.astype(int) - b).max() <= 1 for a, b in apart)


def shrunk(sigma_px) -> tuple[SpriteSide, ...]:
    """Sides as `effort` chooses them: a quarter of what lights a pixel may be left out."""
    size, lit = GaussianPsf(sigma_px).footprint_px, SRGB8.threshold[0] * WHITE
    sides = [
        SpriteSide(0.25 * lit / GaussianPsf(sigma_px).outside_share(side), side)
        for side in range(size - 4, 1, -2)
    ]
    return (SpriteSide(3e38, size - 2), *sides)


@pytest.mark.parametrize("quantisation", ["round", "exact", "temporal"])
@pytest.mark.parametrize(
    ("response", "sigma_px", "count", "per_star"),
    [
        (SRGB8, USUAL, 300, 1),
        (SRGB8, USUAL, 3000, 1),
        (SRGB8, USUAL, 100, 8),
        (SRGB8, (0.4, 0.4), 300, 1),
        (SRGB8, (1.7, 1.7), 200, 1),
        (srgb_response(10), USUAL, 300, 1),
        (gamma_response(8), (1.2, 0.8), 300, 1),
    ],
    ids=["usual", "dense", "paths", "narrow", "wide", "10 bits", "gamma"],
)
def test_both_ways_choose_the_same_codes(
    quantisation, response, sigma_px, count, per_star, rng, monkeypatch
):
    frames = [stars_or_paths(count, sigma_px, rng, per_star) for _ in range(FRAMES)]
    assert_same_codes(
        quantisation,
        *both_ways(
            Target(SIZE, GaussianPsf(sigma_px), response, WHITE, quantisation), frames, monkeypatch
        ),
    )


@pytest.mark.parametrize("quantisation", ["round", "exact", "temporal"])
def test_so_they_do_of_three_primaries_beside_each_other(quantisation, rng, monkeypatch):
    """Each primary's light lies at its own place in a pixel."""
    panels = tuple(Panel(SRGB8, WHITE * share) for share in (0.3, 0.5, 0.2))
    places_px = np.array([(-0.3, 0), (0, 0.2), (0.3, 0)])
    target = Target(SIZE, GaussianPsf(USUAL), SRGB8, WHITE, quantisation, primaries=panels)
    target = replace(target, places_px=places_px, together=0.4 + 0.6 * np.eye(3))
    frames = [stars_or_paths(count, USUAL, rng) for count in (30, 300)]
    for k, one in enumerate(frames):
        light = one.data["electrons_per_s"][:, None] * rng.dirichlet([1, 1, 1], len(one))
        frames[k] = replace(one, primaries=light.astype(np.float32))
    assert_same_codes(quantisation, *both_ways(target, frames, monkeypatch))


@pytest.mark.parametrize("quantisation", ["round", "exact"])
@pytest.mark.parametrize("changed", ["uneven", "smaller sprites"])
def test_so_they_do_on_an_uneven_panel_and_with_smaller_sprites(
    quantisation, changed, rng, monkeypatch
):
    uneven = rng.uniform(0.8, 1.2, SIZE[::-1]).astype(np.float32) if changed == "uneven" else None
    sides = shrunk(USUAL) if changed == "smaller sprites" else ()
    target = Target(SIZE, GaussianPsf(USUAL), SRGB8, WHITE, quantisation, uneven, sides)
    assert_same_codes(
        quantisation,
        *both_ways(target, [stars_or_paths(300, USUAL, rng) for _ in range(FRAMES)], monkeypatch),
    )


def test_so_they_do_where_light_beside_stars_comes_and_goes(rng, monkeypatch):
    """Frames with extended light are blended in both ways, those between them drawn in each
    one's own.
    """
    glow = LightMap(np.full((40, 50), 3e4, dtype=np.float32), (30, 20))
    frames = [stars_or_paths(count, USUAL, rng) for count in (200, 300, 20, 0, 200)]
    frames[1] = replace(frames[1], extended=(glow,))
    target = Target(SIZE, GaussianPsf(USUAL), SRGB8, WHITE)
    assert_same_codes("round", *both_ways(target, frames, monkeypatch))


@pytest.mark.parametrize("quantisation", ["exact", "temporal"])
def test_so_they_do_of_light_without_stars_whose_mask_turns_where_frames_follow(
    quantisation, rng, monkeypatch
):
    """A mask that stays would show each frame's rounding in the mean of all."""
    glow = LightMap(rng.uniform(1e3, 3e4, (40, 50)).astype(np.float32), (30, 20))
    frames = [replace(stars_or_paths(0, USUAL, rng), extended=(glow,)) for _ in range(3)]
    target = Target(SIZE, GaussianPsf(USUAL), SRGB8, WHITE, quantisation)
    on_cpu, by_points = both_ways(target, frames, monkeypatch)
    for first, second in zip(on_cpu, by_points, strict=True):
        assert np.count_nonzero(first) > 1000
        assert np.count_nonzero(first != second) < 10  # near a threshold, by a driver's exp2
    turns = np.count_nonzero(on_cpu[0] != on_cpu[1]) > 500
    assert turns == (quantisation == "temporal")


@pytest.mark.parametrize("smaller", [False, True], ids=["whole", "smaller sprites"])
@pytest.mark.parametrize("sigma_px", [(0.4, 0.4), USUAL, (1.2, 0.8)])
def test_no_frame_of_temporal_leaves_a_pixel_behind(sigma_px, smaller, rng):
    """`temporal` chooses among all near pixels, some of which lie a little beyond its reach:
    they are erased too.
    """
    frames = [stars_or_paths(600, sigma_px, rng) for _ in range(12)]
    side = GaussianPsf(sigma_px).footprint_px
    sides = (SpriteSide(3e38, 2 + side % 2),) if smaller else ()
    target = Target(SIZE, GaussianPsf(sigma_px), SRGB8, WHITE, "temporal", sides=sides)
    for codes, sprites in zip(drawn_frames(target, frames), frames, strict=True):
        under = np.zeros(SIZE[::-1], dtype=bool)
        for x, y in sprites.data["pixel"] - (side - 1) // 2:
            under[max(y, 0) : max(y + side, 0), max(x, 0) : max(x + side, 0)] = True
        assert not codes[~under].any()


def replayed_codes(path, log, ledger=None) -> tuple[dict[int, np.ndarray], list[str], DrawnBy]:
    """The codes of each frame of a replay, what was told of another renderer, and who drew it."""
    codes, told = {}, []

    def listen(notice: Notice) -> None:
        if notice.kind == "other-renderer":
            told.append(notice.detail)

    with load(path) as bench:
        notices = Notices()
        notices.listen(listen)
        kept = LedgerSwitch(None if ledger is None else Ledger(ledger, bench, notices))
        play = plan_play(log, Wanted(math.inf), bench.config)
        replay(
            bench,
            play,
            lambda shown: codes.update({shown.number: shown.drawn.levels.copy()}),
            Outlet(ledger=kept, notices=notices),
        )
        kept.end()
        renderer = bench.renderer
    return codes, told, DrawnBy(renderer.gl_renderer, renderer.gl_version, renderer.path)


@pytest.mark.parametrize("quantisation", ["round", "exact", "temporal"])
def test_a_run_of_another_path_is_said_to_be_one_and_its_codes_are_within_what_is_said(
    tmp_path, quantisation, monkeypatch
):
    monkeypatch.delenv(WAY_VARIABLE, raising=False)
    path, log, ledger = tmp_path / "bench.toml", tmp_path / "log.csv", tmp_path / "run.mcap"
    path.write_text(bench_text({"render": {"quantisation": quantisation}}))
    turn = [(k / 10, math.cos(0.01 * k), math.sin(0.01 * k)) for k in range(6)]
    log.write_text("t_s,qw,qx,qy,qz\n" + "".join(f"{t},{w},{x},0,0\n" for t, w, x in turn))
    first, told, before = replayed_codes(path, log, ledger)
    assert not told
    again, told, _ = replayed_codes(path, ledger)
    assert not told
    assert all(np.array_equal(first[number], again[number]) for number in first)
    if not before.path.startswith("CPU"):
        pytest.skip(f"{before} draws one way only")
    monkeypatch.setenv(WAY_VARIABLE, "gl")
    by_points, told, now = replayed_codes(path, ledger)
    assert len(told) == 1 and str(before) in told[0] and str(now) in told[0]
    assert before.other_codes(now, quantisation) == QUANTISERS[quantisation].other_codes
    for number, codes in first.items():
        assert np.abs(codes.astype(int) - by_points[number]).max() <= 1
        assert np.count_nonzero(codes != by_points[number]) <= QUANTISERS[
            quantisation
        ].other_codes * np.count_nonzero(codes)
    assert max(codes.max() for codes in first.values()) > 0


# over lavapipe, of Debian's mesa-vulkan-drivers
ZINK = {"MESA_LOADER_DRIVER_OVERRIDE": "zink", "LIBGL_ALWAYS_SOFTWARE": "1"}
DRAW = """
import sys
import hilstar, numpy as np
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.optics.psf import GaussianPsf
found = {}
for codes in sys.argv[2:]:
    with hilstar.load(f"{codes}.toml") as bench:
        frames = [bench.frame(from_radec_roll_deg(84.0, -1.0 + k, 2.0 * k), number=k).levels.copy() for k in range(6)]
        found |= {f"{codes} {k}": levels for k, levels in enumerate(frames)}
        said = [bench.renderer.gl_renderer, bench.renderer.path]
np.savez(sys.argv[1], **found)
print(*said, sep=", ")
"""


@pytest.mark.usefixtures("on_llvmpipe")
def test_another_driver_s_codes_are_within_what_replay_says(tmp_path):
    for quantisation in QUANTISERS:
        (tmp_path / f"{quantisation}.toml").write_text(
            bench_text({"render": {"quantisation": quantisation}})
        )
    usual = {
        name: value
        for name, value in os.environ.items()
        if name not in ZINK and name != "MESA_GL_VERSION_OVERRIDE"
    }
    names = []
    for file, environment in (("llvmpipe.npz", usual), ("zink.npz", usual | ZINK)):
        command = [sys.executable, "-c", DRAW, file, *QUANTISERS]
        ran = subprocess.run(
            command,
            capture_output=True,
            text=True,
            cwd=tmp_path,
            env=environment,
            timeout=PATIENCE_S,
            check=False,
        )
        if environment is not usual and "MachineError" in ran.stderr:
            pytest.skip("no zink here: Debian's mesa-vulkan-drivers has it")
        assert not ran.returncode, ran.stderr
        names.append(ran.stdout)
    assert names[0].startswith("llvmpipe")
    if not names[1].startswith("zink"):
        pytest.skip(f"no zink here: {names[1]}")
    first, second = np.load(tmp_path / "llvmpipe.npz"), np.load(tmp_path / "zink.npz")
    assert len(first.files) == 6 * len(QUANTISERS)
    for name in first.files:
        lit, other = np.count_nonzero(first[name]), np.count_nonzero(first[name] != second[name])
        assert lit > 100 and other <= QUANTISERS[name.split()[0]].other_codes * lit, name
        assert np.abs(first[name].astype(int) - second[name]).max() <= 1
