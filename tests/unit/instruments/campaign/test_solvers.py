"""Solvers: a real one solves from the pixels alone, and each way to fail is a reason in the
case's row.
"""

from __future__ import annotations

import resource
import shlex
import signal
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilstar.basics.rotation import from_radec_roll_deg, from_rotation_vector, multiply
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.instruments.campaign import solvers
from hilstar.instruments.campaign.plan import Centroiding
from hilstar.instruments.campaign.solvers import (
    SolverFault,
    checked_attitude,
    choose_solver,
    filled_words,
    last_words,
    printed_attitude,
    time_limit,
    tracker_facts,
)
from hilstar.instruments.campaign.tally import attitude_error_arcsec
from hilstar.instruments.simulate.simulator import Exposure, Simulator
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.bench.bench_file import bench_file_of, read_bench_file
from tests.support.benches import ROOT, bench_text
from tests.support.campaigns import write_campaign
from tests.support.refusals import refusal
from tests.support.waiting import PATIENCE_S, wait_for

EXAMPLES = ROOT / "examples"
# A dozen stars with centroids to 0.03 px of 134 arcsec: 4 / sqrt 12 arcsec an axis; five sigma, and
# the field's lever for roll.
CROSS_LIMIT_ARCSEC = 5 * 4 / np.sqrt(12)
ROLL_LIMIT_ARCSEC = 30 * CROSS_LIMIT_ARCSEC
# Five sigma of a DN's rounding, 0.29 DN, in the faintest star: 590 DN in a PSF of 0.55 px, whose
# place a fit knows to 0.29 sqrt(8 pi) 0.55^2 / 590 px.
CLEAN_PX = 5 * 0.29 * np.sqrt(8 * np.pi) * 0.55**2 / 590
SAME_TURN_ARCSEC = 1e-6  # float64 on 1e6 arcsec, over a dozen stars


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("solvers")
    write_campaign(folder)
    simulator = Simulator(read_bench_file(folder / "bench.toml"))
    motion = simulator.view(from_radec_roll_deg(84.057, -1.2, 30.0), np.zeros(3))
    yield simulator, simulator.expose(motion, np.random.default_rng(1))
    simulator.close()


def solver(text: str, folder: Path = EXAMPLES, timeout_s: float = 60.0):
    return choose_solver(text, Centroiding(), folder, timeout_s)


@pytest.mark.parametrize(
    "text",
    [
        "centroids",
        "python:star_solver:solve",
        pytest.param(
            f"{shlex.quote(sys.executable)} star_solver.py {{image}} {{focal_length_px}}",
            marks=pytest.mark.e2e,
        ),
    ],
)
def test_a_solver_finds_the_commanded_attitude_in_the_pixels(
    seen: tuple[Simulator, Exposure], text: str
) -> None:
    simulator, exposure = seen
    answer = solver(text).solve(exposure, simulator)
    assert answer.q_icrs_to_cam is not None
    error_arcsec = attitude_error_arcsec(exposure.view.q_icrs_to_cam, answer.q_icrs_to_cam)
    assert (
        np.abs(error_arcsec[:2]).max() < CROSS_LIMIT_ARCSEC
        and abs(error_arcsec[2]) < ROLL_LIMIT_ARCSEC
    )
    assert np.abs(error_arcsec).max() > 0


@pytest.mark.parametrize("psf", ["tracker", "gaussian"])
def test_a_fit_of_the_true_psf_has_each_star_where_it_stands(
    seen: tuple[Simulator, Exposure], psf: str
) -> None:
    """Without noise all that is left is the rounding to a DN."""
    simulator, exposure = seen
    clean = simulator.expose(exposure.view, None)
    settings = Centroiding(centroider="psf", psf=psf)
    answer = choose_solver("centroids", settings, EXAMPLES, 60.0).solve(clean, simulator)
    assert answer.star_errors is not None
    off_px = np.concatenate([answer.star_errors.dx_px, answer.star_errors.dy_px])
    assert len(off_px) > 10
    assert np.abs(off_px).max() < CLEAN_PX


def test_an_error_is_the_rotation_vector_from_the_commanded_to_the_reported_attitude() -> None:
    q, turn_arcsec = from_radec_roll_deg(10, 20, 30), np.array([3.0, -2.0, 70.0])
    reported = -multiply(from_rotation_vector(turn_arcsec / ARCSEC_PER_RAD), q)
    # float64 on 1e6 arcsec
    assert attitude_error_arcsec(q, reported) == pytest.approx(turn_arcsec, abs=1e-7)


