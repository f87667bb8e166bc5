"""What the sky and the codes add to each star, of errors that a test chooses."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.instruments.certify import sky_effects
from hilstar.instruments.certify.model import Figures
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import bench_text
from tests.support.planted_certify import reference_star, stated_bench


@pytest.mark.parametrize(
    ("lost_mag", "scatter"), [([0.3, 0.1], 0.0), ([0.3, 0.1, 0.2], 0.1), ([0.4] * 4, 0.0)]
)
def test_each_star_has_its_own_errors_and_all_have_one_spectrum(lost_mag, scatter):
    """What codes lose scatters by three stars or more."""
    file, count = stated_bench(), len(lost_mag)
    stars = []
    for k, mag in enumerate(lost_mag):
        stars.append(reference_star(row=10 + k, b_v_mag=0.5 * k, quantised_mag=mag))
    effects = {
        effect.input.name: effect for effect in sky_effects.of_sky(file, Figures(file, stars))
    }
    own_mag, own_arcsec = sky_effects.catalogue_errors(file, 10 + np.arange(count))
    colour, _ = sky_effects.spectrum_mag(file, 0.5 * np.arange(count))
    assert len({*own_mag.tolist(), *own_arcsec.tolist()}) == 2 * count
    covariances = {}
    for name, effect in effects.items():
        assert effect.sky is not None and len(effect.sky) == effect.input.size
        slopes = effect.sky.reshape(len(effect.sky), -1)
        covariances[name] = (slopes.T @ slopes).reshape(3, count, 3, count)
    nothing = np.zeros((count, count))
    light = covariances["catalogue light"]
    assert light[0, :, 0] == pytest.approx(np.diag(own_mag**2))
    place = covariances["catalogue place"]
    for along in (1, 2):
        assert place[along, :, along] == pytest.approx(np.diag(own_arcsec**2))
        assert light[along, :, along] == pytest.approx(nothing)
    assert place[1, :, 2] == pytest.approx(nothing)
    assert place[0, :, 0] == pytest.approx(nothing)
    assert covariances["spectrum"][0, :, 0] == pytest.approx(np.outer(colour, colour))
    codes = covariances["quantisation"][0, :, 0]
    assert codes == pytest.approx(scatter**2 * np.eye(count))


def test_a_spectrum_s_error_is_that_of_its_way_from_colour(tmp_path):
    """Of black bodies how far they are from the library's star of the colour: the Sun's where none
    is known. Of a library star: what real stars of one colour scatter, 0.026 mag at 95 %.
    """
    errors_mag = {}
    b_v_mag = np.array([0.65, np.nan, 1.4])
    for spectrum in ("blackbody", "pickles"):
        path = tmp_path / f"{spectrum}.toml"
        path.write_text(bench_text({"sky": {"spectrum": spectrum, "brightness": "dgs"}}))
        error_mag, _ = sky_effects.spectrum_mag(read_bench_file(path), b_v_mag)
        errors_mag[spectrum] = error_mag
    sun, unknown, red = errors_mag["blackbody"]
    assert unknown == sun
    assert 0 < red < sun < 0.1
    assert errors_mag["pickles"] == pytest.approx([0.026 / 2] * 3)
