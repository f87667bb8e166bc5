"""The tracker before a running display: what an exposure has of its frames, its clock, and the
errors that are planted.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.attitude.wire import protocol
from hilstar.attitude.wire.packet import AnswerPacket, decode, encode
from hilstar.attitude.wire.shown_frames import FrameHead, ShownFrame
from hilstar.basics.rotation import (
    conjugate,
    from_rotation_vector,
    multiply,
    propagate,
    to_rotation_vector,
)
from hilstar.basics.units import ARCSEC_PER_RAD, NS_PER_S
from hilstar.cli.tracker import solver_of
from hilstar.instruments.simulate import live_exposure
from hilstar.instruments.simulate.answer_link import answer_packet, json_answer
from hilstar.instruments.simulate.live_exposure import (
    BLINDED,
    BLINDED_SHARE,
    LOST,
    TOO_FEW,
    TRACKING,
    Exposed,
    LiveTracker,
    Solved,
    WatchedFrames,
    _levels_of,
    smeared_settings,
    streak_px,
)
from hilstar.instruments.simulate.tracker_process import OwnClock, Planted, PlantedErrors
from hilstar.server.answers.answer import Answer, ReportedStar
from hilstar.server.bench.build import open_bench
from hilstar.tracker.identify import MIN_STARS, FoundStars, Identified
from tests.support.bench_files import filed_bench
from tests.support.refusals import refusal

PERIOD_NS = 100
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def frame_of_light(number, lit, light, q=IDENTITY, lit_ns=None):
    head = FrameHead(
        number,
        number * PERIOD_NS if lit_ns is None else lit_ns,
        8,
        8,
        8,
        None if q is None else tuple(q),
    )
    return ShownFrame(head, np.array(lit, dtype=np.uint32), np.array(light, dtype=np.uint8))


def watched(*frames):
    kept = WatchedFrames(lambda frame: frame.codes.astype(np.float64)[:, None])
    for each in frames:
        kept.add(each)
    return kept


def test_an_exposure_has_of_each_frame_the_time_that_it_was_lit():
    turned = from_rotation_vector(np.array([0.0, 0.0, 0.01]))
    kept = watched(
        frame_of_light(1, [3], [8]),
        frame_of_light(2, [3, 5], [4, 40], turned),
        frame_of_light(4, [], [], None),
    )
    # half of frame 1, all of frame 2 and, as 3 never came, of its time too; and of 4
    exposed = kept.exposed(150, 550)
    assert exposed.lit.tolist() == [3, 5]
    assert exposed.light_e_per_s[:, 0] == pytest.approx([8 / 8 + 4 / 2, 40 / 2])
    assert (exposed.frames, exposed.shown_share) == (3, pytest.approx(5 / 8))
    assert to_rotation_vector(exposed.q_icrs_to_cam)[2] == pytest.approx(0.01 * 4 / 5)
    assert kept.missing == 1
    assert kept.exposed(50, 150) is None  # nobody saw its beginning


def test_a_run_that_begins_anew_forgets_the_one_before():
    kept = watched(
        frame_of_light(7, [1], [1]),
        frame_of_light(1, [2], [2], lit_ns=800),
        frame_of_light(2, [2], [2], lit_ns=900),
    )
    assert kept.exposed(700, 850) is None
    assert kept.exposed(800, 900).lit.tolist() == [2]
    assert kept.missing == 0


def test_triples_of_codes_are_the_levels_that_made_them():
    rgb = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 1, 1], [2, 1, 1]], dtype=np.uint16)
    assert _levels_of(rgb[[4, 0, 2, 3, 1]], rgb).tolist() == [4, 0, 2, 3, 1]
    assert _levels_of(np.array([[9, 9, 9]]), rgb).tolist() == [0]


# A tracker of 64 px before a dark screen and a sky of 2000 e- a pixel in its own exposure: 1000 DN.
GLOWING = {
    "tracker": {"resolution_px": [64, 48], "exposure_s": 0.05},
    "tracker.detector": {
        **{"offset_dn": 100.0, "gain_e_per_dn": 2.0, "dark_e_per_s": 0.0, "dsnu_e_per_s": 0.0},
        **{"dsnu_e": 0.0, "prnu": 0.0, "read_noise_e": 2.0, "bits": 16},
    },
    "monitor": {"resolution_px": [64, 48], "pixel_pitch_um": 57.65},
    "sky": {"faintest_v_mag": 5.0},
    "background": {"electrons_per_px": 2000.0},
}
# of the mean of 64 x 48 pixels: five standard deviations of its shot noise is far less
LEVEL_ERROR = 0.01


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    file = filed_bench(tmp_path_factory.mktemp("live"), GLOWING)
    with LiveTracker(file, np.random.default_rng(1)) as tracker:
        yield tracker


def level_dn(live: LiveTracker) -> float:
    """The mean level above the offset of an exposure of a dark screen."""
    dark = Exposed((0, 1), np.zeros(0, np.intp), np.zeros((0, 1)), None, 1, 1.0)
    return float(live.expose(dark).mean()) - 100.0


def test_a_client_s_exposure_and_gain_scale_what_a_pixel_collects(live):
    """Twice the exposure collects twice as much; a gain of 20 dB is ten times in DN, as of a
    voltage.
    """
    live.adjust(0.05, 0.0)
    assert level_dn(live) == pytest.approx(1000.0, rel=LEVEL_ERROR)
    live.adjust(0.1, 0.0)
    assert level_dn(live) == pytest.approx(2000.0, rel=LEVEL_ERROR)
    live.adjust(0.01, 20.0)
    assert level_dn(live) == pytest.approx(2000.0, rel=LEVEL_ERROR)
    live.adjust(0.05, 0.0)
    assert level_dn(live) == pytest.approx(1000.0, rel=LEVEL_ERROR)


def solved_at(at_ns: int, q: np.ndarray) -> Solved:
    """An exposure about a moment with an attitude."""
    lit = np.zeros(0, np.intp)
    exposed = Exposed((at_ns - 5, at_ns + 5), lit, np.zeros((0, 1)), None, 1, 1.0)
    none = np.zeros(0)
    stars = FoundStars(none, none, none, np.zeros((0, 3)), none)
    identified = Identified(q, np.zeros(0, np.intp), np.zeros(0, np.intp), 0.0)
    return Solved(exposed, "tracking", stars, identified)


def test_a_tracker_expects_where_its_last_two_attitudes_lead_and_nothing_after_five_seconds(live):
    """A turn of 10 deg/s about y, at 10 Hz."""
    rate = np.array([0.0, np.radians(10.0), 0.0])
    live.lost_in_space = lambda stars, dn: None
    try:
        start = np.array([0.5, 0.5, -0.5, 0.5])
        assert live._expected(solved_at(0, start).exposed) is None
        for tenth in (0, 1):
            at_ns = tenth * NS_PER_S // 10
            live._answered(solved_at(at_ns, propagate(start, rate, tenth / 10)))
        assert live.rate_cam_rad_s() == pytest.approx(rate, abs=1e-9)
        for tenths in (2, 5):
            then = solved_at(tenths * NS_PER_S // 10, start).exposed
            expected = live._expected(then)
            off = multiply(expected, conjugate(propagate(start, rate, tenths / 10)))
            assert np.abs(to_rotation_vector(off)).max() < 1e-9
        assert live._expected(solved_at(6 * NS_PER_S, start).exposed) is None
    finally:
        live.lost_in_space = None


@pytest.mark.parametrize(
    ("apart_s", "is_known"), [(0.0, False), (0.1, True), (1.0, True), (1.1, False)]
)
def test_two_attitudes_tell_a_rate_up_to_a_second_apart(live, apart_s, is_known):
    rate = np.array([0.01, -0.02, 0.3])
    start = np.array([0.5, 0.5, -0.5, 0.5])
    for at_s in (0.0, apart_s):
        live._answered(solved_at(round(at_s * NS_PER_S), propagate(start, rate, at_s)))
    wanted = rate if is_known else np.zeros(3)
    assert live.rate_cam_rad_s() == pytest.approx(wanted, abs=1e-9)


def stars_of(count: int) -> FoundStars:
    """Stars of 100, 110, ... e-, 1.5 px wide but for the first, whose width is not known."""
    along = np.arange(count, dtype=float)
    width_px = np.where(along, 1.5, np.nan)
    return FoundStars(along, 2 * along, 100.0 + 10 * along, np.zeros((count, 3)), width_px)


@pytest.mark.parametrize(
    ("count", "full_share", "fits", "guesses", "mode"),
    [
        (9, 0.0, True, True, TRACKING),
        (9, BLINDED_SHARE - 1e-3, True, True, TRACKING),
        (9, BLINDED_SHARE + 1e-3, True, True, BLINDED),
        (MIN_STARS - 1, 0.0, False, None, TOO_FEW),
        (MIN_STARS, 0.0, False, None, LOST),
        (MIN_STARS, 0.0, False, False, LOST),
        (0, 0.0, False, True, TOO_FEW),
    ],
)
def test_a_tracker_says_why_it_has_no_attitude(
    live, monkeypatch, count, full_share, fits, guesses, mode
):
    """`guesses`: whether a solver finds a lost one's attitude, None without a solver."""
    dn = np.zeros((100, 100), dtype=np.uint16)
    dn.ravel()[: round(full_share * dn.size)] = 2**16 - 1
    found = Identified(IDENTITY, np.arange(2), np.arange(2), 0.0)
    asked = []

    def identify(stars, q, near, place):
        asked.append(q)
        return found if fits else None

    monkeypatch.setattr(live_exposure, "identify", identify)
    monkeypatch.setattr(live, "_found", lambda dn, exposed, expected: stars_of(count))

    def solver(stars, dn):
        return IDENTITY if guesses else None

    monkeypatch.setattr(live, "lost_in_space", None if guesses is None else solver)
    monkeypatch.setattr(live, "_expected", lambda exposed: IDENTITY)
    solved = live.solve(solved_at(0, IDENTITY).exposed, dn)
    assert solved.mode == mode
    assert (solved.identified is found) == (mode == TRACKING)
    assert len(asked) == (0 if mode == BLINDED else 1 + bool(guesses and not fits and count))


