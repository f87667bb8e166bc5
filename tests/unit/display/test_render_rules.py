"""Rules of drawing that need no OpenGL: the units in which light adds up, what a GL is asked for, and
which codes are looked at.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.display.panel import Panel
from hilstar.display.render.aids import CROSSHAIR, PATCH, lay_over
from hilstar.display.render.context import check_limits, draws_by_cpu
from hilstar.display.render.encoder import MEETING_WINGS, lit_sides
from hilstar.display.render.light_units import DENSER_WINGS, MAX_SUM, LightUnits
from hilstar.display.render.presenter import checked_triples, drawn_codes
from hilstar.display.response import gamma_response
from hilstar.optics.psf import GaussianPsf
from tests.support.refusals import refusal
from tests.support.stars import sprites_at

SIZE_PX = (64, 48)
PSF = GaussianPsf((0.85, 0.85))
WHITE_E_PER_S = 1000.0


def units(uniformity: np.ndarray | None = None) -> LightUnits:
    response = gamma_response(8, 2.2)
    return LightUnits(Panel(response, WHITE_E_PER_S, uniformity), SIZE_PX, PSF)


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
    gl = SimpleNamespace(info={"GL_RENDERER": renderer})
    for wanted, by_cpu in (("", by_itself), ("cpu", True), ("gl", False)):
        monkeypatch.setenv("HILSTAR_DRAW", wanted)
        assert draws_by_cpu(gl) == by_cpu


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


@pytest.mark.parametrize(("patch", "lines"), [(0, 96), (95, 96), (96, 0), (97, 0), (255, 0)])
def test_on_a_patch_as_bright_as_a_line_lines_are_dark(patch, lines):
    levels = np.full((6, 8), 50, dtype=np.uint8)
    lay_over(levels, PATCH | CROSSHAIR, patch, 96, (3, 2))
    assert (levels[2] == lines).all()
    assert (levels[:, 3] == lines).all()
    assert levels[0, 0] == patch


def described_gl(texture: int = 4096, viewport: tuple[int, int] = (8192, 4000), points: float = 12):
    return SimpleNamespace(
        info={
            "GL_MAX_TEXTURE_SIZE": texture,
            "GL_MAX_VIEWPORT_DIMS": viewport,
            "GL_POINT_SIZE_RANGE": (1.0, points),
        }
    )


def test_an_image_and_its_margin_on_both_sides_have_to_fit_what_a_gl_draws():
    gl = described_gl()
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
