"""Rules of drawing that need no OpenGL: the units in which light adds up, what a GL is asked for, and
which codes are looked at.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.errors import MachineError, NotThereError
from hilstar.basics.units import COMPUTE_VERSION
from hilstar.display.exact import ExactQuantiser, Turn
from hilstar.display.footprints import PixelOrder
from hilstar.display.panel import Panel
from hilstar.display.quantise import round_levels
from hilstar.display.render import context, numpy_backend
from hilstar.display.render.aids import CROSSHAIR, GRID, PATCH, AidLevels, lay_over
from hilstar.display.render.apart import ApartBackend
from hilstar.display.render.backend import ScreenView, level_cost
from hilstar.display.render.context import check_limits, draws_by_cpu
from hilstar.display.render.cpu_stars import CpuStars, least_side_px
from hilstar.display.render.disc_tiles import TILE_PX, Sure
from hilstar.display.render.encoder import (
    MEETING_WINGS,
    lit_sides,
    most_covered_px,
    set_sides,
    viewport_of_sprites,
)
from hilstar.display.render.light_units import DENSER_WINGS, MAX_SUM, LightUnits
from hilstar.display.render.numpy_backend import NumpyBackend, headless_context
from hilstar.display.render.presenter import checked_triples, drawn_codes
from hilstar.display.render.reference import add_stars, linear_image
from hilstar.display.render.target import SpriteSide, Target
from hilstar.display.response import Levels, gamma_response
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Orientation
from tests.support.refusals import refusal
from tests.support.stars import sprites_at

SIZE_PX = (64, 48)
PSF = GaussianPsf((0.85, 0.85))
WHITE_E_PER_S = 1000.0
# lit pixels whose light is so near to a threshold that its rounding to units passes it; measured 4e-3
UNITS = 1e-2


def units(uniformity: np.ndarray | None = None) -> LightUnits:
    response = gamma_response(8, 2.2)
    return LightUnits(Panel(response, WHITE_E_PER_S, uniformity), SIZE_PX, PSF)


NO_EGL = "libEGL-that-is-nowhere.so.1 is missing"


@pytest.mark.parametrize("cause", ["no library", "no context"])
def test_without_opengl_numpy_draws_with_one_warning_and_a_wish_for_it_is_refused(
    cause, monkeypatch, caplog
):
    why = "OpenGL 3.3 is missing"

    def refused(gpu: int | str | None) -> None:
        raise MachineError(why)

    if cause == "no library":
        why = NO_EGL
        monkeypatch.setattr(numpy_backend, "EGL_LIBRARY", NO_EGL.split(maxsplit=1)[0])
    else:
        monkeypatch.setattr(numpy_backend, "EGL_LIBRARY", None)  # this process's own names
    monkeypatch.setattr(context, "create_context", refused)
    numpy_backend._say_once.cache_clear()
    monkeypatch.delenv("HILSTAR_DRAW", raising=False)
    assert [headless_context() for _ in range(3)] == [None] * 3
    monkeypatch.setenv("HILSTAR_DRAW", "cpu")
    assert headless_context() is None
    assert [record.getMessage() for record in caplog.records] == [
        f"no OpenGL here ({why}): the processor draws, discs and `exact` slower than OpenGL would;"
        " 'hilstar doctor' says what to install"
    ]
    monkeypatch.setenv("HILSTAR_DRAW", "gl")
    with pytest.raises(MachineError) as said:
        headless_context()
    assert str(said.value) == (
        f"HILSTAR_DRAW=gl, and there is no OpenGL ({why}); unset it, or see 'hilstar doctor'"
    )


@pytest.mark.parametrize("wanted", ["gl", "cpu"])
def test_no_other_gpu_draws_in_the_place_of_one_that_is_named(wanted, monkeypatch):
    def refused(gpu: int | str | None) -> None:
        raise NotThereError(f"GPU {gpu}: not there")

    monkeypatch.setattr(context, "create_context", refused)
    monkeypatch.setattr(numpy_backend, "EGL_LIBRARY", NO_EGL)  # which only the default GPU needs
    monkeypatch.setenv("HILSTAR_DRAW", wanted)
    with pytest.raises(NotThereError, match="GPU 3: not there"):
        headless_context(3)


def test_the_dimmest_pixel_sets_what_lights_one_and_the_brightest_what_white_is():
    """A pixel of half the light needs twice the light that is asked for: less lights a bright one."""
    plain = units()
    uniformity = np.ones(SIZE_PX[::-1], dtype=np.float32)
    uniformity[3, 4], uniformity[5, 6] = 0.5, 1.25
    uneven = units(uniformity)
    assert uneven.lit_e_per_s == pytest.approx(0.5 * plain.lit_e_per_s)
    assert uneven.most_e_per_s == pytest.approx(1.25 * WHITE_E_PER_S)
    assert plain.most_e_per_s == WHITE_E_PER_S


def test_a_star_is_cut_by_what_lights_the_pixel_that_needs_least():
    """Half the light lights a pixel whose white is half: there a star's wings light up farther out."""
    uniformity = np.ones(SIZE_PX[::-1], dtype=np.float32)
    uniformity[3, 4], uniformity[5, 6] = 0.5, 1.25
    plain, uneven = (
        lit_sides(Panel(gamma_response(8, 2.2), WHITE_E_PER_S, each), 0.01, PSF)
        for each in (None, uniformity)
    )
    assert [side.side_px for side in uneven] == [side.side_px for side in plain]
    half = [0.5 * side.below_e_per_s for side in plain]
    assert [side.below_e_per_s for side in uneven] == pytest.approx(half)
    # at the first rate not to be cut, the brightest pixel outside has a wing's light
    for side in plain:
        outside_e_per_s = side.below_e_per_s * PSF.outside_share(side.side_px)
        assert outside_e_per_s == pytest.approx(0.01 / MEETING_WINGS)