@pytest.mark.parametrize(
    ("rate_rad_s", "window_px", "is_still"),
    [
        ((0.0, 0.0, 9.0), 1.0, True),
        ((0.3, 0.4, 0.0), 1.0, True),
        # a streak of 8 px, and one that is wider than any window
        ((4.8, 6.4, 0.0), 8 / 12**0.5, False),
        ((0.0, 90.0, 0.0), 6.0, False),
    ],
)
def test_the_window_is_as_wide_as_an_even_streak(rate_rad_s, window_px, is_still):
    """Of a tracker whose pixel is a 1000th of a radian, in exposures of a millisecond."""
    smeared_px = streak_px(np.array(rate_rad_s), 1e-3, 1000.0)
    settings = smeared_settings(smeared_px, (0.55, 0.55))
    assert settings.window_sigma_px == pytest.approx(window_px)
    assert (settings.psf_sigma_px is not None) == is_still


def test_the_brightest_stars_are_reported_in_dn_with_what_is_known(live):
    """At 2 e- a DN: the second and the fourth are of the catalogue, one by no number."""
    live.adjust(0.05, 0.0)
    stars = stars_of(40)
    named = np.flatnonzero(live.stars.hip > 0)[:1]
    identified = Identified(IDENTITY, np.array([1, 3]), np.append(named, named), 0.0)
    hip = int(live.stars.hip[named[0]])
    solved = Solved(solved_at(0, IDENTITY).exposed, TRACKING, stars, identified)
    reported = live.reported_stars(solved)
    assert len(reported) == 30
    for k, star in enumerate(reported):
        assert (star.x_px, star.y_px) == (k, 2 * k)
        assert star.dn == pytest.approx((100 + 10 * k) / 2)
        assert star.hip == (hip if k in (1, 3) else None)
        assert star.width_px == (1.5 if k else None)
    live.adjust(0.05, 20.0)
    assert live.reported_stars(solved)[0].dn == pytest.approx(500.0)
    live.adjust(0.05, 0.0)