def test_noise_alone_has_no_attitude_and_centroids_say_so(seen: tuple[Simulator, Exposure]) -> None:
    simulator, exposure = seen
    dark = np.random.default_rng(2).normal(100, 5, exposure.dn.shape).astype(np.uint16)
    blind = Exposure(exposure.view, dark, exposure.mean_e, exposure.truth)
    for text in ("centroids", "python:star_solver:solve"):
        answer = solver(text).solve(blind, simulator)
        assert answer.q_icrs_to_cam is None and answer.why


FAULTS = {
    "false {image}": "code 1",
    "sh -c 'echo bad luck >&2; exit 3' {image}": "code 3: bad luck",
    "sh -c 'cat $0 >/dev/null && cat no-such-file' {image}": "no-such-file",
    "no-such-program {image}": "cannot be started",
    "sh -c 'sleep 5' {image}": "longer than 0.3 s",
    "echo 1 1 1 1 {png} ": "no attitude",
    "sh -c 'echo 1 1 1 1' {image}": "norm 2",
}


@pytest.mark.e2e
@pytest.mark.parametrize("text", FAULTS)
def test_a_command_that_fails_says_how(seen: tuple[Simulator, Exposure], text: str) -> None:
    simulator, exposure = seen
    try:
        said = (
            solver(text, timeout_s=0.3 if "sleep" in text else PATIENCE_S)
            .solve(exposure, simulator)
            .why
        )
    except SolverFault as fault:
        said = str(fault)
    assert FAULTS[text] in said and "hilstar-solver" not in said


def test_what_a_program_prints_is_read_from_its_last_line_with_an_attitude() -> None:
    assert printed_attitude("loading 4 files\n0.5 0.5 -0.5 0.5\ndone in 3 s\n") == [
        0.5,
        0.5,
        -0.5,
        0.5,
    ]
    assert printed_attitude('{"q": [1, 0, 0, 0], "stars": 7}\n') == [1, 0, 0, 0]
    assert printed_attitude("[1e0, -0.0, 0, 0]") == [1, 0, 0, 0]
    assert (
        printed_attitude("1 2 3\n") is None
        and printed_attitude("") is None
        and printed_attitude('{"q": null}') is None
    )


@pytest.mark.parametrize(
    "line", ['{"q": 5}', '{"q": {"w": 1}}', '{"q": [1, 0, 0]}', '{"q": "north"}']
)
def test_an_answer_that_is_no_quaternion_is_a_fault_of_the_solver(
    seen: tuple[Simulator, Exposure], line: str
) -> None:
    simulator, exposure = seen
    with pytest.raises(SolverFault, match="four numbers"):
        solver(
            f"sh -c 'cat $0 >/dev/null; echo \"$1\"' {{image}} '{line}'", timeout_s=PATIENCE_S
        ).solve(exposure, simulator)


def test_what_is_nested_too_deep_is_no_answer() -> None:
    assert printed_attitude('{"q":' * 20_000) is None


NO_SOLVERS = [
    "solve me",
    "python:nothing",
    "python:no_such_module:f",
    "python:math:nothing",
    "a 'b {image}",
]


@pytest.mark.parametrize("text", NO_SOLVERS)
def test_what_is_no_solver_is_refused_before_the_first_case(text: str) -> None:
    assert "--solver" in refusal(solver, text)


@pytest.mark.parametrize("stream", ["1", "2"])
def test_a_solver_that_keeps_printing_is_ended_at_the_bound_with_its_children(
    seen: tuple[Simulator, Exposure], tmp_path: Path, stream: str
) -> None:
    simulator, exposure = seen
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    text = f"sh -c 'sleep 1000 & echo $! > {tmp_path}/child; exec yes {{image}} >&{stream}'"
    with pytest.raises(SolverFault, match="printed more than 4 MB"):
        solver(text, timeout_s=PATIENCE_S).solve(exposure, simulator)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib < 50_000
    child = Path(f"/proc/{(tmp_path / 'child').read_text().strip()}/stat")
    # Without an init of its own a container keeps what has ended as a zombie.
    wait_for(
        lambda: not child.exists() or child.read_text().rpartition(")")[2].split()[0] == "Z",
        "the solver's child to end",
    )


