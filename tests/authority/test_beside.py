"""Independent programs beside hilstar: what docs/beside.md states, run again."""

from __future__ import annotations

import os

import pytest

from hilstar.basics.errors import MachineError
from tests.support.benches import ROOT
from tests.support.beside import (
    astrometry_side,
    lost_side,
    pyxel_side,
    satsim_side,
    stellarium_side,
)
from tests.support.beside.steps import Beside
from tests.support.tables import csv_rows

# float32 shares are within MAX_SHARE_ERROR (1e-7) by polynomial, and 1.2e-7 of rounding
PIXEL_SHARE = 2.2e-7
ROUNDED_SHARE = 1e-9  # what GalSim's tight parameters ask of its transforms
CENTROID_PX = 1e-6
# GalSim's pupil of 4 times its default samples; its padding and edges are half of what is left
ABERRATED = 1e-3
PINHOLE_PX = 1e-9
# a zero point's digits, and linear tables every 0.5 nm
ELECTRONS = 2e-6
SIGMAS = 4.0
# the index's and the list's doubles, and TAN's own digits; 3e-6 was measured
PLACES_ARCSEC = 1e-4
# a centroid of 0.1 px or 4 arcsec, of 40 stars or more
IMAGE_ARCSEC = 1.0
# of 2.6 px at the corner: k1's r^3 is all of order 3, but for the projection's own
BENT_PX, FREE_PX = 2e-3, 0.1
# LOST prints six digits: places are rounded evenly, and 364 of them tell their rms within 10 %
DIGITS = 1.1
# of a size on the page; sums of float32 have other last digits on another processor
OF_THE_PAGE, LAST_DIGITS = 0.02, 1e-7
# programs of minutes, or of an environment of their own
on_demand = pytest.mark.skipif(
    "HILSTAR_BESIDE" not in os.environ, reason="runs on demand: HILSTAR_BESIDE=1"
)
MEAN_DN, PATTERN = 0.25, 0.02  # of 250 000 pixels; Pyxel's means and scatters go to 0.06 and 0.5 %
DARK = 1e-6  # one law, written twice
# of what chance passes once in twenty runs; of SatSim's points, whose error falls with their square
CHANCES, GRID_SHARE = 1.5, 1e-4
# Hipparcos in both, by its steps; UT1 as IERS predicts it, planets by VSOP87 and by DE421
STARS_ARCSEC, PLANETS_ARCSEC, PLANETS_MAG = 0.3, 1.0, 0.03
# the Bright Star Catalogue's own errors, beside 0.32 arcsec of rounding
CATALOGUE_ARCSEC = 1.0


def assert_as_on_the_page(name: str, beside: Beside) -> None:
    """The page's table has the sizes of this run, of the steps that it takes."""
    rows = csv_rows(ROOT / "results" / f"beside_{name}.csv")
    recorded = {(row["subject"], row["step"]): float(row["size"]) for row in rows}
    for step in beside.steps:
        wanted = recorded[step.subject, step.step]
        assert step.size == pytest.approx(wanted, rel=OF_THE_PAGE, abs=LAST_DIGITS), step


@pytest.fixture(scope="module")
def galsim(tmp_path_factory) -> Beside:
    pytest.importorskip("galsim")
    from tests.support.beside import galsim_side

    return galsim_side.run(tmp_path_factory.mktemp("galsim"), quick=True)


def test_galsim_s_table_on_the_page_is_of_this_run(galsim):
    assert_as_on_the_page("galsim", galsim)


def test_galsim_s_pixels_of_a_gaussian_are_hilstar_s(galsim):
    subject = "PSF: Gaussian in pixels"
    assert galsim.size(subject, "with GalSim's GSParams tight") < PIXEL_SHARE
    assert galsim.size(subject, "and hilstar's float64") < ROUNDED_SHARE
    assert galsim.size("PSF: centroid in pixels", "with GalSim's") < CENTROID_PX


def test_galsim_s_aberrations_by_noll_are_hilstar_s(galsim):
    assert galsim.size("PSF: eight aberrations", "with GalSim's oversampling") < ABERRATED


def test_galsim_reads_hilstar_s_headers_as_they_are_meant(galsim):
    assert galsim.size("places: pinhole", "largest") < PINHOLE_PX
    subject = "places: SIP of a lens"
    assert galsim.size(subject, "largest") <= galsim.size(subject, "the header's own LENSERR")


