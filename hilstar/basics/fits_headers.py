"""What a FITS header says of its image: exposure, time, mosaic and order of rows.

Keywords are those of the FITS standard 4.0 (section 9, time coordinates), and those that cameras'
software writes: MaxIm DL, INDI, N.I.N.A., ASIAIR, Siril. An image in an extension inherits what
only the primary header says, unless its own INHERIT is F. What is said and not used is a note.
"""

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.errors import InputError, shortened
from hilstar.basics.image_files import opened_fits
from hilstar.basics.units import NS_PER_S

# Seconds, the first that a header has is taken; where a comment names a unit, that counts.
EXPOSURE_KEYS = (
    *("EXPTIME", "EXPOSURE", "XPOSURE", "TEXPOSUR", "EXP_TIME", "EXP-TIME", "EXPTIME1"),
    *("EXPOSED", "ITIME", "ONTIME", "ELAPTIME", "EXP", "TEXP", "T_EXP", "INTTIME", "INT_TIME"),
    *("EXPOS", "EXPT", "EXPSEC", "TM-EXPOS", "EXPOSURE TIME", "EXPOSURETIME", "ESO DET DIT"),
)
MICROSECOND_KEYS = ("EXPOINUS",)
MILLISECOND_KEYS = ("EXPMS", "EXPOINMS", "EXP_MS", "EXP-MS")
# What other keywords of an exposure are called; they are named where none that is known is there.
LIKE_AN_EXPOSURE = re.compile(r".*(?:EXP|INTEGR|SHUT|FRAMETIM)|TELAPSE|LIVETIME|DARKTIME")
SECONDS_OF_UNIT = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millisec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "usecs", "microsec"), 1e-6),
    **dict.fromkeys(("microsecond", "microseconds", "\u00b5s"), 1e-6),
    **dict.fromkeys(("min", "minute", "minutes"), 60.0),
}
MAX_EXPOSURE_S = 1e6
MAX_NAMED = 4  # keywords in a note
SAME_EXPOSURE = 1e-3  # share by which two keywords may differ, as one of them is rounded

START, MIDDLE, END = "start", "middle", "end"
DATE_KEYS = {
    "DATE-AVG": MIDDLE,
    "DATE-MID": MIDDLE,
    "DATE_MID": MIDDLE,
    "DATEMID": MIDDLE,
    "DATE-BEG": START,
    "DATE-OBS": START,
    "DATE_OBS": START,
    "OBSDATE": START,
    "OBS-DATE": START,
    "DATE-STA": START,
    "DATETIME": START,
    "DATE-END": END,
}
# Beside a date without a time; those of UT before those that may be local.
TIME_KEYS = (
    *("TIME-OBS", "TIME_OBS", "UTC-OBS", "UT-OBS", "UTSTART", "UTCSTART", "UT", "UTC"),
    *("OBSSTART", "TIME-BEG", "UTC-BEG", "UTC-STA", "UTSHUT", "UTIME", "TIMEOBS", "TIME"),
)
MJD_KEYS = {
    "MJD-AVG": MIDDLE,
    "MJD-MID": MIDDLE,
    "MJD-BEG": START,
    "MJD-OBS": START,
    "MJD-END": END,
}
# Days of other scales and places, seconds, and dates of which it is not known what they date.
LIKE_A_TIME = re.compile(r"[HMB]?JD\b.*|JULIAN.*|UNIX.*|GPS.*|.*UTC.*|.*DATE.*")
# The date of the file, and the one at the observer's clock.
OTHER_DATES = frozenset({"DATE", "DATE-LOC"})
NO_DATE = "is no date such as 2024-03-01T20:00:00, and is not used"
MJD_OF_1970, SECONDS_A_DAY = 40587, 86400
UTC_NAMES = frozenset({"", "UTC", "UT", "UT1", "GMT", "Z", "ZULU", "UTC(NTP)"})
# Scales that are a known time from UTC: Astropy's name, and seconds to add first.
SCALES = {
    "TAI": ("tai", 0.0),
    "TT": ("tt", 0.0),
    "TDT": ("tt", 0.0),
    "ET": ("tdb", 0.0),
    "TDB": ("tdb", 0.0),
    "GPS": ("tai", 19.0),
}
CLOCK, ZONE = r"\d\d:\d\d(?::\d\d(?:\.\d*)?)?", r"Z|UTC?|[+-]\d\d:?\d\d"
DATE_TIME = re.compile(rf"(\d{{4}}-\d\d-\d\d)(?:[T ]({CLOCK}) ?({ZONE})?)?")
OLD_DATE = re.compile(r"(\d\d)/(\d\d)/(\d\d)")  # of the standard before 2000: days of 19yy
TIME_OF_DAY = re.compile(r"(\d\d?)[:h ](\d\d?)(?:[:m ](\d\d?(?:\.\d*)?)s?)?")
LOCAL = re.compile(r"\blocal\b|\bcivil\b", re.IGNORECASE)
UNIT_IN_COMMENT = re.compile(r"[\[(] *([a-z\u00b5]+) *[\])]|\bin ([a-z]+)\b", re.IGNORECASE)
# Units that are no other word of a comment, so that they need no brackets.
PLAIN_UNITS = re.compile(
    r"\b(ms|us|\u00b5s|[mu]secs?|milli-?sec(?:ond)?s?|micro-?sec(?:ond)?s?)\b",
    re.IGNORECASE,
)
NUMBER_WITH_UNIT = re.compile(r"([-+0-9.eE]+) *([a-z\u00b5]*)", re.IGNORECASE)

