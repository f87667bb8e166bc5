"""What a run's page has in it."""

from __future__ import annotations

import base64
import json
import re
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt


def run_data_of(page: str) -> dict[str, Any]:
    """The data of a report's HTML."""
    found = re.search(r'id="run-data">([^<]+)<', page)
    assert found is not None
    return json.loads(zlib.decompress(base64.b64decode(found[1])))


def levels_of(picture: dict[str, Any]) -> npt.NDArray[np.unsignedinteger[Any]]:
    """The levels of one of its pictures, (height, width)."""
    data = zlib.decompress(base64.b64decode(picture["data"]))
    return np.frombuffer(data, dtype=f"<{picture['dtype']}").reshape(picture["h"], picture["w"])
