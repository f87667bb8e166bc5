"""The one contract of all registered log formats: what is written is read, what is cut, spoiled or
no log at all is read in order or refused in one line, and the content says what it is.
"""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log, read_log, write_log
from hilstar.attitude.logs.log_formats import NOTHING_STATED, format_of, log_formats
from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.errors import InputError
from tests.support.log_files import FILES, FORMS, LEVEL, SAMPLES, ULOG, LogFile, spoiled
from tests.support.refusals import line_of, refusal

MAX_SPOILED_BYTES = 7
NORM_TOLERANCE = 1e-9
TEXTS = ["CSV", "JSON lines", "a CCSDS AEM, written", "a CCSDS AEM, XML", "a CIC AEM"]
WRITERS = {ending: each for each in log_formats() if each.write for ending in each.endings}
INT64_MIN, INT64_MAX = -(2**63), 2**63 - 1

FAST_FORMS = {name: form for name, form in FORMS.items() if name != "a SPICE CK"}

each_form = pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
each_fast_form = pytest.mark.parametrize("form", FAST_FORMS.values(), ids=FAST_FORMS)


def log_refusal(path, stated=NOTHING_STATED):
    """The one line by which a file is refused, which begins with its path."""
    line = refusal(open_log, path, stated)
    assert line.startswith(str(path)), line
    return line


def read_or_refused(path, form: LogFile) -> list[AttitudeSample] | None:
    """The attitudes of a file, which are in order and unit; None where it is refused."""
    try:
        samples = open_log(path, form.stated).samples
    except InputError as error:
        assert line_of(error).startswith(str(path))
        return None
    times = [sample.t_ns for sample in samples]
    assert samples and times == sorted(set(times))
    assert all(INT64_MIN <= t_ns <= INT64_MAX for t_ns in times)
    for sample in samples:
        assert abs(np.linalg.norm(sample.q_icrs_to_cam) - 1) < NORM_TOLERANCE
        assert sample.rate_cam_rad_s is None or np.isfinite(sample.rate_cam_rad_s).all()
    return samples


def whole_samples(path, form: LogFile) -> list[AttitudeSample]:
    samples = read_or_refused(path, form)
    assert samples is not None
    return samples


def is_same_sample(one: AttitudeSample, other: AttitudeSample) -> bool:
    off = one.q_icrs_to_cam - other.q_icrs_to_cam
    return one.t_ns == other.t_ns and np.abs(off).max() < 1e-12


def test_every_registered_format_stands_here():
    names = {each.name for each in log_formats()}
    assert set(FILES) | {ULOG.format_name} == names
    refused = {"a CCSDS message", ULOG.format_name}
    assert {form.format_name for form in FORMS.values()} == names - refused
    written = {form.format_name for form in FORMS.values()} & {
        each.name for each in WRITERS.values()
    }
    assert written == {each.name for each in WRITERS.values()}


@each_form
def test_a_whole_file_is_read_and_what_is_read_of_it_is_written_in_every_form(tmp_path, form):
    path = form.make(tmp_path)
    samples = whole_samples(path, form)
    assert len(samples) >= 2
    for ending in WRITERS:
        write_log(tmp_path / f"again{ending}", samples)
        again = read_log(tmp_path / f"again{ending}")
        assert len(again) == len(samples)
        assert all(map(is_same_sample, again, samples))