@pytest.mark.parametrize(
    ("renderer", "by_itself"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", True),
        ("zink Vulkan 1.3(llvmpipe (LLVM 15.0.6, 256 bits))", True),
        ("softpipe", True),
        ("NVIDIA H200/PCIe/SSE2", False),
        ("Mesa Intel(R) UHD Graphics 630 (CFL GT2)", False),
    ],
)
def test_stars_are_drawn_by_the_cpu_where_opengl_is_a_processor_s_too(
    monkeypatch, renderer, by_itself
):
    """HILSTAR_DRAW, where it is set, says otherwise."""
    for wanted, by_cpu in (("", by_itself), ("cpu", True), ("gl", False)):
        monkeypatch.setenv("HILSTAR_DRAW", wanted)
        assert draws_by_cpu(renderer) == by_cpu


@pytest.mark.parametrize("count", [1, 1000, 20_000])
def test_whatever_the_light_of_all_stars_their_rounded_units_fit_an_int(count):
    """Each star's brightest pixel takes one unit more at most; all lie in one pixel."""
    light = units()
    sprites = sprites_at(np.full((count, 2), 20.0), np.ones(count), PSF.footprint_px)
    white_e_per_s = WHITE_E_PER_S / PSF.peak_share
    # about each power of two where a unit would just do, by less than what rounding adds
    for room in (MAX_SUM, MAX_SUM - count, MAX_SUM - count / 2, MAX_SUM - 2 * count):
        for exponent in range(-40, -10):
            rate = room * 2.0**exponent / count / PSF.peak_share / 1.000002
            if rate > white_e_per_s or rate * count * PSF.peak_share < WHITE_E_PER_S:
                continue
            data = sprites.data.copy()
            data["electrons_per_s"] = rate
            unit = light._unit_in(replace(sprites, data=data), MAX_SUM)
            total = float(data["electrons_per_s"].sum(dtype=np.float64)) * PSF.peak_share
            assert total / unit + count <= MAX_SUM


