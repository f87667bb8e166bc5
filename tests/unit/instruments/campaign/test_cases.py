"""Cases: made again by other commands, the same whatever came before them, and the display's
light against the sky's.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from astropy.coordinates import get_sun
from astropy.io import fits
from astropy.time import Time
from scipy.spatial.transform import Rotation

from hilstar.basics.errors import InputError
from hilstar.basics.rotation import angle_between_rad, from_radec_roll_deg, propagate, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.instruments.assess.places import Scale
from hilstar.instruments.campaign.cases import CaseMaker, beside_q, first_row, value_kind
from hilstar.instruments.campaign.job import Job, files_sha256
from hilstar.instruments.campaign.plan import Design, Parameter, parse_plan
from hilstar.instruments.campaign.session import Session
from hilstar.instruments.campaign.star_motion import StarMotion
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.star_light import bench_moving
from hilstar.sky.bodies.orbit import TleOrbit
from hilstar.sky.bodies.shapes import EQUATOR_KM
from tests.support.benches import ROOT
from tests.support.campaigns import write_campaign
from tests.support.commands import run_hilstar_here
from tests.support.refusals import refusal


def cases_session(folder: Path, images: bool = False) -> Session:
    """A session of the plan in a folder."""
    plan, bench = folder / "plan.toml", folder / "bench.toml"

    digest = read_bench_file(bench).sha256
    return Session(
        Job(
            plan_path=str(plan),
            plan_text=plan.read_text(),
            bench_path=str(bench),
            bench_text=bench.read_text(),
            bench_sha256=digest,
            files_sha256=files_sha256(parse_plan(plan, plan.read_text()), folder),
            solver="centroids",
            solver_folder=str(folder),
            timeout_s=10.0,
            directory=str(folder),
            images=images,
        )
    )


def points(this: Session, cases: int) -> Any:
    design = Design(
        "sobol",
        this.plan.seed,
        cases,
        this.maker.attitude_dimensions,
        [1] * len(this.maker.parameters),
    )
    return design.points(0, cases)


def test_a_case_does_not_depend_on_the_cases_before_it(tmp_path: Path) -> None:
    write_campaign(tmp_path)
    first, second = cases_session(tmp_path), cases_session(tmp_path)
    where = points(first, 6)
    forwards = [first.row(k, where[k]) for k in range(6)]
    backwards = [second.row(k, where[k]) for k in reversed(range(6))]
    assert forwards == backwards[::-1]
    for name in ("image_sha256", "bench_sha256"):
        assert len({row[name] for row in forwards}) == 6
    first.close()
    second.close()


def test_a_case_s_row_has_its_own_bench_and_each_value_in_its_column_s_kind(
    tmp_path: Path,
) -> None:
    sigma = {"key": "tracker.psf_sigma_px", "minimum": 0.5, "maximum": 1.0}
    write_campaign(tmp_path, sigma)
    this = cases_session(tmp_path)
    where = points(this, 2)
    for number in range(2):
        row = this.row(number, where[number])
        case = this.maker.case(number, where[number])
        assert row["bench_sha256"] == this.maker.bench(case).sha256 != this.file.sha256
        sigma_px = 0.5 * (1 + where[number][-1])
        assert row["vary.tracker.psf_sigma_px"] == pytest.approx(sigma_px)
    this.close()
    mixed = replace(case, values={"a": 3, "b": "three", "c": True, "d": 3})
    kinds = {
        "vary.a": "text",
        "vary.b": "text",
        "vary.c": "bool",
        "vary.d": "int64",
        "flux": "text",
    }
    row = first_row(mixed, kinds)
    varied = [row[name] for name in kinds]
    assert varied == ["3", "three", True, 3, None]
    assert row["case"] == 1 and row["noise_seed"] == case.noise_seed


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("bench_sha256", "is not the campaign's 000000000000: a file that"),
        ("files_sha256", "its log or scenario is not the campaign's: a file that"),
    ],
)
def test_a_worker_with_another_file_than_the_campaign_s_is_refused(
    tmp_path: Path, name: str, words: str
) -> None:
    write_campaign(tmp_path)
    this = cases_session(tmp_path)
    this.close()
    line = refusal(Session, msgspec.structs.replace(this.job, **{name: "0" * 64}))
    assert words in line and line.endswith("copy it")


def test_a_case_is_made_again_by_simulate_and_its_image_has_its_truth(tmp_path: Path) -> None:
    write_campaign(tmp_path, {"key": "noise_seed", "values": [11]})
    this = cases_session(tmp_path, images=True)
    where = points(this, 1)[0]
    row = this.row(0, where)
    # a thousand images a folder
    for number, image in ((999, "000000/case_000000999"), (1000, "000001/case_000001000")):
        assert this.row(number, where)["image"] == f"images/{image}.fits"
        assert (tmp_path / f"images/{image}.fits").is_file()
    this.close()
    q = ",".join(repr(row[name]) for name in ("qw", "qx", "qy", "qz"))
    again = run_hilstar_here(
        "simulate",
        "bench.toml",
        f"--quaternion={q}",
        "--seed",
        "11",
        "-o",
        "again.fits",
        cwd=tmp_path,
    )
    assert again.returncode == 0, again.stderr
    with fits.open(tmp_path / row["image"]) as kept, fits.open(tmp_path / "again.fits") as made:
        assert np.array_equal(kept[0].data, made[0].data)
        assert len(kept["TRUTH"].data) == row["stars_in_view"]
        assert kept[0].header["SEED"] == 11


def test_a_run_of_frames_turns_at_its_rate_and_its_scatter_is_its_noise(tmp_path: Path) -> None:
    write_campaign(tmp_path, {"key": "rate_deg_s.z", "values": [2.0]}, frames=4, step_s=0.5)
    this = cases_session(tmp_path)
    where = points(this, 1)[0]
    case = this.maker.case(0, where)
    last = this.maker.view(case, 3, 0.1)
    assert last.q_icrs_to_cam == pytest.approx(
        propagate(case.first.q_icrs_to_cam, np.radians([0, 0, 2.0]), 1.5), abs=1e-12
    )
    assert last.t_ns == 1_500_000_000
    row = this.row(0, where)
    this.close()
    assert row["frames"] == row["solved"] == 4 and row["scatter_x_arcsec"] > 0


FEW_CODES = {"key": "misalignment_arcsec.x", "values": [0.0, 300.0]}


def test_the_display_shows_what_the_tracker_would_see_and_its_misalignment(tmp_path: Path) -> None:
    """A turn of the mounting by 300 arcsec is an attitude error of as much about the same axis."""
    looks = {"kind": "field", "radec_deg": [84.0, -1.0], "radius_deg": 0.0, "roll_deg": [0, 0]}
    keys = {
        "sampling": "grid",
        "cases": None,
        "through": "display",
        "noise": "none",
        "attitudes": looks,
    }
    write_campaign(tmp_path, FEW_CODES, **keys)
    text = (tmp_path / "bench.toml").read_text().replace("[320, 240]", "[640, 480]")
    text = text.replace("[monitor]", "[monitor]\nbits = 10")
    (tmp_path / "bench.toml").write_text(
        text.replace("focal_length_mm = 60", "focal_length_mm = 170")
    )
    assert (
        parse_plan(tmp_path / "plan.toml", (tmp_path / "plan.toml").read_text()).through
        == "display"
    )
    this = cases_session(tmp_path)
    rows = [this.row(k, np.array([0.5, 0.0, 0.0, share])) for k, share in enumerate((0.25, 0.75))]
    this.close()
    straight, turned = (np.array([row[f"error_{axis}_arcsec"] for axis in "xyz"]) for row in rows)
    # 10-bit codes of stars over 1.1 monitor pixels a tracker's: the twin's own tests hold them to
    # 0.02 px, 3 arcsec here.
    assert np.abs(straight[:2]).max() < 3
    assert (
        np.abs(turned - straight)[0] == pytest.approx(300, abs=3) and abs(turned - straight)[1] < 3
    )
    assert rows[0]["matched"] >= 5


def test_a_misalignment_turns_a_mounting_that_is_turned_already_about_the_camera_s_own_axes(
    tmp_path: Path,
) -> None:
    """Of a display on its side, what the camera's x axis turns is y and z of the camera, which are
    others of the monitor.
    """
    write_campaign(tmp_path, {"key": "misalignment_arcsec.x", "values": [300.0]}, through="display")
    path = tmp_path / "bench.toml"
    mounting = Rotation.from_euler("z", 90, degrees=True)
    x, y, z, w = mounting.as_quat().tolist()
    path.write_text(
        path.read_text().replace("[collimator]", f"[collimator]\nq_cam_to_mon = {[w, x, y, z]}")
    )
    plan = parse_plan(tmp_path / "plan.toml", (tmp_path / "plan.toml").read_text())
    maker = CaseMaker(plan, read_bench_file(path), tmp_path)
    file = maker.bench(maker.case(0, np.full(maker.attitude_dimensions + 1, 0.5)))
    true = to_matrix(np.array(file.config.verify.true_q_cam_to_mon))
    turn = np.radians(300 / 3600)
    cosine, sine = np.cos(turn), np.sin(turn)
    # a rotation vector turns vectors by the right hand
    about_x = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    assert true == pytest.approx(mounting.as_matrix() @ about_x, abs=1e-12)


SCENARIO = """
[[fault]]
kind = "blank"
name = "dark"
at_s = 1.0
for_s = 2.0
"""


def test_a_scenario_is_varied_like_any_key_and_a_file_that_changes_is_another_campaign(
    tmp_path: Path,
) -> None:
    scenario = {"key": "scenario", "values": ["", "dark.toml"]}
    (tmp_path / "dark.toml").write_text(SCENARIO)
    write_campaign(
        tmp_path, scenario, {"key": "time_s", "values": [0.0, 2.0]}, sampling="grid", cases=None
    )
    this = cases_session(tmp_path)
    look = np.array([0.3, 0.6, 0.1])
    found = [
        this.row(k, np.append(look, [(k // 2 + 0.5) / 2, (k % 2 + 0.5) / 2]))["matched"]
        for k in range(4)
    ]
    this.close()
    assert found[0] == found[1] == found[2] > 0 == found[3]
    before = files_sha256(this.plan, tmp_path)
    (tmp_path / "dark.toml").write_text(SCENARIO + "# another\n")
    assert files_sha256(this.plan, tmp_path) != before


@pytest.mark.parametrize(("ends_s", "within"), [(0.55, True), (0.65, False)])
def test_a_fault_that_ends_after_the_last_exposure_has_no_recovery(
    tmp_path: Path, ends_s: float, within: bool
) -> None:
    """Three frames, 0.25 s apart, of 0.1 s: from the first one's begin to the last one's end are
    0.6 s.
    """
    fault = SCENARIO.replace("at_s = 1.0", "at_s = 0.0").replace("for_s = 2.0", f"for_s = {ends_s}")
    (tmp_path / "dark.toml").write_text(fault)
    scenario = {"key": "scenario", "values": ["dark.toml"]}
    write_campaign(tmp_path, scenario, cases=1, frames=3, step_s=0.25)
    this = cases_session(tmp_path)
    row = this.row(0, points(this, 1)[0])
    this.close()
    assert row["fault_end_s"] == (ends_s if within else None)


def test_a_log_s_convention_and_mounting_are_the_bench_files(tmp_path: Path) -> None:
    """A body's attitude, sent from the body to the ICRS, scalar last: the case looks where the
    camera does.
    """
    to_cam = Rotation.from_quat([-0.5, -0.5, -0.5, 0.5])
    camera = Rotation.from_euler("zyx", [10, 20, 30], degrees=True)
    x, y, z, w = (to_cam.inv() * camera).inv().as_quat().tolist()
    (tmp_path / "log.csv").write_text(f"t_s,qw,qx,qy,qz\n0,{x},{y},{z},{w}\n9,{x},{y},{z},{w}\n")
    plan = write_campaign(tmp_path, attitudes={"kind": "log", "log": "log.csv"})
    bench = tmp_path / "bench.toml"
    text = bench.read_text().replace(
        "[tracker]", "[tracker]\nq_body_to_cam = [0.5, -0.5, -0.5, -0.5]", 1
    )
    table = 'convention = { scalar = "last", direction = "cam_to_icrs", frame = "body" }'
    bench.write_text(f"{text}\n[attitude]\n{table}\n")
    maker = CaseMaker(parse_plan(plan, plan.read_text()), read_bench_file(bench), tmp_path)
    first = maker.case(0, np.full(maker.attitude_dimensions + len(maker.parameters), 0.5)).first
    assert (
        Rotation.from_quat(first.q_icrs_to_cam, scalar_first=True) * camera.inv()
    ).magnitude() < 1e-12


def maker_of(folder: Path, *vary: dict[str, Any], **keys: Any) -> CaseMaker:
    path = write_campaign(folder, *vary, **keys)
    file = read_bench_file(folder / "bench.toml")
    return CaseMaker(parse_plan(path, path.read_text()), file, folder)


def bodied(folder: Path, **keys: Any) -> CaseMaker:
    """The cases of a plan that looks 30 degrees from the Sun."""
    return maker_of(
        folder,
        {"key": "sky.epoch_utc", "values": ["2026-03-20T12:00:00"]},
        {"key": "sky.bodies.sun", "values": [True]},
        {"key": "body_deg", "values": [30.0]},
        attitudes={"kind": "body", "body": "sun"} | keys,
    )


def test_a_case_beside_a_body_looks_at_its_angle_from_where_astropy_has_it(tmp_path: Path) -> None:
    maker = bodied(tmp_path)
    sun = get_sun(Time("2026-03-20T12:00:00")).cartesian.xyz.value
    sun = sun / np.linalg.norm(sun)
    points = np.random.default_rng(1).random((20, 6))
    boresights = np.array(
        [to_matrix(maker.case(k, point).first.q_icrs_to_cam)[2] for k, point in enumerate(points)]
    )
    # the aberration between the two, and ICRS against GCRS: 21 arcsec
    assert np.degrees(np.arccos(boresights @ sun)) == pytest.approx(30.0, abs=0.01)
    beside = boresights - (boresights @ sun)[:, None] * sun
    assert np.linalg.norm(beside.mean(axis=0)) < 0.25  # on every side: 0.5 / sqrt(20), twice over


@pytest.mark.parametrize("limb_deg", [20.0, -10.0, -90.0])
def test_a_case_beside_the_earth_looks_at_its_angle_from_the_limb(
    tmp_path: Path, limb_deg: float
) -> None:
    tle = ROOT / "configs" / "plans" / "low-orbit.tle"
    maker = maker_of(
        tmp_path,
        {"key": "sky.epoch_utc", "values": ["2026-03-20T12:00:00"]},
        {"key": "spacecraft.orbit", "values": [str(tle)]},
        {"key": "sky.bodies.earth", "values": [True]},
        {"key": "limb_deg", "values": [limb_deg]},
        {"key": "time_s", "values": [600.0]},
        attitudes={"kind": "body", "body": "earth"},
    )
    utc_ns = int(np.datetime64("2026-03-20T12:10:00", "ns").astype(np.int64))
    place_km, _ = TleOrbit(tle.read_text(), "low-orbit.tle").state(utc_ns)
    radius_deg = np.degrees(np.arcsin(EQUATOR_KM / np.linalg.norm(place_km)))
    # deeper than the middle of the disc is nowhere
    wanted_deg = max(radius_deg + limb_deg, 0.0)
    for k, point in enumerate(np.random.default_rng(1).random((5, 8))):
        boresight = to_matrix(maker.case(k, point).first.q_icrs_to_cam)[2]
        off = np.arccos(-boresight @ place_km / np.linalg.norm(place_km))
        # the aberration by the orbit's velocity: 5 arcsec
        assert np.degrees(off) == pytest.approx(wanted_deg, abs=0.003)


def test_a_case_that_speeds_up_turns_as_its_rate_says(tmp_path: Path) -> None:
    maker = maker_of(
        tmp_path,
        {"key": "rate_deg_s.x", "values": [0.5]},
        {"key": "acceleration_deg_s2.x", "values": [0.2]},
        {"key": "acceleration_deg_s2.y", "values": [-0.1]},
    )
    case = maker.case(0, np.full(6, 0.3))
    later = maker.after(case, 2_000_000_000)
    rate = np.radians([0.5 + 0.4, -0.2, 0.0])
    assert later.turn.rate_cam_rad_s == pytest.approx(rate, abs=1e-12)
    # by SciPy's rotations in steps of a millisecond
    turn = Rotation.identity()
    for k in range(2000):
        middle_s = (k + 0.5) / 1000
        step = np.radians([0.5 + 0.2 * middle_s, -0.1 * middle_s, 0.0]) / 1000
        turn = Rotation.from_rotvec(-step) * turn
    first = Rotation.from_quat(np.roll(case.first.q_icrs_to_cam, -1))
    found = Rotation.from_quat(np.roll(later.q_icrs_to_cam, -1))
    off_arcsec = np.degrees((found * (turn * first).inv()).magnitude()) * 3600
    # midpoints of 10 ms against those of 1 ms: a step of rate 1 deg/s is off by under 1e-9 deg
    assert off_arcsec < 1e-3


def test_stray_light_is_even_and_in_every_exposure(tmp_path: Path) -> None:
    vary = {"key": "stray_e_per_px", "values": [0.0, 5000.0]}
    write_campaign(tmp_path, vary, sampling="grid", cases=2, frames=2)
    this = cases_session(tmp_path)
    where = Design("grid", 7, 2, 3, [2]).points(0, 2)
    for number, wanted_e in ((0, 0.0), (1, 5000.0)):
        case = this.maker.case(number, where[number])
        tracker = this._at(this.maker.bench(case))
        assert isinstance(tracker, Simulator)
        for frame in range(2):
            view = this.maker.view(case, frame, tracker.config.tracker.exposure_s)
            exposure = tracker.expose(view, None, this.maker.faults(case, view, tracker))
            corners_e = exposure.mean_e[[0, 0, -1, -1], [0, -1, 0, -1]]
            # a glow of 80 degrees falls by 0.2 % to the corners, 3.4 degrees off
            assert corners_e == pytest.approx(wanted_e, rel=0.005)
    this.close()


def test_frames_along_a_log_have_the_log_s_rate(tmp_path: Path) -> None:
    """The commanded rate, of which a reported one's errors are counted, is the mean over the
    exposure.
    """
    rate_deg_s = np.array([0.1, -0.05, 0.4])
    begin = from_radec_roll_deg(84.0, 0.0, 0.0)
    rows = []
    for k in range(11):
        w, x, y, z = propagate(begin, np.radians(rate_deg_s), 0.2 * k).tolist()
        rows.append(f"{0.2 * k},{w},{x},{y},{z}")
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    write_campaign(
        tmp_path,
        {"key": "tracker.psf_sigma_px", "minimum": 0.5, "maximum": 1.0},
        attitudes={"kind": "log", "log": "log.csv"},
        cases=2,
        frames=2,
        columns=["rate", "time"],
    )
    session = cases_session(tmp_path)
    try:
        for number, point in enumerate(points(session, 2)):
            row = session.row(number, point)
            for axis, axis_rate_deg_s in zip("xyz", rate_deg_s.tolist(), strict=True):
                told = row[f"frame_rate_{axis}_deg_s"]
                assert told == pytest.approx([axis_rate_deg_s] * 2, rel=1e-5)
    finally:
        session.close()


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        ((2**63 - 1, -(2**63 - 1)), "int64"),
        ((1, 2**63), "float64"),
        ((1, -(2**63) - 1), "float64"),
        ((True, False), "bool"),
        ((1, 0.5), "float64"),
        ((1, "round"), "text"),
    ],
)
def test_whole_values_are_whole_numbers_where_they_have_64_bits(values, kind) -> None:
    assert value_kind(Parameter("key", values)) == kind


@pytest.mark.parametrize(
    ("position_angle_deg", "radec"),
    [(0.0, (84.0, 8.0)), (90.0, (94.0, -2.0)), (180.0, (84.0, -12.0))],
)
def test_a_position_angle_is_from_north_to_east(position_angle_deg, radec) -> None:
    """Ten degrees from a place two degrees under the equator; to the east along a great circle."""
    middle = to_matrix(from_radec_roll_deg(84.0, -2.0, 0.0))[2]
    q = beside_q(middle, np.radians(10.0), np.radians(position_angle_deg), 30.0)
    wanted = to_matrix(from_radec_roll_deg(*radec, 30.0))
    assert np.degrees(np.arccos(to_matrix(q)[2] @ wanted[2])) < 0.04
    back = to_matrix(beside_q(middle, 0.0, 1.0, 30.0))
    assert back == pytest.approx(to_matrix(from_radec_roll_deg(84.0, -2.0, 30.0)), abs=1e-9)


def test_a_case_that_begins_at_a_log_s_end_stays_there(tmp_path: Path) -> None:
    q = [" ".join(map(repr, from_radec_roll_deg(ra, 0.0, 0.0).tolist())) for ra in (80.0, 81.0)]
    rows = [f"{t_s},{','.join(each.split())}" for t_s, each in zip((0.0, 2.0), q, strict=True)]
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    maker = maker_of(tmp_path, attitudes={"kind": "log", "log": "log.csv"}, frames=4, step_s=0.5)
    last = np.full(maker.attitude_dimensions + len(maker.parameters), 0.5)
    last[0] = 0.75  # 1.5 s
    case = maker.case(0, last)
    times_ns = [maker.view(case, frame, 0.1).t_ns for frame in range(4)]
    assert times_ns == [1_500_000_000, 2_000_000_000, 2_000_000_000, 2_000_000_000]
    boresight = to_matrix(maker.view(case, 3, 0.1).q_icrs_to_cam)[2]
    assert np.degrees(np.arctan2(boresight[1], boresight[0])) == pytest.approx(81.0, abs=1e-6)


@pytest.mark.parametrize(
    ("time_s", "length_s", "end_s"),
    [(0.0, 3.0, 3.0), (0.0, 2.9, None), (1.0, 2.0, 2.0), (4.0, 9.0, None)],
)
def test_a_fault_ends_after_the_case_s_own_begin_and_within_it(
    tmp_path: Path, time_s: float, length_s: float, end_s: float | None
) -> None:
    """The scenario's fault is over after 3 s of its own time."""
    (tmp_path / "dark.toml").write_text(SCENARIO)
    vary = ({"key": "scenario", "values": ["dark.toml"]}, {"key": "time_s", "values": [time_s]})
    maker = maker_of(tmp_path, *vary)
    case = maker.case(0, np.full(maker.attitude_dimensions + 2, 0.5))
    assert maker.fault_end_s(case, length_s) == end_s