def assert_cuts_are_read(path, form: LogFile, trials: int) -> None:
    """Cut a file all over, and in the midst of its last attitude."""
    samples = whole_samples(path, form)
    data = path.read_bytes()
    sizes = {*range(0, len(data), len(data) // trials), *range(len(data))[-trials:]}
    for size in sorted(sizes):
        path.write_bytes(data[:size])
        found = read_or_refused(path, form)
        assert found is None or len(found) <= len(samples), size
        assert found is None or all(map(is_same_sample, found, samples[: len(found)])), size


@each_fast_form
def test_a_file_that_is_cut_anywhere_is_refused_in_one_line_or_gives_the_beginning(tmp_path, form):
    assert_cuts_are_read(form.make(tmp_path), form, form.trials)


@pytest.mark.parametrize("name", [*TEXTS, "an STK attitude file"])
def test_a_text_that_is_cut_at_any_byte_is_refused_in_one_line_or_gives_the_beginning(
    tmp_path, name
):
    path = FORMS[name].make(tmp_path)
    assert_cuts_are_read(path, FORMS[name], len(path.read_bytes()))


def spoil(path, form: LogFile, trials: int) -> None:
    """Spoil a file at random, and cut some of those."""
    samples = whole_samples(path, form)
    times = {sample.t_ns for sample in samples}
    data = path.read_bytes()
    rng = np.random.default_rng(11)
    for _ in range(trials):
        count = int(rng.integers(1, MAX_SPOILED_BYTES + 1))
        changed = spoiled(data, rng, count)
        if rng.random() < 0.3:
            changed = changed[: rng.integers(0, len(changed))]
        path.write_bytes(changed)
        found = read_or_refused(path, form)
        if found is not None and form.own_times:
            assert sum(sample.t_ns not in times for sample in found) <= count
        if found is not None and form.checked:
            assert all(map(is_same_sample, found, samples[: len(found)]))


@each_fast_form
def test_a_file_that_is_spoiled_is_refused_in_one_line_or_read_in_order(tmp_path, form):
    """Where each attitude has its own time, no byte moves the time of another; where a checksum is
    over each, what is read is what was written.
    """
    spoil(form.make(tmp_path), form, form.trials)


def noise_behind(path, trials: int) -> None:
    """Noise behind the first bytes of a file: a whole first line would be that of a log, whose
    second is wrong.
    """
    data = path.read_bytes()
    rng = np.random.default_rng(5)
    for k in range(trials):
        noise = rng.integers(0, 256 if k % 2 else 128, size=300, dtype=np.uint8)
        path.write_bytes(data[: rng.integers(0, 24)] + noise.tobytes())
        log_refusal(path)


@each_fast_form
def test_noise_behind_the_beginning_of_a_file_is_refused_in_one_line(tmp_path, form):
    noise_behind(form.make(tmp_path), 20)


def renamed(path, form: LogFile, endings: list[str]) -> None:
    """Read a file under other names."""
    samples = whole_samples(path, form)
    for ending in endings:
        path = path.rename(path.with_name(f"log{ending}"))
        assert format_of(path).name == form.format_name
        found = whole_samples(path, form)
        assert len(found) == len(samples) and all(map(is_same_sample, found, samples))


@each_fast_form
def test_what_a_file_holds_and_not_its_name_says_what_it_is(tmp_path, form):
    renamed(form.make(tmp_path), form, [".dat", *WRITERS])


def test_all_that_holds_of_a_file_that_a_process_of_its_own_reads(tmp_path):
    form = FORMS["a SPICE CK"]
    for claim, trials in ((assert_cuts_are_read, 2), (spoil, 3)):
        claim(form.make(tmp_path), form, trials)
        (tmp_path / "a.bc").unlink()
    noise_behind(form.make(tmp_path), 2)
    (tmp_path / "a.bc").unlink()
    renamed(form.make(tmp_path), form, [".dat"])


@pytest.mark.parametrize("name", TEXTS)
def test_a_text_may_begin_with_a_byte_order_mark_and_end_its_lines_as_windows_does(tmp_path, name):
    form = FORMS[name]
    path = form.make(tmp_path)
    samples = whole_samples(path, form)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    found = whole_samples(path, form)
    assert len(found) == len(samples) and all(map(is_same_sample, found, samples))


@pytest.mark.parametrize("ending", WRITERS)
def test_attitudes_that_go_back_in_time_are_refused_or_put_in_order(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    for samples in (SAMPLES[::-1], [*SAMPLES, SAMPLES[0]]):
        try:
            write_log(path, samples)
        except InputError as error:
            assert line_of(error).startswith(str(path))
            continue
        found = read_or_refused(path, FORMS["CSV"])
        assert found is None or all(map(is_same_sample, found, SAMPLES))


@pytest.mark.parametrize("ending", WRITERS)
def test_the_ends_of_64_bit_time_and_the_nanoseconds_between_survive(tmp_path, ending):
    seconds = [-1_000_000_001, -1_000_000_000, -1, 0, 1, 1_700_000_000_123_456_789]
    times = [INT64_MIN, *seconds, INT64_MAX]
    samples = [AttitudeSample(t_ns, np.array([0.5, 0.5, 0.5, 0.5])) for t_ns in times]
    write_log(tmp_path / f"a{ending}", samples)
    assert [sample.t_ns for sample in read_log(tmp_path / f"a{ending}")] == times


@pytest.mark.parametrize("ending", WRITERS)
def test_no_samples_make_no_log(tmp_path, ending):
    assert "no attitude" in refusal(write_log, tmp_path / f"a{ending}", [])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("stated", [Stated(), LEVEL], ids=["nothing stated", "level"])
@pytest.mark.parametrize("name", ["a CCSDS message", ULOG.format_name])
def test_what_is_told_and_never_read_is_refused_with_what_to_bring(tmp_path, name, stated):
    form = {**FILES, ULOG.format_name: ULOG}[name]
    path = form.make(tmp_path)
    assert format_of(path).name == name
    assert "; " in log_refusal(path, stated)


def test_what_is_not_there_or_empty_is_refused_in_one_line(tmp_path):
    (tmp_path / "empty").touch()
    assert "no attitude" in log_refusal(tmp_path / "empty")
    assert "No such file" in log_refusal(tmp_path / "none.csv")
    assert "cannot be read" in log_refusal(tmp_path)