def test_the_wings_of_an_image_that_footprints_cover_end_farther_out():
    """Where wings of many stars meet in a pixel, each of them is drawn to less light."""
    light = units()
    few = int(np.prod(SIZE_PX) / PSF.footprint_px**2)
    reach = []
    for count in (few, few + 1):
        sprites = sprites_at(np.full((count, 2), 20.0), np.ones(count), PSF.footprint_px)
        reach.append(light.reach_per_e(sprites))
        assert light.reach_per_e(sprites, alone=True) * light.wings == pytest.approx(reach[0])
    assert reach[1] == pytest.approx(DENSER_WINGS * reach[0])


def test_a_star_over_white_needs_no_coarser_unit_than_one_of_white():
    """No pixel is asked for more; a star a million times as bright would else be in no unit."""
    light = units()
    white = WHITE_E_PER_S / PSF.peak_share
    stars = sprites_at(np.full((3, 2), 20.0), np.array([white, white / 2, 1.0]), PSF.footprint_px)
    over = sprites_at(np.full((3, 2), 20.0), np.array([1e6 * white, white / 2, 1.0]), 10)
    assert light.unit_for(over) == light.unit_for(stars)
    assert light.fine_unit_for(over) == light.fine_unit_for(stars) < light.unit_for(stars)


def test_a_sprite_of_a_path_reaches_as_far_as_its_whole_star():
    light = units()
    sprites = sprites_at(np.full((2, 2), 20.0), np.ones(2), PSF.footprint_px)
    path = replace(sprites, per_star=7)
    for alone in (False, True):
        assert light.reach_per_e(path, alone) == pytest.approx(
            7 * light.reach_per_e(sprites, alone)
        )


@pytest.mark.parametrize(("patch", "lines"), [(0, 96), (95, 96), (96, 0), (97, 0), (255, 0)])
def test_on_a_patch_as_bright_as_a_line_lines_are_dark(patch, lines):
    levels = np.full((6, 8), 50, dtype=np.uint8)
    lay_over(levels, PATCH | CROSSHAIR, patch, 96, (3, 2))
    assert (levels[2] == lines).all()
    assert (levels[:, 3] == lines).all()
    assert levels[0, 0] == patch


@pytest.mark.parametrize(("bits", "white", "line"), [(8, 255, 96), (10, 1023, 385)])
def test_aids_lie_over_a_copy_in_codes_of_the_monitor_s_depth(bits, white, line):
    """Lines of 96 / 255 of white, rounded down; a patch of a share of white, to the nearest; a
    grid every 100 px from the crosshair.
    """
    aids = AidLevels(gamma_response(bits, 2.2), bits, (30, 10))
    levels = Levels(np.full((40, 240), 5, np.uint16))
    assert aids.laid_over(levels, 0, 1.0) is levels
    for share, code in ((1.0, white), (0.25, round(white / 4))):
        assert (aids.laid_over(levels, PATCH, share) == code).all()
    gridded = aids.laid_over(levels, GRID, 0.0)
    is_line = np.zeros(levels.shape, bool)
    is_line[10] = is_line[:, [30, 130, 230]] = True
    assert np.array_equal(gridded, np.where(is_line, line, 5))
    assert (levels == 5).all()


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
@pytest.mark.parametrize(("flip_x", "flip_y"), [(False, False), (True, False), (False, True)])
def test_a_frame_lies_on_the_screen_as_it_is_mounted_with_its_aids(quarter_turns, flip_x, flip_y):
    """Each pixel's code where `Orientation` has the pixel, the crosshair in 10 bits through its
    own, and the marker in the screen's lower left corner, whichever way the image lies.
    """
    turned = Orientation(flip_x, flip_y, quarter_turns)
    size, screen = (12, 7), turned.screen_px((12, 7))
    backend = NumpyBackend(Target(size, PSF, gamma_response(10, 2.2), WHITE_E_PER_S))
    backend.draw(sprites_at(np.array([[3.2, 5.1]]), np.array([2e3]), PSF.footprint_px))
    backend.show_on(ScreenView(size, screen, 10, turned, (9.4, 2.0)))
    backend.present(CROSSHAIR, 0, (2, 700))
    codes = backend.levels().astype(int).copy()
    codes[2] = np.maximum(codes[2], 385)  # int(1023 * 96 / 255)
    codes[:, 9] = np.maximum(codes[:, 9], 385)
    rows, columns = (axis.ravel() for axis in np.indices(codes.shape))
    x, y = turned.to_screen(columns, rows, size)
    wanted = np.zeros(screen[::-1], int)
    wanted[y, x] = codes.ravel()
    wanted[-2:, :2] = 700
    assert np.array_equal(backend.back_buffer, np.stack([wanted] * 3, axis=-1))