def test_an_answer_of_several_parts_has_each_of_them() -> None:
    told = {
        "q": [0.5, -0.5, 0.5, 0.5],
        "rate": [0.1, -0.2, 0.3],
        "stamp_s": -0.25,
        "centroids": [[1.0, 2.0, 3.0, 4.0], [5.0, 6.0]],
    }
    answer = solvers.whole_answer(told, "the solver")
    assert answer.q_icrs_to_cam is not None
    assert answer.rate_cam_rad_s is not None
    assert answer.q_icrs_to_cam.tolist() == [0.5, -0.5, 0.5, 0.5]
    assert answer.rate_cam_rad_s.tolist() == [0.1, -0.2, 0.3]
    assert answer.stamp_s == -0.25
    assert answer.stars == (ReportedStar(1.0, 2.0, 3.0, 4), ReportedStar(5.0, 6.0))
    blind = solvers.whole_answer({"centroids": []}, "the solver")
    assert (blind.q_icrs_to_cam, blind.why) == (None, "the solver found no attitude")
    assert blind.stars == ()
    alone = solvers.whole_answer({"q": [1.0, 0.0, 0.0, 0.0]}, "the solver")
    assert (alone.rate_cam_rad_s, alone.stamp_s, alone.stars) == (None, 0.0, None)


@pytest.mark.parametrize(
    "told", [{"q": [1.0, 0.0]}, {"q": [2.0, 0.0, 0.0, 0.0]}, {"rate": "fast"}, {"centroids": [1.0]}]
)
def test_an_answer_that_is_none_is_the_solver_s_fault(told: dict[str, object]) -> None:
    with pytest.raises(SolverFault, match=r"^the solver"):
        solvers.whole_answer(told, "the solver")


@pytest.mark.parametrize(
    ("norm", "is_taken"), [(1.0009, True), (0.9991, True), (1.002, False), (0.998, False)]
)
def test_a_quaternion_is_a_unit_one_but_for_its_decimals(norm: float, is_taken: bool) -> None:
    numbers = (norm * np.array([0.5, 0.5, -0.5, 0.5])).tolist()
    if is_taken:
        assert checked_attitude(numbers, "who") == pytest.approx([0.5, 0.5, -0.5, 0.5])
        return
    with pytest.raises(SolverFault, match="who: answered a quaternion of norm"):
        checked_attitude(numbers, "who")


def test_a_solver_is_told_the_field_along_the_image_s_width() -> None:
    """1200 by 700 px of 13 um behind 65 mm: 5000 px, and twice the arc tangent of 600 of them."""
    tables = {
        "tracker": {
            "resolution_px": [1200, 700],
            "focal_length_mm": 65.0,
            "exposure_s": 0.2,
            "psf_sigma_px": [0.7, 0.8],
        },
        "sky": {"epoch_jyear": 2026.5, "faintest_v_mag": 1.0},
    }
    with Simulator(bench_file_of(Path("bench.toml"), bench_text(tables))) as simulator:
        facts = tracker_facts(simulator)
    assert facts == {
        "resolution_px": (1200, 700),
        "focal_length_px": pytest.approx(5000.0),
        "principal_point_px": (599.5, 349.5),
        "fov_deg": pytest.approx(13.6855, abs=1e-4),
        "psf_sigma_px": (0.7, 0.8),
        "exposure_s": 0.2,
        "epoch_jyear": 2026.5,
    }


def test_stars_are_counted_in_view_found_matched_and_false(
    seen: tuple[Simulator, Exposure],
) -> None:
    """Two blobs that are no stars; a fainter star beside one that has the same find; and stars on
    either side of the outer edge of the last column, of which one is in view.
    """
    simulator, exposure = seen
    usual = solver("centroids").solve(exposure, simulator).star_errors
    assert usual is not None
    drawn = np.flatnonzero(exposure.truth["drawn"])
    inside = drawn[(np.abs(exposure.truth["x_px"][drawn] - 63.5) < 50)]
    beside = np.repeat(exposure.truth[inside[:1]], 3)
    beside["electrons_per_s"] *= 0.5
    beside["x_px"] += [0.5, 0.0, 0.0]
    beside["x_px"][1:] = [127.6, 127.4]
    beside["y_px"][1:] = [5.0, 5.0]
    truth = np.concatenate([exposure.truth, beside])
    dn = exposure.dn.copy()
    for x, y in ((10, 20), (100, 90)):
        dn[y - 1 : y + 2, x - 1 : x + 2] += 2000
    counted = solver("centroids").solve(replace(exposure, rows=truth, dn=dn), simulator).star_errors
    assert counted is not None
    assert counted.stars == usual.stars + 2
    assert counted.found == usual.found + 2
    assert counted.matched == usual.matched
    assert counted.false == usual.false + 2


