"""Whatever a folder of somebody else holds, nothing outside of it changes, and nothing waits."""

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from toftrack.files import safe_files
from toftrack.files.safe_files import (
    leave_folder,
    lock_folder,
    make_folder,
    open_in_place,
    open_new,
    open_to_read,
    remove_partial,
    whole_file,
    write_whole,
)

WRITERS: dict[str, Callable[[Path], object]] = {
    "write_whole": lambda path: write_whole(path, "new"),
    "open_new": lambda path: open_new(path, replace=True).close(),
    "open_in_place": lambda path: open_in_place(path).close(),
}
every_writer = pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    path = tmp_path / "elsewhere"
    path.write_text("precious")
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "folder").mkdir()
    return tmp_path / "folder" / "file"


@every_writer
@pytest.mark.parametrize("there", [True, False])
def test_nothing_is_written_through_a_link(
    write: Callable[[Path], object], there: bool, path: Path, elsewhere: Path
) -> None:
    if not there:
        elsewhere.unlink()
    path.symlink_to(elsewhere)
    with pytest.raises(OSError, match="symbolic link"):
        write(path)
    assert path.is_symlink()
    assert (elsewhere.read_text() == "precious") if there else not elsewhere.exists()


@every_writer
def test_what_has_a_second_name_stays_as_it_was_there(
    write: Callable[[Path], object], path: Path, elsewhere: Path
) -> None:
    os.link(elsewhere, path)
    if write is WRITERS["open_in_place"]:
        with pytest.raises(OSError, match="second name"):
            write(path)
    else:
        write(path)
    assert elsewhere.read_text() == "precious"


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("open_it", [*WRITERS.values(), open_to_read], ids=[*WRITERS, "read"])
def test_what_is_no_file_is_refused_and_not_waited_for(
    open_it: Callable[[Path], object], kind: str, path: Path
) -> None:
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path = Path("/dev/null")
    before = path.lstat().st_mode
    with pytest.raises(OSError, match=kind):
        open_it(path)
    assert path.lstat().st_mode == before


@every_writer
def test_a_folder_in_the_place_of_a_file_is_refused(
    write: Callable[[Path], object], path: Path
) -> None:
    path.mkdir()
    with pytest.raises(IsADirectoryError):
        write(path)


def test_a_file_is_there_as_a_whole_or_as_it_was(path: Path) -> None:
    path.write_text("whole")
    with pytest.raises(RuntimeError), whole_file(path) as stream:
        stream.write(b"half")
        raise RuntimeError
    assert path.read_text() == "whole" and list(path.parent.iterdir()) == [path]
    usual = stat.S_IMODE(path.stat().st_mode)
    write_whole(path, "ä")
    assert path.read_bytes() == "ä".encode() and list(path.parent.iterdir()) == [path]
    assert stat.S_IMODE(path.stat().st_mode) == usual


def test_a_name_as_long_as_the_system_allows_is_written(tmp_path: Path) -> None:
    path = tmp_path / ("手" * 84)
    write_whole(path, "new")
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_two_who_write_a_file_at_once_do_not_meet(path: Path) -> None:
    with whole_file(path) as one, whole_file(path) as other:
        one.write(b"one")
        other.write(b"other")
    assert path.read_bytes() == b"one"


def test_what_a_killed_writer_left_can_be_removed(path: Path) -> None:
    stream = whole_file(path)
    stream.__enter__()  # and no end
    other = path.with_name("file.part")
    other.write_text("not ours")
    assert len(list(path.parent.iterdir())) == 2
    remove_partial(path.parent, [path.name])
    assert list(path.parent.iterdir()) == [other]


def test_a_file_that_is_there_is_only_replaced_when_asked(path: Path) -> None:
    path.write_text("there")
    with pytest.raises(FileExistsError):
        open_new(path)
    with open_in_place(path) as stream:
        assert stream.read() == b"there"
    with open_new(path, replace=True) as stream:
        assert stream.read() == b""
    with pytest.raises(FileNotFoundError):
        open_in_place(path.with_name("other"), make=False)


def test_a_folder_that_is_a_link_is_refused(path: Path, tmp_path: Path) -> None:
    path.symlink_to(tmp_path, target_is_directory=True)
    with pytest.raises(OSError, match="symbolic link"):
        make_folder(path)
    make_folder(path.with_name("other"))


def test_where_the_system_knows_no_such_flag_links_are_refused_all_the_same(
    path: Path, elsewhere: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(safe_files, "_NO_LINK", 0)
    path.symlink_to(elsewhere)
    with pytest.raises(OSError, match="symbolic link"):
        open_in_place(path)


@pytest.mark.parametrize("write", [WRITERS["write_whole"], WRITERS["open_new"]])
@pytest.mark.parametrize("link", [True, False])
def test_nothing_is_written_into_what_took_the_place_of_a_locked_folder(
    write: Callable[[Path], object], link: bool, path: Path, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / path.name).write_text("precious")
    lock = lock_folder(path.parent)
    assert lock is not None
    write(path)
    path.parent.rename(tmp_path / "away")
    if link:
        path.parent.symlink_to(tmp_path / "other")
    else:
        (tmp_path / "other").rename(path.parent)
    with pytest.raises(OSError, match="another folder has taken its place"):
        write(path)
    assert path.read_text() == "precious"
    leave_folder(lock)
    write(path)  # which it is for the user to know


def test_a_folder_that_is_swapped_while_a_file_is_written_stays_as_it_was(
    path: Path, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    lock = lock_folder(path.parent)
    assert lock is not None
    with pytest.raises(OSError, match="another folder"), whole_file(path) as stream:
        stream.write(b"new")
        path.parent.rename(tmp_path / "away")
        path.parent.symlink_to(tmp_path / "other")
    assert list((tmp_path / "other").iterdir()) == []
    leave_folder(lock)