def test_a_primary_s_target_is_a_grey_monitor_whose_sides_are_by_its_own_light():
    """A star of white's rate has a fifth of it in a primary that is a fifth of white."""
    response = gamma_response(8, 2.2)
    uniformity = np.full(SIZE_PX[::-1], 0.9, np.float32)
    panels = tuple(Panel(response, share * 1000.0, uniformity) for share in (0.3, 0.5, 0.2))
    target = Target(
        SIZE_PX,
        PSF,
        response,
        1000.0,
        "exact",
        sides=(SpriteSide(50.0, 8), SpriteSide(10.0, 6)),
        primaries=panels,
    )
    turn = Turn((0.5,), True)
    blue = target.of_primary(2, turn)
    sides = [(side.below_e_per_s, side.side_px) for side in blue.sides]
    assert sides == [(pytest.approx(10.0), 8), (pytest.approx(2.0), 6)]
    assert (blue.flux_at_white_e_per_s, blue.quantisation) == (200.0, "exact")
    assert blue.uniformity is uniformity
    assert (blue.turn, blue.primaries) == (turn, ())


class KeptPanel:
    """A panel's backend that keeps the names of what it is asked for; its level is its number."""

    def __init__(self, number: int, target: Target) -> None:
        self.number = number
        self.target = target
        self.calls: list[str] = []
        self.shown: tuple[object, ...] = ()
        self.gl_renderer = self.gl_version = self.path = "kept"
        self.context = None

    def __getattr__(self, name: str):
        return lambda *arguments: self.calls.append(name)

    def levels(self) -> Levels:
        return Levels(np.full((2, 3), self.number, np.uint8))

    def changed_tables(self) -> int:
        return self.number

    def show_on(self, view, beside=()) -> None:
        self.shown = tuple(beside)


def test_what_is_asked_of_three_primaries_is_asked_of_each_or_of_the_screen_s_first():
    """Red, green and blue in this order, whichever chooses its levels first."""
    response = gamma_response(8, 2.2)
    panels = tuple(Panel(response, 1000.0 * share) for share in (0.3, 0.5, 0.2))
    target = Target(
        SIZE_PX, PSF, response, 1000.0, "exact", primaries=panels, together=np.ones((3, 3))
    )
    opened: list[KeptPanel] = []

    def open_panel(panel: Target, before) -> KeptPanel:
        number = round(10 * panel.flux_at_white_e_per_s / 1000.0)
        opened.append(KeptPanel(number, panel))
        assert [panel.number for panel in before] == [5, 3][: len(before)]
        return opened[-1]

    backend = ApartBackend(target, open_panel)
    assert [panel.number for panel in opened] == [5, 3, 2]
    assert backend.levels()[0, 0].tolist() == [3, 5, 2]
    assert backend.changed_tables() == 10
    backend.show_on(None)
    green, red, blue = opened
    assert (red.shown, green.shown, blue.shown) == ((green, blue), (), ())
    for name in ("begin_anew", "forget_images", "remember_tables"):
        getattr(backend, name)()
        assert [panel.calls[-1:] for panel in opened] == [[name]] * 3
    backend.draw(None, 4)
    assert [panel.calls[-1] for panel in opened] == ["draw"] * 3
    for name in ("present", "take_back_buffer", "changed_codes", "fault", "finish", "close"):
        getattr(backend, name)()
        assert [panel.calls[-1] for panel in opened] == ["draw", name, "draw"]


