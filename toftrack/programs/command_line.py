"""What the command-line programs share: clear errors, exit statuses, and sweeps that carry on.

Exit status: 0 done, 1 an error (one sentence on standard error), 130 interrupted, 143 terminated
(SIGTERM), 129 hung up (SIGHUP), 149 by Ctrl-Break (on Windows).
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import functools
import logging
import math
import os
import re
import shlex
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from toftrack.configuration.check import check_interpolations, check_overrides
from toftrack.configuration.sentences import FULL_ERROR, place_of, sentence
from toftrack.errors import ToftrackError, check_number
from toftrack.files.json_text import read_object, write_json
from toftrack.files.safe_files import leave_folder, let_links_go
from toftrack.output.files import own_folder
from toftrack.programs import shutdown


@dataclass
class _Program:
    """The program that `run` is running, for its jobs."""

    running: bool = False
    tracebacks: bool = False
    failed_jobs: set[Path] = field(default_factory=set)
    """Their folders."""
    locks: list[int] = field(default_factory=list)
    """Descriptors of the folders that nobody else may write into."""
    new_folders: dict[Path, tuple[Path, ...]] = field(default_factory=dict)
    """Of a run or sweep, with those of them and their parents that were not there, the innermost
    first."""


_program = _Program()


class _JobFailedError(BaseException):
    """Carries a job's error, its only argument, past Hydra, which would print a line of its own
    about an Exception.
    """


def run(main: Callable[[], object]) -> int:
    """Run a program and return its exit status, with errors reported in one sentence.

    With HYDRA_FULL_ERROR=1 in the environment the traceback comes before the sentence.

    main: usually a function under `@hydra.main` and `@sweep_job`; an int that it returns is the
    status.
    """
    global _program
    before = os.environ.get(FULL_ERROR)
    os.environ[FULL_ERROR] = "1"  # without it, Hydra prints errors and exits by itself
    _program = program = _Program(running=True, tracebacks=before == "1")
    try:
        with shutdown.obeyed():
            status = main()
            program.new_folders.clear()
    except KeyboardInterrupt as end:
        shutdown.say("interrupted", sys.stderr)  # what was kept was said
        shutdown.forget_streams()
        return shutdown.exit_status(end)
    except SystemExit as end:  # of Hydra's options, as --help, and of its argument parser
        if place := place_of(end):
            print(f"error: a part that is not toftrack's ended the program{place}", file=sys.stderr)
            return 1
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
        return 1 if end.code else 0
    except BrokenPipeError:  # nobody reads the output any more
        shutdown.forget_streams()
        return shutdown.requested_status() or 1
    except _JobFailedError as failure:
        return _report(failure.args[0])
    except Exception as error:
        return _report(error)
    finally:
        for folder, parents in program.new_folders.items():
            with contextlib.suppress(OSError):  # the error that is being reported counts for more
                _clear(folder, parents)
        for lock in program.locks:
            leave_folder(lock)
        _program = _Program()
        del os.environ[FULL_ERROR]
        if before is not None:
            os.environ[FULL_ERROR] = before
    if program.failed_jobs:
        print(f"error: {len(program.failed_jobs)} of the jobs failed, see above", file=sys.stderr)
        return 1
    return status if isinstance(status, int) else 0


def plain_parser(program: str, about: str | None, usage: str | None = None) -> Parser:
    """A parser whose help shows a text, of several lines, as it stands."""
    kind = argparse.RawDescriptionHelpFormatter
    return Parser(program, usage, about, formatter_class=kind)


def note(text: str) -> None:
    """Say what speaks against a result but is no error; of a sweep summary.json tells it."""
    if not in_sweep():
        shutdown.say(f"note: {text}", sys.stderr)


def typed(words: Sequence[str]) -> str:
    """A command as it is typed: the shells of Windows know other quotes."""
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one sentence, without all that there is."""

    def add_number(
        self, name: str, *bounds: float, whole: bool = False, remedy: str = "", **more: Any
    ) -> None:
        """Add an option with a number within bounds, as `check_number` has them; one that need not
        be whole must be above the lower one.
        """

        def number(text: str) -> Any:
            value: Any = text
            with contextlib.suppress(ValueError):
                value = int(text) if whole else float(text)
            check_number(name, value, *bounds, above=not whole, whole=whole, remedy=remedy)
            return value

        self.add_argument(name, type=number, **more)

    def error(self, message: str) -> NoReturn:
        unknown = re.match(r"unrecognized arguments: (--[^\s=]+)", message)
        known = self._option_string_actions if unknown else ()
        if unknown and (near := difflib.get_close_matches(unknown[1], known, n=1)):
            raise ToftrackError(f"there is no option {unknown[1]}; did you mean {near[0]}?")
        raise ToftrackError(f"{message}; {self.prog} --help tells what there is")


