"""The stated error of a geometry holds the truth: of a lens that noise hides, of dots with
errors of their own, of few dots.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from matplotlib.quiver import Quiver
from PIL import Image

from hilstar.basics.rotation import from_rotation_vector, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.display.geometry import load_notes
from hilstar.instruments.calibrate.first_light.geometry import _ends_of, _geometry_figures
from hilstar.instruments.calibrate.geometric import fit as geometric_fit
from hilstar.instruments.calibrate.geometric.dot_shape import DotShape
from hilstar.instruments.calibrate.geometric.dots import (
    DotPlan,
    SeenScreen,
    lit_for,
    plan_seen_dots,
)
from hilstar.instruments.calibrate.geometric.fit import (
    BROWN_CONRADY,
    GAIN,
    PINHOLE,
    RADIAL,
    Candidate,
    Geometry,
    MatchedDots,
    Model,
    Problem,
    best_of,
    fit,
    held_out,
    noise_of_repeats,
    uncertainty_of,
)
from hilstar.instruments.calibrate.geometric.geometry_fit import (
    ROUND,
    Calibrated,
    bounded_to_field,
    draw_geometry,
    in_view,
    is_tracker_known,
    lines_of,
    misfit_words,
    nominal_of,
    refuse_few,
    refuse_gaps,
    refuse_misfit,
    seen_in_pose,
    summary_of,
    without_s_curves,
    write_calibrated,
)
from hilstar.instruments.calibrate.geometric.observed import Observed, dot_centroids, measure_images
from hilstar.optics.camera import Camera, Lens
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import bench_text
from tests.support.refusals import refusal

# A tracker of 256 x 256 px, of 39 arcsec that sees the whole of a small screen.
SMALL_FIELD = {
    "tracker": {
        "focal_length_mm": 45,
        "pixel_pitch_um": 8.5,
        "resolution_px": [256, 256],
        "psf_sigma_px": [1.0, 1.0],
    },
    "monitor": {"resolution_px": [640, 360], "pixel_pitch_um": 60.0},
    "collimator": {"focal_length_mm": 900},
}
SEEDS, FRAMES = 6, 12
# The rms of six errors, each an rms over the field of a fit's few numbers, in their sigmas: over
# 1.5 comes once in a thousand.
MAX_RMS_SIGMAS = 1.5
GRID = 9


def tilted_screen(folder, tilt_deg=0.0):
    """A bench file and the screen as it truly stands."""
    (folder / "bench.toml").write_text(bench_text(SMALL_FIELD))
    file = read_bench_file(folder / "bench.toml")
    nominal = nominal_of(file)
    monitor = dataclasses.replace(
        nominal.monitor, lens=Lens(tilt_rad=(math.radians(tilt_deg), 0.0))
    )
    return file, SeenScreen(monitor, nominal.tracker, is_sure=True, psf_sigma_px=1.0)


def dots_of(file, seen, seed, noise_px, dot_noise_px=0.0):
    """A fit's problem and its dots: centroids with noise of each frame, and of each dot in all
    its frames.
    """
    rng = np.random.default_rng(seed)
    plan = plan_seen_dots(seen, FRAMES, lit_for(seen), rng)
    places = np.stack(
        seen.tracker.project(seen.monitor.rays(plan.x_px, plan.y_px) @ seen.tracker.cam_to_image.T)
    )
    dot, frame = np.nonzero(plan.lit)
    places = (places + rng.normal(0, dot_noise_px, places.shape))[:, dot] + rng.normal(
        0, noise_px, (2, len(dot))
    )
    data = MatchedDots(Observed(frame, np.zeros_like(frame), *places, np.ones(len(dot))), dot)
    problem = Problem(
        plan, nominal_of(file), np.array([[1.0, 0.0, 0.0, 0.0]]), noise_of_repeats(data)
    )
    return problem, data


def lens_error(file, seen, names, seed, noise_px, dot_noise_px=0.0):
    """The rms error of a lens with such parameters over the tracker's field, in its stated
    error.
    """
    problem, data = dots_of(file, seen, seed, noise_px, dot_noise_px)
    found = fit(problem, Model(names), 0, data)
    return (
        field_error_arcsec(found.geometry, seen) / uncertainty_of(problem, found, data).rms_arcsec
    )


@pytest.mark.parametrize(("names", "degree"), [(PINHOLE, 0), (BROWN_CONRADY, 3)])
def test_a_model_is_compared_in_few_steps_by_the_error_of_many(
    tmp_path, monkeypatch, names, degree
):
    """Half of first light's time went to fits that crept along a bent valley, for a choice
    between models that differ by 2 % and more.
    """
    problem, data = dots_of(*tilted_screen(tmp_path, tilt_deg=2.0), 3, 0.01)
    steps = []
    slopes = geometric_fit._Loss.slopes

    def counted(loss, numbers, off):
        steps.append(len(loss.data))
        return slopes(loss, numbers, off)

    monkeypatch.setattr(geometric_fit._Loss, "slopes", counted)
    few = held_out(problem, "few", Model(names), degree, data)
    count = len(steps)
    monkeypatch.setattr(geometric_fit, "COMPARED_GAIN", 1e-3)
    many = held_out(problem, "many", Model(names), degree, data)
    assert few.rms_arcsec == pytest.approx(many.rms_arcsec, rel=1 - GAIN)
    # one fit of all dots from the bench file's geometry, and one without each fifth from that
    assert count < 0.75 * (len(steps) - count)


def field_error_arcsec(geometry, seen):
    """The rms error of directions over the tracker's field."""
    sides = (np.linspace(0, size - 1, GRID) for size in seen.tracker.resolution_px)
    u, v = (part.ravel() for part in np.meshgrid(*sides))
    x_px, y_px = seen.monitor.project(seen.tracker.rays(u, v) @ seen.monitor.cam_to_image.T)
    on_screen = seen.monitor.contains_px(x_px, y_px)
    rays = geometry.monitor.rays(x_px[on_screen], y_px[on_screen])
    seen_x, seen_y = seen.tracker.project(rays @ seen.tracker.cam_to_image.T)
    off_px = np.hypot(seen_x - u[on_screen], seen_y - v[on_screen])
    return float(np.sqrt((off_px**2).mean())) * ARCSEC_PER_RAD / seen.tracker.focal_length_px


