"""For your own tests, by pytest's plugins: a bench, and frames that are compared with golden ones.

Every pytest of an environment with hilstar imports this file: hilstar itself is imported by the
first test that asks for a fixture.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from hilstar.api import OpenBench, SkyFrame
    from hilstar.instruments.compare.sky_comparison import SkyComparison

GOLDEN_FOLDER = "golden"
WRITTEN = "hilstar_golden"  # the property of a test's report that names a golden frame it wrote


def pytest_addoption(parser: pytest.Parser) -> None:
    """The option and the key of hilstar."""
    group = parser.getgroup("hilstar")
    group.addoption(
        "--update-golden",
        action="store_true",
        help="Write the golden frames that assert_same_sky lacks or finds to differ.",
    )
    parser.addini(
        "hilstar_bench",
        "The bench file of the fixture hilstar_bench, relative to pytest's rootdir.",
        default="bench.toml",
    )


@pytest.fixture(scope="session")
def hilstar_bench(pytestconfig: pytest.Config) -> Iterator[OpenBench]:
    """The bench of the key `hilstar_bench`, by default bench.toml in pytest's rootdir, open for the
    session.
    """
    import hilstar

    path = pytestconfig.rootpath / pytestconfig.getini("hilstar_bench")
    try:
        bench = hilstar.load(path)
    except hilstar.HilstarError as error:
        pytest.fail(f"hilstar_bench: {error}", pytrace=False)
    with bench:
        yield bench


@dataclass(frozen=True)
class GoldenFrames:
    """What `assert_same_sky` compares with: the golden frames of a test, in the folder golden
    beside its file.
    """

    node: pytest.Item
    update: bool

    def __call__(
        self,
        frame: SkyFrame,
        golden: str | None = None,
        *,
        flux_mag: float = 0.001,
        centroid_px: float = 0.001,
    ) -> SkyComparison:
        """Assert that a frame shows the sky of golden/NAME.fits, each star within both limits.

        The name is `golden`, or that of the test. With --update-golden a frame that differs, or
        has no golden one, is written as the golden one, with its truth beside it.
        """
        from hilstar.api import SkyFrame
        from hilstar.basics.errors import shortened
        from hilstar.instruments.compare import assert_same_sky

        __tracebackhide__ = True
        if golden is not None and not isinstance(golden, str):
            pytest.fail(
                f"golden {shortened(repr(golden))}: write the golden frame's name, after the frame",
                pytrace=False,
            )
        if self.update and not isinstance(frame, SkyFrame):
            pytest.fail(
                f"frame {shortened(repr(frame))}: golden frames are written of what"
                " hilstar_bench.frame(...) returns",
                pytrace=False,
            )
        image = self._path(golden)
        truth = image.with_suffix(".csv")
        limits: dict[str, Any] = {"flux_mag": flux_mag, "centroid_px": centroid_px}
        if self.update and not self._is_same(frame, image, truth, limits):
            image.parent.mkdir(parents=True, exist_ok=True)
            frame.save(image)
            frame.save(truth)
            self.node.user_properties.append((WRITTEN, str(image)))
        if not image.is_file():
            pytest.fail(
                f"{image}: there is no golden frame; write it with pytest --update-golden, look at"
                " it, and commit it",
                pytrace=False,
            )
        return assert_same_sky(frame, image, truth=truth, **limits)

    def _path(self, golden: str | None) -> Path:
        name = self.node.name if golden is None else golden
        # a parameter of a test may hold any character
        plain = re.sub(r"[^\w.-]+", "_", name).strip("_").removesuffix(".fits")
        return self.node.path.parent / GOLDEN_FOLDER / f"{plain}.fits"

    @staticmethod
    def _is_same(frame: SkyFrame, image: Path, truth: Path, limits: dict[str, Any]) -> bool:
        """Whether a golden frame is there and shows the same sky; one of another size does not."""
        from hilstar.basics.errors import InputError
        from hilstar.instruments.compare import compare

        if not (image.is_file() and truth.is_file()):
            return False
        try:
            return compare(frame, image, truth=truth, **limits).same
        except InputError:
            return False


@pytest.fixture
def assert_same_sky(request: pytest.FixtureRequest) -> GoldenFrames:
    """Asserts that a frame shows the sky of a golden one: `assert_same_sky(frame)`."""
    return GoldenFrames(request.node, request.config.getoption("--update-golden"))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Name the golden frames that were written."""
    reports = terminalreporter.getreports("passed")
    # once for each: every phase of a test reports its properties
    written = dict.fromkeys(
        path for report in reports for name, path in report.user_properties if name == WRITTEN
    )
    if written:
        terminalreporter.section("golden frames")
    for path in written:
        terminalreporter.line(f"wrote {path}")
