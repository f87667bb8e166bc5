"""What a screen shows of a frame's levels, by OpenGL and by NumPy, against the pixels that the
orientation and the aids name. A framebuffer stands for the window's back buffer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.quantise import Panel
from hilstar.display.render.aids import (
    BLANK,
    CROSSHAIR,
    GRID,
    GRID_PX,
    LINE_SHARE,
    PATCH,
    AidLevels,
)
from hilstar.display.render.backend import ScreenView, Target
from hilstar.display.render.context import create_context
from hilstar.display.render.numpy_backend import NumpyBackend, open_backend
from hilstar.display.render.presenter import Presenter, changed_codes, level_texture
from hilstar.display.render.renderer import Renderer
from hilstar.display.response import bit_stealing_response, srgb_response
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Orientation
from tests.support.stars import sprites_at

SIZE, CROSS_PX = (230, 140), (150.4, 99.6)  # the crosshair goes through pixel (150, 100)
COLUMNS, ROWS = (50, 150), (0, 100)  # of the grid's lines, GRID_PX apart
PATCH_CODE, MARKER = 30, (9, 211)
LINE = int(LINE_SHARE * 255)
TURNS = [
    Orientation(flip_x, flip_y, turns)
    for flip_x in (False, True)
    for flip_y in (False, True)
    for turns in range(4)
]
AIDS = [0, CROSSHAIR, GRID, CROSSHAIR + BLANK, GRID + PATCH, PATCH + BLANK]


class Screen:
    """A context whose screen is a framebuffer."""

    def __init__(self, size_px: tuple[int, int]) -> None:
        self.context = create_context()
        assert self.context.info  # it is kept, and can be asked of a current context alone
        colours = self.context.renderbuffer(size_px, 3, dtype="f1")
        # what moderngl has of a window alone
        self.context._screen = self.context.framebuffer([colours])
        self.size_px = size_px

    def codes(self, bits: int = 8) -> np.ndarray:
        """What it shows (height, width, 3), the top row first."""
        with self.context:
            read = self.context.screen.read(components=3, dtype="f4", alignment=1)
        width, height = self.size_px
        shares = np.frombuffer(read, np.float32).reshape(height, width, 3)
        return np.rint(shares[::-1] * (2**bits - 1)).astype(int)


@pytest.fixture(scope="module")
def screen() -> Iterator[Screen]:
    """One as wide as it is high, and larger than the image either way."""
    made = Screen((240, 240))
    yield made
    assert made.context.error == "GL_NO_ERROR"
    made.context.release()


def levels_of(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, SIZE[::-1]).astype(np.uint8)


def numpy_backend(levels: np.ndarray) -> NumpyBackend:
    backend = NumpyBackend(Target(SIZE, GaussianPsf((0.8, 0.8)), srgb_response(8), 1e6))
    backend.levels = lambda: levels
    return backend


def presented(screen: Screen, levels: list[np.ndarray], view: ScreenView, *over) -> list:
    """The codes of a view by OpenGL and by NumPy."""
    textures = [level_texture(screen.context, each) for each in levels]
    Presenter(textures[0], view, textures[1:]).present(*over)
    first, *others = [numpy_backend(each) for each in levels]
    first.show_on(view, others)
    first.present(*over)
    return [screen.codes(view.bits), first.back_buffer.astype(int)]


def wanted_codes(picture: np.ndarray, view: ScreenView, overlay: int) -> np.ndarray:
    """Pixel by pixel: the codes (height, width, 3) of the image, and the aids, where the
    orientation puts them on the screen. Lines go on beyond the image.
    """
    width, height = view.orientation.screen_px(view.screen_px)  # of the screen in image axes
    codes = np.zeros((height, width, 3), dtype=int)
    codes[: SIZE[1], : SIZE[0]] = picture
    if overlay & BLANK:
        codes[:] = 0
    elif overlay & PATCH:
        codes[:] = PATCH_CODE
    lines = np.zeros((height, width), dtype=bool)
    if overlay & CROSSHAIR:
        lines[:, COLUMNS[-1]] = lines[ROWS[-1]] = True
    if overlay & GRID:
        lines[:, [*COLUMNS]] = lines[[*ROWS, *range(200, height, GRID_PX)]] = True
    codes[lines] = np.maximum(codes[lines], LINE)
    y, x = np.indices((height, width))
    at_x, at_y = view.orientation.to_screen(x, y, (width, height))
    shown = np.zeros((view.screen_px[1], view.screen_px[0], 3), dtype=int)
    shown[at_y, at_x] = codes
    return shown


@pytest.mark.parametrize("orientation", TURNS, ids=str)
def test_an_image_lies_on_the_screen_as_its_orientation_says(screen, orientation, rng):
    levels = levels_of(rng)
    view = ScreenView(SIZE, screen.size_px, 8, orientation, CROSS_PX)
    for shown in presented(screen, [levels], view):
        assert (shown == wanted_codes(levels[..., None], view, 0)).all()


@pytest.mark.parametrize("overlay", AIDS)
def test_aids_lie_over_the_image_and_the_photodiode_s_square_over_all(screen, overlay, rng):
    levels = levels_of(rng)
    view = ScreenView(SIZE, screen.size_px, 8, Orientation(True, False, 1), CROSS_PX)
    wanted = wanted_codes(levels[..., None], view, overlay)
    side_px, code = MARKER
    wanted[-side_px:, :side_px] = code
    for shown in presented(screen, [levels], view, overlay, PATCH_CODE, MARKER):
        assert (shown == wanted).all()


def test_a_line_is_dark_on_a_patch_as_bright_as_itself(screen, rng):
    view = ScreenView(SIZE, screen.size_px, 8, cross_px=CROSS_PX)
    for shown in presented(screen, [levels_of(rng)], view, CROSSHAIR + PATCH, LINE):
        dark = (shown == 0).all(axis=2)
        assert dark[:, COLUMNS[-1]].all()
        assert dark[ROWS[-1]].all()
        assert dark.sum() == sum(screen.size_px) - 1
        assert (shown[~dark] == LINE).all()


def test_levels_have_their_codes_in_each_colour(screen, rng):
    """Of more levels than a row of the table has, and other codes for the same levels afterwards."""
    levels = rng.integers(0, 3000, SIZE[::-1]).astype(np.uint16)
    triples = rng.integers(0, 256, (3000, 3)).astype(np.uint16)
    view = ScreenView(SIZE, screen.size_px, 8, Orientation(False, True), triples=triples)
    for shown in presented(screen, [levels], view):
        assert (shown == wanted_codes(triples[levels].astype(int), view, 0)).all()
    presenter = Presenter(level_texture(screen.context, levels), view)
    presenter.set_triples(triples[::-1])
    presenter.present()
    assert (screen.codes() == wanted_codes(triples[::-1][levels].astype(int), view, 0)).all()


def test_each_primary_s_levels_are_its_own_colour_s(screen, rng):
    levels = [levels_of(rng) for _ in range(3)]
    view = ScreenView(SIZE, screen.size_px, 8, Orientation(quarter_turns=3))
    for shown in presented(screen, levels, view):
        assert (shown == wanted_codes(np.stack(levels, axis=-1), view, 0)).all()


def test_a_screen_of_fewer_bits_than_the_view_s_is_told_with_the_first_code_that_it_changes(screen):
    """An 8-bit buffer holds each code of 8 bits; of 10 bits it keeps the codes c for which
    rint(rint(255 c / 1023) 1023 / 255) is c.
    """
    assert changed_codes(screen.context, screen.size_px, 8) == ""
    codes = np.arange(1024)
    kept = np.rint(np.rint(codes * 255 / 1023) * 1023 / 255) == codes
    changed = int(4 * np.count_nonzero(~kept))  # of grey and of three primaries
    assert changed_codes(screen.context, screen.size_px, 10) == (
        f"{changed} of 4096 codes are not drawn as they are, (1, 1, 1) as (0, 0, 0)"
    )


def test_a_back_buffer_is_waited_for_by_the_pixel_that_is_cleared(screen, rng):
    """The driver clears the screen's pixel at the bottom left, and no other."""
    levels = levels_of(rng) | 1  # none is dark
    view = ScreenView(SIZE, screen.size_px, 8, Orientation(flip_y=True))
    texture = level_texture(screen.context, levels)
    presenter = Presenter(texture, view)
    presenter.present()
    before = screen.codes()
    presenter.wait()
    after = screen.codes()
    assert before[-1, 0].all()
    assert not after[-1, 0].any()
    before[-1, 0] = 0
    assert (after == before).all()


