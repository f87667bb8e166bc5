"""SPICE CK: files that are damaged, kernels that are missing, and choices that are open, each
refused in one line.
"""

from __future__ import annotations

import os
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import spiceypy

from hilstar.attitude.logs import ck_spice
from hilstar.attitude.logs.ck_spice import _named, answer
from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_file import open_log
from hilstar.basics.errors import InputError, MachineError
from tests.support.refusals import refusal
from tests.support.sources import spice_kernels as ck

TIMES = np.arange(0.0, 60.0, 0.25)  # more than 100, so that there is a directory
RECORD_BYTES, WORD_BYTES = 1024, 8
DATA_WORD = 3 * RECORD_BYTES // WORD_BYTES  # file record, summaries, names, data


@pytest.fixture(scope="module")
def whole_ck(tmp_path_factory):
    """The bytes of a CK of type 3, which take 0.7 s to make."""
    path = tmp_path_factory.mktemp("ck") / "whole.bc"
    with ck.new_ck(path) as handle:
        ck.write_segment(handle, 3, ck.Motion(np.random.default_rng(1)), TIMES)
    return path.read_bytes()


@pytest.fixture
def raw(tmp_path, whole_ck):
    """The bytes of a CK of type 3, which lies beside its kernels."""
    ck.write_texts(tmp_path)
    (tmp_path / "whole.bc").write_bytes(whole_ck)
    return bytearray(whole_ck)


def ck_refusal(path, kernels=("leap.tls", "clock.tsc"), body=None):
    with spiceypy.KernelPool([]):
        return refusal(answer, path, [path.parent / name for name in kernels], body)


def words(at, *values):
    """An edit that puts doubles at a word (from 0); at a negative one, counted from the end of
    the segment.
    """

    def edit(raw):
        where = at if at >= 0 else len(segment(raw)) + DATA_WORD + at
        raw[where * WORD_BYTES : (where + len(values)) * WORD_BYTES] = struct.pack(
            f"<{len(values)}d", *values
        )

    return edit


def word_again(at):
    """An edit that puts the double before a word there, too."""

    def edit(raw):
        where = at * WORD_BYTES
        raw[where : where + WORD_BYTES] = raw[where - WORD_BYTES : where]

    return edit


def segment(raw):
    first, last = struct.unpack_from("<2i", raw, RECORD_BYTES + 5 * WORD_BYTES + 4 * 4)
    return range(first, last + 1)


def bytes_at(place, new):
    def edit(raw):
        raw[place : place + len(new)] = new

    return edit


def cut_to(count):
    def edit(raw):
        del raw[count:]

    return edit


