"""Discs in frames: stars and bodies behind them, white, the edge of the screen, a turn, and
every quantisation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from skyfield.api import Star

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.display.quantise import dither_levels, mask_turn, round_levels
from hilstar.display.render.disc_tiles import disc_tiles
from hilstar.display.render.extended_drawing import ExtendedLayer
from hilstar.display.render.reference import linear_image
from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import srgb_response
from hilstar.instruments.simulate.twin import Twin
from hilstar.instruments.verify.measure import Comparison
from hilstar.optics.camera import Camera, Lens
from hilstar.optics.extended import DiscLight, DiscView, LightMap, Pose, Shear, disc_lights
from hilstar.optics.layers.bodies import BodyLayer, DiscDrawing, past_discs
from hilstar.optics.layers.layers import light_of, sky_layers
from hilstar.optics.layers.truth import brightest_in_view
from hilstar.optics.layers.view import Canvas, View
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.scan import Scan
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.build import load
from hilstar.server.bench.frame import Bench
from hilstar.sky.bodies.disc import Disc
from tests.support.benches import TWIN, bench_text
from tests.support.skies import skyfield
from tests.support.stars import sprites_at

# The Moon before the Beehive.
NIGHT, BEEHIVE = "2026-11-29T00:00:00Z", (42485, 42516, 42523, 42549, 42578)
AT_START = View(np.array([1.0, 0.0, 0.0, 0.0]))
SIZE, SIGMA, WHITE = (96, 80), (0.85, 0.85), 4e5
CAMERA = Camera(SIZE, 900.0, (47.5, 39.5), np.eye(3))
LENS = Lens(radial=(0.2, 0.05, 0.0), tangential=(1e-3, -2e-3))
# The reference's own rays, five across a pixel, leave 0.3 % of a small crescent's light and 3 % of
# its brightest pixel.
FLUX_LIMIT, PIXEL_LIMIT = 0.01, 0.05


@pytest.fixture(scope="module")
def moon_bench(tmp_path_factory) -> Iterator[Bench]:
    file = tmp_path_factory.mktemp("discs") / "bench.toml"
    bodies = {"moon": True, "sun": True, "planets": True}
    tables = {
        "sky": {"epoch_utc": NIGHT, "faintest_v_mag": 7.0},
        "sky.bodies": bodies,
        "render": {"quantisation": "round"},
    }
    file.write_text(bench_text(tables))
    with load(file) as opened:
        yield opened


def aim(moon_bench: Bench, name: str, off_deg: float = 0.0) -> np.ndarray:
    """The attitude with a body that far above the middle."""
    stars = moon_bench.seen(moon_bench.stars, AT_START)
    vector = stars.vectors[len(stars) - len(stars.bodies) + stars.bodies.index(name)]
    ra, dec = np.degrees(np.arctan2(vector[1], vector[0])), np.degrees(np.arcsin(vector[2]))
    return from_radec_roll_deg(ra, dec - off_deg, 0.0)


def disc_on_image(radius_px: float, phase_deg: float, at_px=(45.0, 41.0), name="Moon") -> Disc:
    direction = CAMERA.rays(np.array([at_px[0]]), np.array([at_px[1]]))[0]
    direction /= np.linalg.norm(direction)
    side = np.cross(direction, [0.3, 1.0, 0.2])
    side /= np.linalg.norm(side)
    sun = -np.cos(np.radians(phase_deg)) * direction + np.sin(np.radians(phase_deg)) * side
    distance = 1 / np.sin(radius_px / CAMERA.focal_length_px)
    one = Disc(
        name,
        direction,
        distance,
        1.0,
        1.0,
        np.array([0.0, 0.0, 1.0]),
        sun,
        "lunar-lambert",
        1.0,
        0.6,
    )
    return one.of_rate(1e8)


def test_stars_behind_the_moon_are_neither_drawn_nor_in_the_table(moon_bench):
    q = aim(moon_bench, "Moon")
    shot = moon_bench.frame(q)
    listed = set(shot.truth["hip"].tolist())
    assert not listed & set(BEEHIVE)
    with skyfield() as (scale, kernel):
        now = kernel["earth"].at(scale.utc(2026, 11, 29))
        moon = now.observe(kernel["moon"]).apparent()
        radius_deg = np.degrees(np.arcsin(1737.4 / moon.distance().km))
        catalog = moon_bench.stars.catalog
        near = np.flatnonzero(
            (np.abs(catalog.dec_deg - 19.5) < 3)
            & (np.abs(catalog.ra_deg - 130) < 3)
            & (catalog.v_mag < 7)
        )
        stars = Star(ra_hours=catalog.ra_deg[near] / 15, dec_degrees=catalog.dec_deg[near])
        off_deg = now.observe(stars).apparent().separation_from(moon).degrees
    assert set(catalog.hip[near[off_deg < 0.99 * radius_deg]].tolist()) == set(BEEHIVE)
    beside = set(catalog.hip[near[(off_deg > 1.01 * radius_deg) & (off_deg < 1.0)]].tolist())
    assert len(beside) > 5 and beside <= listed
    assert shot.truth["name"][0] == "Moon"
    assert shot.linear.sum() == pytest.approx(shot.truth["electrons_per_s"].sum(), rel=FLUX_LIMIT)
    assert moon_bench.losses_mag(shot)["Moon"] > 3
    view, canvas = View(q), Canvas(moon_bench.camera, GaussianPsf(SIGMA))
    stars, layers = moon_bench.seen(moon_bench.stars, view), sky_layers(canvas, moon_bench.sources)
    for seen, behind in ((layers, set()), (layers[:1], set(BEEHIVE))):
        found = brightest_in_view(
            light_of(canvas, seen, stars, view), stars, moon_bench.camera, q, 500
        )
        assert {star.hip for star in found} & set(BEEHIVE) == behind


def test_the_moon_a_degree_beside_the_field_changes_nothing_and_half_of_it_is_half(moon_bench):
    half_deg = np.degrees(
        np.arctan(moon_bench.camera.resolution_px[1] / 2 / moon_bench.camera.focal_length_px)
    )
    beside = moon_bench.light(moon_bench.view(aim(moon_bench, "Moon", half_deg + 1.0)))
    assert beside.extended == () and beside.over_white == ()
    whole, half = (moon_bench.frame(aim(moon_bench, "Moon", off)) for off in (0.0, half_deg))
    named = {row["name"]: row for row in half.truth}
    assert named["Moon"]["clipped"] and named["Moon"]["y_px"] == pytest.approx(-0.5, abs=0.3)
    assert 0.2 < half.linear.sum() / whole.linear.sum() < 0.8
    assert moon_bench.losses_mag(half)["Moon"] == pytest.approx(
        moon_bench.losses_mag(whole)["Moon"], abs=0.5
    )


def test_the_sun_in_the_field_is_white_finite_and_told_and_stars_keep_their_light(moon_bench):
    q = aim(moon_bench, "Sun", 1.0)
    shot = moon_bench.frame(q)
    assert np.isfinite(shot.linear).all() and shot.linear.max() > 1e15
    assert (shot.levels == shot.levels.max()).sum() > 50
    row = shot.truth[shot.truth["name"] == "Sun"][0]
    assert row["clipped"] and moon_bench.losses_mag(shot)["Sun"] > 15
    assert "Sun" in moon_bench.draw(q).clipped_hip
    sprites = moon_bench.light(moon_bench.view(q))
    points = moon_bench.sprites(q, moon_bench.seen(moon_bench.shown_stars, View(q)))
    kept = np.isin(points.star, sprites.star)
    assert len(sprites) > 10 and np.array_equal(sprites.data, points.data[kept])


def test_a_nearer_disc_hides_a_farther_one_and_covers_all_of_it():
    near, far = (
        disc_on_image(9.0, 20.0, name="near"),
        disc_on_image(20.0, 30.0, (47.0, 40.0), "far"),
    )
    view = DiscView(CAMERA, GaussianPsf(SIGMA), (Pose(np.eye(3)),))
    with Renderer(Target(SIZE, GaussianPsf(SIGMA))) as gl:
        none = sprites_at(np.empty((0, 2)), np.empty(0), gl.footprint_px)
        both = replace(
            none, extended=(*disc_lights(far, view, False), *disc_lights(near, view, True))
        )
        gl.draw(both)
        got, wanted = gl.linear().astype(float), linear_image(both, SIZE, GaussianPsf(SIGMA))
        gl.draw(replace(none, extended=tuple(disc_lights(near, view, False))))
        alone = gl.linear().astype(float)
    assert np.abs(got - wanted).max() < PIXEL_LIMIT * wanted.max()
    # seven pixels within the limb
    assert got[38:44, 42:48] == pytest.approx(alone[38:44, 42:48], rel=1e-5)


def test_a_disc_that_others_hide_as_a_whole_is_none():
    """The Sun in a total eclipse is neither drawn nor listed, and comes back at its last
    contact.
    """
    drawing = DiscDrawing(Canvas(CAMERA, GaussianPsf(SIGMA)))
    moon = disc_on_image(20.0, 170.0, (45.0, 41.0))
    for sun, seen in (
        (disc_on_image(19.0, 0.0, (45.5, 41.0), "Sun"), 1),
        (disc_on_image(19.0, 0.0, (47.0, 41.0), "Sun"), 2),
    ):
        assert len(drawing.on_image([moon, sun], AT_START)) == seen


def test_a_point_behind_a_disc_is_gone_and_one_before_it_stays(moon_bench):
    q = aim(moon_bench, "Moon")
    layer = BodyLayer(moon_bench.moving, Canvas(moon_bench.camera, GaussianPsf(SIGMA)))
    stars = moon_bench.seen(moon_bench.shown_stars, View(q))
    points = moon_bench.sprites(q, stars)
    first = len(stars) - len(moon_bench.moving.names)
    moon = int(np.flatnonzero(points.star == first + moon_bench.moving.names.index("Moon"))[0])
    (face,) = layer.on_image(View(q))
    jupiter = first + moon_bench.moving.names.index("Jupiter")
    behind = replace(points, star=np.where(np.arange(len(points)) == moon, jupiter, points.star))
    stars.vectors[jupiter] = face.direction
    distances_km = moon_bench.moving.distances_km()
    assert jupiter not in past_discs(behind, stars, [face], distances_km).star
    farther = replace(face, distance_km=1e12)
    assert jupiter in past_discs(behind, stars, [farther], distances_km).star


@pytest.mark.parametrize("radius_px", [3.0, 25.0])
@pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("late_s", [0.0, 1 / 60], ids=["at once", "row by row"])
def test_the_reference_has_the_same_disc(radius_px, lens, late_s):
    one = disc_on_image(radius_px, 60.0)
    shear = (
        Shear(np.array([0.02, 0.05, 0.01]), (0.0, late_s / SIZE[1]), (47.5, 39.5))
        if late_s
        else None
    )
    view = DiscView(replace(CAMERA, lens=lens), GaussianPsf(SIGMA), (Pose(np.eye(3)),), shear)
    with Renderer(Target(SIZE, GaussianPsf(SIGMA))) as gl:
        sprites = replace(
            sprites_at(np.array([[60.2, 30.7]]), np.array([2e5]), gl.footprint_px),
            extended=tuple(disc_lights(one, view, covers=True)),
        )
        gl.draw(sprites)
        got = gl.linear()
        assert gl.gl_error() == "GL_NO_ERROR"
    wanted = linear_image(sprites, SIZE, GaussianPsf(SIGMA))
    assert got.sum(dtype=float) == pytest.approx(wanted.sum(), rel=FLUX_LIMIT)
    assert np.abs(got - wanted).max() < PIXEL_LIMIT * wanted.max()


WHOLE, PART = (104.0, (47.0, 40.0)), (400.0, (310.0, 300.0))


@pytest.mark.parametrize(
    ("face", "law"),
    [(WHOLE, "lunar-lambert"), (WHOLE, "limb-darkened"), (PART, "lambert"), (PART, "uniform")],
    ids=["the Moon", "the Sun", "a near planet", "a part"],
)
def test_a_large_disc_in_tiles_is_that_of_the_reference(face, law):
    size = (226, 222)
    cam = Camera(size, 900.0, (112.5, 110.5), np.eye(3), LENS)
    one = replace(
        disc_on_image(face[0], 50.0, face[1]),
        law=law,
        polar_km=0.93,
        pole=np.array([0.6, 0.8, 0.0]),
        lunar_share=0.4,
    )
    light = DiscLight(one, np.eye(3), cam, GaussianPsf((0.85, 1.1)))
    tiles = disc_tiles(light, light.region(size))
    assert tiles is not None and len(tiles.face) + len(tiles.edges) > 2
    with Renderer(Target(size, GaussianPsf((0.85, 1.1)))) as gl:
        sprites = replace(
            sprites_at(np.empty((0, 2)), np.empty(0), gl.footprint_px), extended=(light,)
        )
        gl.draw(sprites)
        got = gl.linear()
    wanted = linear_image(sprites, size, GaussianPsf((0.85, 1.1)))
    assert got.sum(dtype=float) == pytest.approx(wanted.sum(), rel=FLUX_LIMIT / 3)
    assert np.abs(got - wanted).max() < PIXEL_LIMIT * wanted.max()  # at the horns; 0.8 % elsewhere


@pytest.mark.parametrize("radius_px", [3.0, 20.0])
@pytest.mark.parametrize("method", ["round", "dither", "temporal", "exact"])
def test_every_quantisation_encodes_discs_and_erases_them(method, radius_px):
    target = Target(SIZE, GaussianPsf(SIGMA), srgb_response(10), WHITE, method)
    panel = target.panel()
    turned = lambda image, panel: dither_levels(image, panel, mask_turn(3))  # noqa: E731
    oracle = {"round": round_levels, "temporal": turned}.get(method, dither_levels)
    view = DiscView(CAMERA, GaussianPsf(SIGMA), (Pose(np.eye(3)),))
    with Renderer(target) as gl:
        star = sprites_at(np.array([[20.2, 20.7]]), np.array([2e5]), gl.footprint_px)
        gl.draw(star, 3)
        plain = gl.levels().copy()
        for _ in range(2):
            gl.draw(
                replace(
                    star,
                    extended=tuple(disc_lights(disc_on_image(radius_px, 40.0), view, covers=True)),
                ),
                3,
            )
            levels = gl.levels().copy()
            wanted = oracle(gl.linear(), panel)
            assert np.mean(levels[30:] != wanted[30:]) < 1e-3  # ties alone
            assert (levels[30:] == 1023).any() == (radius_px == 3.0) and levels[30:].max() > 300
            gl.draw(star, 3)
            assert (gl.levels() == plain).all()


def test_maps_of_discs_do_not_push_out_those_that_last(monkeypatch):
    uploaded = []
    upload = ExtendedLayer._upload
    monkeypatch.setattr(
        ExtendedLayer,
        "_upload",
        lambda self, image, n: uploaded.append(image.shape) or upload(self, image, n),
    )
    view = DiscView(CAMERA, GaussianPsf(SIGMA), (Pose(np.eye(3)),))
    lasting = LightMap(np.ones(SIZE[::-1], dtype=np.float32))
    with Renderer(Target(SIZE, GaussianPsf(SIGMA))) as gl:
        none = sprites_at(np.empty((0, 2)), np.empty(0), gl.footprint_px)
        for _ in range(3):
            discs = [
                light
                for x in range(5)
                for light in disc_lights(
                    disc_on_image(2.0, 40.0, (10.0 + 15 * x, 40.0)), view, covers=True
                )
            ]
            gl.draw(replace(none, extended=(lasting, *discs)))
            assert gl.linear().sum() > 4e8
    assert uploaded.count(SIZE[::-1]) == 1
    assert len(uploaded) == 1 + 3 * 2 * 5


def test_a_disc_under_a_turn_keeps_its_light_and_lies_along_the_way_of_its_star(moon_bench):
    """A turn of 3 degrees/s, 17 ms for a row: 0.9 px of this screen; a star at the Moon's middle
    is the truth for its place.
    """
    q, rate = aim(moon_bench, "Moon"), np.array([0.0, np.radians(3.0), 0.0])
    scan = Scan(scanout_s=1 / 60, hold_s=1 / 60)
    layer = BodyLayer(moon_bench.moving, moon_bench.canvas)
    stars = moon_bench.seen(moon_bench.shown_stars, View(q))
    none = sprites_at(np.empty((0, 2)), np.empty(0), moon_bench.psf.footprint_px)
    middles = []
    for turn in (None, rate, 4 * rate):
        moon_bench.renderer.draw(layer.add(none, stars, View(q, turn, scan=scan)))
        light = moon_bench.renderer.linear().astype(float)
        y, x = np.mgrid[: light.shape[0], : light.shape[1]]
        middles.append(
            (light.sum(), (light * x).sum() / light.sum(), (light * y).sum() / light.sum())
        )
    still, *turned = middles
    for times, (total, x, y) in zip((1, 4), turned, strict=True):
        assert total == pytest.approx(still[0], rel=FLUX_LIMIT)
        way_px = (
            times * np.radians(3.0) / 120 * moon_bench.camera.focal_length_px
        )  # in half the time
        assert abs(x - still[1]) == pytest.approx(way_px, abs=0.1)
        assert y == pytest.approx(still[2], abs=0.1)


def test_verify_takes_no_disc_and_no_star_beside_it_for_a_star(tmp_path):
    bodies: dict = {
        "sky": {"epoch_utc": NIGHT, "faintest_v_mag": 6.0},
        "sky.bodies": {"moon": True},
    }
    (tmp_path / "bench.toml").write_text(bench_text(TWIN, bodies))
    with Twin(read_bench_file(tmp_path / "bench.toml")) as twin:
        comparison = Comparison(twin)
        seen = twin.field(aim(twin.bench, "Moon"), 0)
        comparison.add(seen, np.random.default_rng(1))
        tally = comparison.tally
        assert len(seen.discs) == 1 and seen.sky_e.sum() > 1e9
        assert "Moon" not in seen.truth["name"]
        assert len(tally.stars) > 5 and not tally.lost
        assert max(abs(star.flux_mag) for star in tally.stars) < 0.1
