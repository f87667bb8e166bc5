"""What Basilisk's two links have in common: the parts of a SIM_UPDATE, and where it may come from."""

from __future__ import annotations

from hilstar.attitude.wire.endpoint import parse_endpoint
from hilstar.errors import InputError

SIM_UPDATE = b"SIM_UPDATE"
MAX_UPDATE_BYTES = 1 << 22  # settings, models and maps of a large scenario go along with its spacecraft


def update_of(parts: list[bytes]) -> bytes | None:
    """The VizMessage of a SIM_UPDATE: its last part, with nothing but empty ones between; None where it is not that."""
    whole = len(parts) > 1 and parts[0] == SIM_UPDATE and not any(parts[1:-1])
    return parts[-1] if whole else None


def check_loopback(endpoint: str) -> None:
    """Refuse (InputError) an endpoint that other machines reach: Basilisk has no keys."""
    place = parse_endpoint(endpoint)
    if place.loopback:
        return
    port = place.address.rpartition(":")[2]
    forward = f"ssh -L {port}:127.0.0.1:{port} HOST"
    raise InputError(
        f"{endpoint}: not an address of this machine alone, and Basilisk knows no keys; forward its port ({forward}) and"
        f" write tcp://127.0.0.1:{port}"
    )
