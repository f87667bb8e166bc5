"""Epochs of an AEM: calendar or day-of-year text to nanoseconds, and back."""

from __future__ import annotations

import re
from datetime import date, timedelta
from functools import lru_cache

from hilstar.attitude.logs.aem.blocks import AemFaultError
from hilstar.units import NS_PER_S

DAY_NS = 86_400 * NS_PER_S
UNIX_DAY = date(1970, 1, 1).toordinal()
EPOCH = re.compile(r"(\d{4}-(?:\d\d-\d\d|\d{3}))T(\d\d):(\d\d):(\d\d)(?:\.(\d+))?Z?", re.ASCII)


def epoch_ns(where: str, text: str) -> int:
    """Nanoseconds from 1970-01-01T00:00:00 to an epoch (calendar or day-of-year form), rounded; every day has 86400 s.

    A leap second 23:59:60 is the next day's 00:00:00. Raises AemFaultError.
    """
    match = EPOCH.fullmatch(text)
    day = _day(match[1]) if match else None
    if match is None or day is None or not _is_time(*(int(match[i]) for i in (2, 3, 4))):
        wanted = "write YYYY-MM-DDThh:mm:ss.f or YYYY-DDDThh:mm:ss.f"
        raise AemFaultError(where, f"the epoch is {text[:40]!r}; {wanted}")
    digits = (match[5] or "").ljust(10, "0")
    seconds = 3600 * int(match[2]) + 60 * int(match[3]) + int(match[4])
    return day * DAY_NS + seconds * NS_PER_S + int(digits[:9]) + (digits[9] >= "5")


def _is_time(hours: int, minutes: int, seconds: int) -> bool:
    return hours < 24 and minutes < 60 and (seconds < 60 or (hours, minutes, seconds) == (23, 59, 60))


@lru_cache(maxsize=1024)
def _day(text: str) -> int | None:
    """Days from 1970-01-01 to YYYY-MM-DD or YYYY-DDD, or None when the calendar has no such day."""
    year, first, *second = map(int, text.split("-"))
    try:
        day = date(year, first, second[0]) if second else date(year, 1, 1) + timedelta(days=first - 1)
    except (ValueError, OverflowError):
        return None
    return day.toordinal() - UNIX_DAY if day.year == year else None


def epoch_text(t_ns: int) -> str:
    """The calendar form of `t_ns` with all nine digits; exact for every 64-bit value."""
    day, ns = divmod(t_ns, DAY_NS)
    seconds, ns = divmod(ns, NS_PER_S)
    clock = f"{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}.{ns:09}"
    return f"{date.fromordinal(UNIX_DAY + day).isoformat()}T{clock}"
