"""This process's memory and CPU time, second by second."""

from __future__ import annotations

import contextlib
import os
import resource
import time

from hilstar.run.record.ledger_records import ProcessRecord


class ProcessProbe:
    """Measures this process; opens its file once, because later no descriptor may be free."""

    def __init__(self) -> None:
        self._fd: int | None = None
        with contextlib.suppress(OSError):
            self._fd = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)

    def record(self) -> ProcessRecord | None:
        """The state now; None if the system does not say."""
        if self._fd is None:
            return None
        try:
            pages = int(os.pread(self._fd, 128, 0).split()[1])
        except (OSError, ValueError, IndexError):
            return None
        used = resource.getrusage(resource.RUSAGE_SELF)
        size = os.sysconf("SC_PAGE_SIZE")
        return ProcessRecord(host_ns=time.monotonic_ns(), resident_bytes=pages * size, cpu_s=used.ru_utime + used.ru_stime)

    def close(self) -> None:
        """Close its file."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None
