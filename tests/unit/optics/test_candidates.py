"""Stars kept from frame to frame give the sprites of stars looked for anew, bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, propagate, to_matrix
from hilstar.display.geometry import monitor_camera
from hilstar.optics.camera import Lens, bounded
from hilstar.optics.sprites import KEPT_TURN_RAD, Candidates, FrameLight, make_sprites
from hilstar.sky.stars import with_bodies
from tests.support.stars import stars_at

IDENTITY = np.array([1.0, 0, 0, 0])
SIZE, FOOTPRINT = (1920, 1080), 10
STARTS = {
    "equator": (84.0, -1.2, 10.0),
    "pole": (10.0, 90.0, 0.0),
    "beside the pole": (200.0, -88.5, 45.0),
}
STEPS = 12


@pytest.fixture(scope="module")
def dense_sky():
    rng = np.random.default_rng(3)
    return stars_at(rng.normal(size=(30_000, 3)), rng.uniform(1.0, 2.0, 30_000))


def camera_of(focal_mm: float, lens: Lens | None = None):
    return bounded(
        replace(monitor_camera(SIZE, 57.65, focal_mm, IDENTITY), lens=lens), FOOTPRINT / 2 + 1
    )


def assert_same_light(kept: FrameLight, fresh: FrameLight) -> None:
    for name in ("data", "star", "x_px", "y_px"):
        assert getattr(kept, name).tobytes() == getattr(fresh, name).tobytes()


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("focal_mm", [2000.0, 200.0, 12.0])  # fields of 3 to 155 degrees
@pytest.mark.parametrize("step_of_limit", [0.01, 0.3, 0.999, 30.0])
def test_sprites_are_those_of_a_fresh_look(dense_sky, start, focal_mm, step_of_limit, rng):
    camera, candidates, q = camera_of(focal_mm), Candidates(), from_radec_roll_deg(*STARTS[start])
    for k in range(STEPS):
        # every third step is roll alone
        axis = np.array([0.0, 0.0, 1.0]) if k % 3 == 0 else rng.normal(size=3)
        q = propagate(q, axis / np.linalg.norm(axis), step_of_limit * KEPT_TURN_RAD)
        kept = make_sprites(dense_sky, to_matrix(q), camera, FOOTPRINT, candidates)
        assert_same_light(kept, make_sprites(dense_sky, to_matrix(q), camera, FOOTPRINT))


def test_a_lens_has_them_too(dense_sky, rng):
    camera, candidates, q = (
        camera_of(60.0, Lens(radial=(0.05, 0.0, 0.0))),
        Candidates(),
        from_radec_roll_deg(30.0, 40.0, 50.0),
    )
    for _ in range(STEPS):
        q = propagate(q, rng.normal(size=3), 0.2 * KEPT_TURN_RAD)
        kept = make_sprites(dense_sky, to_matrix(q), camera, FOOTPRINT, candidates)
        assert_same_light(kept, make_sprites(dense_sky, to_matrix(q), camera, FOOTPRINT))


def test_stars_are_looked_for_again_beyond_the_turn_alone(dense_sky):
    camera, candidates, q = camera_of(200.0), Candidates(), from_radec_roll_deg(30.0, 40.0, 50.0)
    first = candidates.near(dense_sky, to_matrix(q), camera, 6.0)[0]
    for rate in np.eye(3):
        within, beyond = (
            to_matrix(propagate(q, rate, share * KEPT_TURN_RAD)) for share in (0.99, 1.01)
        )
        assert candidates.near(dense_sky, within, camera, 6.0)[0] is first
        candidates.near(dense_sky, beyond, camera, 6.0)
        again = candidates.near(dense_sky, to_matrix(q), camera, 6.0)[0]
        assert again is not first
        first = again


def test_other_stars_lights_observers_and_cameras_are_not_mistaken(dense_sky, rng):
    camera, candidates, turn = (
        camera_of(200.0),
        Candidates(),
        to_matrix(from_radec_roll_deg(30.0, 40.0, 50.0)),
    )
    others = stars_at(rng.normal(size=(len(dense_sky), 3)), np.ones(len(dense_sky)))
    fainter = replace(dense_sky, electrons_per_s=dense_sky.electrons_per_s / 2)
    moving = dense_sky.seen_at(np.array([12_000.0, -9_000.0, 4_000.0]))
    stops = moving.seen_at(np.array([0.0, 9_000.0, 0.0]))
    # each after the other by one camera, and by another camera without other stars between
    for stars in (dense_sky, others, fainter, moving, stops, dense_sky):
        kept = make_sprites(stars, turn, camera, FOOTPRINT, candidates)
        assert_same_light(kept, make_sprites(stars, turn, camera, FOOTPRINT))
    wider = camera_of(60.0)
    kept = make_sprites(dense_sky, turn, wider, FOOTPRINT, candidates)
    assert_same_light(kept, make_sprites(dense_sky, turn, wider, FOOTPRINT))


def test_a_wider_margin_is_looked_through_anew(dense_sky):
    """As by a PSF of a larger footprint on the same camera."""
    camera, candidates, turn = camera_of(200.0), Candidates(), np.eye(3)
    found = [len(candidates.near(dense_sky, turn, camera, px).star) for px in (6.0, 900.0, 6.0)]
    fresh = [len(Candidates().near(dense_sky, turn, camera, px).star) for px in (6.0, 900.0)]
    assert found == [fresh[0], fresh[1], fresh[0]]
    assert fresh[1] > fresh[0]


def test_bodies_that_move_in_the_arrays_are_looked_for_in_every_frame(dense_sky):
    camera, candidates, turn = camera_of(200.0), Candidates(), np.eye(3)
    bodies = with_bodies(dense_sky, ("Moon",), np.zeros(1))
    for x in (0.5, 0.0, 0.01):
        direction = np.array([x, 0.0, 1.0]) / np.hypot(x, 1.0)
        bodies.vectors[-1] = bodies.grid.centre[-1] = direction
        bodies.electrons_per_s[-1] = 1 + x
        kept = make_sprites(bodies, turn, camera, FOOTPRINT, candidates)
        assert_same_light(kept, make_sprites(bodies, turn, camera, FOOTPRINT))
        assert (len(dense_sky) in kept.star) == (x < 0.1)


def test_half_a_turn_about_any_axis_is_looked_at_anew(rng):
    """Of two attitudes half a turn apart the chord is 1, which rounding passes in one of six."""
    stars = stars_at(rng.normal(size=(50, 3)), np.ones(50))
    camera, candidates = camera_of(12.0), Candidates()
    q = IDENTITY
    for _ in range(60):
        axis = rng.normal(size=3)
        q = propagate(q, axis / np.linalg.norm(axis), np.pi)
        kept = make_sprites(stars, to_matrix(q), camera, FOOTPRINT, candidates)
        assert_same_light(kept, make_sprites(stars, to_matrix(q), camera, FOOTPRINT))
