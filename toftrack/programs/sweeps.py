"""What Hydra tells of runs and sweeps: which folders they are about to make, and which jobs failed,
whatever ran them: other processes tell it by their folders.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from toftrack.json_text import read_object
from toftrack.programs.command_line import expect_folder, note_failed_job
from toftrack.safe_files import let_links_go


class FailedJobs(Callback):
    """Finds the jobs whose summary.json tells an error, which a launcher may run anywhere.

    Looks for files that are new or were written anew: a sweep may have the folder of an older one.
    """

    def __init__(self) -> None:
        self._before: dict[Path, int] = {}

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        _prepare(Path(config.hydra.run.dir))

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        _prepare(folder)
        for job in folder.iterdir() if folder.is_dir() else ():
            let_links_go(job)
            _let_links_go(job)
        self._before = {path: path.stat().st_mtime_ns for path in _summaries(config)}

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        for path in _summaries(config):
            if path.stat().st_mtime_ns != self._before.get(path) and "error" in read_object(path):
                note_failed_job(path.parent)


def _prepare(folder: Path) -> None:
    _let_links_go(folder)
    expect_folder(folder)


def _let_links_go(folder: Path) -> None:
    """Hydra writes its files into an old folder through whatever stands there."""
    if folder.is_dir():
        let_links_go(folder / ".hydra")
        for path in (*folder.glob("*.log"), *folder.glob("*.yaml"), *folder.glob(".hydra/*")):
            let_links_go(path)


def _summaries(config: DictConfig) -> list[Path]:
    folder = Path(config.hydra.sweep.dir).absolute()
    return sorted(folder.glob("**/summary.json"))
