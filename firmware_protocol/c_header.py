"""hilstar_protocol.h: header_template.h with its constants, structs and codecs filled in."""

from __future__ import annotations

import re

from definition import FRAMING_BYTES, Field, Packet, Wire

C_TYPES = {
    "u8": "uint8_t",
    "u16": "uint16_t",
    "u32": "uint32_t",
    "i64": "int64_t",
    "f32": "float",
    "f64": "double",
}


def header(wire: Wire, template: str) -> str:
    """The C header."""
    sizes = [
        f"    case HILSTAR_KIND_{p.name.upper()}: return HILSTAR_{p.name.upper()}_BYTES;"
        for p in wire.packets
    ]
    parts = {
        "CONSTANTS": "\n".join(_c_constants(wire)),
        "STRUCTS": "\n\n".join(_c_struct(p) for p in wire.packets),
        "SIZES": "\n".join(sizes),
        "CODECS": "\n\n".join(_c_encode(p) + "\n\n" + _c_decode(p) for p in wire.packets),
    }
    return re.sub(r"@([A-Z]+)@", lambda match: parts[match[1]], template)


def _c_constants(wire: Wire) -> list[str]:
    longest = max(p.size for p in wire.packets)
    lines = [f"#define HILSTAR_VERSION {wire.version}", ""]
    for p in wire.packets:
        lines.append(f"/** {p.meaning[0].upper()}{p.meaning[1:]}. */")
        lines.append(f"#define HILSTAR_KIND_{p.name.upper()} {p.kind}")
        lines.append(f"#define HILSTAR_{p.name.upper()}_BYTES {p.size}")
    lines += [
        "",
        f"#define HILSTAR_LONGEST_PACKET {longest}",
        "/** On the wire, its COBS byte and its 0x00 among them. */",
    ]
    lines.append(f"#define HILSTAR_LONGEST_FRAME {longest + FRAMING_BYTES}")
    for group, bits in wire.bits.items():
        lines.append("")
        for k, bit in enumerate(bits):
            lines.append(f"/** {bit.meaning[0].upper()}{bit.meaning[1:]}. */")
            lines.append(f"#define HILSTAR_{group.upper()}_{bit.name.upper()} {1 << k}u")
    for number in wire.numbers:
        name = f"HILSTAR_{number.name.upper()}"
        field, bit = number.field, number.first_bit
        lines += ["", f"/** {number.meaning[0].upper()}{number.meaning[1:]}. */"]
        lines.append(f"#define {name}({field}) ((unsigned)({field}) >> {bit})")
        lines.append(f"/** The {field} that say it: add them to the others. */")
        lines.append(f"#define {name}_FLAGS({number.name}) ((unsigned)({number.name}) << {bit})")
        lines.append(f"#define HILSTAR_MAX_{number.name.upper()} {number.max}u")
    lines.append("")
    for limit in wire.limits:
        lines.append(f"/** {limit.meaning[0].upper()}{limit.meaning[1:]}. */")
        lines.append(f"#define HILSTAR_{limit.name.upper()} {limit.value!r}")
    return lines


def _c_struct(packet: Packet) -> str:
    lines = [
        f"/** {packet.name} ({packet.direction}, {packet.size} bytes): {packet.meaning}. */",
        "typedef struct {",
    ]
    for f in packet.variable:
        bits = f" (HILSTAR_{f.bits.upper()}_...)" if f.bits else ""
        lines.append(f"    /** {f.said}{bits} */")
        lines.append(f"    {C_TYPES[f.type]} {f.name}{f'[{f.count}]' if f.count > 1 else ''};")
    lines.append(f"}} hilstar_{packet.name};")
    return "\n".join(lines)


def _c_encode(packet: Packet) -> str:
    out = [f"/** Writes {packet.size} bytes to `out`. */"]
    out.append(
        f"static inline size_t hilstar_encode_{packet.name}(const hilstar_{packet.name} *in,"
        " uint8_t *out)"
    )
    out += ["{", *_c_index(packet)]
    for f in packet.fields:
        place = f"out + {f.offset}" if f.offset else "out"
        if f.crc:
            out.append(f"    hilstar_put({place}, hilstar_crc32(out, {f.offset}), {f.size});")
        elif f.value is not None:
            out.append(f"    hilstar_put({place}, {f.value}, {f.size});")
        else:
            out += _c_each(f, _c_put(f, place))
    return "\n".join([*out, f"    return {packet.size};", "}"])


def _c_put(f: Field, place: str) -> str:
    where, what = _c_element(f, place, f"in->{f.name}")
    if f.type == "f32":
        return f"hilstar_put_f32({where}, &{what});"
    value = (
        f"hilstar_bits_of_f64({what})"
        if f.type == "f64"
        else f"(uint64_t){what}"
        if f.type == "i64"
        else what
    )
    return f"hilstar_put({where}, {value}, {f.item_bytes});"


def _c_decode(packet: Packet) -> str:
    kind = f"HILSTAR_KIND_{packet.name.upper()}"
    out = [f"/** {kind}, or a negative error with `out` left unchanged. */"]
    arguments = f"const uint8_t *packet, size_t length, hilstar_{packet.name} *out"
    out.append(f"static inline int hilstar_decode_{packet.name}({arguments})")
    out += ["{", "    const int kind = hilstar_check(packet, length);", *_c_index(packet)]
    out += [f"    if (kind != {kind})", "        return kind < 0 ? kind : HILSTAR_ERROR_FORMAT;"]
    for f in packet.variable:
        out += _c_each(f, _c_get(f))
    return "\n".join([*out, "    return kind;", "}"])


def _c_get(f: Field) -> str:
    where, what = _c_element(f, f"packet + {f.offset}", f"out->{f.name}")
    if f.type == "f32":
        return f"hilstar_get_f32({where}, &{what});"
    raw = f"hilstar_get({where}, {f.item_bytes})"
    value = {"f64": f"hilstar_f64_of({raw})", "i64": f"hilstar_i64_of({raw})"}.get(
        f.type, f"({C_TYPES[f.type]}){raw}"
    )
    return f"{what} = {value};"


def _c_index(packet: Packet) -> list[str]:
    return ["    size_t i;"] if any(f.count > 1 for f in packet.variable) else []


def _c_element(f: Field, place: str, name: str) -> tuple[str, str]:
    return (f"{place} + {f.item_bytes} * i", f"{name}[i]") if f.count > 1 else (place, name)


def _c_each(f: Field, statement: str) -> list[str]:
    if f.count == 1:
        return [f"    {statement}"]
    return [f"    for (i = 0; i < {f.count}; i++)", f"        {statement}"]
