"""Two photographs of one night confronted whole, over a site whose air dims them differently: what
another renderer planted is what the camera, the prediction and the tables say.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilstar.attitude.logs.earth import q_icrs_to_enu
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import conjugate, rotate, to_matrix
from hilstar.instruments.confront import page
from hilstar.instruments.confront import run as confront_run
from hilstar.instruments.confront import session as sessions
from hilstar.instruments.confront.background import KERNEL_PX, source_mask
from hilstar.instruments.confront.judge import MASK_PX, Verdict
from hilstar.instruments.confront.page import Pictures
from hilstar.instruments.confront.report import Confronted
from hilstar.instruments.confront.session import Session
from tests.support.planted_sky import (
    HEIGHT,
    SKY,
    WIDTH,
    Extras,
    Planted,
    photograph,
    rotation_of,
    write_bench,
)
from tests.support.tables import csv_rows

SITE = """[site]
latitude_deg = 40.0
longitude_deg = 10.0
height_m = 0
extinction = 0.15
"""
TIMES = ("2020-09-20T20:00:00", "2020-09-21T01:00:00")
POINTINGS = SKY.pointings[1:]
SKY_TIMES = (1.0, 2.5)  # two levels of light tell the gain
EXTINCTION_MAG = 0.25
CAMERA = Planted(hot=((100, 200), (300, 50)), pedestal_dn=0.0, epoch_jyear=2020.72)
FALSE_STAR = (60.3, 120.2, 20000.0)
# of two photographs of 25 stars each, with shot noise: what the fits know
WITHIN_PX, WITHIN_MAG = 0.1, 0.05
# a seventh of the light is beyond a Gaussian of the middle: in wings, and by a PSF that widens
WIDER_MAG = 0.3
ABERRATION_RAD = np.radians(25 / 3600)  # which the renderer leaves out


@dataclass(frozen=True)
class Night:
    """The photographs' zeniths, what was found, each verdict's predicted image, and what was told
    to be done, percent.
    """

    zeniths: list[FloatArray]
    found: Confronted
    predicted: list[FloatArray]
    folder: Path
    percents: list[int]

    @property
    def session(self) -> Session:
        return self.found.session


def zenith_at(t_ns: int) -> FloatArray:
    to_enu = q_icrs_to_enu(np.array([t_ns]), 40.0, 10.0)[0]
    return np.asarray(rotate(conjugate(to_enu), np.array([[0.0, 0.0, 1.0]]))[0])


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Night:
    folder = tmp_path_factory.mktemp("night")
    rng = np.random.default_rng(8)
    zeniths = []
    paths = []
    for k, (time, pointing) in enumerate(zip(TIMES, POINTINGS, strict=True)):
        zeniths.append(zenith_at(int(np.datetime64(time, "ns").astype(np.int64))))
        false_stars = (FALSE_STAR,) * k
        extras = Extras(
            zenith=tuple(zeniths[k]),
            k_mag=EXTINCTION_MAG,
            false_stars=false_stars,
            sky_times=SKY_TIMES[k],
        )
        image = photograph(CAMERA, pointing, rng, extras)
        paths.append(folder / f"night_{time.replace(':', '-')}.png")
        Image.fromarray(image).save(paths[-1], compress_level=1)
    predicted: list[FloatArray] = []
    percents: list[int] = []
    pictures = confront_run.page_pictures

    def kept(session: Session, verdict: Verdict) -> Pictures:
        predicted.append(verdict.predicted)
        return pictures(session, verdict)

    bench = write_bench(folder / "guess.toml", more=SITE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(confront_run, "page_pictures", kept)
        patch.setattr(page, "_charts", lambda *given: [])
        found = confront_run.confront(bench, paths, folder / "out", advance=percents.append)
    return Night(zeniths, found, predicted, folder / "out", percents)


def planted_dn(night: Night, number: int) -> FloatArray:
    """The light (n,) of a photograph's own stars, DN, by what was planted."""
    shot = night.session.shots[number]
    rows = shot.sky.order[shot.star]
    catalog = shot.sky.catalog
    cosine = shot.sky.vectors[shot.star] @ night.zeniths[number]
    mag = catalog.v_mag[rows] + CAMERA.colour * catalog.bv_mag[rows] + EXTINCTION_MAG / cosine
    radius2 = (shot.found.x_px - CAMERA.centre_px[0]) ** 2
    radius2 = radius2 + (shot.found.y_px - CAMERA.centre_px[1]) ** 2
    mag = mag + CAMERA.vignetting_mag * radius2 / ((WIDTH**2 + HEIGHT**2) / 4)
    return np.asarray(CAMERA.zero_e * 10 ** (-0.4 * mag) / CAMERA.gain_e_per_dn)


