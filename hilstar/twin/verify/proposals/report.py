"""What a proposal says to a person, and the bench file with it."""

from __future__ import annotations

import difflib
import json
import os
import stat

from hilstar.bench.bench_file import BenchFile
from hilstar.errors import InputError, cannot_write
from hilstar.files import write_whole
from hilstar.reading import MAX_TOML_BYTES, read_text
from hilstar.twin.verify.proposals.proposal import Change, Proposal, Verified, changed_text


def proposal_lines(file: BenchFile, proposal: Proposal) -> list[str]:
    """The proposal for a person, with the difference that it makes in the bench file."""
    verified = proposal.verified
    if not proposal.changes:
        lines = [f"{'proposal':20}none: {proposal.cannot}"]
        if verified is not None:
            lines.append(f"{'':20}the best is {_words(proposal.best)}: {_figures(verified)}")
        return lines
    said = "" if verified is None else f": passes, {_figures(verified)}"
    return [f"{'proposal':20}{_words(proposal.changes)}{said}", *difference(file, proposal)]


def difference(file: BenchFile, proposal: Proposal) -> list[str]:
    """The lines that a proposal changes in the bench file, as a unified diff."""
    before, after = file.text.splitlines(), changed_text(file.text, proposal.changes).splitlines()
    return list(difflib.unified_diff(before, after, str(file.path), str(file.path), n=1, lineterm=""))


def check_writable(file: BenchFile) -> None:
    """Refuse (InputError) a bench file that may not be written, before anything is tried."""
    try:
        status = file.path.stat()
    except OSError as error:
        raise cannot_write(file.path, error) from error
    if not stat.S_ISREG(status.st_mode):
        raise cannot_write(file.path, "it is no regular file", "leave --write out, and change the file yourself")
    # Root may write what nobody should: a file without any write permission was protected by somebody.
    protected = not status.st_mode & (stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH)
    if protected or not os.access(file.path, os.W_OK):
        raise cannot_write(file.path, "it is read-only", "copy it, and verify the copy")


def write_proposal(file: BenchFile, proposal: Proposal) -> None:
    """Make the changes in the bench file. Raises InputError where it cannot be written, or has changed since it was read."""
    check_writable(file)
    if read_text(file.path, "give the path of a bench file", MAX_TOML_BYTES) != file.text:
        raise InputError(f"{file.path}: has changed since it was read; run verify again")
    write_whole(file.path, changed_text(file.text, proposal.changes))


def _words(changes: tuple[Change, ...]) -> str:
    return ", ".join(f"[{change.table}] {change.key} = {json.dumps(change.value)}" for change in changes)


def _figures(verified: Verified) -> str:
    flux, centroid = verified.flux_error_mag.p95, verified.centroid_error_px.p95
    at_95 = f"{flux:.3f} mag and {centroid:.3f} px at 95 %, " if flux is not None and centroid is not None else ""
    return f"{at_95}{verified.stars} stars, {verified.lost} lost, {verified.clipped} clipped, {verified.not_shown} not shown"