@pytest.mark.parametrize("time_s", [0.0, 40.1])
def test_a_case_that_begins_later_swings_as_one_that_begins_at_once(
    tmp_path: Path, time_s: float
) -> None:
    """An exposure of 0.1 s from 0.2 s after its begin on, in pieces of a swing of 7 Hz."""
    vary = (
        {"key": "jitter_arcsec.x", "values": [100.0]},
        {"key": "jitter_hz", "values": [7.0]},
        {"key": "time_s", "values": [time_s]},
    )
    maker = maker_of(tmp_path, *vary, frames=2, step_s=0.25)
    case = maker.case(0, np.full(maker.attitude_dimensions + 3, 0.5))
    view = maker.view(case, 1, 0.1)
    with Simulator(maker.file) as simulator:
        faulty = maker.faults(case, view, simulator)
    assert faulty is not None and len(faulty.pieces) > 8
    for shown in (piece.view for piece in faulty.pieces):
        assert shown.t_ns is not None
        after_s = shown.t_ns / NS_PER_S - time_s
        assert 0.2 < after_s < 0.3
        wanted = case.motion.at(after_s).q_icrs_to_cam
        assert angle_between_rad(shown.q_icrs_to_cam, wanted) < 1e-9


def test_a_scenario_along_a_log_counts_from_the_log_s_begin(tmp_path: Path) -> None:
    """A log of 9 s of a clock that is far from 0, and a fault from its 1st to its 3rd second."""
    (tmp_path / "dark.toml").write_text(SCENARIO)
    rows = "".join(f"{t_s},1,0,0,0\n" for t_s in (5000, 5009))
    (tmp_path / "log.csv").write_text("t_s,qw,qx,qy,qz\n" + rows)
    log = {"kind": "log", "log": "log.csv"}
    maker = maker_of(tmp_path, {"key": "scenario", "values": ["dark.toml"]}, attitudes=log)
    active = []
    with Simulator(maker.file) as simulator:
        for share in (0.5 / 9, 2 / 9, 3.5 / 9):
            case = maker.case(0, np.array([share, 0.5]))
            faulty = maker.faults(case, maker.view(case, 0, 0.1), simulator)
            assert faulty is not None
            active.append([len(piece.now) for piece in faulty.pieces])
    assert active == [[0], [1], [0]]