def test_where_numpy_draws_a_bench_is_planned_as_for_a_usual_opengl():
    by_compute = ExactQuantiser.cost(PSF, COMPUTE_VERSION)
    assert level_cost(ExactQuantiser, PSF) == by_compute
    assert level_cost(ExactQuantiser, PSF, 330) == ExactQuantiser.cost(PSF, 330) != by_compute


@pytest.mark.parametrize("sigma_px", [(0.85, 0.85), (0.6, 0.75)], ids=["even", "odd"])
@pytest.mark.parametrize("rate", [400.0, 8000.0])
def test_stars_on_any_pixel_of_an_image_s_edges_have_the_levels_of_their_light(sigma_px, rate):
    """One to a row or a column of tiles, moved by a third of a pixel from one to the next, across
    the left and right edges, then the upper and lower ones.
    """
    psf = GaussianPsf(sigma_px)
    assert psf.footprint_px % 2 == (sigma_px[0] != 0.85)
    across = np.concatenate([np.arange(-7, 7, 1 / 3), 25 + np.arange(-7, 7, 1 / 3)])
    along = 10 + 19 * np.arange(len(across)) + np.linspace(-0.5, 0.5, len(across))
    long_px = 19 * len(across) + 3
    for size, places in (
        ((25, long_px), np.stack([across, along], axis=1)),
        ((long_px, 25), np.stack([along, across], axis=1)),
    ):
        stars = sprites_at(places, np.full(len(places), rate), psf.footprint_px)
        backend = NumpyBackend(Target(size, psf, gamma_response(8, 2.2), WHITE_E_PER_S))
        backend.draw(stars)
        linear = linear_image(stars, size, psf).astype(np.float32)
        wanted = round_levels(linear, backend.target.panel())
        assert np.count_nonzero(wanted) > 500
        off = backend.levels().astype(int) - wanted
        # light in whole units, to either side of a threshold
        assert np.count_nonzero(off) <= UNITS * np.count_nonzero(wanted)
        assert np.abs(off).max() <= 1
        # nothing stays where the last frame was
        backend.draw(None)
        assert not backend.levels().any()


@pytest.mark.parametrize(("share", "lit"), [(0.98, 0), (1.02, 1)])
def test_a_lone_star_lights_its_pixel_from_the_first_threshold_on(share, lit):
    """To a part in 64 of it, the largest unit."""
    target = Target(SIZE_PX, PSF, gamma_response(8, 2.2), WHITE_E_PER_S)
    threshold = float(target.response.threshold[0]) * WHITE_E_PER_S
    rate = share * threshold / PSF.peak_share
    backend = NumpyBackend(target)
    backend.draw(sprites_at(np.array([[20.0, 30.0]]), np.array([rate]), PSF.footprint_px))
    assert np.count_nonzero(backend.levels()) == lit


@pytest.mark.parametrize("per_star", [1, 4])
def test_sprites_cover_the_squares_of_their_whole_stars_at_most(per_star):
    """Two of 10 px, three of 6 and one of 4, by rates that are a path's in all."""
    rates = np.array([200.0, 100.0, 99.0, 50.0, 10.0, 9.0]) / per_star
    stars = replace(sprites_at(np.zeros((6, 2)), rates, 10), per_star=per_star)
    sides = (SpriteSide(100.0, 6), SpriteSide(10.0, 4))
    assert most_covered_px(stars, 10, sides, 0) == 2 * 100 + 3 * 36 + 16
    # fewer than are worth counting, or of one side
    assert most_covered_px(stars, 10, sides, 601) == most_covered_px(stars, 10, (), 0) == 600


