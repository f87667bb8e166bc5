"""A socket filter in the kernel (classic BPF): what other addresses send costs neither the socket's buffer nor a read.

Linux, Documentation/networking/filter.rst: a program of (code, jump if true, jump if false, operand). The source address lies
at a fixed place of the IP header, which a filter of a UDP socket reaches through SKF_NET_OFF.
"""

from __future__ import annotations

import ctypes
import socket
import struct
from collections.abc import Sequence

from hilstar.attitude.wire.udp.addresses import Network

SO_ATTACH_FILTER = 26  # asm-generic/socket.h
SKF_NET_OFF = 0xFFF00000
SOURCE_AT = {4: 12, 6: 8}  # in the IP header
WORD_BYTES = 4
LOAD_WORD, AND, JUMP_IF_EQUAL, RETURN = 0x20, 0x54, 0x15, 0x06
WHOLE, NOTHING = 0xFFFF, 0
INSTRUCTION = struct.Struct("=HBBI")
MAX_INSTRUCTIONS = 4096


def program(networks: Sequence[Network], version: int) -> bytes:
    """The program that keeps what comes from these networks, all of that IP version, and drops the rest."""
    code = b"".join(_keep(network, SOURCE_AT[version]) for network in networks if network.version == version)
    return code + INSTRUCTION.pack(RETURN, 0, 0, NOTHING)


def _keep(network: Network, source_at: int) -> bytes:
    """Return the whole datagram where the source address lies in the network; go on after this otherwise."""
    address, mask = network.network_address.packed, network.netmask.packed
    words = range(0, len(address), WORD_BYTES)
    left = 3 * len(words) + 1
    code = []
    for at in words:
        wanted, bits = (int.from_bytes(each[at : at + WORD_BYTES], "big") for each in (address, mask))
        left -= 3
        code.append(INSTRUCTION.pack(LOAD_WORD, 0, 0, SKF_NET_OFF + source_at + at))
        code.append(INSTRUCTION.pack(AND, 0, 0, bits))
        code.append(INSTRUCTION.pack(JUMP_IF_EQUAL, 0, left, wanted))
    return b"".join([*code, INSTRUCTION.pack(RETURN, 0, 0, WHOLE)])


def keep_only(receiving: socket.socket, networks: Sequence[Network]) -> bool:
    """Have the kernel drop what comes from anywhere else; False where it does not take the filter."""
    code = program(networks, 6 if receiving.family == socket.AF_INET6 else 4)
    count = len(code) // INSTRUCTION.size
    if count > MAX_INSTRUCTIONS:
        return False
    kept = ctypes.create_string_buffer(code, len(code))
    try:
        receiving.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, struct.pack("@HP", count, ctypes.addressof(kept)))
    except OSError:
        return False
    return True
