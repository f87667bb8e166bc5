"""What has to be installed to run the tests is the same in the README, in CONTRIBUTING and in
CI.
"""

from __future__ import annotations

import re

from tests.support.benches import ROOT

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