def test_a_program_of_points_knows_up_to_eight_sides_and_a_footprint_about_its_image():
    sides = tuple(SpriteSide(100.0 - k, 20 - 2 * k) for k in range(9))
    program: dict[str, object] = {}
    set_sides(program, sides[:8])
    assert program["sides"] == 8
    set_sides(program, sides[:2])
    assert program == {
        "sides": 2,
        "below_e_per_s": [100.0, 99.0, *[0.0] * 6],
        "side_px": [20, 18, *[0] * 6],
    }
    assert refusal(set_sides, program, sides) == "9 sizes of sprites; give at most 8"
    assert viewport_of_sprites((64, 48), 5) == (-5, -5, 74, 58)


def test_nothing_stays_of_a_frame_in_finer_units_or_of_a_floor(rng):
    """Sixty stars over white need units that an int has no room for."""
    target = Target(SIZE_PX, PSF, gamma_response(8, 2.2), WHITE_E_PER_S)
    places = rng.uniform(10, 38, (2, 60, 2))
    over_white = np.full(60, 3 * WHITE_E_PER_S)
    first, second = (sprites_at(at, over_white, PSF.footprint_px) for at in places)
    light = LightUnits(target.panel(), SIZE_PX, PSF)
    assert light.unit_for(second) is None
    after, alone = NumpyBackend(target), NumpyBackend(target)
    after.draw(first)
    for backend in (after, alone):
        backend.draw(second)
    assert np.array_equal(after.levels(), alone.levels())
    levels = np.zeros(SIZE_PX[::-1], np.uint8)
    cpu = CpuStars(light, levels)
    cpu.lay(Levels(np.full(SIZE_PX[::-1], 7, np.uint8)))
    star = sprites_at(np.array([[20.2, 30.1]]), np.array([900.0]), PSF.footprint_px)
    cpu.add(star, light.unit_for(star))
    cpu.encode()
    assert levels.min() == 7 < levels[30, 20]
    cpu.lay(None)
    assert not levels.any()


