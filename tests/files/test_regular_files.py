"""Pipes, devices and folders with them are refused at once, whoever would read them."""

import os
from pathlib import Path

import pytest
from helpers.readers import write_readers

from toftrack.errors import ToftrackError
from toftrack.programs.report import read_runs, report
from toftrack.recordings.store import open_recording
from toftrack.recordings.unfinished import recover_recording

pytestmark = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")


def test_every_reader_refuses_a_pipe_in_place_of_its_file(tmp_path: Path) -> None:
    for reader in write_readers(tmp_path, whole=False):
        if reader.name in ("config.yaml", "group: a .yaml"):  # programs, and read by Hydra
            continue
        reader.file.unlink()
        os.mkfifo(reader.file)
        try:
            if reader.name == "unfinished recording":  # of which that reader makes a copy
                recover_recording(reader.given)
            reader.read(reader.given)
        except ToftrackError as error:
            assert "pipe" in str(error) or reader.name.startswith("part "), reader.name
        else:
            assert reader.name == "overrides.yaml"  # a job that is told to have failed


def test_a_folder_with_a_pipe_is_no_bag(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    for name in ("metadata.yaml", "one.db3"):
        os.mkfifo(tmp_path / name)
    with pytest.raises(ToftrackError, match="is a pipe, and only files"):
        open_recording(tmp_path)


def test_names_that_are_not_utf8_are_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    job = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe"))
    (job / ".hydra").mkdir(parents=True)
    (job / ".hydra" / "overrides.yaml").write_text('- "seed=\\ud800"\n')
    (job / "summary.json").write_text('{"metrics": {"mean_mm": 5.5}, "\\udc00": 1, "mean_ms": 2.0}')
    (tmp_path / "1" / ".hydra").mkdir(parents=True)
    (tmp_path / "1" / ".hydra" / "overrides.yaml").write_bytes(b"- seed=\xff\n")
    report(tmp_path)
    assert "udcff" in (tmp_path / "sweep.csv").read_text(encoding="utf-8")
    assert "1 of 2 jobs failed" in capsys.readouterr().out
    assert len(read_runs(tmp_path)) == 2
