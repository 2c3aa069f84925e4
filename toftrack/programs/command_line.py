"""What the command-line programs share: clear errors, exit statuses, and sweeps that carry on.

A program of Hydra's:

    @hydra.main(version_base="1.3", config_path="conf", config_name="track")
    @sweep_job
    def main(config: DictConfig) -> float: ...

    sys.exit(run(main))

Exit status: 0 done, 1 an error (one sentence on standard error), 130 interrupted, 143 terminated
(SIGTERM), 129 hung up (SIGHUP).
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import logging
import math
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from toftrack.configuration.check import check_overrides
from toftrack.configuration.sentences import FULL_ERROR, sentence
from toftrack.json_text import read_object
from toftrack.programs import shutdown
from toftrack.safe_files import write_whole


@dataclass
class _Program:
    """The program that `run` is running, for its jobs."""

    running: bool = False
    tracebacks: bool = False
    failed_jobs: set[Path] = field(default_factory=set)
    """Their folders."""


_program = _Program()


class _JobFailedError(BaseException):
    """Carries a job's error past Hydra, which would print a line of its own about an Exception."""

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


def run(main: Callable[[], object]) -> int:
    """Run a program and return its exit status, with errors reported in one sentence.

    With HYDRA_FULL_ERROR=1 in the environment the traceback comes before the sentence.

    Args:
        main: usually a function under `@hydra.main` and `@sweep_job`.

    Returns:
        What main returns if it is an int; else 0 done, 1 after an error (also of one job of a
        sweep), 130 after Ctrl-C, 143 after SIGTERM, 129 after SIGHUP.
    """
    _program.running = True
    _program.tracebacks = os.environ.get(FULL_ERROR) == "1"
    _program.failed_jobs.clear()
    _forget_folders()
    try:
        with shutdown.obeyed(), _hydra_raises():
            status = main()
            _forget_folders()
    except KeyboardInterrupt as end:
        shutdown.say("interrupted: what was done until then is kept", sys.stderr)
        shutdown.forget_streams()
        return shutdown.exit_status(end)
    except SystemExit as end:  # of Hydra's options, as --help, and of its argument parser
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        return 1 if end.code else 0
    except BrokenPipeError:
        # Nobody reads the output any more; python would complain again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except _JobFailedError as failure:
        _report(failure.error)
        return 1
    except Exception as error:
        _report(error)
        return 1
    finally:
        _clear_folders()
        _program.running = False
    if _program.failed_jobs:
        count = len(_program.failed_jobs)
        print(f"error: {count} of the jobs failed, see above", file=sys.stderr)
        return 1
    return status if isinstance(status, int) else 0


def plain_parser(program: str, about: str | None) -> argparse.ArgumentParser:
    """A parser whose help shows a text, of several lines, as it stands."""
    kind = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(prog=program, description=about, formatter_class=kind)


def sweep_job(task: Callable[[DictConfig], float]) -> Callable[[DictConfig], float]:
    """Decorate the function under `@hydra.main` so that a failing job does not stop a sweep.

    In a sweep (`-m`) an error is reported in one sentence, also as `error` in the summary.json of
    the job's output folder, and the job returns infinity: the worst there is for a sweeper that
    minimises, where NaN would stop it. Otherwise the error is raised.
    """

    @functools.wraps(task)
    def guarded(config: DictConfig) -> float:
        try:
            _check(config)
            return task(config)
        except Exception as error:
            if not in_sweep():
                if _program.running:
                    raise _JobFailedError(error) from error
                raise
            _report(error, f"{job_words()}: ")
            folder = Path(HydraConfig.get().runtime.output_dir)
            note_failed_job(folder)
            _note_error(folder, sentence(error))
            return math.inf

    return guarded


def note_failed_job(folder: Path) -> None:
    """A job of the sweep failed, in this process or another: `run` will say how many did."""
    _program.failed_jobs.add(folder.absolute())


@contextlib.contextmanager
def _hydra_raises() -> Iterator[None]:
    """Hydra prints errors and exits by itself, unless it believes that the user wants them raw."""
    before = os.environ.get(FULL_ERROR)
    os.environ[FULL_ERROR] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[FULL_ERROR]
        else:
            os.environ[FULL_ERROR] = before


def _check(config: DictConfig) -> None:
    hydra = HydraConfig.get()
    check_overrides(config, str(hydra.job.config_name), hydra.overrides.task)


def in_sweep() -> bool:
    """Whether this is a job of a sweep, which prints one line."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def job_words() -> str:
    """How the line of a sweep's job begins: its number and its settings, "#0 seed=1"."""
    hydra = HydraConfig.get()
    return " ".join((f"#{hydra.job.num}", *hydra.overrides.task))


def _report(error: BaseException, job: str = "") -> None:
    if _program.tracebacks:
        traceback.print_exception(error)
    print(f"error: {job}{sentence(error)}", file=sys.stderr, flush=True)


def _note_error(folder: Path, text: str) -> None:
    """Add the error to the job's summary.json; what a finished part wrote there stays."""
    path = folder / "summary.json"
    # The sentence is on the terminal; a folder that cannot be written must not stop the sweep.
    with contextlib.suppress(OSError):
        write_whole(path, json.dumps(read_object(path) | {"error": text}, indent=1) + "\n")


# Hydra makes the folder of a run, with its own files in it, before the program has looked at its
# settings: that of one that failed before it wrote anything of its own goes away again.
_HYDRAS = frozenset({"config.yaml", "hydra.yaml", "overrides.yaml"})
_SWEEPS = "multirun.yaml"


@dataclass(frozen=True)
class _Folder:
    path: Path
    new: tuple[Path, ...]
    """Those of it and its parents that were not there, the innermost first."""


_expected: list[_Folder] = []


def expect_folder(folder: Path) -> None:
    """A run or a sweep is about to make this folder. One with files in it is nobody's to clear."""
    path = folder.absolute()
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        return
    new = [place for place in (path, *path.parents) if not place.exists()]
    _expected.append(_Folder(path, tuple(new)))


def _forget_folders() -> None:
    """What was expected so far stays as it is."""
    _expected.clear()


def _clear_folders() -> None:
    """Remove the expected folders that hold nothing but what Hydra put there."""
    for folder in _expected:
        with contextlib.suppress(OSError):  # the error that is being reported counts for more
            _clear(folder)
    _forget_folders()


def _clear(folder: _Folder) -> None:
    files = [path for path in folder.path.glob("*") if path.name != ".hydra"]
    inner = list(folder.path.glob(".hydra/*"))
    if any(path.suffix != ".log" and path.name != _SWEEPS for path in files):
        return
    if any(path.name not in _HYDRAS for path in inner):
        return
    _close_logs(folder.path)
    for path in (*files, *inner):
        path.unlink()
    for place in (folder.path / ".hydra", *folder.new):
        if place.is_dir():
            place.rmdir()


def _close_logs(folder: Path) -> None:
    """Windows removes no file that is open."""
    root = logging.getLogger()
    for handler in list(root.handlers):
        if (
            isinstance(handler, logging.FileHandler)
            and folder in Path(handler.baseFilename).parents
        ):
            root.removeHandler(handler)
            handler.close()