def test_a_renderer_presents_the_levels_that_it_drew_last(rng):
    screen = Screen((SIZE[1], SIZE[0]))
    psf = GaussianPsf((0.8, 0.8))
    target = Target(SIZE, psf, srgb_response(8), 1e6)
    view = ScreenView(SIZE, screen.size_px, 8, Orientation(quarter_turns=1))
    frames = [sprites_at(rng.uniform(20, 100, (30, 2)), np.full(30, 4e5), psf.footprint_px)]
    frames.append(sprites_at(np.array([[15.0, 30.0]]), np.array([6e6]), psf.footprint_px))
    with Renderer(target, screen.context) as gl:
        gl.show_on(view)
        gl.remember_tables()
        for sprites in frames:
            gl.draw(sprites)
            gl.present()
            picture = gl.levels()[..., None].astype(int)
            assert (screen.codes() == wanted_codes(picture, view, 0)).all()
        assert picture[30, 15] == 255
        gl.take_back_buffer()
        assert gl.fault() == ""
        assert gl.changed_tables() == 0
        with screen.context:
            gl._presenter.table.write(np.full(3 * 1024, 7, np.uint16))
        assert gl.changed_tables() == 1


def test_primaries_apart_are_presented_in_their_own_colours(rng):
    """Red's stars are where no other primary has light, and so on."""
    screen = Screen(SIZE)
    psf = GaussianPsf((0.8, 0.8))
    panels = tuple(Panel(srgb_response(8), 1e6 * share) for share in (0.3, 0.5, 0.2))
    places_px = np.array([(-0.3, 0.0), (0.0, 0.0), (0.3, 0.0)])
    target = Target(
        SIZE, psf, srgb_response(8), 1e6, primaries=panels, places_px=places_px, together=np.eye(3)
    )
    at_px = np.array([[40.0, 30.0], [90.0, 60.0], [160.0, 110.0]])
    sprites = replace(
        sprites_at(at_px, np.full(3, 1e5), psf.footprint_px),
        primaries=np.diag([9e5, 8e5, 7e5]).astype(np.float32),
    )
    view = ScreenView(SIZE, SIZE, 8)
    for context in (screen.context, None):
        backend = open_backend(target, context)
        backend.draw(sprites)
        backend.show_on(view)
        backend.present()
        if context is not None:
            shown = screen.codes()
            assert backend.fault() == ""
        levels = backend.levels()
        assert (shown == levels).all()
        for k, (x, y) in enumerate(at_px.astype(int)):
            others = [colour for colour in range(3) if colour != k]
            assert shown[y, x, k] > 100
            assert not shown[y - 4 : y + 5, x - 4 : x + 5, others].any()


