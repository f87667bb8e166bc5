"""A whole confrontation of two photographs, made of numbers that all differ: nothing was fitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.instruments.confront.background import FixedPattern, FoundSources, SkyLevel
from hilstar.instruments.confront.camera_fit import CameraFit, Pointing
from hilstar.instruments.confront.excess import Excess, Part
from hilstar.instruments.confront.images import Photograph
from hilstar.instruments.confront.judge import (
    DatedBy,
    Expected,
    Fainter,
    SourceRow,
    StarRow,
    Verdict,
)
from hilstar.instruments.confront.light import LightFit, StarLight
from hilstar.instruments.confront.lost_in_space import SolvedField
from hilstar.instruments.confront.photographed_sky import DatedSky
from hilstar.instruments.confront.photon_transfer import PixelFit
from hilstar.instruments.confront.report import Confronted
from hilstar.instruments.confront.session import Session, Shot
from hilstar.instruments.confront.star_psf import Measured, StarPsf
from hilstar.optics.camera import Camera, Lens
from hilstar.server.bench.bench_file import BenchFile, bench_file_of
from hilstar.sky.catalog import plain_catalog

SIZE_PX = (800, 600)
PICTURE_PX = (80, 60)  # of the photographs, which no figure goes by
TRACKER = """[tracker]
aperture_mm = 20.0
focal_length_mm = 40.0
pixel_pitch_um = 10.0
resolution_px = [800, 600]
quantum_efficiency = 0.5
exposure_s = 0.2
[monitor]
resolution_px = [1920, 1080]
pixel_pitch_um = 265.5
[collimator]
focal_length_mm = 1000.0
"""
LEVELS_DN = (300.0, 500.0)
PEDESTAL_DN, GAIN_E_PER_DN = 100.0, 2.0
NONE = np.empty(0)


def a_bench() -> BenchFile:
    """A tracker of 4000 px of focal length."""
    return bench_file_of(Path("bench.toml"), TRACKER)


def a_star(
    name: str, hip: int, v_mag: float, place_px: tuple[float, float], **keys: Any
) -> StarRow:
    """A star of 1000 DN and 5 DN of noise, a quarter right of its prediction and an eighth above
    it.
    """
    x_px, y_px = place_px
    row = StarRow(
        star=hip,
        hip=hip,
        name=name,
        x_px=x_px + 0.25,
        y_px=y_px - 0.125,
        x_predicted_px=x_px,
        y_predicted_px=y_px,
        dn=1000.0,
        sigma_dn=5.0,
        dn_predicted=1100.0,
        v_mag=v_mag,
        b_v_mag=0.5,
        flags=(),
    )
    return replace(row, **keys)


def a_missing_star(hip: int, v_mag: float, place_px: tuple[float, float]) -> StarRow:
    """A star of which nothing was seen."""
    nothing = dict.fromkeys(("x_px", "y_px", "dn", "sigma_dn"), math.nan)
    return a_star(f"HIP {hip}", hip, v_mag, place_px, flags=("missing",), **nothing)


def a_shot(number: int) -> Shot:
    """A photograph of an even background that was dated to the year 2020."""
    width, height = PICTURE_PX
    dn = np.full((height, width), LEVELS_DN[number])
    t_ns = int(np.datetime64("2020-09-20T20:00:00", "ns").astype(np.int64))
    photo = Photograph(Path(f"p{number}.fits"), dn, 1.0, 4095.0, t_ns, exposure_s=0.5)
    stars = {name: np.zeros(1) for name in ("v_mag", "ra_deg", "dec_deg")}
    catalog = plain_catalog("HIP", 1, {"hip": np.ones(1, dtype=np.int32), **stars})
    first = np.zeros(1, dtype=np.intp)
    q_icrs_to_cam = from_radec_roll_deg(280.0 + number, 38.0, 10.0)
    return Shot(
        photo=photo,
        level=SkyLevel(dn, np.ones_like(dn), 16),
        sources=FoundSources(NONE, NONE, NONE, NONE, NONE, NONE, np.empty(0, dtype=bool)),
        sky=DatedSky(catalog, 2020.72, None, np.array([[0.0, 0.0, 1.0]]), first),
        pointing=Pointing(q_icrs_to_cam),
        focal_length_px=4000.0,
        matched=SolvedField(q_icrs_to_cam, 4000.0, first, first),
        star=np.empty(0, dtype=np.intp),
    )


def sources_at(places_px: Sequence[tuple[float, float]], **changes: float) -> FoundSources:
    """Sources of a signal of 9 sigmas, 2 px long and wide, at places."""
    x_px, y_px = np.array(places_px, dtype=float).reshape(-1, 2).T
    figures = {"snr": 9.0, "length_px": 2.0, "width_px": 2.0, "fwhm_px": 2.0} | changes
    columns = {name: np.full(len(x_px), figure) for name, figure in figures.items()}
    return FoundSources(x_px, y_px, single=np.zeros(len(x_px), dtype=bool), **columns)


def seen_shot(places_px: Sequence[tuple[float, float]], star: list[int], **changes: Any) -> Shot:
    """A photograph of stars, rows of its sky, that are seen at places, alone and by 1 px and 1
    DN.
    """
    x_px, y_px = np.array(places_px, dtype=float).T
    one, no = np.ones(len(star)), np.zeros(len(star), dtype=bool)
    found = Measured(x_px, y_px, one, one.copy(), one, one)
    whole = replace(a_shot(0), star=np.array(star), measured=found, saturated=no, blended=no)
    return replace(whole, **changes)


def a_light() -> LightFit:
    """The light of two photographs, the second of which is the clearer one."""
    sigma = {
        "linearity": 0.004,
        "colour_term": 0.02,
        "zero_point_mag": 0.03,
        "extinction_mag_per_air_mass": 0.015,
    }
    return LightFit(
        offsets_mag=np.array([-12.0, -12.25]),
        vignetting_mag=(0.375, 0.125),
        correction=(0.5, -1.0),
        zero_point_mag=14.5,
        colour_term=-0.21,
        linearity=1.01,
        sigma=sigma,
        masses=(1.5, 1.125),
        extinction_mag=0.31,
        colour_terms={"r": -0.4, "b": 0.3},
    )


def some_pixels() -> PixelFit:
    """A detector whose response is told and whose offsets are not."""
    pattern = FixedPattern((0.02**2, 0.04, 0.25, 0.0), (0.004**2, 0.02, 0.01, 0.0001))
    sigma = {"gain_e_per_dn": 0.03, "read_noise_e": 0.4, "pedestal_dn": math.inf}
    points = np.array([[200.0, 60.0], [300.0, 110.0], [500.0, 220.0]])
    return PixelFit(
        gain_e_per_dn=GAIN_E_PER_DN,
        pedestal_dn=PEDESTAL_DN,
        read_noise_e=6.0,
        step_dn=4.0,
        sigma=sigma,
        points=points,
        pattern=pattern,
        gain_told=True,
    )


def a_session(**changes: Any) -> Session:
    """What two photographs say of a camera."""
    lens = Lens((0.125, -0.5, 0.0), (0.01, -0.02))
    camera = Camera(SIZE_PX, 4000.0, (410.0, 290.0), np.eye(3), lens)
    shots = (a_shot(0), a_shot(1))
    pointings = []
    for k, shot in enumerate(shots):
        pointings.append(replace(shot.pointing, zenith=(1.0, 0.75 * k)))
    sigma = {"log_focal": 0.0005, "centre_x": 1.5, "centre_y": 2.5, "k1": 0.03}
    fit = CameraFit(camera, tuple(pointings), "k1", sigma, {"pinhole": 0.5, "k1": 0.0625}, 0.01)
    covariance = np.array([[0.8, 0.1, 0.2, -0.3, 0, 0], [0.9, 0.1, 0, 0.3, 0, 0], [0.1] + 5 * [0]])
    numbers = np.empty(0, dtype=np.intp)
    flags = np.empty(0, dtype=bool)
    session = Session(
        file=a_bench(),
        shots=shots,
        camera=fit,
        psf=StarPsf(covariance, 0.1, 0.2, 2.5, SIZE_PX),
        light=a_light(),
        stars=StarLight(numbers, NONE, NONE, NONE, NONE, NONE, flags, numbers),
        pixels=some_pixels(),
        power=1.0,
        fixed=False,
    )
    return replace(session, **changes)


def a_verdict(shot: Shot, number: int, **changes: Any) -> Verdict:
    """A verdict on a photograph of one star, of which nothing is odd."""
    image = np.zeros_like(shot.level.level)
    verdict = Verdict(
        shot=shot,
        number=number,
        stars=[a_star("HIP 91262", 91262, 0.03, (40.0, 30.0))],
        sources=[],
        rms_px=0.0625,
        rms_mag=0.03125,
        counted=17,
        background_chi2=1.0625,
        star_chi2=1.25,
        dim=[],
        dated=DatedBy(0.125, 0.25),
        fainter=Fainter(8.25, 9.5, 0.0),
        expected=Expected(np.empty(0, dtype=np.intp), NONE, NONE, NONE),
        predicted=shot.level.level + image,
        residual=image,
    )
    return replace(verdict, **changes)


def odd_stars() -> list[StarRow]:
    """Vega at the right, a star of another catalogue, one too faint to count, one that is
    saturated, one without light and one that is missing.
    """
    return [
        a_star("TYC 5", 0, 3.5, (10.0, 20.0), b_v_mag=1.5, dn_predicted=900.0),
        a_star("HIP 91262", 91262, 0.03, (70.0, 50.0), dn=5000.0, dn_predicted=5500.0),
        a_star("HIP 7", 7, 7.5, (50.0, 8.0), dn=90.0, dn_predicted=99.0),
        a_star("HIP 102098", 102098, 1.25, (20.0, 40.0), dn=9000.0, flags=("saturated",)),
        a_star("HIP 3", 3, 6.0, (33.0, 33.0), dn=-4.0),
        a_missing_star(11, 5.25, (30.4, 12.6)),
    ]


def odd_sources() -> list[SourceRow]:
    """Two that nothing explains, the weaker one first, and a third that is too weak; a hot pixel,
    a star, and a trail that is too weak.
    """
    return [
        SourceRow(12.34, 45.67, 9.0, ""),
        SourceRow(61.2, 5.5, 22.0, ""),
        SourceRow(1.0, 2.0, 7.9, ""),
        SourceRow(3.25, 4.75, 40.0, "a hot pixel"),
        SourceRow(70.0, 50.0, 50.0, "HIP 91262"),
        SourceRow(8.0, 9.0, 7.5, "a trail, 30 px long"),
    ]


def some_verdicts(session: Session) -> tuple[Verdict, Verdict]:
    """One on a photograph with all that can be odd, and one on a photograph without."""
    odd = a_verdict(
        session.shots[0],
        0,
        stars=odd_stars(),
        sources=odd_sources(),
        rms_px=0.25,
        rms_mag=0.5,
        counted=2,
        background_chi2=0.75,
        star_chi2=3.5,
        dim=["lower left: dim"],
        dated=DatedBy(-9.5, 0.75),
        fainter=Fainter(8.25, 9.75, 1.0),
    )
    return odd, a_verdict(session.shots[1], 1)


def an_excess() -> Excess:
    """A scatter of three parts, of which one is not known."""
    light = (Part("noise", 0.0125, "by gain"), Part("scintillation by law", math.nan, "no height"))
    return Excess(0.0375, 0.0625, 19, light, (Part("seeing", 0.05, "by pairs"),))


def a_confrontation(**changes: Any) -> Confronted:
    """The confrontation of these; nothing in it was computed."""
    session = changes.pop("session", None) or a_session()
    confronted = Confronted(
        session=session,
        verdicts=some_verdicts(session),
        excess=an_excess(),
        lines=("a line of a test",),
        failures=("p0.fits: too few", "p0.fits: too dim"),
        notes=("a note of a test",),
        written=("out/index.html", "out/stars.csv"),
        defects=(3, 1),
    )
    return replace(confronted, **changes)