@pytest.mark.parametrize("values", [[5.0, 20.0], [20.0, 5.0]])
def test_the_fastest_jitter_has_to_be_shown(tmp_path: Path, values: list[float]) -> None:
    """Six frames a swing: 10 Hz on a display of 60 Hz."""
    vary = (
        {"key": "jitter_arcsec.across", "values": [10.0]},
        {"key": "jitter_hz", "values": values},
    )
    with pytest.raises(InputError, match="20 Hz on a display of 60 Hz; write at most 10"):
        maker_of(tmp_path, *vary, through="bench")


def test_a_case_s_seed_has_63_bits(tmp_path: Path) -> None:
    """As many as a FITS header holds: half of them begin with a 1."""
    maker = maker_of(tmp_path)
    point = np.full(maker.attitude_dimensions + len(maker.parameters), 0.5)
    seeds = [maker.case(number, point).noise_seed for number in range(40)]
    assert len(set(seeds)) == 40
    assert max(seeds) < 2**63
    assert 8 < sum(seed >= 2**62 for seed in seeds) < 32


PLANTED_OLD = "[planted]\nproper_motion = 0.5\ncatalogue_age_yr = 30.0\nparallax = -4.0\n"
DATES = "2026-04-01T00:00:00Z", "2050-07-01T00:00:00Z"


