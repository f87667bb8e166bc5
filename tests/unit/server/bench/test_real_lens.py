"""A bench with a strongly bent lens: everything that is drawn is where the geometry file's
formulas have it.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.basics.rotation import propagate, to_matrix
from hilstar.instruments.simulate.budget import budget
from hilstar.optics.frame_motion import CameraTurn, swept_sprites
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Scan
from hilstar.server.bench.build import load
from tests.support.real_lens import SIZE, true_places_px

PLACE_PX = 1e-6
FIELDS = 20
SIGMA_SUMS = 2e-5  # of the brightest pixel: float32 sums and the sprites' cut
PATH_STEPS = 400
# The time of a row is found to a 500th of the scan-out, and the star's speed times that is the
# limit.
PATH_LIMIT = {(0.3, -0.5, 0.2): 0.2, (1.0, 0.8, -1.9): 1.0}
# Two moments, each within half a step of 1.2 scan-outs in 600, in one of hold; and at 130 deg/s how
# a path bends in that time.
SHARE_LIMIT = {(0.3, -0.5, 0.2): 3e-3, (1.0, 0.8, -1.9): 1e-2}


def random_attitude(rng):
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def test_no_star_is_lost_and_none_is_a_ghost(lens_bench, lens_folder, rng):
    reach = lens_bench.psf.footprint_px // 2
    for _ in range(FIELDS):
        q = random_attitude(rng)
        x, y = true_places_px(lens_folder, lens_bench.stars.vectors @ to_matrix(q).T)
        inside = (
            (x > -0.5 - reach + 1)
            & (x < SIZE[0] - 0.5 + reach - 1)
            & (y > -0.5 - reach + 1)
            & (y < SIZE[1] - 0.5 + reach - 1)
        )
        near = (x > -1 - reach) & (x < SIZE[0] + reach) & (y > -1 - reach) & (y < SIZE[1] + reach)
        sprites = lens_bench.sprites(q, lens_bench.stars)
        assert (
            set(np.flatnonzero(inside)) <= set(sprites.star.tolist()) <= set(np.flatnonzero(near))
        )
        assert (
            np.hypot(sprites.x_px - x[sprites.star], sprites.y_px - y[sprites.star]).max()
            < PLACE_PX
        )


def test_light_truth_and_clipping_are_at_the_bent_places(lens_bench, lens_folder, rng):
    q = random_attitude(rng)
    frame = lens_bench.frame(q)
    x, y = true_places_px(lens_folder, lens_bench.stars.vectors @ to_matrix(q).T)
    star = np.flatnonzero((np.abs(x - 960) < 980) & (np.abs(y - 540) < 560))
    wanted = np.zeros(SIZE[::-1])
    sx, sy = lens_bench.config.render.sprite_sigma_px
    for k in star:
        share_x, share_y = (
            np.diff(ndtr((np.arange(size + 1) - 0.5 - place) / sigma))
            for size, place, sigma in ((SIZE[0], x[k], sx), (SIZE[1], y[k], sy))
        )
        wanted += lens_bench.stars.electrons_per_s[k] * np.outer(share_y, share_x)
    assert np.abs(frame.linear - wanted).max() < SIGMA_SUMS * wanted.max()
    hip = {int(h): k for k, h in enumerate(lens_bench.stars.hip)}
    rows = np.array([hip[int(h)] for h in frame.truth["hip"]])
    assert np.hypot(frame.truth["x_px"] - x[rows], frame.truth["y_px"] - y[rows]).max() < PLACE_PX
    inside = (x[rows] > 3) & (x[rows] < SIZE[0] - 4) & (y[rows] > 3) & (y[rows] < SIZE[1] - 4)
    for row, k in zip(frame.truth[inside], rows[inside], strict=True):
        peak = wanted[round(y[k]), round(x[k])]
        if not 0.98 < peak / lens_bench.flux_at_white_e_per_s < 1.02:
            assert row["clipped"] == (peak > lens_bench.flux_at_white_e_per_s)


def test_exact_codes_put_a_star_in_a_bent_corner_where_it_belongs(lens_bench, lens_folder, rng):
    """A code's light over a star's own pixels has its centroid, as far as the monitor's steps
    let it.
    """
    offs = []
    for _ in range(6):
        q = random_attitude(rng)
        frame = lens_bench.frame(q)
        light = lens_bench.panel.response.light[frame.levels]
        x, y = true_places_px(lens_folder, lens_bench.stars.vectors @ to_matrix(q).T)
        bright = lens_bench.stars.electrons_per_s > 0.02 * lens_bench.flux_at_white_e_per_s
        bright &= lens_bench.stars.electrons_per_s < lens_bench.flux_at_white_e_per_s
        corner = (
            (np.abs(x - 959.5) > 500)
            & (np.abs(y - 539.5) > 250)
            & (np.abs(x - 959.5) < 950)
            & (np.abs(y - 539.5) < 530)
        )
        for k in np.flatnonzero(bright & corner):
            c, r = round(x[k]), round(y[k])
            window = light[r - 5 : r + 6, c - 5 : c + 6]
            if (np.hypot(x - x[k], y - y[k]) < 14).sum() > 1:
                continue
            rows, columns = np.mgrid[-5:6, -5:6]
            offs.append(
                np.hypot(
                    (columns * window).sum() / window.sum() + c - x[k],
                    (rows * window).sum() / window.sum() + r - y[k],
                )
            )
    assert len(offs) > 5
    assert np.median(offs) < 0.02


@pytest.mark.parametrize("rate", [(0.3, -0.5, 0.2), (1.0, 0.8, -1.9)], ids=["slew", "spin"])
def test_paths_are_those_of_the_bent_stars_while_their_rows_are_lit(
    lens_bench, lens_folder, rng, rate
):
    """Each star's light on the screen, and its centroid, by small steps of time; none is lost
    that only cuts a corner.
    """
    q, rate = random_attitude(rng), np.array(rate)
    found = lens_bench.light(lens_bench.view(q, rate))
    scan = lens_bench.scan
    near = np.flatnonzero(
        (lens_bench.shown_stars.vectors @ to_matrix(q).T)[:, 2] > np.cos(np.radians(25))
    )
    stars, rates_e = (
        lens_bench.shown_stars.vectors[near],
        lens_bench.shown_stars.electrons_per_s[near],
    )

    def at(seconds):
        turned = to_matrix(propagate(q, rate, seconds))
        return true_places_px(lens_folder, stars @ turned.T)

    times = np.linspace(-0.6, 0.6, 601) * scan.scanout_s

    def met(after_s):
        """When the panel, `after_s` after it lit the middle row, writes each star's row, from
        that moment on.
        """
        # The row of each star at each time; the panel is there where the two agree.
        found_s, rows = np.zeros(len(near)), np.array([at(t + after_s)[1] for t in times])
        with np.errstate(invalid="ignore"):
            differ = np.abs(
                np.clip((rows - 539.5) / SIZE[1], -0.5, 0.5) * scan.scanout_s - times[:, None]
            )
        seen_ever = np.isfinite(differ).any(axis=0)
        found_s[seen_ever] = times[np.nanargmin(differ[:, seen_ever], axis=0)]
        return found_s

    late = met(0.0)
    span = scan.hold_s + met(scan.hold_s) - late
    axis = rate / np.linalg.norm(rate)
    cam = stars @ to_matrix(q).T
    total = np.zeros((len(cam), 3))
    for step in (np.arange(PATH_STEPS) + 0.5) / PATH_STEPS:
        angle = (-np.linalg.norm(rate) * (late + step * span))[:, None]
        turned = (
            cam * np.cos(angle)
            + np.cross(axis, cam) * np.sin(angle)
            + (cam @ axis)[:, None] * axis * (1 - np.cos(angle))
        )
        x, y = true_places_px(lens_folder, turned)
        on = (x > -0.5) & (x < SIZE[0] - 0.5) & (y > -0.5) & (y < SIZE[1] - 0.5)
        total[on] += np.column_stack([np.ones(on.sum()), x[on], y[on]]) / PATH_STEPS
    share, place_of = np.zeros(len(cam)), np.searchsorted(near, found.star)
    assert np.array_equal(near[place_of], found.star)
    np.add.at(share, place_of, found.data["electrons_per_s"].astype(float))
    share /= rates_e
    assert (share[total[:, 0] > 0.02] > 0).all()
    whole = total[:, 0] > 1 - 0.5 / PATH_STEPS
    assert whole.sum() > 50
    # A star that runs with the scan meets fewer frames, and has more light in each.
    assert np.abs(share - span / scan.hold_s)[whole].max(initial=0) < SHARE_LIMIT[tuple(rate)]
    for place, column in ((found.x_px, 1), (found.y_px, 2)):
        mean = np.zeros(len(cam))
        np.add.at(mean, place_of, place * found.data["electrons_per_s"])
        off = mean[whole] / (rates_e * share)[whole] - total[whole, column]
        assert np.abs(off).max(initial=0) < PATH_LIMIT[tuple(rate)]


def test_a_fast_star_that_cuts_a_corner_from_beyond_the_lens_to_beyond_it_is_drawn(lens_bench):
    """The lens ends with the farthest corner, and a path between two places beyond it can still
    cross that corner.
    """
    star, hold_s, camera = 100, 1 / 60, lens_bench.camera
    corners = np.array([[3.0, 3.0], [1916.0, 3.0], [3.0, 1076.0], [1916.0, 1076.0]])
    corner = corners[np.argmax(np.hypot(*camera.tangents(*corners.T)))]
    ray = camera.rays(*corner[:, None])[0]
    ray /= np.linalg.norm(ray)
    from_star = lens_bench.shown_stars.vectors[star]
    q = np.concatenate([[1 + from_star @ ray], np.cross(from_star, ray)])
    q /= np.linalg.norm(q)
    outward = camera.cam_to_image.T @ [*(camera.cam_to_image @ ray)[:2], 0.0]
    rate = 4.5 * outward / np.linalg.norm(outward)
    turn = CameraTurn(propagate(q, rate, -hold_s / 2), rate)
    for seconds in (0.0, hold_s):
        seen = (
            camera.cam_to_image
            @ to_matrix(propagate(turn.q_icrs_to_cam, rate, seconds))
            @ from_star
        )
        assert np.isnan(camera.project(seen[None])[0])
    sigma_px = lens_bench.config.render.sprite_sigma_px
    found = swept_sprites(
        lens_bench.shown_stars, turn, Scan((0, 1), 0.0, hold_s), camera, GaussianPsf(sigma_px)
    )
    assert (
        found.data["electrons_per_s"][found.star == star].sum()
        > 0.01 * lens_bench.shown_stars.electrons_per_s[star]
    )


def test_the_crosshair_is_where_the_boresight_is_shown(lens_bench, lens_folder):
    x, y = true_places_px(lens_folder, np.array([[0.0, 0.0, 1.0]]))
    assert lens_bench.camera.boresight_px == pytest.approx((x[0], y[0]), abs=PLACE_PX)
    assert np.hypot(x[0] - 974.5, y[0] - 524.0) > 20  # the principal point is elsewhere


def test_a_budget_counts_arcseconds_where_a_pixel_is_widest(lens_bench, lens_folder):
    """By differences: two directions a small angle apart, all ways, all over the screen."""
    rng, h = np.random.default_rng(8), 1e-6
    x, y = (
        part.ravel() for part in np.meshgrid(np.linspace(0, 1919, 33), np.linspace(0, 1079, 19))
    )
    seen = lens_bench.camera.rays(x, y)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    arcsec = []
    for _ in range(60):
        step = np.cross(seen, rng.normal(size=3))
        step /= np.linalg.norm(step, axis=1, keepdims=True)
        x1, y1 = true_places_px(lens_folder, seen + h * step)
        arcsec.append(h / np.hypot(x1 - x, y1 - y) * 206264.806)
    row = next(row for row in budget(lens_bench).rows if row.centroid_max_px)
    assert row.centroid_max_arcsec / row.centroid_max_px == pytest.approx(np.max(arcsec), rel=0.003)


def test_a_bent_star_has_its_light_on_a_screen_that_is_not_uniform(lens_folder, tmp_path, rng):
    """Codes times the pixels' own light, down to 0.43 of the brightest, add up to the star where
    the lens has it.
    """
    light = np.linspace(0, 1, 1024) ** 2.2
    (tmp_path / "r.csv").write_text(
        "code,w\n" + "\n".join(f"{code},{value!r}" for code, value in enumerate(light.tolist()))
    )
    (tmp_path / "u.csv").write_text("0.8,1.0\n1.0,0.9\n")
    (tmp_path / "c.toml").write_text(
        '[calibration]\nkind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\nbits'
        ' = 10\nresponse = "r.csv"\n[uniformity]\nfile = "u.csv"\n'
    )
    (tmp_path / "geometry.toml").write_text((lens_folder / "geometry.toml").read_text())
    text = (
        (lens_folder / "bench.toml")
        .read_text()
        .replace("[monitor]", '[monitor]\ncalibration = "c.toml"')
    )
    (tmp_path / "bench.toml").write_text(text)
    wrong = []
    with load(tmp_path / "bench.toml") as lens_bench:
        # The grid's numbers stand for the middles of the screen's quarters, beyond which its slope
        # goes on; the brightest is 1.
        s, t = ((np.arange(size) - (size / 4 - 0.5)) / (size / 2) for size in SIZE)
        across = np.outer(1 - t, 0.8 + 0.2 * s) + np.outer(t, 1.0 - 0.1 * s)
        across /= across.max()
        for _ in range(6):
            q = random_attitude(rng)
            shown = light[lens_bench.frame(q).levels] * across * lens_bench.flux_at_white_e_per_s
            x, y = true_places_px(lens_folder, lens_bench.stars.vectors @ to_matrix(q).T)
            rate = lens_bench.stars.electrons_per_s
            good = (rate > 0.05 * lens_bench.flux_at_white_e_per_s) & (
                rate < lens_bench.flux_at_white_e_per_s
            )
            good &= (np.abs(x - 959.5) < 940) & (np.abs(y - 539.5) < 520)
            for k in np.flatnonzero(good):
                if (np.hypot(x - x[k], y - y[k]) < 14).sum() == 1:
                    c, r = round(x[k]), round(y[k])
                    wrong.append(shown[r - 5 : r + 6, c - 5 : c + 6].sum() / rate[k] - 1)
    assert len(wrong) > 10
    assert np.abs(wrong).max() < 0.02
    assert abs(np.mean(wrong)) < 0.003