PATTERN_KEYS = ("BAYERPAT", "BAYRPAT", "BAYERPATTERN", "CFAPAT", "CFA-PAT", "CFATYPE")
VAGUE_PATTERN_KEYS = (
    "COLORTYP",
    "FILTER",
)  # hold a pattern in some software, another word in other
PATTERNS = frozenset({"RGGB", "BGGR", "GRBG", "GBRG"})
NO_PATTERN = frozenset(
    {"", "NONE", "NO", "N/A", "MONO", "MONOCHROME", "GREY", "GRAY", "FALSE", "F", "0"}
)
# GenICam's names (BayerRG12, SRGGB10) have the first two colours, or all, and the bits.
SHORT_PATTERNS = {"RG": "RGGB", "BG": "BGGR", "GR": "GRBG", "GB": "GBRG"}
MAKERS_PATTERN = re.compile(r"(?:BAYER|S)?([RGB]{2,4})\d{0,2}P?")
OFFSET_KEYS = (("XBAYROFF", "BAYOFFX", "XBAYOFF"), ("YBAYROFF", "BAYOFFY", "YBAYOFF"))
BINNING_KEYS = ("XBINNING", "YBINNING")
TOP_DOWN, BOTTOM_UP = "TOP-DOWN", "BOTTOM-UP"
PATTERN_ADVICE = "write RGGB, BGGR, GRBG or GBRG, or give one colour's pixels as a grey image"


@dataclass(frozen=True, slots=True)
class FitsImage:
    """An image (height, width, or more axes), its first row at the top, and what its header says.

    `t_ns` is the UTC of the middle of the exposure, ns since 1970; `bayer` the colours of the first
    two rows of pixels as four letters, "" for a grey image. `header` has what is inherited, too.
    """

    pixels: npt.NDArray[Any]
    header: Any
    exposure_s: float | None
    t_ns: int | None
    bayer: str
    notes: tuple[str, ...]


def read_fits_image(data: bytes, size_px: tuple[int, int] | None = None) -> FitsImage:
    """The first image of a FITS file's bytes, packed by gzip or fpack or not.

    Raises InputError for what it says and cannot be; ImageSizeError, and whatever Astropy does.
    """
    with opened_fits(data, size_px) as hdus:
        images = [hdu for hdu in hdus if hdu.is_image and hdu.data is not None]
        if not images:
            raise InputError("has no image; give a FITS file of one")
        image = images[0]
        header = _with_inherited(image.header, hdus[0].header)
        pixels = np.asarray(image.data)
        _refuse_blank(pixels, header)
    notes: list[str] = []
    if len(images) > 1:
        notes.append(f"holds {len(images)} images, of which the first is taken")
    exposure_s = _exposure_s(header, notes)
    t_ns = _middle_ns(header, exposure_s, notes)
    if _row_order(header) == BOTTOM_UP:
        pixels = np.flip(pixels, axis=-2)
    bayer = _bayer(header, notes)
    binned = [key for key in _stated(header, BINNING_KEYS) if str(header[key]).strip() != "1"]
    if bayer and binned:
        mixed = "a binned mosaic may mix colours; give frames that are not binned"
        notes.append(f"{binned[0]} = {shortened(header[binned[0]])}: {mixed}")
    return FitsImage(pixels, header, exposure_s, t_ns, bayer, tuple(notes))


