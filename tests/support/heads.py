"""Files of several heads: one small bench each, mounted at right angles."""

from __future__ import annotations

from pathlib import Path

from tests.support.benches import Tables, bench_text

MOUNTINGS = {
    "a": (1.0, 0.0, 0.0, 0.0),
    "b": (0.7071067811865476, 0.0, 0.7071067811865476, 0.0),
    "c": (0.5, -0.5, -0.5, -0.5),
}


def heads_file(folder: Path, port: int, *changes: Tables) -> Path:
    """A file with three heads that listen to one port of this machine."""
    for name, q in MOUNTINGS.items():
        own: Tables = {"tracker": {"q_body_to_cam": list(q)}, "render": {"quantisation": "round"}}
        (folder / f"{name}.toml").write_text(bench_text(own, *changes))
    path = folder / "heads.toml"
    names = ", ".join(f'"{name}.toml"' for name in MOUNTINGS)
    path.write_text(f'heads = [{names}]\n[attitude]\nendpoint = "tcp://127.0.0.1:{port}"\n')
    return path