def test_a_lens_that_noise_hides_is_in_the_error_of_a_pinhole(tmp_path):
    """A tilt of 2.5 degrees: the covariance of a pinhole's four numbers alone is half of its
    error.
    """
    file, seen = tilted_screen(tmp_path, tilt_deg=2.5)
    off = [lens_error(file, seen, PINHOLE, seed, noise_px=0.1) for seed in range(SEEDS)]
    assert np.sqrt(np.mean(np.square(off))) < MAX_RMS_SIGMAS


def test_dots_with_errors_of_their_own_are_not_averaged_over_frames(tmp_path):
    file, seen = tilted_screen(tmp_path, tilt_deg=3.0)
    off = [
        lens_error(file, seen, BROWN_CONRADY, seed, noise_px=0.004, dot_noise_px=0.02)
        for seed in range(SEEDS)
    ]
    assert np.sqrt(np.mean(np.square(off))) < MAX_RMS_SIGMAS


def candidate(name, off_arcsec):
    return Candidate(name, Model(PINHOLE), 0, np.arange(len(off_arcsec)), off_arcsec)


@pytest.mark.parametrize(("is_chance", "chosen"), [(True, "small"), (False, "large")])
def test_a_larger_model_is_taken_for_more_than_chance(is_chance, chosen):
    """Both are 4 % better: one has other residuals, the other smaller ones."""
    rng = np.random.default_rng(2)
    small, other = (
        candidate("small", rng.normal(0, 1.0, (50, 2))),
        candidate("other", rng.normal(0, 1.0, (50, 2))),
    )
    large = other if is_chance else small
    large = candidate("large", large.off_arcsec * (0.96 * small.rms_arcsec / large.rms_arcsec))
    assert large.rms_arcsec < GAIN * small.rms_arcsec
    assert best_of([small, large]).name == chosen


def test_a_dot_that_both_models_throw_far_off_hides_no_gain_on_the_others():
    """Every dot is 10 % nearer by the larger model, and one of fifty is a hundred times farther."""
    off_arcsec = np.random.default_rng(5).normal(0, 1.0, (50, 2))
    off_arcsec[7] = [80.0, -60.0]
    small, large = candidate("small", off_arcsec), candidate("large", 0.9 * off_arcsec)
    assert best_of([small, large]).name == "large"


@pytest.mark.parametrize("psf_sigma_px", [0.5, 2.8])
def test_no_dot_is_planned_whose_window_leaves_the_image(tmp_path, psf_sigma_px):
    _, seen = tilted_screen(tmp_path)
    seen = dataclasses.replace(seen, psf_sigma_px=psf_sigma_px)
    plan = plan_seen_dots(seen, 16, lit_for(seen), np.random.default_rng(0))
    x, y = seen.tracker.project(
        seen.monitor.rays(plan.x_px, plan.y_px) @ seen.tracker.cam_to_image.T
    )
    reach = dot_centroids(seen.dot_sigma_px).radius_px
    assert min(x.min(), y.min()) >= reach
    assert max(x.max(), y.max()) <= 255 - reach