def test_what_is_done_is_told_by_photograph_and_by_fit(night: Night) -> None:
    """Two photographs opened, three parts of the fit, two verdicts and the page."""
    assert night.percents == [4, 8, 27, 46, 65, 88, 91, 100]


def test_the_camera_and_its_attitudes_are_those_planted(night: Night) -> None:
    camera = night.session.camera.camera
    assert camera.focal_length_px == pytest.approx(CAMERA.focal_px, abs=2.0)
    assert camera.principal_point_px == pytest.approx(CAMERA.centre_px, abs=2.0)
    assert camera.lens is not None
    assert camera.lens.radial[0] == pytest.approx(CAMERA.k1, abs=0.05)
    for pointing, planted in zip(night.session.camera.pointings, POINTINGS, strict=True):
        true = rotation_of(*planted)
        turn = to_matrix(pointing.q_icrs_to_cam) @ true.T
        off_rad = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])
        # the principal point that is off turns the boresight as much
        assert np.abs(off_rad[:2]).max() < 2.0 / CAMERA.focal_px + ABERRATION_RAD
        assert abs(off_rad[2]) < 1e-4


def test_stars_are_predicted_behind_the_air_of_their_own_photograph(night: Night) -> None:
    session = night.session
    for number, shot in enumerate(session.shots):
        expected_dn = planted_dn(night, number)
        at_px = shot.found.x_px, shot.found.y_px
        predicted_dn = session.predicted_dn(number, shot.star, *at_px)
        off_mag = -2.5 * np.log10(predicted_dn / expected_dn)[shot.clean]
        assert np.abs(np.median(off_mag)) < WITHIN_MAG
        assert off_mag.std() < WITHIN_MAG
        measured_mag = -2.5 * np.log10(shot.found.dn / expected_dn)[shot.clean]
        assert np.abs(np.median(measured_mag)) < WITHIN_MAG


def test_the_simulator_s_image_has_each_bright_star_s_light_at_its_place(night: Night) -> None:
    """The sum over 15 x 15 pixels, less the level, of stars that stand alone."""
    for number, shot in enumerate(night.session.shots):
        above_dn = night.predicted[number] - shot.level.level
        expected_dn = planted_dn(night, number)
        brightest = np.argsort(-expected_dn * shot.clean)[:6]
        ratios = []
        off_px = []
        for k in brightest:
            row, column = round(shot.found.y_px[k]), round(shot.found.x_px[k])
            if not (8 <= row < HEIGHT - 8 and 8 <= column < WIDTH - 8):
                continue
            box = above_dn[row - 7 : row + 8, column - 7 : column + 8]
            ratios.append(float(box.sum()) / expected_dn[k])
            rows, columns = np.mgrid[row - 7 : row + 8, column - 7 : column + 8]
            x_px = float((box * columns).sum() / box.sum())
            y_px = float((box * rows).sum() / box.sum())
            off_px.append((x_px - shot.found.x_px[k], y_px - shot.found.y_px[k]))
        assert len(ratios) >= 3
        assert np.median(ratios) == pytest.approx(1.0, abs=WITHIN_MAG)
        # a fainter neighbour draws some centres of gravity aside
        assert np.abs(np.median(off_px, axis=0)).max() < WITHIN_PX


