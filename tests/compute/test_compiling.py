"""What is wrong with the cache of the kernels costs compiling and a sentence, no run."""

import logging
import os
import pickle
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import filelock
import numba
import numpy as np
import pytest

from toftrack.compute import compiling
from toftrack.compute.compiling import Kernel, compiled, entry_point
from toftrack.errors import ToftrackError

FACTOR = 2.0


@compiled
def _times_factor(value):
    return FACTOR * value


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog) -> Iterator[Path]:
    """Of the kernels, which is empty; and nothing has been said yet."""
    caplog.set_level("WARNING")  # runs of other tests in this process leave INFO
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(compiling, "_said", set())
    yield tmp_path / "toftrack" / "kernels"


def _made() -> Kernel:
    """The same kernel as a process has it that starts."""
    compiling._said.clear()

    @entry_point
    def doubled(values):
        for i in range(len(values)):
            values[i] = _times_factor(values[i])

    return doubled


def _kept(kernel: Kernel) -> str:
    """Where its code is kept."""
    path: str = compiling._cached(kernel.function, kernel.options).stats.cache_path
    return path


def _is_loaded() -> bool:
    """Run the kernel in a new process, which must work; whether its code was on the disk."""
    kernel, values = _made(), np.arange(3.0)
    kernel(values)
    assert values.tolist() == [0, FACTOR, 2 * FACTOR]
    return bool(kernel.dispatcher.stats.cache_hits)


def _files(folder: Path) -> list[Path]:
    return [file for file in folder.rglob("*") if file.is_file()]


def test_a_kernel_is_compiled_once_for_all_runs(folder: Path, caplog) -> None:
    kernel = _made()
    assert not kernel.is_compiled
    kernel(np.arange(3.0))
    assert kernel.is_compiled and len(_files(folder)) == 3, "index, code and lock"
    assert _is_loaded() and not caplog.messages
    assert str(folder.parents[1]) == numba.config.CACHE_DIR, "for the kernels of others"


def test_a_changed_constant_compiles_a_kernel_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not _is_loaded() and _is_loaded()
    before = compiling._fingerprint(_made().function)
    monkeypatch.setattr(sys.modules[__name__], "FACTOR", 3.0)
    assert compiling._fingerprint(_made().function) != before


@pytest.mark.parametrize("kind", ["nbi", "nbc"])
@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(os.urandom(500)),
        lambda file: file.write_bytes(file.read_bytes()[:-100]),
        lambda file: file.write_bytes(pickle.dumps(("nothing", "that", "numba", "knows"))),
    ],
    ids=["empty", "garbage", "cut", "other"],
)
def test_a_damaged_kernel_is_compiled_anew_and_reported_once(
    damage: Callable[[Path], object], kind: str, folder: Path, caplog
) -> None:
    assert not _is_loaded()
    (file,) = folder.rglob(f"*.{kind}")
    damage(file)
    assert not _is_loaded()
    # An index that is of another version is none.
    assert len(caplog.messages) == 1 or (kind == "nbi" and not caplog.messages)
    assert all("damaged" in message for message in caplog.messages)
    assert _is_loaded(), "it was mended"


def test_where_it_cannot_be_written_every_run_compiles_and_says_why(folder: Path, caplog) -> None:
    folder.parent.mkdir()
    folder.write_bytes(b"mine")
    for _ in range(2):
        caplog.clear()
        assert not _is_loaded()
        (message,) = caplog.messages
        assert str(folder) in message and "NUMBA_CACHE_DIR" in message
    assert folder.read_bytes() == b"mine"


class _Executed:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.mark),)


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="Windows says it otherwise")
@pytest.mark.parametrize("mode", [0o770, 0o707, 0o750, None])
def test_what_others_could_have_written_is_never_unpickled(
    mode: int | None, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    assert not _is_loaded()
    for file in _files(folder):
        file.write_bytes(pickle.dumps(_Executed(tmp_path / "executed")))
    if mode is not None:
        folder.chmod(mode)
    elif os.geteuid() == 0:
        os.chown(folder, 12345, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert not _is_loaded()
    assert not (tmp_path / "executed").exists()
    (message,) = caplog.messages
    assert "closed to others" in message and str(folder) in message


def test_numba_without_its_compiler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
    with pytest.raises(ToftrackError, match="NUMBA_DISABLE_JIT"):
        _made()(np.zeros(1))


def test_an_error_of_a_kernel_s_own_is_raised() -> None:
    @entry_point
    def wrong(values):
        values[0] = values + "text"

    with pytest.raises(numba.TypingError):
        wrong(np.zeros(1))


@pytest.mark.parametrize("kept", [True, False])
def test_compiling_is_announced_and_loading_is_not(kept: bool, folder: Path, caplog) -> None:
    if not kept:
        folder.parent.mkdir()
        folder.touch()
    caplog.set_level(logging.INFO)
    for times in (1, 1 if kept else 2):
        _made()(np.arange(3.0))
        said = [message for message in caplog.messages if message.startswith("compiling kernels")]
        assert len(said) == times
        assert all(("once on a machine" in message) == kept for message in said)


def test_kernels_are_kept_in_the_user_s_cache_not_in_the_package(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("LOCALAPPDATA" if os.name == "nt" else "XDG_CACHE_HOME", str(tmp_path))
    here = compiling._private_folder()
    assert here.parent == tmp_path / "toftrack" / "kernels"
    # Those of another processor, as where a home is shared, are no use, and elsewhere.
    monkeypatch.setattr(numba.config, "CPU_NAME", "nocona")
    compiling._machine.cache_clear()
    other = compiling._private_folder()
    compiling._machine.cache_clear()
    assert other.parent == here.parent and other != here


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such variable")
def test_a_cache_that_is_not_absolute_is_ignored(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    assert compiling._private_folder().is_relative_to(tmp_path / ".cache" / "toftrack")


def test_what_another_process_is_compiling_is_waited_for() -> None:
    values, kernel = np.arange(3.0), _made()
    assert not _is_loaded()
    with filelock.FileLock(f"{_kept(kernel)}.lock"):
        waits = threading.Thread(target=kernel, args=(values,))
        waits.start()
        waits.join(0.5)
        assert waits.is_alive()
    waits.join()
    assert values[1] == FACTOR


def test_what_another_process_never_finishes_is_compiled_all_the_same(monkeypatch) -> None:
    monkeypatch.setattr(compiling, "_PATIENCE_S", 0.1)
    with filelock.FileLock(f"{_kept(_made())}.lock"):
        assert not _is_loaded()


def test_where_nothing_can_be_locked_it_is_compiled_all_the_same(monkeypatch) -> None:
    def refused(self: filelock.FileLock) -> None:
        raise OSError("no locks here")

    monkeypatch.setattr(filelock.FileLock, "acquire", refused)
    assert not _is_loaded() and _is_loaded()
