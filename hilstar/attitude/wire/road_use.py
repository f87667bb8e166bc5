"""What a road of bytes is for: attitudes, or a tracker's answers."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RoadUse:
    """What a road is for, as its refusals and notices say it.

    `table` has its keys in a bench file; `where` stands before its endpoint in a refusal. `lost`,
    `back` and `second` are kinds of notices; `{endpoint}`, `{why}`, `{peer}`, `{host}` and
    `{holder}` stand in their lines.
    """

    table: str
    where: str
    lost: str
    lost_line: str
    back: str
    back_line: str
    second: str = "connections-refused"
    second_line: str = ""
