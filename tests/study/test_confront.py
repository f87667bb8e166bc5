"""The study of photographs: a set of cameras, what agrees, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.commands import run_hilstar_here
from tests.support.planted_sky import SKY, Planted, photograph, write_bench
from tests.support.tables import csv_rows

pytestmark = pytest.mark.study


@pytest.mark.usefixtures("whole_study")
def test_a_set_has_a_row_and_a_page_for_each_camera_and_says_what_is_no_photograph(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "set" / "planted"
    folder.mkdir(parents=True)
    write_bench(folder / "guess.toml")
    Image.fromarray(photograph(Planted(), SKY.pointings[2], np.random.default_rng(5))).save(
        folder / "a.png"
    )
    (folder / "b.png").write_text("no image")
    done = run_hilstar_here(
        "study", "confront", "--images", tmp_path / "set", "-o", tmp_path / "out", "--quick"
    )
    assert done.returncode == 0, done.stderr
    rows = {row["image"]: row for row in csv_rows(tmp_path / "out" / "confront.csv")}
    assert float(rows["a.png"]["rms_px"]) < 0.05
    assert int(rows["a.png"]["stars"]) > 20
    assert "is no image" in rows["b.png"]["refused"]
    assert "planted/b.png: refused: is no image" in done.stdout
    assert (tmp_path / "out" / "planted" / "index.html").exists()
    assert (tmp_path / "out" / "confront.png").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [(("confront",), "add --images DIR"), (("models", "--images", "."), "leave out --images")],
)
def test_photographs_belong_to_their_study(
    tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    done = run_hilstar_here("study", *words, "-o", tmp_path)
    assert (done.returncode, said in done.stderr) == (2, True)


def test_a_folder_without_cameras_is_refused(tmp_path: Path) -> None:
    done = run_hilstar_here("study", "confront", "--images", tmp_path, "-o", tmp_path / "out")
    assert (done.returncode, "guess.toml" in done.stderr) == (2, True)