@pytest.mark.parametrize("sigma_px", [(0.85, 0.85), (0.6, 0.75), (1.2, 0.7)])
def test_the_smallest_square_holds_all_pixels_that_exact_may_light(sigma_px):
    """And none of two pixels less does."""
    psf = GaussianPsf(sigma_px)
    order = PixelOrder(psf)
    x, y = order.places()[:, :, : order.near]
    side = least_side_px(psf)
    assert side % 2 == psf.footprint_px % 2
    for smaller, is_held in ((0, True), (2, False)):
        first = -((side - smaller - 1) // 2)
        last = (side - smaller) // 2
        inside = (x >= first) & (x <= last) & (y >= first) & (y <= last)
        assert inside.all() == is_held


def test_a_tile_has_a_sprite_s_light_where_its_square_touches_it(rng):
    """Of tiles from a corner of the image that is none of its own; pixel by pixel."""
    corner_px, shape = (-32 + 7, 13), (5, 7)
    for reach_px in (3, 40):
        sprites_px = rng.integers((-60, -40), (300, 260), (6, 2))
        is_apart = Sure(1.0, 2.0, sprites_px, reach_px).apart(corner_px, shape)
        rows, columns = np.indices((5 * TILE_PX, 7 * TILE_PX))
        is_lit = np.zeros(rows.shape, bool)
        for x, y in sprites_px - corner_px:
            is_lit |= (np.abs(columns - x) <= reach_px) & (np.abs(rows - y) <= reach_px)
        by_tile = is_lit.reshape(5, TILE_PX, 7, TILE_PX).any(axis=(1, 3))
        assert np.array_equal(is_apart, ~by_tile)


def test_a_thousand_stars_in_a_pixel_have_their_light_though_each_is_rounded(rng):
    """To whole units, half of one off at most and none of it to one side: 5 sigmas of the sum."""
    stars = sprites_at(rng.uniform(20, 21, (1000, 2)), rng.uniform(0.2, 0.4, 1000), 10)
    target = Target(SIZE_PX, PSF, gamma_response(8, 2.2), WHITE_E_PER_S)
    light = LightUnits(target.panel(), SIZE_PX, PSF)
    unit_e_per_s = light.unit_for(stars)
    cpu = CpuStars(light, np.zeros(SIZE_PX[::-1], np.uint8), sums := np.zeros(64 * 48, np.int32))
    cpu.lay(None)
    cpu.add(stars, unit_e_per_s)
    off = sums.reshape(48, 64)[20, 20] - linear_image(stars, SIZE_PX, PSF)[20, 20] / unit_e_per_s
    assert abs(off) < 5 * np.sqrt(1000 / 12) + 1


def test_a_path_s_sprites_have_the_side_of_their_whole_star():
    """Of four sprites a fourth of the light each, on a monitor so dim that all light lights it."""
    sides = (SpriteSide(100.0, 6), SpriteSide(10.0, 4))
    backend = NumpyBackend(
        Target(SIZE_PX, PSF, gamma_response(8, 2.2), 0.01, "dither", sides=sides)
    )
    for rate, side_px in ((104.0, 10), (96.0, 6), (12.0, 6), (8.0, 4)):
        path = sprites_at(np.full((4, 2), 20.5), np.full(4, rate / 4), PSF.footprint_px)
        backend.draw(replace(path, per_star=4))
        assert np.count_nonzero(backend.levels().any(axis=0)) == side_px


def test_an_image_and_its_margin_on_both_sides_have_to_fit_what_a_gl_draws():
    gl = {
        "GL_MAX_TEXTURE_SIZE": 4096,
        "GL_MAX_VIEWPORT_DIMS": (8192, 4000),
        "GL_POINT_SIZE_RANGE": (1.0, 12.0),
    }
    check_limits(gl, (3976, 100), 12, "sigma")
    for size in ((3977, 100), (100, 3977)):
        assert "at most 3976 px" in refusal(check_limits, gl, size, 12, "sigma")
    assert "needs sprites of 13 px" in refusal(check_limits, gl, (100, 100), 13, "sigma")


@pytest.mark.parametrize("bits", [1, 8])
def test_every_code_of_grey_and_of_each_primary_is_looked_at(bits):
    triples = checked_triples(bits)
    codes = np.arange(2**bits)
    assert len(triples) == 4 * 2**bits
    for mask in ((1, 1, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1)):
        wanted = np.outer(codes, mask)
        assert {tuple(row) for row in wanted.tolist()} <= {tuple(row) for row in triples.tolist()}


def test_a_buffer_is_read_from_its_bottom_row_and_compared_from_its_top():
    """glReadPixels: the first row is the lowest, and each pixel has its colours side by side."""
    codes = np.arange(2 * 3 * 3).reshape(3, 2, 3)  # three rows of two pixels
    read = (codes / 255).astype(np.float32)[::-1].tobytes()
    np.testing.assert_array_equal(drawn_codes(read, (2, 3), 8), codes)


def test_a_share_of_some_sprites_is_added_to_what_an_image_has():
    """A quarter of the light of two of three."""
    sprites = sprites_at(
        np.array([[9.0, 8.0], [20.0, 15.0], [30.0, 22.0]]),
        np.array([4.0, 8.0, 16.0]),
        PSF.footprint_px,
    )
    image = np.full((32, 48), 0.5)
    add_stars(image, sprites, PSF, PSF.footprint_px, np.array([0, 2]), 0.25)
    assert (image - 0.5).sum() == pytest.approx(0.25 * (4.0 + 16.0), rel=1e-4)
