"""A file with `heads`: what it means, and what is wrong with it in one line."""

from __future__ import annotations

import pytest

from hilstar.basics.errors import InputError
from hilstar.server.bench.bench_file import HeadsFile, as_head, read_bench_or_heads, read_heads
from tests.support.benches import SMALL_BENCH
from tests.support.heads import MOUNTINGS, heads_file
from tests.support.refusals import refusal


def test_each_head_has_its_own_bench_and_the_common_source(tmp_path):
    path = heads_file(tmp_path, 5599)
    heads = read_heads(path)
    assert isinstance(read_bench_or_heads(path), HeadsFile)
    assert heads.names == ("a", "b", "c")
    assert [file.config.tracker.q_body_to_cam for file in heads.files] == [
        pytest.approx(q) for q in MOUNTINGS.values()
    ]
    assert {file.config.attitude.endpoint for file in heads.files} == {"tcp://127.0.0.1:5599"}
    assert as_head(tmp_path / "b.toml", path).sha256 == heads.files[1].sha256


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('heads = ["a.toml"]', "from 2 to 8"),
        ('heads = "a.toml"', "no list of files"),
        ('heads = ["a.toml", 3]', "no list of files"),
        ('heads = ["a.toml", "sub/../a.toml"]', "two are called a"),
        ('heads = ["a.toml", "nowhere.toml"]', "nowhere.toml"),
        ('heads = ["a.toml", "b.toml"]\n[monitor]\nbits = 8', "monitor: beside heads stands only"),
        ('heads = ["a.toml", "heads.toml"]', "give one of its heads' files"),
        ('heads = ["a.toml", "b.toml"]\n[attitude]\nlockstep = true', "lockstep"),
        ('heads = ["a.toml", "b.toml"]\n[attitude]\nsource = "pigeon"', "source"),
        (
            'heads = ["a.toml", "b.toml"]\n[attitude]\nconvention = { frame = "cam" }',
            'several heads have one source, the attitude of the body; write frame = "body"',
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path, text, words):
    for name in "ab":
        (tmp_path / f"{name}.toml").write_text(SMALL_BENCH)
    (tmp_path / "heads.toml").write_text(text + "\n")
    assert words in refusal(read_heads, tmp_path / "heads.toml")


def test_a_bench_file_is_read_as_one(tmp_path):
    (tmp_path / "bench.toml").write_text(SMALL_BENCH)
    (tmp_path / "broken.toml").write_text("heads = [")
    assert not isinstance(read_bench_or_heads(tmp_path / "bench.toml"), HeadsFile)
    with pytest.raises(InputError):
        read_bench_or_heads(tmp_path / "broken.toml")


@pytest.mark.parametrize("link", ["soft", "hard"])
def test_two_names_of_one_file_are_no_two_heads(tmp_path, link):
    (tmp_path / "a.toml").write_text(SMALL_BENCH)
    if link == "soft":
        (tmp_path / "b.toml").symlink_to("a.toml")
    else:
        (tmp_path / "b.toml").hardlink_to(tmp_path / "a.toml")
    path = tmp_path / "heads.toml"
    path.write_text('heads = ["a.toml", "b.toml"]\n')
    with pytest.raises(
        InputError, match=r"heads: b.toml is the same file as a.toml; give each a file of its own"
    ):
        read_heads(path)
