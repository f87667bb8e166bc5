"""ULogs of PX4: refused, with the way to bring one.

Their attitudes refer to a magnetometer's north, which is degrees off, and their dates and places
come from receivers that a reader would have to judge. The way of docs/sources.md states all three.
"""

from pathlib import Path
from typing import NoReturn

from hilstar.attitude.logs.entries import Stated
from hilstar.attitude.logs.log_formats import ALL_STATEMENTS, LogFormat
from hilstar.basics.errors import InputError

RECIPE = (
    "pip install pyulog; ulog2csv FILE; of the CSV of vehicle_attitude, write timestamp / 1e6 as"
    " t_s and q[0] to q[3] as qw,qx,qy,qz; then --convention frame=body,direction=cam_to_icrs"
    " --reference ned --place LAT,LON,HEIGHT --epoch-utc TIME (docs/sources.md, PX4)"
)


def _refuse(path: Path, stated: Stated) -> NoReturn:
    raise InputError(f"{path}: a ULog of PX4, which is not read; {RECIPE}")


log_format = LogFormat("a ULog of PX4", _refuse, uses=ALL_STATEMENTS, magic=(b"ULog\x01\x12\x35",))
