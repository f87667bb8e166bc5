"""Bytes that are no JSON, each for a reason of its own: msgspec does not raise one error for all
of them.
"""

from __future__ import annotations

NO_JSON = (
    b"\xff\xfe{}",
    b'{"\xff\xfe": 1}',
    b'{"kind": "\xc3\x28", "\xe2\x82": 1}',
    b"[" * 100_000,
    b'{"a":' * 100_000,
    b"{}}",
    b"",
    b"\0",
)
