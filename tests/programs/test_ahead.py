"""On the first run of a machine, a second process compiles half of the kernels."""

import gc
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from toftrack.compute.compiling import Kernel, _private_folder
from toftrack.programs import ahead


@pytest.fixture(autouse=True)
def mark(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that a helper writes, and nothing is compiled yet, on a machine of two cores."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(ahead, "_cores", lambda: 2)
    written = tmp_path / "begun"
    program = f"import time, toftrack; open({str(written)!r}, 'w').close(); time.sleep(60)"
    monkeypatch.setattr(ahead, "_PROGRAM", program)
    return written


@pytest.fixture
def helpers(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen]:
    """Those that were begun."""
    begun: list[subprocess.Popen] = []
    make = ahead._helper
    monkeypatch.setattr(ahead, "_helper", lambda: begun.append(make()) or begun[0])
    return begun


def test_a_helper_ends_with_the_run_even_if_that_fails(
    mark: Path, helpers: list[subprocess.Popen]
) -> None:
    with pytest.raises(ValueError), ahead.compiling_ahead():
        while not mark.exists() and helpers[0].poll() is None:
            pass
        raise ValueError
    assert mark.exists() and helpers[0].poll() is not None


def test_there_is_none_once_kernels_are_kept_or_on_one_core_or_where_none_can_be_begun(
    mark: Path, helpers: list[subprocess.Popen], monkeypatch: pytest.MonkeyPatch
) -> None:
    nowhere = str(mark.parent / "nowhere")
    for place, name, value in ((ahead, "_cores", lambda: 1), (sys, "executable", nowhere)):
        with monkeypatch.context() as patch:
            patch.setattr(place, name, value)
            with ahead.compiling_ahead():
                assert not helpers
    (_private_folder() / "one").mkdir()
    with ahead.compiling_ahead():
        assert not helpers


def _compiles(program: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """The kernels that a program needs where none is loaded, and for which types."""
    for one in _kernels():
        monkeypatch.setattr(one, "dispatcher", None)
    exec(program, {})
    return {one.__name__: str([*one.dispatcher.overloads]) for one in _kernels() if one.is_compiled}


def _kernels() -> list[Kernel]:
    return [one for one in gc.get_objects() if type(one) is Kernel]


def test_the_helper_compiles_what_the_tracker_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same kernels, for the same types; or each process would compile all of its own."""
    monkeypatch.undo()
    tracks = ahead._PROGRAM.replace('"experiment=paper", ', "")
    helps, needs = (_compiles(program, monkeypatch) for program in (ahead._PROGRAM, tracks))
    assert helps.items() <= needs.items()
    assert "score_hands" in helps and len(needs) // 3 < len(helps) < len(needs)