def test_galsim_counts_a_black_body_s_electrons_as_hilstar_does(galsim):
    assert galsim.size("light: electrons of V = 0", "and the zero point") < ELECTRONS


def test_galsim_draws_a_whole_exposure_as_hilstar_does(galsim):
    assert galsim.size("exposure: 1024 x 1024 px", "with GalSim's GSParams tight") < PIXEL_SHARE


def test_galsim_s_noise_has_hilstar_s_variance_and_distribution(galsim):
    subject = "noise: variance of DN"
    assert galsim.size(subject, "and rounded") < SIGMAS * galsim.size(subject, "one sigma")
    subject = "noise: distribution of DN"
    assert galsim.size(subject, "and rounded") < galsim.size(subject, "by chance")


@pytest.fixture(scope="module")
def astrometry(tmp_path_factory) -> Beside:
    try:
        astrometry_side.solver_version()
    except MachineError as error:
        pytest.skip(str(error))
    return astrometry_side.run(tmp_path_factory.mktemp("astrometry"), quick=True)


def test_astrometry_net_solves_exposures_to_the_attitude_drawn(astrometry):
    subject = "attitude: across the boresight"
    assert astrometry.size(subject, "hilstar's places, a fit") < PLACES_ARCSEC
    assert astrometry.size(subject, "a fit to all its centroids") < IMAGE_ARCSEC


def test_astrometry_net_s_sip_follows_a_lens(astrometry):
    subject = "distortion of a lens, over the image"
    assert astrometry.size(subject, "without its SIP") > FREE_PX
    assert astrometry.size(subject, "hilstar's places, SIP of order 3") < BENT_PX


def test_lost_s_generator_has_stars_where_hilstar_has_them():
    """A fixed file of LOST's output, with its commit."""
    places = lost_side.read_places(lost_side.FIXED)
    lost = Beside("LOST", "", "", tuple(lost_side.place_steps(places)))
    subject = lost_side.PLACES
    assert len(places.hr) == 182
    assert_as_on_the_page("lost", lost)
    assert lost.size(subject, "by LOST's own") < DIGITS * lost.size(
        subject, "for comparison: the six digits"
    )
    assert lost.size(subject, "and pixels from their centres") < CATALOGUE_ARCSEC
    assert lost.size(subject, "as both come") > 1000 * CATALOGUE_ARCSEC  # its roll's sign


@on_demand
def test_pyxel_s_photon_transfer_is_hilstar_s_but_for_its_pattern(tmp_path):
    pyxel = pyxel_side.run(tmp_path)
    subject = "photon transfer: mean"
    assert pyxel.size(subject, "half a DN for that") < MEAN_DN
    sigma = pyxel.size(pyxel_side.VARIANCE, "one sigma")
    assert pyxel.size(pyxel_side.VARIANCE, "as both come") < SIGMAS * sigma
    assert pyxel.size(pyxel_side.PRNU, "light, Pyxel's halved") < PATTERN
    assert pyxel.size(pyxel_side.PRNU, "scatter to Pyxel's doubled") < PATTERN
    assert pyxel.size("dark current, 233 to 300 K", "with the gap") < DARK


@on_demand
def test_satsim_s_photon_transfer_is_hilstar_s_but_for_its_well(tmp_path):
    satsim = satsim_side.run(tmp_path)
    assert satsim.size(satsim_side.MEAN, "half a DN for that") < MEAN_DN
    sigma = satsim.size(satsim_side.VARIANCE, "one sigma")
    assert satsim.size(satsim_side.VARIANCE, "as both come") < SIGMAS * sigma
    chance = satsim.size(satsim_side.SHAPE, "by chance")
    assert satsim.size(satsim_side.SHAPE, "with half a DN") < CHANCES * chance
    assert satsim.size(satsim_side.SHAPE, "as both come") > CHANCES * chance
    assert satsim.size(satsim_side.WELL, "without a bias") < MEAN_DN
    assert satsim.size(satsim_side.STAR, "SatSim's grid of 45") < GRID_SHARE


@on_demand
def test_stellarium_has_stars_and_planets_where_hilstar_has_them(tmp_path):
    stellarium = stellarium_side.run(tmp_path)
    stars, bodies = stellarium_side.STAR_PLACES, stellarium_side.BODY_PLACES
    assert stellarium.size(stars, "some at their places of 1991.25") < STARS_ARCSEC
    assert stellarium.size(bodies, "without Moon") < PLANETS_ARCSEC
    assert stellarium.size("magnitudes", "planets") < PLANETS_MAG