def test_planted_old_places_turn_a_case_by_its_years_and_its_parallax(tmp_path: Path) -> None:
    """Half of the 24.25 years from the bench's date to the case's, 30 years more, and four times
    the parallax the other way: each by the stars of a field that is wider than high.
    """
    vary = {"key": "sky.epoch_utc", "values": [DATES[1]]}
    look = {"kind": "field", "radec_deg": [84.0, -1.0], "radius_deg": 0.0, "roll_deg": [40, 40]}
    plan = write_campaign(tmp_path, vary, cases=1, attitudes=look, noise="none")
    bench = tmp_path / "bench.toml"
    text = bench.read_text().replace("[128, 128]", "[160, 90]")
    observer = f'[sky]\nfaintest_v_mag = 6.0\nepoch_utc = "{DATES[0]}"\n[spacecraft]\norbit = "geocentre"\n'
    bench.write_text(f"{text}\n{observer}")
    errors = []
    for planted in ("", PLANTED_OLD):
        plan.write_text(plan.read_text() + planted)
        this = cases_session(tmp_path)
        case = this.maker.case(0, points(this, 1)[0])
        file = this.maker.bench(case)
        row = this.row(0, points(this, 1)[0])
        this.close()
        errors.append(np.array([row[f"error_{axis}_arcsec"] for axis in "xyz"]))
    q = case.first.q_icrs_to_cam
    scale = Scale(20e3 / file.config.tracker.pixel_pitch_um, (160, 90))
    stars = StarMotion.of(read_bench_file(bench))
    moving = bench_moving(file.config, tmp_path)
    assert moving is not None
    first, last = np.array([date[:-1] for date in DATES], dtype="datetime64[s]")
    years = float((last - first) / np.timedelta64(1, "D")) / 365.25
    turn_rad = (0.5 * years + 30.0) * stars.whole_turn_rad(q, scale)
    turn_rad += -4.0 * stars.by_parallax(moving).whole_turn_rad(q, scale)
    turn_arcsec = ARCSEC_PER_RAD * turn_rad
    assert np.abs(turn_arcsec).min() > 0.01
    assert errors[1] - errors[0] == pytest.approx(turn_arcsec, rel=1e-3, abs=1e-3)


def test_a_case_that_overflows_fails_alone_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next case is as in a session of its own."""

    def overflows(*_: object, **__: object) -> None:
        raise OverflowError("a light that\nhas no number")

    write_campaign(tmp_path)
    this, alone = cases_session(tmp_path), cases_session(tmp_path)
    where = points(this, 2)
    with monkeypatch.context() as patch:
        patch.setattr(Simulator, "expose", overflows)
        failed = this.row(0, where[0])
    assert (failed["case"], failed["status"]) == (0, "failed")
    assert failed["why"] == "OverflowError: a light that has no number"
    assert this.row(1, where[1]) == alone.row(1, where[1])
    this.close()
    alone.close()