def sweep_job(task: Callable[[DictConfig], float]) -> Callable[[DictConfig], float]:
    """Decorate the function under `@hydra.main` so that a failing job does not stop a sweep.

    In a sweep (`-m`) an error is reported in one sentence, also as `error` in the summary.json of
    the job's output folder, and the job returns infinity: the worst there is for a sweeper that
    minimises, where NaN would stop it. Otherwise the error is raised.
    """

    @functools.wraps(task)
    def guarded(config: DictConfig) -> float:
        try:
            hydra = HydraConfig.get()
            check_overrides(config, str(hydra.job.config_name), hydra.overrides.task)
            return task(config)
        except Exception as error:
            if not in_sweep():
                if _program.running:
                    raise _JobFailedError(error) from error
                raise
            _report(error, f"{job_words()}: ")
            folder = Path(HydraConfig.get().runtime.output_dir)
            _program.failed_jobs.add(folder.absolute())
            path = folder / "summary.json"
            # What a finished part wrote there stays. The sentence is on the terminal; a folder that
            # cannot be written must not stop the sweep.
            with contextlib.suppress(OSError):
                content = read_object(path) | {"error": sentence(error)}
                write_json(path, content)
            return math.inf

    return guarded


def in_sweep() -> bool:
    """Whether this is a job of a sweep, which prints one line."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def job_words() -> str:
    """How the line of a sweep's job begins: its number and its settings, "#0 seed=1"."""
    hydra = HydraConfig.get()
    return " ".join((f"#{hydra.job.num}", *hydra.overrides.task))


def _report(error: BaseException, job: str = "") -> int:
    """Tell of an error; returns the exit status. Where nobody reads it, as the terminal was closed
    with which a request to end came, that is the request's.
    """
    if _program.tracebacks:
        traceback.print_exception(error)
    told = shutdown.say(f"error: {job}{sentence(error)}", sys.stderr)
    return 1 if told else shutdown.requested_status() or 1


# Hydra makes the folder of a run, with its own files in it, before the program has looked at its
# settings: that of one that failed before it wrote anything of its own goes away again.
_HYDRAS = frozenset({"config.yaml", "hydra.yaml", "overrides.yaml", "multirun.yaml"})


class FailedJobs(Callback):
    """What Hydra tells of runs and sweeps: which folders they make, and which jobs failed: those
    whose summary.json tells an error, which a launcher may run anywhere.

    Looks for files that are new or were written anew: a sweep may have the folder of an older one.
    """

    def __init__(self) -> None:
        self._before: dict[Path, int] = {}

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        _begin(config, "run")

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        folder = _begin(config, "sweep")
        for job in folder.iterdir() if os.path.isdir(folder) else ():
            let_links_go(job)
            _let_links_go(job)
        self._before = {path: path.stat().st_mtime_ns for path in _summaries(config)}

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        for path in _summaries(config):
            if path.stat().st_mtime_ns != self._before.get(path) and "error" in read_object(path):
                _program.failed_jobs.add(path.parent)


def _begin(config: DictConfig, kind: str) -> Path:
    """Before Hydra makes the folder of a run or a sweep: have it for oneself, for two that begin
    together would share, or clear, it. One with files in it is nobody's to clear.
    """
    try:
        check_interpolations(config)
        if not (folder := config.hydra[kind].dir):  # which would be the current one
            raise ToftrackError(
                f"hydra.{kind}.dir is empty; give a folder, or . for the current one"
            )
        path = Path(folder).absolute()
        new = tuple(place for place in (path, *path.parents) if not os.path.exists(place))
        with contextlib.suppress(OSError):  # Hydra will say it, too
            if _program.running and (lock := own_folder(path)) is not None:
                _program.locks.append(lock)
    except ToftrackError as error:
        raise _JobFailedError(error) from error
    with contextlib.suppress(OSError):  # likewise
        _let_links_go(path)
        if not path.exists() or path.is_dir() and not any(path.iterdir()):
            _program.new_folders.setdefault(path, new)
    return path


def _let_links_go(folder: Path) -> None:
    """Hydra writes its files into an old folder through whatever stands there."""
    if folder.is_dir():
        let_links_go(folder / ".hydra")
        for path in (*folder.glob("*.log"), *folder.glob("*.yaml"), *folder.glob(".hydra/*")):
            let_links_go(path)


def _summaries(config: DictConfig) -> list[Path]:
    return sorted(Path(config.hydra.sweep.dir).absolute().glob("**/summary.json"))


def _clear(folder: Path, new: tuple[Path, ...]) -> None:
    """Remove a folder that holds nothing but what Hydra put there."""
    inner = folder / ".hydra"
    files = [path for path in (*folder.glob("*"), *inner.glob("*")) if path != inner]
    if any(path.suffix != ".log" and path.name not in _HYDRAS for path in files):
        return
    for handler in list(logging.root.handlers):  # Windows removes no file that is open
        if isinstance(handler, logging.FileHandler) and Path(handler.baseFilename) in files:
            logging.root.removeHandler(handler)
            handler.close()
    for path in files:
        path.unlink()
    for place in (inner, *new):
        if place.is_dir():
            place.rmdir()
