"""What is wrong with the folder of the compiled kernels costs compiling and a sentence, no run."""

from __future__ import annotations

import errno
import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numba
import numpy as np
import pytest

from toftrack.compute import kernel_cache
from toftrack.compute.compiling import entry_point, must_be_compiled


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    _new_process()
    yield tmp_path / "toftrack"
    _new_process()


def _new_process() -> None:
    kernel_cache._said.clear()
    kernel_cache._usable.cache_clear()


def _made():
    """The same kernel as a process has it that starts."""
    _new_process()

    @entry_point(__file__)
    def doubled(values):
        for i in range(len(values)):
            values[i] *= 2

    return doubled


def _is_loaded() -> bool:
    """Run the kernel in a new process, which must work; whether its code was on the disk."""
    kernel, values = _made(), np.arange(3.0)
    kernel(values)
    assert values.tolist() == [0, 2, 4]
    return bool(kernel.stats.cache_hits)


def test_a_kernel_is_compiled_once_for_all_runs(folder: Path, caplog) -> None:
    kernel = _made()
    assert must_be_compiled(kernel)
    kernel(np.arange(3.0))
    assert not must_be_compiled(kernel) and not must_be_compiled(_made())
    (file,) = folder.iterdir()
    assert file.suffix == ".kernel"
    assert _is_loaded() and not caplog.messages


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-100])


def _turn_a_bit(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def _of_another_numba(file: Path) -> None:
    described = pickle.dumps(("nothing", "that", "numba", "knows"))
    digest = hashlib.sha256(described).digest()
    file.write_bytes(kernel_cache._FORMAT + digest + described)


def _folder_instead(file: Path) -> None:
    file.unlink()
    file.mkdir()


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(os.urandom(500)),
        _cut,
        _turn_a_bit,
        _of_another_numba,
    ],
    ids=["empty", "garbage", "cut", "bit", "other numba"],
)
def test_a_damaged_kernel_is_compiled_anew_and_reported_once(
    damage: Callable[[Path], object], folder: Path, caplog
) -> None:
    assert not _is_loaded()
    (file,) = folder.iterdir()
    damage(file)
    assert not _is_loaded()
    (reported,) = caplog.messages
    assert "damaged" in reported and str(folder) in reported and "compiled anew" in reported
    assert _is_loaded(), "it was mended"


def test_what_stands_in_the_way_of_a_kernel_is_reported(folder: Path, caplog) -> None:
    assert not _is_loaded()
    (file,) = folder.iterdir()
    _folder_instead(file)
    assert not _is_loaded()
    assert caplog.messages and all(str(folder) in reported for reported in caplog.messages)
    assert list(folder.iterdir()) == [file]


def test_of_another_processor_or_numba_nothing_is_loaded(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    assert not _is_loaded()
    monkeypatch.setattr(kernel_cache, "_machine", lambda: "another")
    assert must_be_compiled(_made())
    assert not _is_loaded() and _is_loaded()
    monkeypatch.undo()
    assert not caplog.messages


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES, errno.EROFS, errno.EDQUOT])
def test_where_it_cannot_be_written_every_run_compiles_and_says_why(
    number: int, folder: Path, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    def replace(source: str, target: str) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "replace", replace)
    for _ in range(2):
        caplog.clear()
        assert not _is_loaded()
        (reported,) = caplog.messages
        assert os.strerror(number) in reported and "NUMBA_CACHE_DIR" in reported
        assert not kernel_cache.can_be_kept()
    assert not list(folder.iterdir()), "nothing half-written stays"


def test_a_file_in_place_of_the_folder_is_reported(folder: Path, caplog) -> None:
    folder.write_bytes(b"mine")
    assert not _is_loaded()
    (reported,) = caplog.messages
    assert "neither read nor kept" in reported and "NUMBA_CACHE_DIR" in reported
    assert folder.read_bytes() == b"mine" and not must_be_compiled(_made())


class _Executed:
    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.mark),)

    def __init__(self, mark: Path) -> None:
        self.mark = mark


def _belongs_to_another(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if os.geteuid() == 0:
        os.chown(path, 12345, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)


@pytest.mark.parametrize("what", ["folder", "file"])
@pytest.mark.parametrize("mode", [0o770, 0o707, None])
def test_what_others_could_have_written_is_never_unpickled(
    what: str,
    mode: int | None,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog,
) -> None:
    assert not _is_loaded()
    (file,) = folder.iterdir()
    described = pickle.dumps(_Executed(tmp_path / "executed"))
    digest = hashlib.sha256(described).digest()
    file.write_bytes(kernel_cache._FORMAT + digest + described)
    theirs = folder if what == "folder" else file
    if mode is None:
        _belongs_to_another(theirs, monkeypatch)
    else:
        theirs.chmod(mode)
    assert not _is_loaded()
    assert not (tmp_path / "executed").exists()
    (reported,) = caplog.messages
    reason = "belongs to another user" if mode is None else "can be written by other users"
    assert reason in reported and str(folder) in reported


def test_a_link_or_a_pipe_is_not_read(folder: Path, tmp_path: Path, caplog) -> None:
    assert not _is_loaded()
    (file,) = folder.iterdir()
    for make in (lambda: file.symlink_to(file.rename(tmp_path / "it")), lambda: os.mkfifo(file)):
        make()
        caplog.clear()
        assert not _is_loaded()
        assert len(caplog.messages) == 1
        file.unlink()


def test_files_of_older_versions_do_not_pile_up(folder: Path) -> None:
    assert not _is_loaded()
    (file,) = folder.iterdir()
    function = file.name.split("doubled_")[0] + "doubled_"
    for number in range(40):
        old = folder / f"{function}{number:08x}-a-b.kernel"
        old.touch()
        os.utime(old, (1e9, 1e9))
    (folder / "abandoned.part").touch()
    os.utime(folder / "abandoned.part", (1e9, 1e9))
    (folder / "begun.part").touch()
    file.unlink()
    assert not _is_loaded()
    names = [path.name for path in folder.iterdir()]
    assert file.name in names and "begun.part" in names and "abandoned.part" not in names
    assert len(names) == kernel_cache._KEPT + 1


def test_kernels_are_kept_in_the_users_cache_not_in_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = Path(kernel_cache.__file__).parents[1]
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    for given in ("", str(tmp_path), "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", given)
        found = kernel_cache.cache_folder()
        assert found.is_absolute() and not found.is_relative_to(package)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if sys.platform.startswith("linux"):
        assert kernel_cache.cache_folder() == tmp_path / "toftrack" / "kernels"
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "own"))
    assert kernel_cache.cache_folder() == tmp_path / "own" / "toftrack"
