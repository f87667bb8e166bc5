"""A tracker's colours against quadrature that shares nothing with the package but data files:
three sensors, mono and Bayer.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import trapezoid

from hilstar.display.primaries import reddest_nm
from hilstar.instruments.simulate.budget import red_shares
from hilstar.instruments.simulate.simulator import Simulator
from hilstar.server.bench.bench_file import read_bench_file
from hilstar.server.bench.star_light import bench_stars
from hilstar.server.bench.star_rates import bench_channels
from hilstar.sky.electrons import Optics
from hilstar.sky.spectrum import DATA_DIR, Curve, load_curve
from tests.authority.integrals import read
from tests.support.benches import ORION_Q, bench_text
from tests.support.claims import holds
from tests.support.spectra import bump, channel_keys, write_channels, write_curve

NM = np.arange(350.0, 1051.0, 10.0)
FINE_NM = np.arange(300.0, 1100.01, 0.25)


# Mosaics as data sheets draw them: narrow dyes behind an infrared cut; wide ones; dyes that all
# pass the near infrared.
CUT = 1 / (1 + np.exp((NM - 660) / 8))
SENSORS = {
    "cut": [
        0.75 * bump(600, 45, NM) * CUT,
        0.85 * bump(530, 45, NM) * CUT,
        0.7 * bump(460, 35, NM) * CUT,
    ],
    "wide": [0.6 * bump(620, 80, NM), 0.7 * bump(540, 80, NM), 0.6 * bump(460, 70, NM)],
    "infrared": [
        0.6 * bump(610, 50, NM) + 0.3 * bump(850, 90, NM),
        0.7 * bump(535, 50, NM) + 0.3 * bump(850, 80, NM),
        bump(460, 40, NM) * 0.6 + 0.3 * bump(850, 75, NM),
    ],
}
QUADRATURE = 1e-3  # asked for: 1 %; tables of rates are within 1e-6 of the Planck integral
BUDGET = 2e-3  # absolute: the library's own samples of 0.5 nm against interpolated ones of 0.25


@pytest.fixture(scope="module", params=SENSORS)
def sensor(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    curves = SENSORS[request.param]
    write_channels(folder, NM, dict(zip("rgb", curves, strict=True)))
    write_curve(folder / "mono.csv", NM, np.sum(curves, axis=0) / 3)
    return folder, [np.interp(FINE_NM, NM, value, left=0, right=0) for value in curves]


def channel_bench(folder, mono, *changes):
    keys, detector = {"quantum_efficiency": "mono.csv"}, {}
    if not mono:
        keys, detector = channel_keys("rgb"), {"bayer": "grbg"}
    detector |= {"gain_e_per_dn": 1.0, "full_well_e": 1e9, "bits": 16}
    sky = {"faintest_v_mag": 4.0, "spectrum": "blackbody"}
    path = folder / f"{'mono' if mono else 'bayer'}.toml"
    path.write_text(
        bench_text({"tracker": keys, "tracker.detector": detector, "sky": sky}, *changes)
    )
    return path


def electrons(temperature_k, efficiency):
    """Electrons per second of a star of V = 0: 3.631e-2 W/m2/m in the mean through V (Bessell
    1998), by trapezia of 0.25 nm.
    """
    power = FINE_NM**-5 / np.expm1(0.0143877688 / (FINE_NM * 1e-9 * temperature_k))
    glass, v = (
        np.interp(FINE_NM, *read(name), left=0, right=0) for name in ("n-bk7-10mm", "johnson-v")
    )
    w_m2_m = 3.631e-2 * power / (trapezoid(power * v, FINE_NM) / trapezoid(v, FINE_NM))
    photons = np.pi / 4 * 0.03**2 * w_m2_m * glass * FINE_NM * 1e-9 / 1.98644586e-25
    return trapezoid(photons * efficiency, FINE_NM * 1e-9)


@pytest.mark.parametrize("mono", [True, False], ids=["mono", "bayer"])
def test_each_channels_electrons_of_every_star(sensor, mono):
    folder, channels = sensor
    stars = bench_stars(read_bench_file(channel_bench(folder, mono)).config, folder)
    some = np.linspace(0, len(stars) - 1, 60).astype(int)
    found = stars.electrons_per_s[some, None] * (1 if mono else stars.colours[some])
    efficiencies = [sum(channels) / 3] if mono else channels
    wanted = [
        [
            electrons(stars.temperature_k[k], one) * 10 ** (-0.4 * stars.v_mag[k])
            for one in efficiencies
        ]
        for k in some
    ]
    np.testing.assert_allclose(found, wanted, rtol=QUADRATURE)


@pytest.mark.gpu
def test_the_mosaics_mean_image_has_a_quarter_of_red_and_blue_and_half_of_green(sensor):
    """A star of sigma 1.6 px: every second pixel has its quarter of the light to 3e-6."""
    folder, channels = sensor
    with Simulator(
        read_bench_file(channel_bench(folder, False, {"tracker": {"psf_sigma_px": [1.6, 1.6]}}))
    ) as simulator:
        exposure = simulator.expose(simulator.view(np.array(ORION_Q), np.zeros(3)), None)
    star = exposure.truth[0]
    x, y = round(star["x_px"]), round(star["y_px"])
    square, y0, x0 = exposure.mean_e[y - 12 : y + 13, x - 12 : x + 13], y - 12, x - 12
    rows, columns = np.indices(square.shape)
    colour = np.array(
        [
            "grbg"[2 * ((r + y0) % 2) + (c + x0) % 2]
            for r, c in zip(rows.ravel(), columns.ravel(), strict=True)
        ]
    )
    found = [square.ravel()[colour == name].sum() / 0.1 for name in "rgb"]
    wanted = [
        electrons(star["temperature_k"], one) * 10 ** (-0.4 * star["v_mag"]) for one in channels
    ]
    np.testing.assert_allclose(found, np.array(wanted) * [0.25, 0.5, 0.25], rtol=QUADRATURE)


def spectra():
    """Wavelengths, fluxes and types of the library, as its file has them."""
    with np.load(DATA_DIR / "pickles.npz") as packed:
        return (
            packed["wavelength_nm"].astype(float),
            packed["flux"].astype(float),
            packed["spectral_type"],
        )


def test_the_near_infrared_of_a_bare_sensor_is_the_librarys_own():
    glass = load_curve("n-bk7-10mm", "transmission")
    (row,) = red_shares({"all": Optics(30.0, load_curve("ccd47-20", "qe"), glass)}, [700.0])
    nm, flux, kinds = spectra()
    sensitivity = FINE_NM * np.prod(
        [np.interp(FINE_NM, *read(name), left=0, right=0) for name in ("n-bk7-10mm", "ccd47-20")],
        axis=0,
    )
    for one in "GM":
        of_class = [str(kind).startswith(one) for kind in kinds]
        light = [np.interp(FINE_NM, nm, spectrum) * sensitivity for spectrum in flux[of_class]]
        shares = [part[FINE_NM >= 700].sum() / part.sum() for part in light]
        assert row["by_class"][one] == pytest.approx(np.mean(shares), abs=BUDGET)
        holds(f"infrared-{one.lower()}", 100 * row["by_class"][one])


def test_the_budgets_near_infrared_is_the_librarys_own(sensor):
    folder, channels = sensor
    power = np.exp(-(((NM - 600) / 40) ** 2))  # 1 % of it at 686 nm
    primaries = [Curve(NM, power), Curve(NM, np.where(NM < 560, power, 0.0))]
    tracker = read_bench_file(channel_bench(folder, False)).config.tracker
    optics = dict(zip(tracker.quantum_efficiencies, bench_channels(tracker, folder), strict=True))
    rows = red_shares(optics, [700.0, reddest_nm(primaries)])
    found = {(row["channel"], row["from_nm"]): row["by_class"] for row in rows}
    assert {nm for _, nm in found} == {700.0, 680.0} and len(found) == 8
    nm, flux, kinds = spectra()
    glass = np.interp(FINE_NM, *read("n-bk7-10mm"), left=0, right=0)
    for name, efficiency in (("all", sum(channels)), ("quantum_efficiency_r", channels[0])):
        for one in "OBAFGKM":
            shares = []
            for spectrum in flux[[str(kind).startswith(one) for kind in kinds]]:
                light = np.interp(FINE_NM, nm, spectrum) * FINE_NM * glass * efficiency
                shares.append(light[FINE_NM >= 700].sum() / light.sum())
            assert found[name, 700.0][one] == pytest.approx(np.mean(shares), abs=BUDGET)
