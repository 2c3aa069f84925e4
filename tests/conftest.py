"""Tests marked `slow` run only with `pytest --slow`, and those marked `endurance` only with
`pytest -m endurance`; and the list of what was skipped, and why.

A test may be skipped where a machine lacks what it needs, for the reasons below. Any other skip
fails the run, so that no test falls asleep unnoticed.
"""

from __future__ import annotations

import functools
import os
import re
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

# Before torch is loaded: workers, and what they start, share the cores among them.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

ALLOWED_SKIPS = (
    r"slow; run with --slow",
    r"endurance; run with -m endurance",
    r"hypothesis is not installed",
    r"needs a CUDA device|there is no CUDA device|there is a CUDA device",
    r"triton is not installed",
    r"pyrealsense2",  # the error's own sentence names it
    r"pyorbbecsdk2",
    r"rosbags is not installed|h5py is not installed|OpenEXR is not installed",
    r"rerun-sdk is not installed|of the extra rerun|this rerun-sdk reads files in another way",
    r"pip install '.\[browser-test\]'|needs chromium and chromedriver",
    r"pip install '.\[(osc|export|pandas)\]'",
    r"needs npm|npm could not install three",
    r"(jsonschema|mkdocs) is not installed",
    r"there is no C compiler",
    r"there is no C# compiler",
    r"needs /dev/full|needs /proc",
    r"a camera is plugged in",
    r"hatchling is not installed",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="run the tests marked slow, too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    asked = {"slow": config.getoption("--slow"), "endurance": "endurance" in config.option.markexpr}
    how = {"slow": "--slow", "endurance": "-m endurance"}
    for item in items:
        for mark, wanted in asked.items():
            if mark in item.keywords and not wanted:
                item.add_marker(pytest.mark.skip(reason=f"{mark}; run with {how[mark]}"))


def _skips(config: pytest.Config) -> Counter[str]:
    """How often each reason to skip was given."""
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    skipped = reporter.stats.get("skipped", []) if reporter else []
    reasons = (report.longrepr[2] for report in skipped if isinstance(report.longrepr, tuple))
    return Counter(reason.removeprefix("Skipped: ") for reason in reasons)


def _allowed(reason: str) -> bool:
    return any(re.search(pattern, reason) for pattern in ALLOWED_SKIPS)


def pytest_sessionfinish(session: pytest.Session) -> None:
    if session.exitstatus == pytest.ExitCode.OK and not all(map(_allowed, _skips(session.config))):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    if reasons := _skips(config):
        terminalreporter.section("skipped")
    for reason, count in sorted(reasons.items()):
        note = "" if _allowed(reason) else "  NOT ALLOWED by tests/conftest.py"
        terminalreporter.write_line(f"{count:4d} x {reason}{note}")


@pytest.fixture(autouse=True, scope="session")
def _ctrl_c_interrupts():
    """A shell's background job ignores Ctrl-C, and so would the programs that the tests start."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(autouse=True, scope="session")
def _loaded_once():
    """What hundreds of trackers begin with: the same networks."""
    with pytest.MonkeyPatch.context() as patch:
        if detector := sys.modules.get("toftrack.detector.hand_detector"):
            load = detector.load_networks
            known = functools.cache(lambda file: load())  # a test may say that it is another one
            weights = sys.modules["toftrack.detector.weights"]

            def networks(path=None):
                if path:
                    return load(path)
                # On a GPU torch's are moved there.
                return [type(one)(one.weights, one.session) for one in known(weights.DEFAULT_FILE)]

            patch.setattr(detector, "load_networks", networks)
        yield


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Idle helpers of torch hold up small work on a busy machine."""
    if not (torch := sys.modules.get("torch")):
        yield
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def files_of_at_most() -> Callable[[int], AbstractContextManager[None]]:
    """A disk that is full: meanwhile no file of this process may become larger."""
    resource = pytest.importorskip("resource")

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited
