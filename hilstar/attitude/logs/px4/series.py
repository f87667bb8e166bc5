"""A topic of a PX4 log as arrays: its times, and values at the times of another topic."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hilstar.arrays import FloatArray
from hilstar.attitude.logs.px4.sieve import ADVICE, Sieved, Topic
from hilstar.errors import InputError, shortened

IntArray = npt.NDArray[np.int64]
MAX_TIME_US = 2**53  # 285 years: what a boot clock never shows
GAP_INTERVALS = 5  # of the usual interval: farther from both neighbours, a value is unknown


class Series(NamedTuple):
    """The columns of one topic, by the names of its fields (`q[0]`), each (n,); `t_us` is the boot clock, microseconds."""

    t_us: IntArray
    columns: dict[str, npt.NDArray[Any]]

    def stacked(self, name: str, count: int) -> FloatArray | None:
        """The fields `name[0]`, `name[1]`, ... as (n, count); None where one is missing."""
        names = [f"{name}[{i}]" for i in range(count)]
        if not all(each in self.columns for each in names):
            return None
        return np.stack([np.asarray(self.columns[each], dtype=np.float64) for each in names], axis=1)

    def where(self, good: npt.NDArray[np.bool_]) -> Series:
        """Some of the rows."""
        return Series(self.t_us[good], {name: column[good] for name, column in self.columns.items()})


def read_series(path: Path, sieved: Sieved) -> dict[Topic, Series]:
    """Every topic that the sieved log has messages of. Raises InputError where pyulog reads none of it."""
    import pyulog

    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):  # pyulog prints what it thinks of a file
            log = pyulog.ULog(io.BytesIO(sieved.ulog))
    except Exception as error:  # pyulog passes on what struct, NumPy and its own tables raise
        raise InputError(f"{path}: pyulog does not read it ({shortened(error)}); {ADVICE}") from error
    if log.file_corruption:
        sieved.misfits = True
    series = {}
    for data in log.data_list:
        if "timestamp" in data.data:
            series[Topic(data.name, data.multi_id)] = Series(_times_us(path, data.data), data.data)
    return series


def _times_us(path: Path, columns: dict[str, npt.NDArray[Any]]) -> IntArray:
    """When the values were true: `timestamp_sample` where the topic has it, else when they were published."""
    published = columns["timestamp"].astype(np.uint64)
    sampled = columns.get("timestamp_sample", np.zeros(1)).astype(np.uint64)
    times = sampled if len(sampled) == len(published) and bool(np.all((sampled > 0) & (sampled <= published))) else published
    if len(times) and int(times.max()) > MAX_TIME_US:
        raise InputError(f"{path}: a time of {int(times.max())} microseconds since boot; the log is damaged")
    return times.astype(np.int64)


def at_times(series: Series, values: FloatArray, t_us: IntArray) -> FloatArray:
    """Values (n, k) at other times (m,), linear between samples; NaN outside of them and within gaps."""
    order = np.argsort(series.t_us, kind="stable")
    times, values = series.t_us[order], values[order]
    if len(times) < 2:
        return np.full((len(t_us), values.shape[1]), np.nan)
    found = np.stack([np.interp(t_us, times, column, left=np.nan, right=np.nan) for column in values.T], axis=1)
    after = np.clip(np.searchsorted(times, t_us), 1, len(times) - 1)
    interval = times[after] - times[after - 1]
    found[interval > GAP_INTERVALS * np.median(np.diff(times))] = np.nan
    return found