def _with_inherited(own: Any, primary: Any) -> Any:
    """The header, with those keywords of the primary one that it lacks."""
    if own is primary or own.get("INHERIT") in (False, "F"):
        return own
    whole = own.copy()
    for card in primary.cards:
        is_known = card.keyword in own or card.keyword in {"COMMENT", "HISTORY", ""}
        if not is_known:
            whole.append(card, end=True)
    return whole


def _refuse_blank(pixels: npt.NDArray[Any], header: Any) -> None:
    """Pixels without a value: Astropy makes them NaN but for unsigned numbers, which it leaves, and
    whose BSCALE is 1.
    """
    blank = header.get("BLANK")
    if blank is None or pixels.dtype.kind not in "iu":
        return
    level = blank + header.get("BZERO", 0)
    count = int((pixels == level).sum())
    if count:
        raise InputError(f"{count} pixels have no value (BLANK = {blank}); give a whole raw frame")


def _stated(header: Any, keys: Iterable[str]) -> Iterator[str]:
    """The keywords, of those given, to which a header gives a value."""
    for key in keys:
        value = header.get(key)
        if value is not None and str(value).strip():
            yield key


def _exposure_s(header: Any, notes: list[str]) -> float | None:
    keys = (*EXPOSURE_KEYS, *MILLISECOND_KEYS, *MICROSECOND_KEYS)
    seconds: dict[str, float] = {}
    for key in _stated(header, keys):
        value_s = _seconds(key, header[key], header.comments[key])
        if value_s is None:
            stated = f"{key} = {shortened(header[key])}"
            notes.append(f"{stated} is no exposure in seconds, and is not used")
        else:
            seconds[key] = value_s
    if not seconds:
        others = []
        for card in header.cards:
            is_number = isinstance(card.value, int | float) and not isinstance(card.value, bool)
            if is_number and LIKE_AN_EXPOSURE.match(card.keyword):
                others.append(card.keyword)
        if others and not notes:
            named = ", ".join(others[:MAX_NAMED])
            notes.append(f"{named} is no keyword of an exposure that is known; write EXPTIME, s")
        return None
    first, exposure_s = next(iter(seconds.items()))
    for key, other_s in seconds.items():
        if abs(other_s - exposure_s) > SAME_EXPOSURE * max(exposure_s, other_s):
            notes.append(f"{first} says {exposure_s:g} s and {key} {other_s:g} s: {first} is taken")
    return exposure_s


def _seconds(key: str, value: Any, comment: str) -> float | None:
    """An exposure in seconds, by the unit beside the number, in the comment, or of the keyword."""
    match = NUMBER_WITH_UNIT.fullmatch(str(value).strip())
    if match is None or isinstance(value, bool):
        return None
    try:
        number = float(match[1])
    except ValueError:
        return None
    unit_s: float | None = 1.0
    if key in MICROSECOND_KEYS:
        unit_s = 1e-6
    elif key in MILLISECOND_KEYS:
        unit_s = 1e-3
    else:
        unit_s = _unit_of_comment(comment)
    if match[2]:
        unit_s = SECONDS_OF_UNIT.get(match[2].lower())
    if unit_s is None or not 0 <= number * unit_s <= MAX_EXPOSURE_S:
        return None
    return number * unit_s


def _unit_of_comment(comment: str) -> float:
    for match in UNIT_IN_COMMENT.finditer(comment):
        unit_s = SECONDS_OF_UNIT.get((match[1] or match[2]).lower())
        if unit_s is not None:
            return unit_s
    plain = PLAIN_UNITS.search(comment)
    if plain is None:
        return 1.0
    return SECONDS_OF_UNIT[plain[1].lower().replace("-", "")]


def _middle_ns(header: Any, exposure_s: float | None, notes: list[str]) -> int | None:
    """The UTC of the exposure's middle, of the first keyword that tells it."""
    moments: list[tuple[str, str, int]] = []
    for key, role, utc_at_ns in _moments(header, notes):
        moments.append((key, role, utc_at_ns))
    if not moments:
        return None
    half_ns = round((exposure_s or 0.0) / 2 * NS_PER_S)
    shift_ns = {START: half_ns, MIDDLE: 0, END: -half_ns}
    by_role = {role: (key, utc_at_ns) for key, role, utc_at_ns in reversed(moments)}
    key, role, utc_at_ns = moments[0]
    if MIDDLE not in by_role and exposure_s is None:
        if START in by_role and END in by_role:
            # Start and end tell the middle without any exposure.
            return (by_role[START][1] + by_role[END][1]) // 2
        notes.append(f"no exposure is known: {key}, its {role}, is taken for its middle")
    middle_ns = utc_at_ns + shift_ns[role]
    for other, other_role, other_ns in moments[1:]:
        off_s = (other_ns + shift_ns[other_role] - middle_ns) / NS_PER_S
        if abs(off_s) > 1 + (exposure_s or 0.0) / 2:
            notes.append(f"{other} is {off_s:.6g} s off {key}, which is taken")
    return middle_ns


