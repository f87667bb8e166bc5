"""What has to be installed to run the tests is the same in the README, in CONTRIBUTING and in
CI.
"""

from __future__ import annotations

import re

from tests.support.benches import ROOT


def installed(text: str) -> set[str]:
    """The packages of every `apt-get install` in a text."""
    lines = re.findall(r"apt-get install((?: -\S+)*)((?: [a-z0-9][\w.+-]*)+)", text)
    return {package for _, packages in lines for package in packages.split()}


def test_readme_contributing_and_ci_install_the_same():
    command = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[1]
    readme = installed(command)
    contributing, ci = (
        installed((ROOT / name).read_text()) for name in ("CONTRIBUTING.md", ".ci/run")
    )
    assert readme == contributing
    assert readme <= ci
    assert {"chromium", "chromium-driver", "xvfb"} <= readme
