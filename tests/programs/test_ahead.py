"""On the first run of a machine, a second process compiles half of the kernels."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from toftrack.programs import ahead

_KERNELS = """
import gc, json, logging
from toftrack.compute.compiling import Kernel
kernels = [one for one in gc.get_objects() if isinstance(one, Kernel) and one.is_compiled]
print(json.dumps({one.__name__: str(list(one.dispatcher.overloads)) for one in kernels}))
"""


@pytest.fixture(autouse=True)
def mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that a helper writes, and nothing is compiled yet, on a machine of two cores."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(ahead, "_cores", lambda: 2)
    written = tmp_path / "begun"
    program = f"import time, toftrack; open({str(written)!r}, 'w').close(); time.sleep(60)"
    monkeypatch.setattr(ahead, "_PROGRAM", program)
    return written


def _begins(mark: Path, helpers: list[subprocess.Popen]) -> bool:
    with ahead.compiling_ahead():
        while helpers and not mark.exists() and helpers[0].poll() is None:
            pass
    return mark.exists()


@pytest.fixture
def helpers(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen]:
    """Those that were begun."""
    begun: list[subprocess.Popen] = []
    make = ahead._helper
    monkeypatch.setattr(ahead, "_helper", lambda: begun.append(make()) or begun[0])
    return begun


def test_a_helper_ends_with_the_run(mark: Path, helpers: list[subprocess.Popen]) -> None:
    assert _begins(mark, helpers)
    assert helpers[0].poll() is not None


def test_a_run_that_fails_leaves_no_helper(helpers: list[subprocess.Popen]) -> None:
    with pytest.raises(ValueError), ahead.compiling_ahead():
        raise ValueError
    assert helpers[0].poll() is not None


def test_there_is_none_once_kernels_are_kept_or_on_one_core(
    mark: Path, helpers: list[subprocess.Popen], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "_cores", lambda: 1)
    assert not _begins(mark, helpers)
    monkeypatch.setattr(ahead, "_cores", lambda: 2)
    (mark.parent / "toftrack" / "kernels" / "one").mkdir(parents=True, mode=0o700)
    (mark.parent / "toftrack" / "kernels").chmod(0o700)
    assert not _begins(mark, helpers)


def test_where_no_process_can_be_begun_the_run_compiles_alone(
    mark: Path, helpers: list[subprocess.Popen], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(mark.parent / "nowhere"))
    assert not _begins(mark, helpers)


def test_the_helper_compiles_what_the_tracker_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same kernels, for the same types; or each process would compile all of its own."""
    monkeypatch.undo()
    tracks = ahead._PROGRAM.replace('"experiment=paper", ', "")
    helps, needs = (
        json.loads(
            subprocess.run(
                [sys.executable, "-c", program + _KERNELS],
                check=True,
                capture_output=True,
                text=True,
            ).stdout.splitlines()[-1]
        )
        for program in (ahead._PROGRAM, tracks)
    )
    assert helps.items() <= needs.items()
    assert "score_hands" in helps and len(needs) // 3 < len(helps) < len(needs)