def _moments(header: Any, notes: list[str]) -> Iterator[tuple[str, str, int]]:
    """Keywords with a moment: of the start, middle or end, and the UTC, ns since 1970."""
    count = len(notes)
    moments = [*_of_dates(header, notes), *_of_days(header, notes)]
    stated = list(_stated(header, DATE_KEYS))
    is_explained = len(notes) > count
    if stated and not moments and not is_explained:
        date = f"{stated[0]} = {shortened(header[stated[0]])}"
        notes.append(f"{date} tells no time of day, nor does another keyword: undated")
    elif not stated and not moments and not is_explained:
        _tell_other_times(header, notes)
    yield from moments


def _tell_other_times(header: Any, notes: list[str]) -> None:
    """Name the keywords that look like a time of the exposure, where none that is known is
    there.
    """
    others = []
    for card in header.cards:
        has_value = card.value is not None and str(card.value).strip()
        if has_value and LIKE_A_TIME.fullmatch(card.keyword) and card.keyword not in OTHER_DATES:
            others.append(card.keyword)
    if others:
        named = ", ".join(others[:MAX_NAMED])
        notes.append(f"{named} is no keyword of a time that is known: undated; write DATE-OBS")


def _scale(header: Any) -> str:
    return str(header.get("TIMESYS", "")).strip().upper()


def _of_dates(header: Any, notes: list[str]) -> Iterator[tuple[str, str, int]]:
    for key in _stated(header, DATE_KEYS):
        naive_ns, offset_s = _date_time(key, header, notes)
        if naive_ns is None:
            continue
        comment = header.comments[key]
        is_local = LOCAL.search(comment) is not None
        scale = "LOCAL" if is_local else _scale(header)
        utc_at_ns = _utc_ns(naive_ns, offset_s, scale)
        if utc_at_ns is None:
            clock = "local time" if is_local else scale
            notes.append(f"{key} is in {clock}, which is no known time from UTC: undated")
            continue
        yield key, _role(DATE_KEYS[key], comment), utc_at_ns


def _of_days(header: Any, notes: list[str]) -> Iterator[tuple[str, str, int]]:
    """Modified Julian days; a float64 has one of this age to 1 us."""
    for key in _stated(header, MJD_KEYS):
        try:
            days = float(header[key])
        except (TypeError, ValueError):
            days = math.nan
        utc_at_ns = None
        if days > 0:
            naive_ns = round((days - MJD_OF_1970) * SECONDS_A_DAY * 1e6) * 1000
            utc_at_ns = _utc_ns(naive_ns, None, _scale(header))
        if utc_at_ns is None:
            notes.append(f"{key} = {shortened(header[key])} is no date of UTC, and is not used")
            continue
        yield key, MJD_KEYS[key], utc_at_ns


def _role(role: str, comment: str) -> str:
    """Whether a time is that of the exposure's begin, middle or end: `role`, unless the keyword's
    comment says otherwise, as some programs' do.
    """
    text = comment.lower()
    if "mid" in text:
        return MIDDLE
    if "end of" in text:
        return END
    return role


def _date_time(key: str, header: Any, notes: list[str]) -> tuple[int | None, float | None]:
    """A moment, ns since 1970 in its own scale, and s that it is ahead of UTC, if it says so."""
    text = str(header[key]).strip()
    match = DATE_TIME.fullmatch(text)
    old = OLD_DATE.fullmatch(text)
    if match is None and old is None:
        notes.append(f"{key} = {shortened(text)} {NO_DATE}")
        return None, None
    if old is not None:
        date = f"19{old[3]}-{old[2]}-{old[1]}"
        time = None
        zone = None
    else:
        assert match is not None
        date = match[1]
        time = match[2]
        zone = match[3]
    if time is None:
        time = _time_beside(key, header)
    if time is None:
        return None, None
    naive_ns = utc_ns(f"{date}T{time}")
    if naive_ns is None:
        notes.append(f"{key} = {shortened(text)} {NO_DATE}")
    return naive_ns, _ahead_s(zone)


