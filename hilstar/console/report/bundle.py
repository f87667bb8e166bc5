"""The page as one file: its style, its modules and a run's data inside, and a policy that lets nothing else in.

Modules become functions in one script, because a browser loads no module from a file beside a page that is a file itself. The
page's modules keep to what this reads: imports and exports that begin a line, by name, and no default.
"""

from __future__ import annotations

import base64
import hashlib
import re
import zlib
from pathlib import Path
from typing import Any

import msgspec

PAGE_DIR = Path(__file__).resolve().parent.parent / "page"
_import = re.compile(r'^import \{ ([^}]+) \} from "\./(\w+)\.js";\n', re.MULTILINE)
_export = re.compile(r"^export (?=(?:class|const|function) (\w+))", re.MULTILINE)
LINKS = re.compile(r'^<(?:link rel="(?:icon|stylesheet)"|script type="module").*\n', re.MULTILINE)


def one_script(entry: str, folder: Path = PAGE_DIR) -> str:
    """The module `entry` and all that it imports, as one script. Raises ValueError for an import that it does not know."""
    done: dict[str, str] = {}
    _take(entry, folder, done)
    return "".join(done.values())


def _take(name: str, folder: Path, done: dict[str, str]) -> None:
    text = (folder / f"{name}.js").read_text(encoding="utf-8")
    wanted = _import.findall(text)
    for _, other in wanted:
        if other not in done:
            _take(other, folder, done)
    body, names = _import.sub("", text), _export.findall(text)
    body = _export.sub("", body)
    if re.search(r"^(?:import|export)\b", body, re.MULTILINE):
        raise ValueError(f"{name}.js: an import or export that is not in one line with names in braces")
    takes = "".join(
        f"const {{ {', '.join(part.replace(' as ', ': ').split(', '))} }} = of_{other};\n" for part, other in wanted
    )
    done[name] = f"const of_{name} = (() => {{\n{takes}{body}return {{ {', '.join(names)} }};\n}})();\n"


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def report_page(data: dict[str, Any]) -> str:
    """The page with a run's data (see `run_data`), as HTML that needs no other file and no network."""
    html = (PAGE_DIR / "index.html").read_text(encoding="utf-8")
    style, script = (PAGE_DIR / "page.css").read_text(encoding="utf-8"), one_script("report")
    policy = (
        f"default-src 'none'; script-src {_hash(script)}; style-src {_hash(style)}; img-src data:; base-uri 'none'; "
        "form-action 'none'"
    )
    icon = _base64((PAGE_DIR / "icon.svg").read_bytes())
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        f'<link rel="icon" href="data:image/svg+xml;base64,{icon}">\n<style>{style}</style>\n'
    )
    packed = _base64(zlib.compress(msgspec.json.encode(data), 9))
    tail = f'<script type="text/plain" id="run-data">{packed}</script>\n<script type="module">{script}</script>\n'
    html = LINKS.sub("", html).replace('data-mode="live"', 'data-mode="report"')
    # The data come before the script that reads them, and both after the page's own text.
    return html.replace("</head>", f"{head}</head>").replace("</body>", f"{tail}</body>")
