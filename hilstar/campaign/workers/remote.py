"""What a cluster's worker is asked to do; each of its threads has a session, and a GL context, of its own."""

from __future__ import annotations

import threading

from hilstar.arrays import FloatArray
from hilstar.campaign.workers.identity import Identity
from hilstar.campaign.workers.session import Answered, Job, Session
from hilstar.errors import HilstarError

_here = threading.local()


def examine(job: Job) -> Identity | str:
    """What this worker is, or why it cannot do the job."""
    try:
        return _session(job).identity()
    except HilstarError as error:
        return str(error)


def run_task(job: Job, begin: int, points: FloatArray) -> Answered:
    """The rows of the cases from `begin` on at their points (n, dimensions)."""
    return _session(job).run(begin, points)


def _session(job: Job) -> Session:
    """This thread's session of a job; the one of an older job is closed."""
    session: Session | None = getattr(_here, "session", None)
    if session is None or session.job != job:
        _here.session = None
        if session is not None:
            session.close()
        session = _here.session = Session(job)
    return session