def test_each_number_s_stated_error_is_that_of_fits_of_many_noises(tmp_path):
    """Neither less nor more: of the whole lens's numbers, and over the field."""
    file, seen = tilted_screen(tmp_path)
    fits, sigmas, over_field = [], [], []
    for seed in range(SEEDS):
        problem, data = dots_of(file, seen, seed, 0.05)
        found = fit(problem, Model(BROWN_CONRADY), 0, data)
        stated = uncertainty_of(problem, found, data)
        whole = dict(zip(found.model.names, found.numbers, strict=False))
        fits.append([geometric_fit.STEPS[name] * number for name, number in whole.items()])
        sigmas.append([stated.sigma[name] for name in whole])
        over_field.append(field_error_arcsec(found.geometry, seen) / stated.rms_arcsec)
    sigmas_off = np.array(fits) / np.array(sigmas)
    # every truth here is 0
    rms = np.sqrt((sigmas_off**2).mean())
    assert 0.6 < rms < MAX_RMS_SIGMAS
    assert 0.6 < np.sqrt(np.mean(np.square(over_field))) < MAX_RMS_SIGMAS


@pytest.mark.parametrize("degree", [0, 3])
def test_slopes_of_places_are_what_a_step_moves(tmp_path, degree):
    problem, data = dots_of(*tilted_screen(tmp_path, tilt_deg=1.0), 3, 0.01)
    found = fit(problem, Model(BROWN_CONRADY), degree, data)
    x_px, y_px = np.array([30.0, 500.0, 320.0]), np.array([20.0, 300.0, 100.0])
    along_x, along_y = geometric_fit._slopes_of_places(problem, found, x_px, y_px)
    size = found.model.size
    assert along_x.shape == along_y.shape == (3, size + (degree and (degree + 1) * (degree + 2)))
    directions = found.geometry.monitor.rays(x_px, y_px)
    loss = geometric_fit._Loss(problem, found.model, degree, data)
    for number in range(along_x.shape[1]):
        places = []
        for sign in (-1, 1):
            step = np.zeros(len(found.numbers))
            step[number] = sign * 1e-3
            moved = loss.geometry(found.numbers + step).monitor
            places.append(np.stack(moved.project(directions @ moved.cam_to_image.T)))
        by_step = (places[1] - places[0]) / 2e-3
        np.testing.assert_allclose([along_x[:, number], along_y[:, number]], by_step, atol=2e-3)


def test_scatter_of_dots_is_of_their_means_in_sigmas_of_these(rng):
    """Dots of 1 to 9 frames, each off by its noise, and then by one twice as large as all its
    frames' mean leaves.
    """
    count = rng.integers(1, 10, 4000)
    site = np.repeat(np.arange(4000), count)
    off = rng.normal(size=(2, len(site)))
    scatter = geometric_fit._scatter_of_dots(site, off.ravel(), 0)
    assert scatter == pytest.approx(1.0, rel=0.05)
    off += (2 / np.sqrt(count) * rng.normal(size=(2, 4000)))[:, site]
    assert geometric_fit._scatter_of_dots(site, off.ravel(), 0) == pytest.approx(5**0.5, rel=0.05)
    few = geometric_fit._scatter_of_dots(site, off.ravel(), 6000)
    assert few == pytest.approx((5 * 8000 / 2000) ** 0.5, rel=0.05)