@pytest.mark.parametrize("overlay", AIDS)
def test_aids_in_levels_are_those_in_codes(overlay, rng):
    """For a run without a screen: where level k is code k, and a patch of a third of white."""
    levels = levels_of(rng)
    aids = AidLevels(srgb_response(8), 8, (150, 100))
    shown = aids.laid_over(levels, overlay, PATCH_CODE / 255)
    view = ScreenView(SIZE, SIZE, 8, cross_px=CROSS_PX)
    assert (shown == wanted_codes(levels[..., None], view, overlay)[..., 0]).all()
    assert (shown is levels) == (overlay == 0)


def test_a_patch_of_stolen_bits_is_the_level_whose_codes_are_nearest():
    grey = srgb_response(8)
    stolen = bit_stealing_response((grey, grey, grey), (0.2126, 0.7152, 0.0722))
    levels = np.zeros(SIZE[::-1], dtype=np.uint16)
    shown = AidLevels(stolen, 8, (150, 100)).laid_over(levels, PATCH, PATCH_CODE / 255)
    assert (stolen.rgb[shown] == PATCH_CODE).all()
    lines = AidLevels(stolen, 8, (150, 100)).laid_over(levels, CROSSHAIR, 0.0)
    assert (stolen.rgb[lines[0, 150]] == LINE).all()
    assert (lines > 0).sum() == sum(SIZE) - 1
