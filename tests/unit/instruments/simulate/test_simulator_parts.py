"""What a simulator of the tracker makes anew where its bench changes, the glow between its stars,
and how fast it turns at the ends of a log.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.basics.rotation import from_rotation_vector
from hilstar.instruments.simulate import simulator
from hilstar.instruments.simulate.exposures import view_at
from hilstar.instruments.simulate.simulator import Simulator, TrackerBackground, full_e
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.cameras import tracker_camera
from tests.support.benches import bench_text


@pytest.mark.parametrize(
    ("tables", "made"),
    [
        ({"verify": {"flux_mag": 0.2}}, []),
        ({"sky": {"faintest_v_mag": 5.0}}, ["sky", "tracker"]),
        ({"tracker": {"transmission": 0.5}}, ["sky", "tracker"]),
        ({"tracker.detector": {"fill_factor": 0.5}}, ["sky", "tracker"]),
        ({"tracker": {"exposure_s": 0.3}}, ["tracker"]),
        ({"background": {"electrons_per_px": 3.0}}, ["tracker"]),
    ],
)
def test_what_a_change_of_the_bench_touches_is_made_anew(tmp_path, monkeypatch, tables, made):
    files = []
    for name, changes in (("before.toml", {}), ("after.toml", tables)):
        (tmp_path / name).write_text(bench_text({}, changes))
        files.append(read_bench_file(tmp_path / name))
    before, after = files
    loaded = []
    target = SimpleNamespace(resolution_px=before.config.tracker.resolution_px, psf="psf")
    monkeypatch.setattr(simulator, "sky_layers", lambda canvas, sources: ())
    monkeypatch.setattr(
        simulator,
        "Target",
        lambda resolution_px, psf: SimpleNamespace(resolution_px=resolution_px, psf=psf),
    )
    running = SimpleNamespace(
        config=before.config,
        file=before,
        moving=None,
        canvas=SimpleNamespace(psf="psf"),
        sources=(),
        renderer=SimpleNamespace(target=target),
        _load_sky=lambda: loaded.append("sky"),
        _load_tracker=lambda: loaded.append("tracker"),
    )
    Simulator.change(running, after)
    assert loaded == made
    assert running.config is after.config
    running.moving = "bodies"
    Simulator.change(running, before)
    assert loaded[len(made)] == "sky"
    # what is drawn into is opened anew for another PSF alone
    closed = []
    running.renderer = SimpleNamespace(target=target, close=lambda: closed.append(True))
    monkeypatch.setattr(simulator, "headless_context", lambda gpu: "context")
    monkeypatch.setattr(simulator, "open_backend", lambda target, context: target.psf)
    for psf, renderer, times in (("psf", running.renderer, 0), ("wider", "wider", 1)):
        running.canvas = SimpleNamespace(psf=psf)
        Simulator.change(running, after if times == 0 else before)
        assert (running.renderer, len(closed)) == (renderer, times)


def test_a_detector_without_a_mosaic_gathers_the_glow_of_all_channels():
    """Three channels of 1, 2 and 4 e-/s over each place, in half a second."""
    glow = np.array([[1.0, 1.0], [2.0, 2.0], [4.0, 4.0]])
    air = SimpleNamespace(glow_at=lambda directions, utc_ns: glow)
    background = SimpleNamespace(
        _lights=[],
        _moving=SimpleNamespace(air=air, utc_ns=lambda t_ns: t_ns),
        _rays=np.eye(3)[:2],
        _bayer=None,
        _sr=np.array([1.0, 3.0]),
        _config=SimpleNamespace(tracker=SimpleNamespace(exposure_s=0.5)),
        _over_pixels=lambda values: values[None],
        steady_e=10.0,
    )
    view = SimpleNamespace(q_icrs_to_cam=np.array([1.0, 0, 0, 0]), t_ns=0)
    np.testing.assert_allclose(TrackerBackground.of_view_e(background, view), [[13.5, 20.5]])


def test_a_pixel_of_a_wide_field_has_its_own_solid_angle_across_and_down(tmp_path):
    """The cube of the cosine of a pixel's angle from the axis, on 300 x 200 px."""
    tracker = {"resolution_px": [300, 200], "focal_length_mm": 5.0, "pixel_pitch_um": 13.0}
    path = tmp_path / "bench.toml"
    path.write_text(
        bench_text({"tracker": tracker}, {"background": {"zodiacal_v_mag_arcsec2": 20.0}})
    )
    file = read_bench_file(path)
    light_e = TrackerBackground(
        file.config, tmp_path, tracker_camera(file.config.tracker, tmp_path)
    ).steady_e
    for row, column in ((0, 150), (100, 0), (100, 299), (199, 299)):
        tangent = np.hypot(column - 149.5, row - 99.5) * 13e-3 / 5.0
        share = light_e[row, column] / light_e[100, 150]
        # light is linear between places 0.05 rad apart
        assert share == pytest.approx((1 + tangent**2) ** -1.5, rel=2e-3)


@pytest.mark.parametrize("t_ns", [0, 10**7, 5 * 10**8, 99 * 10**7, 10**9])
def test_a_log_s_exposures_turn_as_fast_at_its_ends(t_ns):
    """A second of 0.3 rad/s about the second axis, beyond which nothing turns."""

    def at(time_ns):
        seconds = min(max(time_ns, 0), 10**9) / 1e9
        q = from_rotation_vector(np.array([0.0, 0.3 * seconds, 0.0]))
        return SimpleNamespace(q_icrs_to_cam=q)

    view = view_at(SimpleNamespace(at=at), (0, 10**9), t_ns, 0.1)
    assert abs(view.rate_cam_rad_s[1]) == pytest.approx(0.3, rel=1e-6)
    assert view.rate_cam_rad_s[[0, 2]] == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(("full_well_e", "full"), [(9_000.0, 8_000.0), (5_000.0, 5_000.0)])
def test_a_pixel_is_full_by_its_well_or_by_the_adc_above_its_offset(full_well_e, full):
    """Codes to 1023, of which 23 are the offset, of 8 electrons each."""
    detector = SimpleNamespace(bits=10, offset_dn=23.0, gain_e_per_dn=8.0, full_well_e=full_well_e)
    assert full_e(detector) == full