@pytest.mark.parametrize(
    ("edit", "words_said"),
    [
        (cut_to(800), "SPICE refuses it (Error reading the file record"),
        (cut_to(1500), "SPICE refuses it ("),
        (cut_to(3 * RECORD_BYTES + 999), "segment 1 has the words 385 to"),
        (bytes_at(88, b"VAX-GFLT"), "VAX-GFLT"),
        (bytes_at(8, struct.pack("<2i", 99, 9999)), "is another kind of DAF than a CK"),
        (
            words(RECORD_BYTES // WORD_BYTES, 1e15),
            "SPICE refuses it (Attempt to read descriptor record",
        ),
        (words(RECORD_BYTES // WORD_BYTES + 2, 0.0), "contains no segment"),
        (
            words(RECORD_BYTES // WORD_BYTES + 2, 1e9),
            "segment 2 is of type 0; types 1 to 6 are read",
        ),
        (words(RECORD_BYTES // WORD_BYTES + 3, float("nan")), "segment 1 spans the ticks nan"),
        (
            bytes_at(RECORD_BYTES + 5 * WORD_BYTES + 8, struct.pack("<i", 9)),
            "segment 1 is of type 9; types 1 to 6 are read",
        ),
        (
            bytes_at(RECORD_BYTES + 5 * WORD_BYTES + 8, struct.pack("<i", 7)),
            "segment 1 is of type 7; types 1 to 6 are read",
        ),
        (words(-1, 1e9), "its counts do not fit"),
        (words(-1, float("nan")), "its counts do not fit"),
        (words(-2, 0.0), "SPICE refuses it (The requested segment"),
        (words(DATA_WORD + 7 * len(TIMES) + 3, 0.0), "its times do not increase"),
        (words(DATA_WORD + 7 * len(TIMES) + 3, float("inf")), "its times do not increase"),
        (word_again(DATA_WORD + 7 * len(TIMES) + 3), "its times do not increase"),
        (
            words(DATA_WORD + 7 * len(TIMES) + len(TIMES), 5.0),
            "its directory is not that of its times",
        ),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(tmp_path, raw, edit, words_said):
    edit(raw)
    (tmp_path / "a.bc").write_bytes(raw)
    assert words_said in ck_refusal(tmp_path / "a.bc")


def test_a_list_of_segments_that_goes_round_for_ever_is_refused(tmp_path, raw, monkeypatch):
    """At the limit, which SPICE takes 10 s to reach."""
    monkeypatch.setattr(ck_spice, "MAX_SUMMARIES", 500)
    words(RECORD_BYTES // WORD_BYTES, 2.0)(raw)
    (tmp_path / "a.bc").write_bytes(raw)
    assert ck_refusal(tmp_path / "a.bc") == (
        f"{tmp_path / 'a.bc'}: has more than 500 segments; split it, or copy it again if it is"
        " damaged"
    )


@pytest.mark.parametrize(
    ("q", "norm"), [([0.0] * 4, "0"), ([2.0, 0.0, 0.0, 0.0], "2"), ([float("nan")] * 4, "nan")]
)
def test_a_quaternion_that_is_none_is_refused_and_not_taken_for_an_attitude(tmp_path, raw, q, norm):
    words(DATA_WORD + 7, *q)(raw)
    (tmp_path / "a.bc").write_bytes(raw)
    assert f"a.bc: segment 1: the norm of its quaternion 2 is {norm}; it must be 1" in ck_refusal(
        tmp_path / "a.bc"
    )


def test_a_file_on_which_spice_aborts_ends_a_process_of_its_own_and_is_one_line(tmp_path, raw):
    """CSPICE ends its process on some damaged files: a segment of type 6 whose counts it
    believes.
    """
    path = tmp_path / "a.bc"
    with ck.new_ck(path) as handle:
        ck.write_type_6(handle, ck.Motion(np.random.default_rng(1)), [TIMES])
    damaged = bytearray(path.read_bytes())
    words(-1, 2.0e9)(damaged)
    words(-2, -7.0)(damaged)
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"a\.bc: SPICE (broke off|refuses)") as caught:
        open_log(path)
    assert "\n" not in str(caught.value)


# Kernels


def test_a_missing_kernel_is_named_with_the_option(tmp_path, raw):
    assert (
        "its clock is unknown; give its SCLK kernel, and leap seconds: --kernel FILE.tsc"
        in ck_refusal(tmp_path / "whole.bc", kernels=["leap.tls"])
    )
    with ck.new_ck(tmp_path / "a.bc") as handle:
        (tmp_path / "frames.tf").write_text(ck.frame_kernel())
        with spiceypy.KernelPool([str(tmp_path / "frames.tf")]):
            ck.write_segment(
                handle, 3, ck.Motion(np.random.default_rng(1)), TIMES, reference="PROBE_TABLE"
            )
    assert (
        "a frame has no place among the stars; give what orients it: --kernel FILE.tf, or its own"
        " .bc, or .tpc" in ck_refusal(tmp_path / "a.bc")
    )


@pytest.mark.parametrize("relative", ["", "'+"])
def test_a_meta_kernel_gives_its_kernels(tmp_path, raw, relative):
    part = tmp_path.as_posix()
    files = "'$K/leap.tls' '$K/clock.tsc'" if not relative else "'$K/le+' 'ap.tls' '$K/clock.tsc'"
    meta = (
        f"KPL/MK\n\\begindata\nPATH_SYMBOLS = ( 'K' )\nPATH_VALUES = ( '{part[:30]}+'"
        f" '{part[30:]}' )\n"
    )
    (tmp_path / "all.tm").write_text(f"{meta}KERNELS_TO_LOAD = ( {files} )\n\\begintext\n")
    with spiceypy.KernelPool([]):
        found, _ = answer(tmp_path / "whole.bc", [tmp_path / "all.tm"], None)
    assert len(found.t_ns) == len(TIMES)


def test_of_path_symbols_that_begin_alike_the_one_that_is_written_counts(tmp_path):
    meta = (
        "KPL/MK\n\\begindata\nPATH_SYMBOLS = ( 'K' 'KERNELS' 'KE' )\n"
        "PATH_VALUES = ( '/nowhere' '/kernels' '/nowhere' )\n"
        "KERNELS_TO_LOAD = ( '$KERNELS/leap.tls' '$KERNELS/clock.tsc' )\n\\begintext\n"
    )
    (tmp_path / "all.tm").write_text(meta)
    with spiceypy.no_found_check():
        paths = _named(spiceypy, tmp_path / "all.tm")
    assert paths == [Path("/kernels/leap.tls"), Path("/kernels/clock.tsc")]


@pytest.mark.parametrize(
    ("text", "words_said"),
    [
        ("KPL/MK\n", "names no kernels"),
        (
            "KPL/MK\n\\begindata\nKERNELS_TO_LOAD = ( '/dev/zero' )\n",
            "/dev/zero: cannot be read (it is a device)",
        ),
        (
            "KPL/MK\n\\begindata\nKERNELS_TO_LOAD = ( 'missing.tls' )\n",
            "missing.tls: cannot be read",
        ),
        ("KPL/MK\n\\begindata\nKERNELS_TO_LOAD = ( 'all.tm' )\n", "names another meta-kernel"),
        ("DAFETF NAIF DAF ENCODED TRANSFER FILE\n", "is a transfer file; convert it by tobin"),
        ("KPL/LSK\n\\begindata\nDELTET/K = = 3\n", "SPICE refuses it"),
        ("", "SPICE refuses it"),
    ],
)
def test_a_kernel_that_is_none_is_refused(tmp_path, raw, monkeypatch, text, words_said):
    monkeypatch.chdir(tmp_path)  # SPICE takes a name in a meta-kernel from where the command runs
    name = "all.tm" if "KPL/MK" in text else "x.tls"
    (tmp_path / name).write_text(text)
    assert words_said in ck_refusal(tmp_path / "whole.bc", kernels=[name])


@pytest.mark.parametrize(("begin", "said"), [("KPL/LSK\n", "50 MB"), ("DAF/SPK\n", "4 GB")])
def test_a_kernel_of_one_byte_over_its_limit_is_refused_before_spice_reads_it(
    tmp_path, raw, begin, said
):
    kernel = tmp_path / "x.tls"
    kernel.write_text(begin)
    limit_bytes = {"50 MB": 50 * 10**6, "4 GB": 4 * 10**9}[said]
    os.truncate(kernel, limit_bytes + 1)
    line = ck_refusal(tmp_path / "whole.bc", kernels=[kernel.name])
    assert line.startswith(f"{kernel}: ") and f"and at most {said} are read" in line


def test_a_ck_of_one_byte_over_its_limit_is_refused_before_spice_reads_it(tmp_path, raw):
    path = tmp_path / "whole.bc"
    os.truncate(path, 500 * 10**6 + 1)
    line = ck_refusal(path)
    assert line.startswith(f"{path}: ") and "and at most 500 MB are read" in line


def test_a_structure_that_is_not_there_is_refused_with_those_that_are(tmp_path, raw):
    for stated in ("-7", "NOBODY", "MARS"):
        assert f"contains no structure {stated!r}; it has -82000: --body ID" in ck_refusal(
            tmp_path / "whole.bc", body=stated
        )
    with spiceypy.KernelPool([]):
        answer(tmp_path / "whole.bc", [tmp_path / "leap.tls", tmp_path / "clock.tsc"], "-82000")


def test_without_the_library_one_line_says_what_to_install(tmp_path, raw, monkeypatch):
    monkeypatch.setitem(sys.modules, "spiceypy", None)
    with pytest.raises(
        MachineError,
        match=r"whole\.bc: a SPICE CK; reading it needs spiceypy: pip install 'hilstar\[spice\]'",
    ):
        open_log(tmp_path / "whole.bc", Stated())