def test_a_solver_that_takes_too_long_is_ended_and_its_alarm_with_it(
    seen: tuple[Simulator, Exposure], tmp_path: Path
) -> None:
    """Afterwards the process has the handler that it had, and no alarm."""
    (tmp_path / "slow_solver.py").write_text(
        "import time\n\ndef solve(image, tracker):\n    time.sleep(600)\n"
    )
    simulator, exposure = seen
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(SolverFault, match=r"longer than 0\.01 s"):
        solver("python:slow_solver:solve", tmp_path, 0.01).solve(exposure, simulator)
    assert signal.getsignal(signal.SIGALRM) is before
    with time_limit(600.0):
        assert signal.getitimer(signal.ITIMER_REAL)[0] > 0
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_a_command_gets_what_its_braces_name() -> None:
    facts = {"fov_deg": 9.53125, "focal_length_px": 1538.4615384, "resolution_px": (640, 480)}
    words = ["solve", "{image}", "--png={png}", "{fov_deg}", "{focal_length_px}"]
    words += ["{width_px}x{height_px}", "{other}"]
    assert filled_words(words, facts, Path("/a/i.fits"), Path("/a/i.png")) == [
        "solve",
        "/a/i.fits",
        "--png=/a/i.png",
        "9.53125",
        "1538.46154",
        "640x480",
        "{other}",
    ]


def test_of_what_a_program_says_the_last_line_counts() -> None:
    assert last_words("first\nsecond\nlast \n\n") == "last"
    assert last_words(" \n") == "it said nothing on stderr"
    two = "1 0 0 0\n0 1 0 0\ndone in 3 s\n"
    assert printed_attitude(two) == [0.0, 1.0, 0.0, 0.0]
    assert printed_attitude('{"q": [1, 0, 0, 0]}\n{"q": [0, 0, 1, 0]}\n{"t": 1}') == [0, 0, 1, 0]


def test_centroids_turn_by_the_least_squares_of_their_light(
    seen: tuple[Simulator, Exposure],
) -> None:
    """As scipy weighs the same centroids by their electrons; even weights are another attitude."""
    simulator, exposure = seen
    answer = solver("centroids").solve(exposure, simulator)
    errors = answer.star_errors
    assert errors is not None and answer.q_icrs_to_cam is not None
    x_px, y_px = errors.star["x_px"], errors.star["y_px"]
    true = simulator.camera.rays(x_px, y_px)
    measured = simulator.camera.rays(x_px + errors.dx_px, y_px + errors.dy_px)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    measured /= np.linalg.norm(measured, axis=1, keepdims=True)
    off_arcsec = []
    for weights in (errors.star["electrons_per_s"], np.ones(len(true))):
        turn, _ = Rotation.align_vectors(measured, true, weights=weights)
        commanded = Rotation.from_quat(exposure.view.q_icrs_to_cam, scalar_first=True)
        wanted = (turn * commanded).as_quat(scalar_first=True)
        off_arcsec.append(np.abs(attitude_error_arcsec(wanted, answer.q_icrs_to_cam)).max())
    assert off_arcsec[0] < SAME_TURN_ARCSEC < 100 * SAME_TURN_ARCSEC < off_arcsec[1]


def test_false_stars_are_those_that_match_none_and_no_star_at_the_edge_is_reported(
    seen: tuple[Simulator, Exposure],
) -> None:
    simulator, exposure = seen
    dn = exposure.dn.copy()
    dn[:3, :3] += 3000
    answer = solver("centroids").solve(replace(exposure, dn=dn), simulator)
    errors = answer.star_errors
    assert errors is not None and answer.stars is not None
    # a crowded star is matched, and has no error of its own
    truth = np.concatenate([exposure.truth, exposure.truth])
    crowded = solver("centroids").solve(replace(exposure, rows=truth, dn=dn), simulator)
    assert crowded.star_errors is not None
    for counted in (errors, crowded.star_errors):
        assert counted.false == counted.found - counted.matched >= 1
    assert len(crowded.star_errors.dx_px) < crowded.star_errors.matched
    usual = solver("centroids").solve(exposure, simulator)
    assert usual.star_errors is not None and usual.stars is not None
    assert errors.found == usual.star_errors.found + 1
    assert len(answer.stars) == len(usual.stars)
    assert min(np.hypot(star.x_px, star.y_px) for star in answer.stars) > 3
