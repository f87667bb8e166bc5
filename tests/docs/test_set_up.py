"""What has to be installed to run the tests is the same in the README, in CONTRIBUTING and in
CI.
"""

from __future__ import annotations

import re
import sys
from importlib.metadata import PackageNotFoundError, packages_distributions, requires

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support.benches import ROOT

# a package that a file imports as it is loaded; to parse every file takes a second and a half
IMPORTED = re.compile(r"^(?:from|import) (\w+)", re.MULTILINE)
SCREENS_AND_BROWSERS = {"chromium", "chromium-driver", "xserver-xorg-core", "xvfb"}


def installed(text: str) -> set[str]:
    """The packages of every `apt-get install` in a text."""
    lines = re.findall(r"apt-get install((?: -\S+)*)((?: [a-z0-9][\w.+-]*)+)", text)
    return {package for _, packages in lines for package in packages.split()}


def test_readme_contributing_and_ci_install_what_their_tests_need():
    """README's tests need neither a screen nor a browser; CONTRIBUTING's need both, and CI's also
    other drivers.
    """
    command = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    readme = installed(command)
    contributing = installed((ROOT / "CONTRIBUTING.md").read_text())
    ci = installed((ROOT / ".ci" / "run").read_text())
    assert readme < contributing <= ci
    assert not readme & SCREENS_AND_BROWSERS
    assert contributing >= SCREENS_AND_BROWSERS


# a plugin for tools/mutants.py, which says what it needs; README's command does not load it
NO_TEST = ROOT / "tests" / "support" / "line_map.py"


def installed_by(distribution: str, extras: frozenset[str], known: set[str]) -> None:
    """Add what pip installs with a distribution and these extras of it to `known`."""
    try:
        requirements = requires(distribution) or []
    except PackageNotFoundError:  # of another system
        return
    for text in requirements:
        requirement = Requirement(text)
        marker = requirement.marker
        if marker is not None and not any(
            marker.evaluate({"extra": extra}) for extra in (*extras, "")
        ):
            continue
        name = canonicalize_name(requirement.name)
        asked = f"{name}[{','.join(sorted(requirement.extras))}]"
        if asked not in known:
            known |= {name, asked}
            installed_by(name, frozenset(requirement.extras), known)


def test_readme_s_command_installs_what_its_tests_import():
    known: set[str] = set()
    installed_by("hilstar", frozenset({"test"}), known)
    distributions = packages_distributions()
    missing = []
    for path in sorted((ROOT / "tests").rglob("*.py")):
        if path == NO_TEST:
            continue
        for top in IMPORTED.findall(path.read_text()):
            if top in sys.stdlib_module_names or top in {"tests", "hilstar"}:
                continue
            names = {canonicalize_name(name) for name in distributions.get(top, [])}
            if names and not names & known:
                missing.append(f"{path.relative_to(ROOT)}: {top}")
    assert missing == []
