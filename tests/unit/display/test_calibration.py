"""Calibration files: what they say, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.display.calibration import (
    load_calibration,
    primary_lights,
    primary_responses,
    read_toml,
    with_uniformity,
)
from hilstar.display.identity import MonitorIdentity
from tools import make_lcd_example

HEAD = """[calibration]
kind = "photometric"
who = "tester"
when = 2026-03-01
instrument = "meter"
unit = "cd/m2"
bits = 2
response = "table.csv"
"""
TABLE = "code,w\n0,0.5\n1,1.5\n2,4.5\n3,10.5\n"
RGB = "code,r,g,b\n0,0.4,0.4,0.4\n1,1.4,2.4,0.5\n2,2.4,12.4,0.9\n3,4.4,30.4,6.4\n"


@pytest.fixture
def write(tmp_path):
    def make(head=HEAD, table=TABLE, **files):
        (tmp_path / "monitor.toml").write_text(head)
        (tmp_path / "table.csv").write_text(table)
        for name, text in files.items():
            (tmp_path / f"{name}.csv").write_text(text)
        return tmp_path / "monitor.toml"

    return make


@pytest.mark.parametrize("name", ["srgb", "gamma2.2", "lcd-example"])
def test_built_ins_load_with_and_without_bit_stealing(name):
    plain, stolen = load_calibration(name, 8), load_calibration(name, 8, bit_stealing=True)
    assert plain.name == name
    assert len(plain.sha256) == 64
    assert len(plain.response.light) == 256
    assert len(stolen.response.light) == 1786
    # The greys of both are the same levels, but for the rounding of the sums.
    grey = np.all(stolen.response.rgb == stolen.response.rgb[:, :1], axis=1)
    assert stolen.response.light[grey] == pytest.approx(plain.response.light, abs=1e-12)


def test_the_example_is_an_invention_with_1000_to_1_and_dark_corners():
    example = load_calibration("lcd-example", 8)
    assert "not a measurement" in example.instrument
    assert example.response.black == pytest.approx(1e-3, rel=1e-5)  # the CSV has six figures
    assert example.noise == 0.005
    light = example.uniformity_map((192, 108))
    assert light.shape == (108, 192)
    assert light.max() == 1
    assert 0.85 <= light.min() < 0.86
    assert make_lcd_example.uniformity().max() <= 1


def test_the_example_is_what_its_script_writes(monkeypatch, tmp_path):
    shipped = make_lcd_example.DATA
    monkeypatch.setattr(make_lcd_example, "DATA", tmp_path)
    make_lcd_example.main()
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (shipped / path.name).read_bytes()


def test_light_is_above_black_and_relative_to_white(write):
    calibration = load_calibration(write(), 2)
    assert calibration.response.light == pytest.approx([0, 0.1, 0.4, 1])
    assert calibration.response.threshold == pytest.approx([0.05, 0.25, 0.7])
    assert calibration.response.black == pytest.approx(0.05)
    assert (calibration.who, calibration.when, calibration.unit) == (
        "tester",
        "2026-03-01",
        "cd/m2",
    )
    assert calibration.weights is None
    assert not calibration.can_steal_bits
    assert load_calibration(write(table=RGB), 2).can_steal_bits
    assert calibration.uniformity_map((8, 8)) is None


def test_primaries_add_to_grey_by_their_white_light_or_by_given_weights(write):
    measured = load_calibration(write(table=RGB), 2)
    assert measured.weights == pytest.approx((0.1, 0.75, 0.15))
    assert measured.response.light == pytest.approx([0, 3.1 / 40, 14.5 / 40, 1])
    assert measured.response.black == pytest.approx(0.01)
    seen = load_calibration(write(HEAD + "[weights]\nr = 1\ng = 1\nb = 2\n", RGB), 2)
    assert seen.response.light[1] == pytest.approx(0.25 * 1 / 4 + 0.25 * 2 / 30 + 0.5 * 0.1 / 6)


def test_codes_between_the_rows_follow_the_light_s_power(write):
    rows = "".join(
        f"{code},{0.25 + 250 * (code / 255) ** 2.2!r}\n" for code in (0, 4, 16, 40, 90, 160, 255)
    )
    calibration = load_calibration(
        write(HEAD.replace("bits = 2", "bits = 8"), "code,w\n" + rows), 8
    )
    # A power law is a straight line in log light over log code, which PCHIP keeps; so is what lies
    # below the first row.
    assert calibration.response.light == pytest.approx((np.arange(256) / 255) ** 2.2, rel=1e-9)
    # below the first row the power is that of the first two
    steep = rows.replace("4,", "4,", 1).splitlines()
    steep[1] = f"4,{0.25 + 250 * (16 / 255) ** 2.2 / 4**3!r}"
    path = write(HEAD.replace("bits = 2", "bits = 8"), "\n".join(["code,w", *steep, ""]))
    light = load_calibration(path, 8).response.light
    assert light[[1, 2, 3]] / light[4] == pytest.approx((np.arange(1, 4) / 4) ** 3, rel=1e-9)


def test_uniformity_is_bilinear_between_the_middles_of_its_fields(write):
    path = write(HEAD + '[uniformity]\nfile = "grid.csv"\n', grid="1.0,0.8\n0.6,0.4\n")
    light = load_calibration(path, 2).uniformity_map((4, 4))
    assert light.dtype == np.float32
    # the grid is a plane: -0.2 and -0.4 a field
    plane = np.add.outer([0, -0.2, -0.4, -0.6], [0, -0.1, -0.2, -0.3]) + 1.15
    assert light == pytest.approx(plane / plane.max(), rel=1e-6)


NOISE = "[weights]\nr = 2\ng = 5\nb = 1\n[noise]\nrelative = 0.0135724\n"
ERRORS = """[errors]
light = [0.5, 1.0]
off = [0.01, -0.02]
relative = [0.003, 0.004]
dof = 7
[notes]
text = "by night"
[monitor_identity]
serial = "ABC12"
"""


def test_uniformity_that_falls_steeply_ends_at_half_its_darkest_field(write):
    """0.01 in a field next to 1: the same slope would be below 0 in the half field to the edge."""
    path = write(HEAD + '[uniformity]\nfile = "grid.csv"\n', grid="1.0,0.01\n")
    light = load_calibration(path, 2).uniformity_map((8, 2))
    field = (np.arange(8) + 0.5) / 4 - 0.5
    line = 1.0 - 0.99 * field
    assert line.min() < -0.3
    expected = np.where(line > 0.005, line, 0.005)
    assert light == pytest.approx(np.tile(expected / line.max(), (2, 1)), rel=1e-6)


@pytest.mark.parametrize("source", ["gamma2.2", "grey", "rgb"])
def test_a_calibration_with_another_grid_of_light_is_else_as_it_was(write, tmp_path, source):
    """A grid of two columns and three rows, rows from the top; without one the light is even."""
    if source != "gamma2.2":
        source = write(HEAD + NOISE + ERRORS, TABLE if source == "grey" else RGB)
        file = read_toml(source)
        assert (file.errors.black, file.errors.common) == (0.0, None)
    before = load_calibration(source, 2)
    grid = np.array([[1.0, 0.8], [0.9, 0.7], [0.6, 0.5]])
    path = tmp_path / "even" / "other.toml"
    path.parent.mkdir()
    for relative in (0.02345, None):
        files = with_uniformity(source, 2, path, grid, when="2026-11-29", relative=relative)
        names = ["other.toml", "other.csv", "other-uniformity.csv"]
        assert [file.name for file in files] == names
        after = load_calibration(path, 2)
        assert after.uniformity_map((2, 3)) == pytest.approx(grid, abs=1e-6)
        assert read_toml(path).uniformity.relative == relative
        assert after.response.light == pytest.approx(before.response.light, rel=1e-6)
        assert after.weights == pytest.approx(before.weights, rel=1e-6)
        assert after.noise == pytest.approx(before.noise, rel=1e-6)
        assert after.notes == before.notes
        if source != "gamma2.2":
            again = read_toml(path)
            kept = again.errors, again.notes, again.monitor_identity
            assert kept == (file.errors, file.notes, file.monitor_identity)
    assert with_uniformity(source, 2, path, None, when="2026-11-29") == files[:2]
    assert load_calibration(path, 2).uniformity_map((2, 3)) is None


def test_the_hash_covers_every_file(write, tmp_path):
    path = write(HEAD + '[uniformity]\nfile = "grid.csv"\n', grid="1.0,0.8\n")
    hashes = {load_calibration(path, 2).sha256}
    for name in ("monitor.toml", "table.csv", "grid.csv"):
        (tmp_path / name).write_text("# more\n" + (tmp_path / name).read_text())
        hashes.add(load_calibration(path, 2).sha256)
    assert len(hashes) == 4


def refusal(path, bits=2, **more):
    with pytest.raises(InputError) as caught:
        load_calibration(path, bits, **more)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("head", "words"),
    [
        ("", "the table [calibration] is missing"),
        ("calibration = 3\n", "calibration = 3; a table is wanted"),
        ("[calibration\n", "not TOML"),
        (HEAD.replace("who", "whom"), "unknown key whom"),
        (HEAD.replace('who = "tester"\n', ""), "the key who is missing"),
        (HEAD.replace("photometric", "geometric"), '"photometric" is wanted'),
        (
            HEAD.replace("bits = 2", "bits = 2.5"),
            "[calibration] bits = 2.5; a whole number is wanted",
        ),
        (HEAD.replace("bits = 2", "bits = 99"), "bits = 99"),
        (HEAD.replace("bits = 2", "bits = 10"), "the monitor has 2"),
        (HEAD.replace("table.csv", "none.csv"), "no such file"),
        (HEAD.replace("table.csv", "\\u0000"), "no such file"),
        (HEAD + "[weights]\nr = 1\ng = -1\nb = 1\n", "[weights] g = -1"),
        (HEAD + "[weights]\nr = 1\ng = nan\nb = 1\n", "[weights] g"),
        (HEAD + "[weights]\nr = 0\ng = 0\nb = 0\n", "all 0"),
        (HEAD + "[noise]\nrelative = 7\n", "[noise] relative = 7"),
        (HEAD + '[uniformity]\nfile = "gone.csv"\n', "[uniformity] file"),
        (HEAD + "[extra]\n", "unknown key extra"),
        (HEAD + "[noise]\nabsolute = 1\n", "[noise] unknown key absolute; known are relative"),
        (HEAD + "[noise]\nrelative = 2\n", "[noise] relative = 2; a number <= 1.0 is wanted"),
    ],
)
def test_a_malformed_file_is_refused_in_one_line(write, head, words):
    assert words in refusal(write(head))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", "write code,w or code,r,g,b"),
        ("code,w,r\n0,1,1\n", "write code,w or code,r,g,b"),
        ("code,w\n", "no row of numbers"),
        ("code,w\n0,0.5\n1,1.5\n2,1.5\n3,10\n", "code 1 to code 2"),
        ("code,w\n0,0.5\n1,1.5\n2,1.4\n3,10\n", "code 1 to code 2"),
        ("code,w\n0,0.5\n1,1\n2,two\n3,10\n", ".csv:4: w = 'two'"),
        ("code,w\n0,0.5\n1,1\n2,nan\n3,10\n", ".csv:4: w = 'nan'"),
        ("code,w\n0,0.5\n1,1\n2,2,2\n3,10\n", ".csv:4: 3 cells"),
        ("code,w\n0,-0.5\n3,10\n", ".csv:2: "),
        ("code,w\n1,1\n2,2\n3,10\n", "0 (black) to 3"),
        ("code,w\n0,1\n2,2\n1,10\n3,11\n", "sort the rows"),
        ("code,w\n0,1\n3,11\n", "two codes"),
        ("code,r,g,b\n0,1,2,1\n1,2,3,2\n2,3,4,3\n3,9,9,9\n", "one black screen"),
    ],
)
def test_a_table_that_is_no_response_is_refused(write, table, words):
    assert words in refusal(write(table=table))


def test_what_is_not_there_or_not_text_is_refused(tmp_path, write):
    assert "no such built-in" in refusal("adobe")
    assert "cannot be read" in refusal(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    assert "UTF-8" in refusal(tmp_path / "bytes.toml")
    path = write(HEAD + '[uniformity]\nfile = "grid.csv"\n', grid="1.0,0\n")
    assert "no light" in refusal(path)
    path = write(HEAD + '[uniformity]\nfile = "grid.csv"\n', grid="1.0,1\n0.9,x\n")
    assert "grid.csv:2: column 2 = 'x' is not a finite number" in refusal(path)
    assert "add [weights]" in refusal(write(), bit_stealing=True)
    assert "the monitor has 10" in refusal("lcd-example", bits=10)


@pytest.mark.parametrize(("bits", "can"), [(8, True), (13, True), (14, False)])
def test_bits_are_stolen_up_to_13_bits(bits, can):
    assert load_calibration("srgb", bits).can_steal_bits == can
    if can:
        load_calibration("srgb", bits, bit_stealing=True)
    else:
        with pytest.raises(InputError, match="at most 13 bits"):
            load_calibration("srgb", bits, bit_stealing=True)


WEIGHTS = "[weights]\nr = 1\ng = 1\nb = 2\n"
OF_GREY = np.array([0, 0.1, 0.4, 1])
OF_EACH = np.array([[0, 1, 2, 4], [0, 2, 12, 30], [0, 0.1, 0.5, 6]])


@pytest.mark.parametrize(
    ("head", "table", "wanted"),
    [
        (HEAD + WEIGHTS, TABLE, np.outer([0.25, 0.25, 0.5], OF_GREY)),
        (HEAD, RGB, OF_EACH / 40),
        (HEAD + WEIGHTS, RGB, OF_EACH / [[16], [120], [12]]),
    ],
    ids=["grey and weights", "each", "each and weights"],
)
def test_a_primary_s_light_is_its_share_of_white_as_the_tracker_sees_it(write, head, table, wanted):
    """Above black, by its code: all three at full light are 1."""
    lights = primary_lights(write(head, table), 2)
    assert lights == pytest.approx(wanted)
    assert lights[:, -1].sum() == pytest.approx(1)


def test_each_primary_s_response_is_relative_to_its_own_white(write):
    responses = primary_responses(write(table=RGB), 2)
    lights = [response.light for response in responses]
    assert np.array(lights) == pytest.approx(OF_EACH / OF_EACH[:, -1:])
    of_grey = primary_responses(write(), 2)
    assert np.array([response.light for response in of_grey]) == pytest.approx(
        np.tile(OF_GREY, (3, 1))
    )
    assert "add [weights] r, g, b" in str(_refused(primary_lights, write(), 2))


def _refused(asked, *arguments) -> InputError:
    with pytest.raises(InputError) as caught:
        asked(*arguments)
    return caught.value


def test_a_formula_s_primaries_are_those_of_rec_709_and_its_hash_is_of_its_bits():
    """IEC 61966-2-1: 0.2126, 0.7152 and 0.0722 of white."""
    lights = primary_lights("gamma2.2", 8)
    for light, share in zip(lights, (0.2126, 0.7152, 0.0722), strict=True):
        assert light == pytest.approx(share * (np.arange(256) / 255) ** 2.2)
    assert [len(response.light) for response in primary_responses("srgb", 10)] == [1024] * 3
    hashes = {
        load_calibration(name, bits).sha256 for name in ("srgb", "gamma2.2") for bits in (8, 10)
    }
    assert len(hashes) == 4


def test_a_grid_is_of_the_monitor_that_is_told_or_else_of_the_file_s(write, tmp_path):
    source = write(HEAD + '[monitor_identity]\nmaker = "ABC"\nserial = "7"\n')
    grid = np.array([[1.0, 0.8], [0.9, 0.7]])
    for identity, serial in ((None, "7"), (MonitorIdentity(maker="ABC", serial="8"), "8")):
        with_uniformity(source, 2, tmp_path / "other.toml", grid, identity)
        assert read_toml(tmp_path / "other.toml").monitor_identity.serial == serial


def test_a_table_may_stand_in_a_folder_beside_its_file(write, tmp_path):
    path = write(HEAD.replace("table.csv", "tables/light.csv"))
    assert "there is no such file beside it" in str(_refused(load_calibration, path, 2))
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "light.csv").write_text(TABLE)
    (tmp_path / "light.csv").write_text(TABLE.replace("1.5", "2.5"))
    assert load_calibration(path, 2).response.light == pytest.approx(OF_GREY)


@pytest.mark.parametrize(("black", "is_one"), [("0.44", True), ("0.45", False), ("0.35", False)])
def test_three_blacks_agree_within_a_tenth_of_their_mean(write, black, is_one):
    path = write(table=RGB.replace("0,0.4,0.4,0.4", f"0,0.4,0.4,{black}"))
    if is_one:
        assert load_calibration(path, 2).response.white == 3
    else:
        assert f"code 0 has 0.4, 0.4, {black}" in str(_refused(load_calibration, path, 2))


@pytest.mark.parametrize("codes", [(0, 1, 1, 3), (0, 2, 1, 3), (0, 0.5, 2, 3)])
def test_codes_rise_by_whole_numbers(write, codes):
    rows = "".join(f"{code},{light}\n" for code, light in zip(codes, (1, 2, 3, 4), strict=True))
    said = str(_refused(load_calibration, write(table="code,w\n" + rows), 2))
    assert "its codes are not whole numbers that rise" in said