@pytest.mark.parametrize("degree", [0, 3])
def test_slopes_of_a_fit_of_three_poses_are_what_a_step_of_each_number_moves(tmp_path, degree):
    problem, data = dots_of(*tilted_screen(tmp_path), 3, 0.01)
    seen = data.centroids
    pose = np.arange(len(seen)) % 3
    three = dataclasses.replace(seen, pose=pose)
    aligned = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    problem = dataclasses.replace(problem, q_poses=aligned)
    model = Model(BROWN_CONRADY, tuple(geometric_fit.TRACKER_STEPS), 3)
    loss = geometric_fit._Loss(problem, model, degree, MatchedDots(three, data.dot))
    numbers = np.zeros(model.size + (degree and (degree + 1) * (degree + 2)))
    slopes = loss.slopes(numbers, loss.residuals(numbers))
    assert slopes.shape == (2 * len(seen), len(numbers))
    first_pose = len(model.names) + len(model.tracker_names)
    for number in range(len(numbers)):
        step = np.zeros(len(numbers))
        step[number] = 1e-3
        moved = (loss.residuals(step) - loss.residuals(-step)) / 2e-3
        scale = np.abs(moved).max()
        np.testing.assert_allclose(slopes[:, number], moved, atol=0.02 * scale)
        if first_pose <= number < model.size:
            # a pose turns its own centroids alone
            its = np.tile(pose == 1 + (number - first_pose) // 3, 2)
            assert scale > 0 and not slopes[~its, number].any()


def test_the_noise_of_repeats_is_their_scatter_over_their_own_sigmas(rng):
    """Dots of three frames in each of two poses, which stand elsewhere; one of three centroids has
    four times the error of the others.
    """
    count = 2000
    dot = np.tile(np.arange(count), 6)
    frame = np.repeat(np.arange(6), count)
    pose = frame // 3
    sigma_px = np.where(dot % 3, 1.0, 4.0)
    x_px, y_px = rng.uniform(0, 200, (2, 2, count))
    off_px = 0.02 * sigma_px * rng.normal(size=(2, len(dot)))
    seen = Observed(frame, pose, x_px[pose, dot], y_px[pose, dot], sigma_px)
    seen = dataclasses.replace(seen, x_px=seen.x_px + off_px[0], y_px=seen.y_px + off_px[1])
    data = MatchedDots(seen, dot)
    # the median of 24 000 deviations is known to 1 %
    assert noise_of_repeats(data) == pytest.approx(0.02, rel=0.04)
    # of two centroids both deviations are alike, and tell no scatter
    twice = data.at(np.flatnonzero(frame % 3 < 2))
    assert noise_of_repeats(twice) is None


def test_a_whole_lens_that_is_fitted_has_nothing_left_to_move(tmp_path):
    """One step of Gauss and Newton from where a fit ended, with its prior."""
    problem, data = dots_of(*tilted_screen(tmp_path, tilt_deg=3.0), 3, 0.02)
    found = fit(problem, Model(BROWN_CONRADY), 0, data, min_gain=1e-9)
    root = geometric_fit._covariance_root(problem, found, data, is_simpler=True)
    moved, spread = root[:, -1], np.linalg.norm(root[:, :-1], axis=1)
    assert np.abs(found.numbers / spread).max() > 1.0
    assert np.abs(moved / spread).max() < 0.02


def test_a_prior_is_firm_on_round_lenses_of_the_tracker_and_weak_on_all_else(tmp_path):
    problem, data = dots_of(*tilted_screen(tmp_path), 3, 0.02)
    names = ("tracker_p1", "tracker_k1", "tracker_p2", "tracker_k2")
    model = Model(("rotation_x", "log_focal", "k1"), names, 2)
    weights = geometric_fit._Loss(problem, model, 3, data).prior(model.size + 20)
    own = [0.3] * 3 + [0.3, 30.0, 0.3, 30.0] + [0.3] * 3
    np.testing.assert_allclose(weights, np.square([*own, *[0.5] * 20]))


def calibrated(folder, *, tracker_known: bool) -> Calibrated:
    """A screen that was fitted in two poses, with seven centroids lost and four of no dot."""
    problem, data = dots_of(*tilted_screen(folder, tilt_deg=2.0), 3, 0.02)
    still = np.array([1.0, 0.0, 0.0, 0.0])
    both = dataclasses.replace(problem, q_poses=np.stack([still, still]))
    seen = data.centroids
    pose = np.arange(len(seen)) % 2
    posed = MatchedDots(dataclasses.replace(seen, pose=pose), data.dot)
    kept = posed.at(np.arange(7, len(posed)))
    model = Model((*RADIAL, "tilt_x", "tilt_y"), tuple(geometric_fit.TRACKER_STEPS), 2)
    found = fit(both, model, 0, kept, min_gain=1.0)
    off = [candidate(name, size * np.array([[0.3, 0.4], [0.6, 0.8]])) for name, size in OFF]
    return Calibrated(
        problem=both,
        data=kept,
        fit=found,
        models=off,
        chosen=off[1],
        uncertainty=uncertainty_of(both, found, kept),
        centroids=len(kept) + 4,
        tracker_known=tracker_known,
    )


def assert_reported(found: Calibrated, summary: dict) -> None:
    """The figures of first light's step, and which of them are at an end."""
    figures = _geometry_figures(found)
    counts = summary["centroids"]
    assert (figures["centroids_lost"], figures["centroids_false"]) == (counts["lost"], 4)
    assert (figures["dots_planned"], figures["dots_recognised"]) == (
        len(found.plan),
        len(np.unique(found.data.dot)),
    )
    for place, error in (("held_out", summary["held_out"]), ("error", summary["error"])):
        for name in ("rms_arcsec", "max_arcsec"):
            assert figures[f"{place}_{name}"] == error[name]
    for name, parameter in summary["parameters"].items():
        if name.startswith("rotation"):
            assert name not in figures
        else:
            assert figures[name] == parameter["value"]
    assert figures["notes"] == ("; ".join(summary["notes"]) or "none")
    tilts = [summary["parameters"][f"tilt_{axis}_deg"]["value"] for axis in "xy"]
    wanted = [
        (f"tilt_{axis}_deg", tilt, -60.0, 60.0) for axis, tilt in zip("xy", tilts, strict=True)
    ]
    # held-out dots are two hundred times their noise off
    assert _ends_of(found) == (*wanted, ("the degree of the lens's field", 0, -1.0, 7))
    # of the noise that held-out dots have, half more may be chance
    for share, is_far in ((1.45, False), (1.55, True)):
        size = share * found.held_out_noise_arcsec / candidate("1", np.ones((2, 2))).rms_arcsec
        chosen = candidate("pinhole", np.full((2, 2), size))
        ends = _ends_of(dataclasses.replace(found, chosen=chosen))
        assert (ends[:2], len(ends)) == (tuple(wanted), 2 + is_far)


OFF = (("pinhole", 4.0), ("pinhole + k1", 2.0))


@pytest.mark.parametrize("tracker_known", [False, True])
def test_the_figures_of_a_geometry_are_the_fit_s_wherever_they_stand(tmp_path, tracker_known):
    """In the summary, in the file and in the lines."""
    found = calibrated(tmp_path, tracker_known=tracker_known)
    summary = summary_of(found, ["geometry.toml"])
    matched = len(found.data)
    seen_both = sum(int(found.plan.lit[inside].sum()) for inside in found.measurable)
    assert summary["centroids"] == {
        "given": matched + 4,
        "matched": matched,
        "lost": seen_both - matched,
        "false": 4,
    }
    assert summary["centroids"]["lost"] > 4
    assert summary["dots"]["planned"] == len(found.plan)
    errors = {name: {"rms_arcsec": size * 0.625**0.5, "max_arcsec": size} for name, size in OFF}
    for row, (name, _) in zip(summary["models"], OFF, strict=True):
        assert row == pytest.approx({"name": name, **errors[name]})
    # dots that are seen in as many frames each: the mean of these, along both axes
    frames = np.bincount(found.data.dot)
    noise_arcsec = 0.02 * ARCSEC_PER_RAD / (45e3 / 8.5)
    held_out = summary["held_out"]
    assert summary["noise_arcsec"] == pytest.approx(noise_arcsec, rel=0.2)
    of_means = math.sqrt(2 * (1 / frames[frames > 0]).mean())
    assert held_out["noise_arcsec"] == pytest.approx(of_means * summary["noise_arcsec"])
    assert {name: held_out[name] for name in errors["pinhole + k1"]} == pytest.approx(
        errors["pinhole + k1"]
    )
    uncertainty = found.uncertainty
    assert summary["error"]["max_arcsec"] == uncertainty.max_arcsec > uncertainty.rms_arcsec
    assert summary["tracker"] == ("held" if tracker_known else "fitted")
    assert summary["notes"] == (() if tracker_known else (ROUND,))
    sigma = uncertainty.sigma
    shown = summary["parameters"]
    monitor = found.fit.geometry.monitor
    for axis, name in enumerate(("tilt_x", "tilt_y")):
        assert shown[f"{name}_deg"] == pytest.approx(
            {"value": math.degrees(monitor.lens.tilt_rad[axis]), "sigma": math.degrees(sigma[name])}
        )
    for axis in "xyz":
        turn_arcsec = ARCSEC_PER_RAD * sigma[f"rotation_{axis}"]
        assert shown[f"rotation_{axis}_arcsec"] == {"value": 0.0, "sigma": turn_arcsec}
    focal_px = monitor.focal_length_px
    assert shown["focal_length_px"]["sigma"] == pytest.approx(focal_px * sigma["log_focal"])
    assert shown["k1"] == {"value": monitor.lens.radial[0], "sigma": sigma["k1"]}
    tracker = found.fit.geometry.tracker.lens
    of_tracker = (*tracker.radial[:2], *tracker.tangential)
    for name, value in zip(geometric_fit.TRACKER_STEPS, of_tracker, strict=True):
        assert shown[name] == {"value": value, "sigma": sigma[name]}
    path = tmp_path / "geometry.toml"
    assert write_calibrated(path, found, None) == [str(path)]
    notes = load_notes(path)
    for name, figure in shown.items():
        assert notes.sigma[name] == pytest.approx(figure["sigma"], rel=1e-5)
    assert notes.made.poses == 2
    of_file = notes.error
    assert (of_file.model, of_file.noise_px) == ("pinhole + k1", found.problem.noise_px)
    for name, value in errors["pinhole + k1"].items():
        assert getattr(of_file, f"held_out_{name}") == pytest.approx(value)
        assert getattr(of_file, name) == pytest.approx(getattr(uncertainty, name))
    map_arcsec = np.nan_to_num(uncertainty.map_arcsec, nan=-1.0)
    np.testing.assert_allclose(of_file.map_arcsec, map_arcsec, atol=1e-4)
    np.testing.assert_allclose(of_file.modes_arcsec, uncertainty.modes_arcsec, rtol=1e-4)
    assert_reported(found, summary)
    lines = "\n".join(lines_of(found))
    lost = summary["centroids"]["lost"]
    assert f"{matched} matched, {lost} lost, 4 false" in lines
    assert f"1.581 arcsec rms, 2.000 max; noise: {held_out['noise_arcsec']:.3f}" in lines


def test_what_the_tracker_does_not_see_of_the_screen_is_in_the_file_and_in_a_note(tmp_path):
    found = calibrated(tmp_path, tracker_known=True)
    uncertainty = found.uncertainty
    map_arcsec = uncertainty.map_arcsec.copy()
    map_arcsec[0, 1] = np.nan
    path = tmp_path / "geometry.toml"
    blank = dataclasses.replace(uncertainty, map_arcsec=map_arcsec)
    write_calibrated(path, dataclasses.replace(found, uncertainty=blank), None)
    assert load_notes(path).error.map_arcsec[0][1] == -1
    geometry = found.fit.geometry
    lens = dataclasses.replace(geometry.monitor.lens, max_tangent=0.5)
    monitor = dataclasses.replace(geometry.monitor, lens=lens)
    geometry = dataclasses.replace(geometry, monitor=monitor)
    in_field = dataclasses.replace(found, fit=dataclasses.replace(found.fit, geometry=geometry))
    (note,) = summary_of(in_field, [])["notes"]
    # the arc tangent of a half
    assert note == "the tracker sees 26.57 deg from the axis: no star is shown farther out"


@pytest.mark.parametrize("size_px", [(120, 60), (60, 120), (256, 256)])
def test_a_lens_is_known_to_a_hundredth_beyond_the_farthest_corner_of_the_field(tmp_path, size_px):
    """Of a pinhole before a tracker that sees a part of the screen; all of it, and it has no end."""
    problem, data = dots_of(*tilted_screen(tmp_path), 3, 0.02)
    found = fit(problem, Model(PINHOLE), 0, data, min_gain=1.0)
    tracker = found.geometry.tracker
    middle_px = tuple((side - 1) / 2 for side in size_px)
    seen = dataclasses.replace(tracker, resolution_px=size_px, principal_point_px=middle_px)
    geometry = dataclasses.replace(found.geometry, tracker=seen)
    bounded = bounded_to_field(problem, dataclasses.replace(found, geometry=geometry))
    if size_px == (256, 256):
        assert bounded.geometry is geometry
    else:
        # the fit turns and shifts it by far less than a thousandth
        reach = math.hypot(*size_px) / 2 / tracker.focal_length_px
        assert bounded.geometry.monitor.lens.max_tangent == pytest.approx(1.01 * reach, rel=2e-3)


def test_residuals_are_drawn_as_the_mean_of_a_dot_s_centroids(tmp_path, figures):
    found = calibrated(tmp_path, tracker_known=True)
    draw_geometry(tmp_path / "geometry", found)
    places, residuals = figures[0].axes[:2]
    (arrows,) = (drawn for drawn in residuals.collections if isinstance(drawn, Quiver))
    right_px, down_px = geometric_fit.residuals_px(found.problem, found.fit.geometry, found.data)
    dots = np.unique(found.data.dot)
    means = [[part[found.data.dot == dot].mean() for dot in dots] for part in (right_px, down_px)]
    np.testing.assert_allclose([arrows.U, arrows.V], means, atol=1e-12)
    # the median is 3 % of the screen's width long
    assert np.median(np.hypot(*means)) / arrows.scale == pytest.approx(0.03 * 640)
    np.testing.assert_allclose([arrows.X, arrows.Y], [found.plan.x_px[dots], found.plan.y_px[dots]])
    # down the screen is down the picture
    assert places.images[0].get_extent() == [-0.5, 639.5, 359.5, -0.5]
    assert residuals.get_ylim() == (359.5, -0.5)
    np.testing.assert_array_equal(places.images[0].get_array(), found.uncertainty.map_arcsec)


def test_only_centroids_of_a_pose_are_freed_of_its_dots_s_curve(rng):
    """Of narrow dots, and not of those whose PSF or side is wide."""
    x_px, y_px = rng.uniform(20, 40, (2, 30))
    pose = np.arange(30) % 3
    settings = dot_centroids(1.5)
    seen = Observed(np.zeros(30, np.intp), pose, x_px, y_px, np.ones(30), settings)
    freed = seen.without_s_curve(1, DotShape(0.4, 2.0, 10.0))
    is_moved = (np.abs(freed.x_px - x_px) > 1e-6) & (np.abs(freed.y_px - y_px) > 1e-6)
    np.testing.assert_array_equal(is_moved, pose == 1)
    np.testing.assert_array_equal(freed.x_px[pose != 1], x_px[pose != 1])
    np.testing.assert_array_equal(freed.y_px[pose != 1], y_px[pose != 1])
    for wide in (DotShape(0.81, 2.0, 10.0), DotShape(0.4, 8.1, 10.0)):
        same = seen.without_s_curve(1, wide)
        np.testing.assert_array_equal([same.x_px, same.y_px], [x_px, y_px])
    # nothing is known of how a table's were measured
    table = dataclasses.replace(seen, settings=None)
    assert table.without_s_curve(1, DotShape(0.4, 2.0, 10.0)) is table


def test_dots_that_the_image_s_edge_cuts_are_not_measured(tmp_path):
    """Of Gaussians of 1.5 px, the second within its window of the left edge."""
    y, x = np.mgrid[:60, :80]
    image = np.full((60, 80), 40.0)
    for x_px, y_px in ((40.3, 30.6), (2.0, 20.0), (60.0, 50.2)):
        image += 800 * np.exp(-((x - x_px) ** 2 + (y - y_px) ** 2) / (2 * 1.5**2))
    path = tmp_path / "frame_3.png"
    Image.fromarray(np.rint(image).astype(np.uint16)).save(path, compress_level=1)
    seen = measure_images([path], None, (80, 60))
    assert seen.frame.tolist() == [3, 3]
    np.testing.assert_allclose(np.sort(seen.x_px), [40.3, 60.0], atol=0.05)
    np.testing.assert_allclose(np.sort(seen.y_px), [30.6, 50.2], atol=0.05)
    assert seen.edge_px == dot_centroids(1.5).radius_px
    # what the dark frame has, too, is none
    glow = np.rint(600 * np.exp(-((x - 20) ** 2 + (y - 45) ** 2) / (2 * 1.5**2)))
    for name, light in (("dark_0", glow + 40), ("frame_3", image + glow)):
        light = np.rint(light).astype(np.uint16)
        Image.fromarray(light).save(tmp_path / f"{name}.png", compress_level=1)
    assert len(measure_images([path], None, (80, 60))) == 3
    above = measure_images([path], tmp_path / "dark_0.png", (80, 60))
    np.testing.assert_allclose(np.sort(above.x_px), [40.3, 60.0], atol=0.05)


@pytest.mark.parametrize(
    ("error_arcsec", "expected_arcsec", "is_refused"),
    [(1.09, 0.1, False), (1.11, 0.1, True), (7.9, 2.0, False), (8.1, 2.0, True), (0.0, 0.0, False)],
)
def test_dots_are_no_lens_s_beyond_four_times_their_noise_and_an_arcsecond(
    error_arcsec, expected_arcsec, is_refused
):
    if not is_refused:
        refuse_misfit(error_arcsec, expected_arcsec)
        return
    words = refusal(refuse_misfit, error_arcsec, expected_arcsec)
    assert f"are {error_arcsec:.3g} arcsec rms off" in words
    assert f"makes {expected_arcsec:.2g}: something moved" in words


def test_a_fit_needs_twelve_dots_however_many_centroids_they_have():
    numbers = np.repeat(np.arange(12), 2)
    zeros = np.zeros(24)
    seen = Observed(zeros.astype(int), zeros.astype(int), zeros, zeros, zeros, None)
    refuse_few(MatchedDots(seen, numbers))
    line = refusal(refuse_few, MatchedDots(seen, np.minimum(numbers, 10)))
    assert line.startswith("11 dots were recognised and 12 are needed")


def test_a_dot_is_turned_as_its_pose_is():
    """Of a tracker that is turned by 50 degrees about its boresight: by where its pixels lie."""
    camera = Camera((400, 300), 2000.0, (199.5, 149.5), np.eye(3))
    pose = from_rotation_vector(np.array([0.0, 0.0, math.radians(50)]))
    geometry = geometric_fit.Geometry(camera, np.array([1.0, 0.0, 0.0, 0.0]), camera, pose[None])
    seen = seen_in_pose(geometry, pose, 0.6)
    rays = camera.rays(np.array([199.5, 209.5]), np.array([149.5, 149.5])) @ to_matrix(pose).T
    (u, right), (v, below) = camera.project(rays)
    turn_deg = math.degrees(math.atan2(below - v, right - u))
    assert abs(turn_deg) == pytest.approx(50, abs=1e-6)
    assert seen.dot_shape.turn_deg == pytest.approx(turn_deg)
    assert (seen.is_sure, seen.psf_sigma_px) == (True, 0.6)


@pytest.mark.parametrize("edge_px", [0.0, 7.0])
def test_places_are_in_view_farther_than_a_window_from_each_edge(edge_px):
    """Of two cameras alike: a monitor's pixel is the tracker's."""
    camera = Camera((120, 80), 900.0, (50.0, 45.0), np.eye(3))
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    geometry = Geometry(camera, upright, camera, upright[None])
    for axis, last in ((0, 119), (1, 79)):
        for end, inwards in ((edge_px, 1), (last - edge_px, -1)):
            for off, is_seen in ((0.01, True), (-0.01, False)):
                place = [60.0, 40.0]
                place[axis] = end + inwards * off
                x_px, y_px = np.array(place)[:, None]
                assert in_view(geometry, x_px, y_px, edge_px)[0].tolist() == [is_seen]
    # a quarter turn takes what is at the right down, where the image ends sooner than above
    quarter = np.array([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]])
    turned = dataclasses.replace(geometry, q_poses=quarter)
    x_px, y_px = np.array([[50.0 + 38, 50.0 - 38], [45.0, 45.0]])
    (is_seen,) = in_view(turned, x_px, y_px, 0.0)
    assert is_seen.tolist() == [False, True]