@pytest.mark.parametrize(("gain_db", "e_per_dn"), [(0.0, 2.0), (20.0, 0.2)])
def test_a_star_s_light_is_its_dn_by_the_gain_that_a_client_set(
    live, gain_db, e_per_dn, monkeypatch
):
    """A Gaussian of the PSF, integrated over pixels, of 20 000 DN above an even level."""
    sigma_px = np.array(live.canvas.psf.sigma_px)
    steps = (np.arange(65) - 0.5 - 30.3, np.arange(49) - 0.5 - 20.8)
    across, down = (
        np.diff(ndtr(step / sigma)) for step, sigma in zip(steps, sigma_px, strict=True)
    )
    dn = np.rint(1100 + 20_000 * np.outer(down, across)).astype(np.uint16)
    monkeypatch.setattr(live, "_last", None)
    live.adjust(0.05, gain_db)
    try:
        found = live.solve(solved_at(0, IDENTITY).exposed, dn).found
    finally:
        live.adjust(0.05, 0.0)
    assert (found.x_px[0], found.y_px[0]) == pytest.approx((30.3, 20.8), abs=0.02)
    # what of a star is beyond its window
    assert found.flux_e[0] == pytest.approx(20_000 * e_per_dn, rel=0.02)


SMALL = {"tracker": {"aperture_mm": 1.5}, "render": {"quantisation": "round"}}