def test_air_masses_and_the_sky_are_those_of_each_moment(night: Night) -> None:
    figures = night.found.figures
    masses = [image["air_mass"] for image in figures["images"]]
    wanted = []
    for pointing, up in zip(POINTINGS, night.zeniths, strict=True):
        wanted.append(1 / float(rotation_of(*pointing)[2] @ up))
    assert masses == pytest.approx(wanted, abs=0.01)
    assert abs(masses[0] - masses[1]) > 0.1
    # 600 e- in 68.75 arcsec squared, where 6e6 are V = 0; a night sky of that V has more red light
    for image, times in zip(figures["images"], SKY_TIMES, strict=True):
        darkened_mag = image["sky_v_mag_arcsec2"] + 2.5 * np.log10(times)
        assert 19.0 < darkened_mag < 19.7
    days = [shot.photo.t_ns for shot in night.session.shots]
    assert days == [int(np.datetime64(time, "ns").astype(np.int64)) for time in TIMES]


def test_figures_have_the_detector_and_the_light_that_were_planted(night: Night) -> None:
    camera = night.found.figures["camera"]
    sigma = camera["sigma"]
    assert camera["gain_e_per_dn"] == pytest.approx(CAMERA.gain_e_per_dn, rel=0.1)
    assert camera["colour_term"] == pytest.approx(CAMERA.colour, abs=WITHIN_MAG)
    assert camera["linearity_power"] == pytest.approx(1.0, abs=0.02)
    assert camera["focal_length_px"] == night.session.camera.camera.focal_length_px
    assert 0 < sigma["focal_length_px"] < 2.0
    # of a Gaussian of 0.75 px and more, 1.15 times as wide down, with its pixel
    widths = 2.3548 * np.sqrt(np.array([0.75, 1.1 * 1.15]) ** 2 + 1 / 12)
    assert widths[0] < camera["psf_fwhm_px"] < widths[1]
    assert camera["hot_pixels"] == len(CAMERA.hot)
    assert camera["dead_pixels"] == 0
    for image in night.found.figures["images"]:
        assert image["rms_px"] < WITHIN_PX
        assert image["background_chi2"] == pytest.approx(1.0, abs=0.05)
        assert image["star_chi2"] < 2.0
        assert image["missing"] == 0
    for verdict in night.found.verdicts:
        clean = verdict.shot.clean
        # stars with a neighbour are fitted worse
        assert not clean.all()
        assert verdict.star_chi2 == np.median(verdict.shot.found.chi2[clean])
    assert night.found.figures["passed"] is (not night.found.failures)


def test_a_background_is_what_no_star_lights_by_a_tenth_of_a_sigma(night: Night) -> None:
    """Beside sources and hot pixels; of the pixels that are left the mean square is the chi^2."""
    for number, verdict in enumerate(night.found.verdicts):
        shot = verdict.shot
        level_dn = shot.level.level
        sigma_dn = np.sqrt(night.session.pixels.variance_dn2(level_dn))
        above_dn = shot.photo.dn - level_dn
        light_dn = night.predicted[number] - level_dn
        is_dark = np.abs(light_dn) <= 0.1 * sigma_dn
        is_dark &= ~source_mask(shot.sources, shot.level.above(shot.photo.dn), MASK_PX)
        for place in CAMERA.hot:
            is_dark[place] = False
        shot_dn = np.sqrt(np.maximum(light_dn, 0) / night.session.pixels.gain_e_per_dn)
        sigmas = ((above_dn - light_dn) / np.hypot(sigma_dn, shot_dn))[is_dark]
        near = sigmas[np.abs(sigmas) < 5]
        assert verdict.background_chi2 == pytest.approx(np.mean(near**2), rel=1e-9)