def test_a_part_of_an_upright_screen_without_its_dots_is_named():
    """Of 90 x 180 px, with four dots in each ninth: two in its lower right are enough."""
    corners = [(x, y) for y in (20, 40, 80, 100, 140, 160) for x in (10, 20, 40, 50, 70, 80)]
    x_px, y_px = np.array(corners, dtype=float).T
    ninth = (x_px // 30 + 3 * (y_px // 60)).astype(int)
    plan = DotPlan(x_px, y_px, np.ones((36, 1), dtype=bool))
    dots = np.arange(36)

    def refuse(is_seen):
        refuse_gaps(plan, (90, 180), np.ones(36, dtype=bool), is_seen)

    refuse(dots >= 0)
    for place, words in ((8, "lower right"), (2, "upper right"), (4, "middle"), (3, "middle left")):
        of_ninth = dots[ninth == place]
        refuse(~np.isin(dots, of_ninth[:2]))
        refused = refusal(refuse, ~np.isin(dots, of_ninth[:3]))
        assert refused.startswith(f"only 1 of 4 dots were recognised in the {words} of the screen")


@pytest.mark.parametrize(
    ("has_model", "is_ideal", "is_known"),
    [(False, False, False), (True, False, True), (False, True, True)],
)
def test_a_tracker_s_lens_is_held_where_it_is_stated(tmp_path, has_model, is_ideal, is_known):
    tracker = dict(SMALL_FIELD["tracker"])
    if has_model:
        tracker["distortion"] = "lens.toml"
    path = tmp_path / "bench.toml"
    path.write_text(bench_text(SMALL_FIELD, {"tracker": tracker}))
    assert is_tracker_known(read_bench_file(path), is_ideal=is_ideal) == is_known


@pytest.mark.parametrize(("sigma_px", "is_freed"), [(0.4, True), (0.8, True), (0.81, False)])
def test_narrow_dots_are_freed_of_their_s_curve(tmp_path, sigma_px, is_freed):
    problem, data = dots_of(*tilted_screen(tmp_path, tilt_deg=2.0), 3, 0.01)
    seen = dataclasses.replace(data.centroids, settings=dot_centroids(1.0))
    freed = without_s_curves(problem.plan, problem.nominal, seen, sigma_px)
    assert (freed is not seen) == is_freed


@pytest.mark.parametrize(("sigma_px", "is_told"), [(0.5, True), (0.51, False)])
def test_dots_within_a_pixel_may_be_why_no_lens_fits(sigma_px, is_told):
    words = misfit_words("they are off", sigma_px)
    assert words.startswith("they are off")
    assert ("psf_sigma_px" in words) == is_told == (words != "they are off")


def test_an_rms_of_dots_is_as_sure_as_it_is_over_many_draws(rng):
    """Of 40 dots whose two axes have one scatter."""
    candidates = [candidate("", rng.normal(0.0, 3.0, (40, 2))) for _ in range(1000)]
    scatter_arcsec = np.std([each.rms_arcsec for each in candidates])
    stated_arcsec = np.mean([each.rms_error_arcsec for each in candidates])
    # a scatter of a thousand is known to 2.2 %
    assert stated_arcsec == pytest.approx(scatter_arcsec, rel=0.09)