@pytest.mark.parametrize(("bits", "read_noise_e"), [(2, 2.0), (8, 100.0)])
def test_stars_are_expected_that_the_display_shows_and_the_noise_leaves(
    tmp_path, bits, read_noise_e
):
    """Of a screen of three steps, or of read noise: three sigmas of it in the brightest pixel."""
    tables = {"monitor": {"bits": bits}, "tracker.detector": {"read_noise_e": read_noise_e}}
    file = filed_bench(tmp_path, GLOWING, SMALL, tables)
    with open_bench(file) as bench:
        rates_e_per_s = bench.stars.electrons_per_s
        shown_e_per_s = bench.faintest_shown_e_per_s
    with LiveTracker(file, np.random.default_rng(1)) as tracker:
        kept_e_per_s = tracker.stars.electrons_per_s
        peak_share = tracker.canvas.psf.peak_share
    # a step of the codes, of a twelfth of 2 e- squared, is the least of it
    noise_e = np.hypot(read_noise_e, 2.0 / np.sqrt(12))
    detected_e_per_s = 3 * noise_e / peak_share / 0.05
    limit_e_per_s = max(shown_e_per_s, detected_e_per_s)
    assert limit_e_per_s > 1.5 * min(shown_e_per_s, detected_e_per_s)
    assert rates_e_per_s.min() < limit_e_per_s < rates_e_per_s.max()
    # a black screen glows by a thousandth of the noise
    margin_e_per_s = 1e-3 * limit_e_per_s
    assert kept_e_per_s.min() >= limit_e_per_s - margin_e_per_s
    assert len(kept_e_per_s) >= (rates_e_per_s > limit_e_per_s + margin_e_per_s).sum()


def test_an_uneven_dark_grows_with_the_client_s_exposure_and_gain(live, monkeypatch):
    """1000 to 3000 e- at 2 e- a DN, above an offset of 100 DN."""
    ramp_e = np.linspace(1000.0, 3000.0, 48 * 64).reshape(48, 64)
    live.adjust(0.05, 0.0)
    monkeypatch.setattr(live, "_bench_under_e", ramp_e)
    try:
        for exposure_s, gain_db, dn_per_e in (
            (0.1, 0.0, 1.0),
            (0.05, 20.0, 5.0),
            (0.025, 0.0, 0.25),
        ):
            live.adjust(exposure_s, gain_db)
            np.testing.assert_allclose(live._dark_dn, 100 + dn_per_e * ramp_e)
    finally:
        monkeypatch.undo()
        live.adjust(0.05, 0.0)


def test_its_own_clock_is_off_and_drifts_and_is_turned_back():
    clock = OwnClock(Planted(drift_ppm=50.0, offset_s=2.0), 10**12)
    assert clock.of_host(10**12) == 10**12 + 2 * 10**9
    assert clock.of_host(10**12 + 10**9) - clock.of_host(10**12) == 10**9 + 50_000
    assert clock.to_host(clock.of_host(10**12 + 123_456_789)) == pytest.approx(
        10**12 + 123_456_789, abs=1
    )


def test_planted_errors_have_their_mean_and_their_sigma_over_a_scan(rng):
    planted = Planted((20.0, -10.0, 40.0), fov_arcsec=2.0, pixel_arcsec=0.5)
    errors = PlantedErrors(planted, 5384.6, rng)
    found = []
    for x, y in rng.uniform(-400 / 5384.6, 400 / 5384.6, (1500, 2)):  # two waves each way
        q = from_rotation_vector(np.array([x, y, 0.0]))
        reported, wrong = errors.reported(q)
        assert not wrong
        found.append(ARCSEC_PER_RAD * to_rotation_vector(multiply(reported, conjugate(q))))
    sigma = np.hypot(2.0, 0.5)  # of 1500 places: a third of a sigma of their mean is 0.05
    assert np.array(found).mean(axis=0) == pytest.approx([20, -10, 40], abs=0.5)
    assert np.array(found).std(axis=0) == pytest.approx([sigma, sigma, 4 * sigma], rel=0.05)


def test_wrong_answers_come_at_their_share_and_are_far_off(rng):
    errors = PlantedErrors(Planted(wrong=0.1), 5384.6, rng)
    told = [errors.reported(IDENTITY) for _ in range(1000)]
    wild = [q for q, wrong in told if wrong]
    assert 60 < len(wild) < 140
    assert np.median([np.linalg.norm(to_rotation_vector(q)) for q in wild]) > 1
    assert all(np.array_equal(q, IDENTITY) for q, wrong in told if not wrong)


