"""The study of photographs: a set of cameras, what agrees, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from hilstar.instruments.study import confront
from hilstar.instruments.study.confront import PhotographRow
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


def row(image: str, camera: str = "cam", **figures: float | int | str) -> PhotographRow:
    return PhotographRow(camera, image, **figures)


def test_an_image_is_named_by_the_words_that_set_it_apart() -> None:
    rows = [row("night_a_1.png"), row("night_b_1.png"), row("night_c.png", "other")]
    names = [confront.short_name(each, rows) for each in rows]
    assert names == ["a", "b", "night c"]
    # of three, words that two alone share set them apart from the third
    rows = [row("n_a_1.png"), row("n_a_2.png"), row("n_b_2.png")]
    assert [confront.short_name(each, rows) for each in rows] == ["a 1", "a 2", "b 2"]


def test_a_refusal_is_of_the_image_that_it_names_or_of_all() -> None:
    paths = [Path("/set/a.png"), Path("/set/b.png"), Path("/set/ab.png")]
    assert confront.wrong_images("/set/b.png: is no image", paths) == [paths[1]]
    assert confront.wrong_images("b.png: too dark", paths) == [paths[1]]
    assert confront.wrong_images("too few stars in all", paths) == paths


def test_an_image_s_row_is_its_own_verdict_s() -> None:
    def verdict(name: str, stars: int) -> SimpleNamespace:
        return SimpleNamespace(
            shot=SimpleNamespace(photo=SimpleNamespace(name=name)),
            **{"counted": stars, "rms_px": 0.1 * stars, "rms_mag": 0.01 * stars},
            **{"background_chi2": 1.5, "sources": [1] * 9, "unexplained": [1] * 4, "missing": [1]},
        )

    session = SimpleNamespace(power=2.0, light=SimpleNamespace(linearity=0.45))
    verdicts = [verdict("a.png", 5), verdict("b.png", 7)]
    own = confront.row_of("cam", SimpleNamespace(verdicts=verdicts, session=session), 1)
    assert (own.camera, own.image, own.stars, own.sources) == ("cam", "b.png", 7, 9)
    assert (own.unexplained, own.missing) == (4, 1)
    assert (own.rms_px, own.rms_mag) == pytest.approx((0.7, 0.07))
    assert (own.background_chi2, own.linearity) == (1.5, 0.9)
    line = confront.line_of(own)
    assert line == (
        "cam/b.png: 7 stars to V = 6.5 within 0.700 px and 0.070 mag, background chi2 1.50,"
        " 4 of 9 sources unexplained, DN go as light to the power 0.90"
    )
    held_out = row("b.png", stars=7, held_out_px=0.5, held_out_mag=0.25)
    assert confront.line_of(held_out).endswith("; held out 0.500 px, 0.250 mag")
    assert confront.line_of(row("c.png", refused="too dark")) == "cam/c.png: refused: too dark"


def test_a_photograph_is_a_bar_of_its_error_and_a_point_of_that_when_it_is_held_out(
    tmp_path: Path, figures: list
) -> None:
    rows = [
        row("n_a.png", rms_px=0.4, rms_mag=0.03, held_out_px=0.6, held_out_mag=0.05),
        row("n_b.png", refused="no image"),
        row("n_c.png", rms_px=0.2, rms_mag=0.07, held_out_px=0.3, held_out_mag=0.09),
    ]
    confront.draw(tmp_path / "confront", rows)
    (figure,) = figures
    title = " ".join(figure.get_suptitle().replace("\N{NO-BREAK SPACE}", " ").split())
    assert title == "2 photographs: stars to V = 6.5 are 0.20 to 0.40 px off their places"
    for axes, bars, points in zip(
        figure.axes, ([0.4, 0.2], [0.03, 0.07]), ([0.6, 0.3], [0.05, 0.09]), strict=True
    ):
        assert [bar.get_width() for bar in axes.patches] == bars
        (line,) = axes.get_lines()
        assert list(line.get_xdata()) == points and list(line.get_ydata()) == [0, 1]
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names == ["cam, a", "cam, c"]
    confront.draw(tmp_path / "none", [rows[1]])
    assert len(figures) == 1


def test_cameras_are_confronted_one_by_one_and_held_out_in_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figures: list
) -> None:
    """Of three good images and a bad one: all together but the bad one, then each by the others."""
    folder = tmp_path / "set" / "cam"
    folder.mkdir(parents=True)
    for name in ("guess.toml", "a.png", "b.PNG", "c.png", "bad.png", "notes.txt"):
        (folder / name).write_text("")
    asked = []

    def fitted(guess: Path, paths: list[Path], output: Path, fixed: bool = False):
        names = [path.name for path in paths]
        asked.append((guess.name, names, output.name, fixed))
        if "bad.png" in names:
            raise confront.InputError(f"{folder / 'bad.png'}: is no image")
        verdicts = []
        for number, name in enumerate(names):
            verdicts.append(
                SimpleNamespace(
                    shot=SimpleNamespace(photo=SimpleNamespace(name=name)),
                    **{"counted": 9, "rms_px": 0.1 + number + fixed, "rms_mag": 0.2 + fixed},
                    **{"background_chi2": 1.0, "sources": [], "unexplained": [], "missing": []},
                )
            )
        session = SimpleNamespace(power=1.0, light=SimpleNamespace(linearity=1.0))
        return SimpleNamespace(verdicts=verdicts, session=session)

    monkeypatch.setattr(confront, "confront", fitted)
    monkeypatch.setattr(confront, "MIN_HELD_OUT", 3)
    lines = confront.run(tmp_path / "set", tmp_path / "set")
    good = ["a.png", "b.PNG", "c.png"]
    wanted = [("guess.toml", ["a.png", "b.PNG", "bad.png", "c.png"], "cam", False)]
    wanted.append(("guess.toml", good, "cam", False))
    for name in good:
        wanted.append(("guess.toml", [other for other in good if other != name], "fit", False))
        wanted.append(("tracker.toml", [name], "test", True))
    assert asked == wanted
    rows = {row["image"]: row for row in csv_rows(tmp_path / "set" / "confront.csv")}
    assert [float(rows[name]["rms_px"]) for name in good] == pytest.approx([0.1, 1.1, 2.1])
    assert [float(rows[name]["held_out_px"]) for name in good] == pytest.approx([1.1] * 3)
    assert rows["bad.png"]["refused"] == "is no image" and len(lines) == 4
    assert math.isnan(float(rows["bad.png"]["rms_px"])) and len(figures) == 1
    # quick: none is held out
    asked.clear()
    confront.run(tmp_path / "set", tmp_path / "set", True)
    assert len(asked) == 2