def test_tables_have_each_star_at_its_place_and_what_explains_each_source(night: Night) -> None:
    stars = csv_rows(night.folder / "stars.csv")
    names = [path.name for path in (shot.photo.path for shot in night.session.shots)]
    assert sorted({row["image"] for row in stars}) == sorted(names)
    for number, shot in enumerate(night.session.shots):
        seen = {}
        for row in stars:
            if row["image"] == names[number] and row["x_px"]:
                seen[int(row["hip"])] = row
        hips = shot.sky.catalog.hip[shot.sky.order[shot.star]]
        assert set(seen) == set(hips.tolist())
        expected_dn = planted_dn(night, number)
        ratios: list[float] = []
        for k, hip in enumerate(hips.tolist()):
            row = seen[hip]
            assert float(row["x_px"]) == pytest.approx(shot.found.x_px[k], abs=1e-4)
            assert float(row["y_px"]) == pytest.approx(shot.found.y_px[k], abs=1e-4)
            if shot.clean[k]:
                assert float(row["x_predicted_px"]) == pytest.approx(float(row["x_px"]), abs=1.0)
                assert float(row["y_predicted_px"]) == pytest.approx(float(row["y_px"]), abs=1.0)
                ratios.append(float(row["dn_predicted"]) / expected_dn[k])
        assert np.median(ratios) == pytest.approx(1.0, abs=WITHIN_MAG)
    sources = csv_rows(night.folder / "sources.csv")
    x_px, y_px, _ = FALSE_STAR
    near = []
    for row in sources:
        if np.hypot(float(row["x_px"]) - x_px, float(row["y_px"]) - y_px) < 1.0:
            near.append(row)
    assert [(row["image"], row["explained_by"]) for row in near] == [(names[1], "")]
    hot = {(row["y_px"], row["x_px"]) for row in sources if not row["image"]}
    assert hot == {(str(row), str(column)) for row, column in CAMERA.hot}


def test_sources_are_written_at_their_places_with_their_light(night: Night) -> None:
    rows = csv_rows(night.folder / "sources.csv")
    for shot in night.session.shots:
        written = []
        for row in rows:
            if row["image"] == shot.photo.name:
                written.append([float(row[key]) for key in ("x_px", "y_px", "snr")])
        seen_sources = np.column_stack([shot.sources.places_px, shot.sources.snr])
        # three and two decimals
        assert np.array(written) == pytest.approx(seen_sources, abs=0.0051)


def test_fainter_stars_are_seen_down_to_a_signal_of_eight(night: Night) -> None:
    """Of a Gaussian as wide as the PSF, smoothed by one of a pixel, in even noise."""
    session = night.session
    middle = np.array([WIDTH / 2]), np.array([HEIGHT / 2])
    psf_px = float(session.psf.fwhm_px(*middle)[0]) / 2.3548
    for verdict in night.found.verdicts:
        shot = verdict.shot
        noise_dn = float(np.median(shot.level.noise))
        faintest_dn = 8.0 * noise_dn * (psf_px**2 + KERNEL_PX**2) / KERNEL_PX * math.sqrt(math.pi)
        v_mag = shot.sky.v_mag[shot.star[shot.clean]]
        zero_mag = float(np.median(v_mag + 2.5 * np.log10(shot.found.dn[shot.clean])))
        reached_mag = zero_mag - 2.5 * math.log10(faintest_dn)
        assert verdict.fainter.reached_v_mag == pytest.approx(reached_mag, abs=WIDER_MAG)


def test_the_page_and_the_tracker_file_are_written_beside_the_tables(night: Night) -> None:
    for name in ("index.html", "sources.csv", "stars.csv", "tracker.toml"):
        assert str(night.folder / name) in night.found.written
        assert (night.folder / name).stat().st_size > 0
    text = (night.folder / "index.html").read_text()
    for shot in night.session.shots:
        assert shot.photo.path.name in text
    assert json.loads(json.dumps(night.found.figures)) == night.found.figures
    noted = [note for note in night.found.notes if "its time is read from its name" in note]
    assert [note.partition(":")[0] for note in noted] == [
        shot.photo.path.name for shot in night.session.shots
    ]
    assert any(line.startswith("lens: ") for line in night.found.lines)


def test_a_photograph_with_an_attitude_is_taken_though_its_corners_are_dark(
    night: Night, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "is_round", lambda dn: True)
    session = night.session
    photo = session.shots[0].photo
    shot = sessions.open_shot(session.file, photo, session.camera.camera, None)
    first = session.camera.pointings[0].boresight
    # before the principal point, 6.5 px beside the middle, is fitted
    assert shot.pointing.boresight @ first > np.cos(np.radians(0.3))
    blank = replace(photo, dn=np.full_like(photo.dn, 500.0) + np.arange(WIDTH) % 2)
    with pytest.raises(InputError, match="an all-sky lens"):
        sessions.open_shot(session.file, blank, session.camera.camera, None)
    monkeypatch.setattr(sessions, "is_round", lambda dn: False)
    with pytest.raises(InputError, match="0 sources stand out of its noise"):
        sessions.open_shot(session.file, blank, session.camera.camera, None)
