"""What an exposure of several frames sees of codes that change from frame to frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hilstar.basics.arrays import FloatArray
from hilstar.display.quantise import LitLight
from hilstar.instruments.simulate.twin import exposure_lights
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.build import open_bench
from tests.support.benches import ORION_Q, TWIN, bench_text

REFRESH_HZ = 60.0
FRAMES = 4


def exposed(folder: Path, frames: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The wanted light, that of the first frame's codes, and that of an exposure of so many."""
    changes = {
        "monitor": {"bits": 8, "refresh_hz": REFRESH_HZ},
        "render": {"quantisation": "temporal"},
        "tracker": {"exposure_s": frames / REFRESH_HZ},
    }
    with open_bench(bench_file_of(folder / "bench.toml", bench_text(TWIN, changes))) as bench:
        frame = bench.frame(np.array(ORION_Q), 4)
        ((light,),) = exposure_lights(bench, frame, 4, [bench.panel])
        panel = bench.panel
        shown = panel.response.light[frame.levels] * panel.flux_at_white_e_per_s
        return frame.linear.astype(np.float64), shown, image_of(light, frame.levels.shape)


def image_of(light: LitLight, shape: tuple[int, ...]) -> FloatArray:
    image = np.zeros(int(np.prod(shape)))
    image[light.place] = light.e_per_s
    return image.reshape(shape)


def test_an_exposure_of_one_frame_has_the_light_of_its_codes(tmp_path: Path) -> None:
    _, shown, light = exposed(tmp_path, 1)
    np.testing.assert_allclose(light, shown, rtol=1e-6)


def test_frames_of_a_sequence_are_together_nearer_to_the_light_that_is_wanted(
    tmp_path: Path,
) -> None:
    """Four codes about a level are off by half as much as one, or less."""
    wanted, shown, light = exposed(tmp_path, FRAMES)
    off = np.abs(light - wanted).sum() / np.abs(shown - wanted).sum()
    assert off < 0.7
    # a star's light is that of the sky
    assert light.sum() == pytest.approx(wanted.sum(), rel=0.02)