def _time_beside(key: str, header: Any) -> str | None:
    """The time of day in a keyword of its own, beside a date of the exposure's start."""
    if DATE_KEYS[key] != START:
        return None
    for name in _stated(header, TIME_KEYS):
        match = TIME_OF_DAY.fullmatch(str(header[name]).strip())
        if match is not None:
            return f"{int(match[1]):02}:{int(match[2]):02}:{float(match[3] or 0):012.9f}"
    return None


def _ahead_s(zone: str | None) -> float | None:
    if zone is None:
        return None
    if zone[0] not in "+-":
        return 0.0
    digits = zone[1:].replace(":", "")
    ahead_s = int(digits[:2]) * 3600 + int(digits[2:]) * 60
    return float(-ahead_s if zone[0] == "-" else ahead_s)


def _utc_ns(naive_ns: int, ahead_s: float | None, scale: str) -> int | None:
    """UTC, ns since 1970, of a moment in a scale; None for one not known from UTC."""
    if ahead_s is not None:
        return naive_ns - round(ahead_s * NS_PER_S)
    if scale in UTC_NAMES:
        return naive_ns
    if scale not in SCALES:
        return None
    from astropy.time import Time

    name, further_s = SCALES[scale]
    at = np.datetime64(naive_ns, "ns") + np.timedelta64(round(further_s * NS_PER_S), "ns")
    utc = Time(str(at), format="isot", scale=name, precision=9).utc
    return utc_ns(str(utc.isot))


def utc_ns(text: str) -> int | None:
    """A UTC as ns since 1970 of days of 86400 s; None where it is none."""
    match = DATE_TIME.fullmatch(text)
    if match is None or (match[3] or "Z") != "Z":
        return None
    try:
        return int(np.datetime64(text.rstrip("Z").replace(" ", "T"), "ns").astype(np.int64))
    except (ValueError, OverflowError):
        return None


def _row_order(header: Any) -> str:
    """Which row comes first in the file.

    Cameras' software writes the top one, where it does not say.
    """
    text = str(header.get("ROWORDER", TOP_DOWN)).strip().upper() or TOP_DOWN
    if text not in {TOP_DOWN, BOTTOM_UP}:
        raise InputError(f"ROWORDER is {shortened(text)}; write {TOP_DOWN} or {BOTTOM_UP}")
    return text


def _bayer(header: Any, notes: list[str]) -> str:
    """The mosaic's pattern from its top left pixel, "" for none. Raises InputError for others.

    Of pixel (row, column) the colour is pattern[(row + YBAYROFF) % 2][(column + XBAYROFF) % 2],
    rows from the top (MaxIm DL, INDI; CCDciel and Siril for ROWORDER).
    """
    pattern = ""
    for key in _stated(header, PATTERN_KEYS):
        pattern = _pattern(key, header[key])
        break
    else:
        for key in _stated(header, VAGUE_PATTERN_KEYS):
            text = str(header[key]).strip().upper()
            pattern = pattern or (text if text in PATTERNS else "")
    pattern = pattern or _pattern_elsewhere(header, notes)
    if not pattern:
        return ""
    x, y = (_offset(header, keys) for keys in OFFSET_KEYS)
    letters = []
    for row in (0, 1):
        for column in (0, 1):
            letters.append(pattern[(row + y) % 2 * 2 + (column + x) % 2])
    return "".join(letters)


def _pattern_elsewhere(header: Any, notes: list[str]) -> str:
    """The pattern that a keyword of another name has; "" where a known one says that there is
    none.
    """
    if any(_stated(header, PATTERN_KEYS)):
        return ""
    for card in header.cards:
        text = str(card.value).strip().upper()
        if text in PATTERNS:
            notes.append(f"{card.keyword} = {text} is taken for the mosaic's pattern")
            return text
    return ""


def _pattern(key: str, value: Any) -> str:
    text = re.sub(r"[^A-Z0-9/]", "", str(value).upper())
    maker = MAKERS_PATTERN.fullmatch(text.replace("/", ""))
    if maker is None:
        letters = ""
    else:
        letters = SHORT_PATTERNS.get(maker[1], maker[1])
    if letters in PATTERNS:
        return letters
    if text not in NO_PATTERN:
        mosaic = f"{key} is {shortened(value)}: a mosaic of a kind that is not read"
        raise InputError(f"{mosaic}; {PATTERN_ADVICE}")
    return ""


def _offset(header: Any, keys: tuple[str, ...]) -> int:
    for key in _stated(header, keys):
        try:
            number = float(header[key])
        except (TypeError, ValueError):
            number = math.nan
        if not number.is_integer():
            raise InputError(f"{key} is {shortened(header[key])}; write a whole number of pixels")
        return int(number)
    return 0
