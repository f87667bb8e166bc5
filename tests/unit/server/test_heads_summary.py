"""What a head printed at its end is somebody's bytes: no summary is said for what is none."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from hilstar.server.heads import _told
from tests.support.damage import NO_JSON


@pytest.mark.parametrize("output", NO_JSON)
def test_a_head_whose_output_is_no_json_has_no_summary(output):
    assert _told(SimpleNamespace(output=output, code=-9, restarts=2)) == {
        "exit_code": -9,
        "restarts": 2,
        "summary": None,
    }


def test_a_summary_is_told():
    assert _told(SimpleNamespace(output=b'{"frames": 3}\n', code=0, restarts=0))["summary"] == {
        "frames": 3
    }