def test_json_says_what_is_known_and_nothing_else():
    whole = Answer(
        0,
        b"",
        5,
        IDENTITY,
        np.zeros(3),
        True,
        "tracking",
        9,
        1.5,
        (ReportedStar(1, 2, 3.00001, 7), ReportedStar(1, 2, 3), ReportedStar(1, 2, 3, None, 1.5)),
    )
    assert (
        json_answer(whole)
        == b'{"t_ns":5,"valid":true,"mode":"tracking","stars":9,"q":[1.0,0.0,0.0,0.0],"rate":[0.0,0.0,0.0],"rms_arcsec":1.5,'
        b'"centroids":[[1,2,3.0,7],[1,2,3],[1,2,3,null,1.5]]}'
    )
    assert (
        json_answer(Answer(0, b"", 5, valid=False, mode="lost", star_count=0))
        == b'{"t_ns":5,"valid":false,"mode":"lost","stars":0,"centroids":[]}'
    )


def test_a_packet_has_the_flags_of_its_mode_and_of_what_is_known():
    whole = Answer(0, b"", 5, IDENTITY, np.ones(3), True, "tracking", 9)
    found = decode(encode(answer_packet(whole, 3)))
    flags = protocol.ANSWER_VALID + protocol.ANSWER_RATE_VALID + protocol.ANSWER_TRACKING
    assert found == AnswerPacket(3, flags, 5, (1.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 9)
    none = decode(
        encode(answer_packet(Answer(0, b"", 5, valid=False, mode="too few stars", star_count=2), 4))
    )
    assert (none.flags, none.stars) == (protocol.ANSWER_TOO_FEW_STARS, 2)


@pytest.mark.parametrize(("q", "q_flag"), [(None, 0), (IDENTITY, protocol.ANSWER_VALID)])
@pytest.mark.parametrize(
    ("rate", "rate_flag"), [(None, 0), (np.ones(3), protocol.ANSWER_RATE_VALID)]
)
@pytest.mark.parametrize(
    ("mode", "mode_flag"),
    [
        (TRACKING, protocol.ANSWER_TRACKING),
        (LOST, protocol.ANSWER_LOST_IN_SPACE),
        (TOO_FEW, protocol.ANSWER_TOO_FEW_STARS),
        (BLINDED, protocol.ANSWER_BLINDED),
        ("of another vendor", 0),
    ],
)
def test_a_packet_and_an_object_say_of_attitude_and_rate_which_is_known(
    q, q_flag, rate, rate_flag, mode, mode_flag
):
    answer = Answer(7, b"", 5, q, rate, q is not None, mode, 9)
    packet = answer_packet(answer, 3)
    assert packet.flags == q_flag + rate_flag + mode_flag
    assert packet.t_ns == 5  # of the tracker's own clock
    told = json.loads(json_answer(answer))
    assert ("q" in told, "rate" in told) == (q is not None, rate is not None)
    assert (told["valid"], told["mode"]) == (q is not None, mode)


OWN_SOLVER = """
answers = [[0.6, 0.0, -0.8, 0.0], "no star", "no star", "blind", None]

def solve(image, tracker):
    assert image.shape == (48, 64)
    answer = answers.pop(0)
    if isinstance(answer, str):
        raise ValueError(answer)
    return answer
"""


def test_a_solver_of_images_gives_its_attitudes_and_each_reason_of_a_failure_is_told_once(
    live, capsys
):
    (live.file.folder / "own_solver.py").write_text(OWN_SOLVER)
    solve = solver_of("python:own_solver:solve", live)
    dn = np.zeros((48, 64), np.uint16)
    found = [solve(None, dn) for _ in range(5)]
    assert found[0].tolist() == [0.6, 0.0, -0.8, 0.0] and found[1:] == [None] * 4
    assert capsys.readouterr().err.splitlines() == [
        f"hilstar: the solver raised ValueError: {why}" for why in ("no star", "blind")
    ]


def test_without_a_solver_the_true_attitude_is_taken_and_where_none_is_installed_that_is_told(
    live, capsys, monkeypatch
):
    assert solver_of("truth", live) is None and capsys.readouterr().err == ""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert solver_of(None, live) is None
    told = capsys.readouterr().err
    assert "hilstar[solve] is not installed" in told and "--solver truth" in told
    assert "--solver centroids: is a campaign's" in refusal(solver_of, "centroids", live)
