"""Explains an answer to the engineer who writes `[answers]`: which bytes became which field, why
bytes were refused, and which quaternion convention agrees with the attitude on the display.
"""

from dataclasses import dataclass, replace
from itertools import product

import msgspec
import numpy as np

from hilstar.attitude.wire.source import Convention, Mounting, SentAttitudes
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import printable, shortened
from hilstar.basics.rotation import angle_between_rad, to_radec_roll_deg, turn_text
from hilstar.basics.units import ARCSEC_PER_RAD
from hilstar.server.answers.answer import Answer
from hilstar.server.answers.formats import CHECKSUMS, AnswerDecoder, RefusedAnswer
from hilstar.server.bench.config.answers import field_format

MAX_SHOWN_BYTES = 96
# A convention is certain only where its attitude is nearer than NEAR_RAD to the shown one (the
# tracker may have a bias), and every other convention is over APART times as far from it.
NEAR_RAD = np.radians(5.0)
APART = 20.0


@dataclass(frozen=True, slots=True)
class UnderConvention:
    """The attitude that an answer has under one convention: unit quaternion q_icrs_to_cam, its
    angle `off_rad` to the shown attitude, rad (None: the shown one is not known), and whether this
    convention `matches`.
    """

    convention: Convention
    q_icrs_to_cam: FloatArray
    off_rad: float | None = None
    matches: bool = False

    def line(self) -> str:
        """One line of text; ">" at its start marks the convention that matches."""
        c = self.convention
        ra_deg, dec_deg, roll_deg = to_radec_roll_deg(self.q_icrs_to_cam)
        ra = turn_text(ra_deg)
        roll = turn_text(roll_deg)
        said = (
            f"scalar {c.scalar:<5} {c.direction:<11} {c.frame:<4}  RA {ra:>8}  Dec {dec_deg:+8.4f} "
            f" roll {roll:>8}"
        )
        if self.off_rad is None:
            off = ""
        else:
            off = f"  {_angle(self.off_rad)} from what is shown"
        return f"{'>' if self.matches else ' '} {said}{off}"


def _angle(off_rad: float) -> str:
    if off_rad > np.radians(1.0):
        return f"{np.degrees(off_rad):.2f} deg"
    return f"{off_rad * ARCSEC_PER_RAD:.1f} arcsec"


def under_conventions(
    answer: Answer, decoder: AnswerDecoder, shown: FloatArray | None
) -> list[UnderConvention]:
    """The attitude of an answer under every convention, the matching one marked; [] for an answer
    without an attitude. `shown` is the displayed q_icrs_to_cam, None where it is not known.
    """
    mounted = decoder.q_body_to_cam
    if answer.q_icrs_to_cam is None:
        return []
    sent = decoder.sent.as_sent(answer.q_icrs_to_cam)
    frames = ("cam", "body") if mounted is not None else ("cam",)
    found = []
    for scalar, direction, frame in product(
        ("first", "last"), ("icrs_to_cam", "cam_to_icrs"), frames
    ):
        convention = Convention(scalar=scalar, direction=direction, frame=frame)  # type: ignore[arg-type]
        q = SentAttitudes(convention, Mounting(mounted)).q_icrs_to_cam(sent)
        found.append(
            UnderConvention(convention, q, None if shown is None else angle_between_rad(q, shown))
        )
    if shown is None:
        return found
    nearest, *others = sorted(found, key=lambda each: each.off_rad or 0.0)
    off, next_off = (
        nearest.off_rad or 0.0,
        min((other.off_rad or 0.0 for other in others), default=np.pi),
    )
    certain = off < NEAR_RAD and next_off > APART * off
    return [replace(each, matches=certain and each is nearest) for each in found]


def hex_line(raw: bytes) -> str:
    """The first MAX_SHOWN_BYTES bytes in hexadecimal, and the number of bytes where there are
    more.
    """
    if len(raw) > MAX_SHOWN_BYTES:
        more = f" ... ({len(raw)} bytes)"
    else:
        more = ""
    return raw[:MAX_SHOWN_BYTES].hex(" ") + more


def byte_lines(raw: bytes, decoder: AnswerDecoder) -> list[str]:
    """Lines of text that show which bytes of an answer became the checksum and each field; the
    raw bytes or text alone for a format without declared fields.
    """
    settings = decoder.settings
    if settings.format != "frame":
        text = raw[:1] in {b"{", b" "}
        return [
            f"  {printable(shortened(raw.decode(errors='replace'))) if text else hex_line(raw)}"
        ]
    lines = [f"  {hex_line(raw)}"]
    if settings.checksum != "none" and raw:
        _, size = CHECKSUMS[settings.checksum]
        at = (-size if settings.checksum_at is None else settings.checksum_at) % len(raw)
        checksum_text = decoder.frames.fault(raw) or f"{settings.checksum}, right"
        lines.append(
            f"  bytes {at:3} to {at + size - 1:3}  {raw[at : at + size].hex(' '):<24} checksum:"
            f" {checksum_text}"
        )
    for field in sorted(settings.fields, key=lambda field: field.at):
        _, size, _ = field_format(field.type) or ("u", 1, False)
        part = raw[field.at : field.at + size]
        try:
            value = f"{decoder.frames.value(raw, field):.12g}"
        except IndexError as error:
            value = f"beyond the frame ({error})"
        by = "".join(
            f", {name} {number:.12g}"
            for name, number in (("x", field.scale), ("+", field.add))
            if number != (name == "x")
        )
        span = f"{field.at:3} to {field.at + size - 1:3}"
        lines.append(
            f"  bytes {span}  {part.hex(' '):<24} {field.name:<5} = {value}  ({field.type}{by})"
        )
    return lines


def lines_of(
    found: Answer | RefusedAnswer, decoder: AnswerDecoder, shown: FloatArray | None
) -> list[str]:
    """The explanation of an answer or a refusal, as lines of text: its bytes, its attitude under
    every convention, and what to write in the bench file. `shown` as in `under_conventions`.
    """
    if isinstance(found, RefusedAnswer):
        if found.reason == "framing":
            return [f"  {hex_line(found.raw)}"]
        return byte_lines(found.raw, decoder)
    readings = under_conventions(found, decoder, shown)
    lines = [*byte_lines(found.raw, decoder), *(reading.line() for reading in readings)]
    matching = next((reading for reading in readings if reading.matches), None)
    if matching is not None:
        found_as = matching.convention
        form = decoder.settings.format
        # In a frame the field names say which number is the scalar: `[answers]` refuses "last".
        scalar = "first" if form == "frame" else found_as.scalar
        written = msgspec.structs.replace(found_as, scalar=scalar)
        is_own = found_as == decoder.sent.convention
        lines.append(
            "  the bench file's convention matches"
            if is_own
            else f"  write [answers] convention = {written}"
        )
        if form == "frame" and found_as.scalar == "last":
            lines.append(
                "  and name its four fields qx, qy, qz, qw in the order in which they now are qw,"
                " qx, qy, qz"
            )
    elif shown is not None and readings:
        lines.append(
            "  no convention matches what is shown: is it another sky, another mounting, or a"
            " mirrored frame?"
        )
    return lines
