"""Whether a machine is well: by what is required alone."""

from __future__ import annotations

import pytest

from hilstar.server import doctor
from hilstar.server.doctor import Check


@pytest.mark.parametrize(
    ("there", "gpus", "is_ok"),
    [(True, True, True), (False, True, False), (True, False, False)],
)
def test_a_machine_is_well_where_all_that_is_required_is_there(monkeypatch, there, gpus, is_ok):
    """Neither a display nor a serial port nor a camera is required."""

    def look() -> str:
        if there:
            return "here"
        raise doctor.HilstarError("not here")

    monkeypatch.setattr(doctor, "LOOKS", {"python": look})
    monkeypatch.setattr(doctor, "displays", list)
    monkeypatch.setattr(doctor, "serial_ports", list)
    monkeypatch.setattr(doctor, "lit_outputs", list)
    monkeypatch.setattr(doctor, "_gpus", lambda: Check("gpus", gpus, ""))
    monkeypatch.setattr(doctor, "_cameras", lambda: Check("cameras", False, "", required=False))
    found = doctor.examine()
    assert found.ok is is_ok
    oks = {check.name: (check.ok, check.required) for check in found.checks}
    assert oks == {
        "python": (there, True),
        "gpus": (gpus, True),
        "display": (False, False),
        "serial": (False, False),
        "cameras": (False, False),
    }
