"""The twin over fields of stars: what it sees, and what it says of what it finds."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.display.response import bit_stealing_response, gamma_response, srgb_response
from hilstar.instruments.simulate.twin import Twin, changed_keys, levels_of, true_geometry
from hilstar.instruments.verify.measure import Comparison
from hilstar.instruments.verify.summary import summarise, verify
from hilstar.instruments.verify.verdict import Verdict, judge
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.config import read_config
from tests.support.bench_files import filed_bench
from tests.support.benches import TWIN, bench_text

# Measured 0.005 px; a lens that is not undone is 1.6 px off.
LENS_PX = 0.02


def twin_file(directory: Path, verify_lines: str = "", **changes: object) -> Path:
    """A bench of the twin with other exposure, monitor, bits, calibration or quantisation."""
    values = {
        "exposure_s": 0.1,
        "monitor_px": [480, 400],
        "bits": 10,
        "calibration": "srgb",
        "method": "exact",
        **changes,
    }
    tables = {
        "tracker": {"resolution_px": [300, 300], "exposure_s": values["exposure_s"]},
        "monitor": {
            "resolution_px": values["monitor_px"],
            "bits": values["bits"],
            "calibration": values["calibration"],
        },
        "render": {"quantisation": values["method"]},
    }
    path = directory / "bench.toml"
    path.write_text(f"{bench_text(TWIN, tables)}[verify]\n{verify_lines}")
    return path


def verified(path: Path, fields: int, rng: np.random.Generator) -> tuple[Verdict, dict]:
    verdict = verify(read_bench_file(path), fields, rng)
    return verdict, msgspec.to_builtins(summarise(verdict))


def test_levels_of_another_monitor_s_primaries_stand_where_the_assumed_ones_do():
    grey = srgb_response(8)
    assumed, true = (
        bit_stealing_response((grey,) * 3, weights)
        for weights in ((0.2126, 0.7152, 0.0722), (0.4, 0.35, 0.25))
    )
    seen = levels_of(assumed, true)
    light = grey.light[assumed.rgb] @ np.array([0.4, 0.35, 0.25])
    known = {tuple(triple) for triple in true.rgb.tolist()}
    common = np.array([tuple(triple) in known for triple in assumed.rgb.tolist()])
    assert common.mean() > 0.9
    assert seen.light[common] == pytest.approx(light[common], rel=1e-9)


def test_all_methods_see_the_same_fields_whatever_noise_they_draw(tmp_path):
    places = []
    for method in ("round", "exact"):
        verdict, _ = verified(twin_file(tmp_path, method=method), 2, np.random.default_rng(5))
        places.append({(s.hip, s.x_px) for s in verdict.errors.stars + verdict.errors.lost})
    assert len(places[0] & places[1]) > 0.8 * len(places[1]) > 0


def test_a_whole_cycle_of_temporal_is_better_than_one_frame_of_it(tmp_path):
    """Eight frames bring the step of light, so the errors of faint stars, down to an eighth; a
    half is asked for.
    """
    errors = []
    for frames in (1, 8):
        path = twin_file(tmp_path, method="temporal", exposure_s=frames / 60)
        _, summary = verified(path, 4, np.random.default_rng(3))
        errors.append((summary["flux_error_mag"]["rms"], summary["centroid_error_px"]["rms"]))
    assert errors[1][0] < errors[0][0] / 2
    assert errors[1][1] < errors[0][1] / 2


def test_a_black_level_is_caught_on_a_screen_that_covers_a_fifth_of_the_detector(tmp_path):
    path = twin_file(tmp_path, 'true_calibration = "lcd-example"\n', monitor_px=[160, 130], bits=8)
    _, summary = verified(path, 1, np.random.default_rng(1))
    assert summary["black_e_per_s_px"]["seen"] > 1e3
    assert any("black" in reason for reason in summary["reasons"])


def test_coarse_codes_are_blamed_on_the_codes_and_not_on_the_response(tmp_path):
    path = twin_file(tmp_path, bits=8, method="round")
    path.write_text(path.read_text().replace("[verify]", "brightest_v_mag = -2\n[verify]"))
    verdict, summary = verified(path, 3, np.random.default_rng(1))
    assert not verdict.passed
    assert any("the codes alone" in reason and "exact" in reason for reason in verdict.reasons)
    assert not any("response and uniformity" in reason for reason in verdict.reasons)
    assert summary["codes_alone"]["flux_mag"] == summary["flux_error_mag"]


def test_the_codes_alone_do_not_depend_on_what_the_monitor_really_is(tmp_path):
    """Wherever the same stars are measured, the codes on the assumed monitor cost them the same."""
    right, _ = verified(twin_file(tmp_path), 4, np.random.default_rng(4))
    wrong, _ = verified(
        twin_file(tmp_path, 'true_calibration = "gamma2.2"\n'), 4, np.random.default_rng(4)
    )
    assert not wrong.passed
    alone = {(s.hip, s.x_px): s.codes_px for s in right.errors.stars}
    assert len(wrong.errors.stars) > 5
    assert all(
        s.codes_px == pytest.approx(alone[s.hip, s.x_px], abs=1e-9) for s in wrong.errors.stars
    )


def test_a_field_without_stars_passes_nothing(tmp_path):
    with Twin(read_bench_file(twin_file(tmp_path))) as twin:
        verdict = judge(Comparison(twin).measured())
    assert not verdict.passed
    assert "no star could be measured" in verdict.reasons[0]


def test_a_true_rotation_that_is_none_is_refused_with_the_file_s_name(tmp_path):
    path = twin_file(tmp_path, "true_q_cam_to_mon = [0, 0, 0, 0]\n")
    assert read_config(path).verify.true_q_cam_to_mon == (0.0, 0.0, 0.0, 0.0)
    with pytest.raises(InputError, match=r"bench\.toml: \[verify\] true_q_cam_to_mon.*unit"):
        Twin(read_bench_file(path))


def test_a_bench_whose_geometry_is_as_assumed_has_its_own_camera(tmp_path):
    """That of its geometry file, too, which no key of [verify] describes."""
    with Twin(read_bench_file(twin_file(tmp_path, 'true_mirror = "x"\n'))) as twin:
        true = true_geometry(twin.bench, twin.camera)
        assert true.monitor is twin.bench.camera
        assert true.mirror == "x"


@pytest.mark.parametrize(
    ("lens", "mirror"),
    [('true_geometry = "true.toml"', "y"), ("true_focal_length_mm = 121", "swap")],
)
def test_a_true_mirror_holds_however_the_true_lens_is_stated(tmp_path, lens, mirror):
    (tmp_path / "true.toml").write_text(
        'kind = "hilstar geometry 1"\nresolution_px = [480, 400]\nfocal_length_px = 2100\n'
        "principal_point_px = [239.5, 199.5]\nq_cam_to_mon = [1, 0, 0, 0]\n"
    )
    with Twin(read_bench_file(twin_file(tmp_path, f'{lens}\ntrue_mirror = "{mirror}"\n'))) as twin:
        true = true_geometry(twin.bench, twin.camera)
        assert true.mirror == mirror
        assert true.monitor is not twin.bench.camera


def test_a_bench_that_draws_through_its_measured_lens_passes(tmp_path):
    """Distortion, a tilted screen and a misalignment, each of them known."""
    (tmp_path / "geometry.toml").write_text(
        'kind = "hilstar geometry 1"\nresolution_px = [480, 400]\nfocal_length_px ='
        " 2081.5\nprincipal_point_px = [241, 198.5]\nq_cam_to_mon = [0.99999, 0, 0, 0.00447]\nk1 ="
        " 0.6\np1 = 0.001\ntilt_deg = [0.8, -0.5]\n"
    )
    path = twin_file(tmp_path)
    path.write_text(
        path.read_text().replace("[collimator]", '[collimator]\ngeometry = "geometry.toml"')
    )
    verdict, summary = verified(path, 6, np.random.default_rng(2))
    assert verdict.passed, verdict.reasons
    assert summary["stars"] > 10
    assert summary["centroid_error_px"]["p95"] < LENS_PX


def test_only_what_is_said_to_be_true_makes_a_twin_differ(tmp_path):
    assert changed_keys(read_config(twin_file(tmp_path, "flux_mag = 0.2\n")).verify) == ["flux_mag"]
    assert changed_keys(read_config(twin_file(tmp_path, 'true_mirror = "x"\n')).verify) == [
        "true_mirror"
    ]


@pytest.mark.parametrize(("columns", "stealing"), [("w", False), ("r,g,b", True)])
def test_what_is_proposed_for_coarse_codes_is_what_the_calibration_takes(
    tmp_path, columns, stealing
):
    """Grey alone does not say how the tracker sees the primaries: its file refuses bit stealing."""
    light = gamma_response(8).light
    share = 1 / (columns.count(",") + 1)
    rows = [
        ",".join([str(code), *[repr(share * float(value) + 1e-9)] * (columns.count(",") + 1)])
        for code, value in enumerate(light)
    ]
    (tmp_path / "monitor.csv").write_text("\n".join([f"code,{columns}", *rows]))
    head = (
        'kind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\nbits = 8\nresponse'
        ' = "monitor.csv"\n'
    )
    (tmp_path / "monitor.toml").write_text(f"[calibration]\n{head}")
    path = twin_file(
        tmp_path, "centroid_px = 1e-4\n", bits=8, method="round", calibration="monitor.toml"
    )
    verdict, _ = verified(path, 2, np.random.default_rng(1))
    (proposal,) = [reason for reason in verdict.reasons if reason.startswith("the codes alone")]
    assert ("bit_stealing" in proposal) == stealing
    assert "a monitor calibrated on more bits" in proposal
    path.write_text(path.read_text().replace("[verify]", "bit_stealing = true\n[verify]"))
    if stealing:
        assert verified(path, 1, np.random.default_rng(1))[1]["stars"] > 0
    else:
        with pytest.raises(InputError, match="bit stealing needs the primaries"):
            verified(path, 1, np.random.default_rng(1))


def test_a_true_monitor_that_is_known_in_grey_alone_refuses_bit_stealing_too(tmp_path):
    light = gamma_response(8).light
    rows = [f"{code},{float(value) + 1e-9!r}" for code, value in enumerate(light)]
    (tmp_path / "monitor.csv").write_text("\n".join(["code,w", *rows]))
    head = (
        'kind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\nbits = 8\nresponse'
        ' = "monitor.csv"\n'
    )
    (tmp_path / "monitor.toml").write_text(f"[calibration]\n{head}")
    lines = 'centroid_px = 1e-4\ntrue_calibration = "monitor.toml"\n'
    path = twin_file(tmp_path, lines, bits=8, method="round", calibration="gamma2.2")
    verdict, _ = verified(path, 2, np.random.default_rng(1))
    assert not any("bit_stealing" in reason for reason in verdict.reasons)
    assert any(reason.startswith("the codes alone") for reason in verdict.reasons)


def test_a_field_without_a_star_says_how_many_the_catalogue_has_there(tmp_path):
    narrow = {
        "tracker": {"focal_length_mm": 150, "resolution_px": [128, 128]},
        "collimator": {"focal_length_mm": 720},
    }
    verdict = verify(filed_bench(tmp_path, TWIN, narrow), 2, np.random.default_rng(3))
    # 0.64 degrees, and 2900 stars to V = 5.5 over 41 253 square degrees
    assert "0.028 stars to V = 5.5 are in the tracker's field on average" in verdict.reasons[0]
    assert "[sky] catalogue with fainter stars" in verdict.reasons[0]
