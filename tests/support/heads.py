"""Files of several heads: one small bench each, mounted at right angles."""

from __future__ import annotations

from pathlib import Path

from tests.support.benches import Tables, bench_text

MOUNTINGS = {
    "a": (1.0, 0.0, 0.0, 0.0),
    "b": (0.7071067811865476, 0.0, 0.7071067811865476, 0.0),
    "c": (0.5, -0.5, -0.5, -0.5),
}


def heads_file(folder: Path, port: int, *changes: Tables, names: str = "abc") -> Path:
    """A file with heads of these names that listen to one port of this machine."""
    for name in names:
        q = MOUNTINGS[name]
        own: Tables = {"tracker": {"q_body_to_cam": list(q)}, "render": {"quantisation": "round"}}
        (folder / f"{name}.toml").write_text(bench_text(own, *changes))
    path = folder / "heads.toml"
    benches = ", ".join(f'"{name}.toml"' for name in names)
    path.write_text(f'heads = [{benches}]\n[attitude]\nendpoint = "tcp://127.0.0.1:{port}"\n')
    return path
