"""What the command-line programs share: clear errors, exit statuses, and sweeps that carry on.

A program is a thin script:

    @hydra.main(version_base="1.3", config_path="conf", config_name="track")
    @sweep_job
    def main(config: DictConfig) -> float: ...

    if __name__ == "__main__":
        sys.exit(run(main))

Exit status: 0 done, 1 an error (one sentence on standard error), 130 interrupted.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from toftrack.errors import ToftrackError

_FULL_ERROR = "HYDRA_FULL_ERROR"


@dataclass
class _Program:
    """The program that `run` is running, for its jobs."""

    running: bool = False
    tracebacks: bool = False
    failed_jobs: list[str] = field(default_factory=list)


_program = _Program()


class _JobFailedError(BaseException):
    """Carries a job's error past Hydra, which would print a line of its own about an Exception."""

    def __init__(self, error: Exception) -> None:
        super().__init__(str(error))
        self.error = error


def run(main: Callable[[], object]) -> int:
    """Run a program and return its exit status, with errors told in one sentence.

    With HYDRA_FULL_ERROR=1 in the environment the traceback comes before the sentence.

    Args:
        main: usually a function under `@hydra.main` and `@sweep_job`.

    Returns:
        0 done, 1 after an error (also of one job of a sweep), 130 after Ctrl-C.
    """
    _program.running = True
    _program.tracebacks = os.environ.get(_FULL_ERROR) == "1"
    _program.failed_jobs.clear()
    try:
        with _hydra_raises():
            main()
    except KeyboardInterrupt:
        print("interrupted: what was done until then is kept", file=sys.stderr)
        return 130
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
        _program.running = False
    if _program.failed_jobs:
        count = len(_program.failed_jobs)
        print(f"error: {count} of the jobs failed, see above", file=sys.stderr)
        return 1
    return 0


def sweep_job(task: Callable[[DictConfig], float]) -> Callable[[DictConfig], float]:
    """Decorate the function under `@hydra.main` so that a failing job does not stop a sweep.

    In a sweep (`-m`) an error is told in one sentence, also as `error` in the summary.json of the
    job's output folder, and the job returns infinity: the worst there is for a sweeper that
    minimises, where NaN would stop it. Otherwise the error is raised.
    """

    @functools.wraps(task)
    def guarded(config: DictConfig) -> float:
        try:
            return task(config)
        except Exception as error:
            if not _in_sweep():
                if _program.running:
                    raise _JobFailedError(error) from error
                raise
            _report(error)
            folder = Path(HydraConfig.get().runtime.output_dir)
            _program.failed_jobs.append(str(folder))
            _note_error(folder, sentence(error))
            return math.inf

    return guarded


def sentence(error: BaseException) -> str:
    """What went wrong, where, and what to do: one line for the user, without 'error:'."""
    chain = list(_chain(error))
    for cause in chain:
        if isinstance(cause, ToftrackError):
            return _one_line(str(cause))
    for cause in chain:
        if isinstance(cause, MissingMandatoryValue):
            return _of_missing_value(cause)
        # Some of Hydra's errors are OSErrors too, without being of the system.
        if isinstance(cause, OSError) and not isinstance(cause, HydraException):
            return _of_system(cause)
    if target := re.match(r"Error locating target '([^']+)'", str(error)):
        return (
            f"the _target_ {target[1]} cannot be imported ({_one_line(str(chain[-1]))}); check its "
            "name, and that its module lies beside the program or on PYTHONPATH"
        )
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        return _of_config(error)
    text = _one_line(str(error))
    name = type(error).__name__
    return f"unexpected {name}{f': {text}' if text else ''} ({_FULL_ERROR}=1 shows the traceback)"


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """The error and its causes, the error first: Hydra wraps what a constructor raises."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        yield error
        seen.add(id(error))
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _of_system(error: OSError) -> str:
    reason = error.strerror or _one_line(str(error)) or type(error).__name__
    if error.filename is None:
        return f"{reason}; free what is needed, or choose another folder with hydra.run.dir=DIR"
    return (
        f"'{os.fsdecode(error.filename)}' cannot be read or written ({reason}); check the path and "
        "its permissions, or choose another output folder with hydra.run.dir=DIR"
    )


def _of_missing_value(error: MissingMandatoryValue) -> str:
    name = error.full_key or str(error).rpartition(" ")[2]
    return f"the value of {name} is missing; give it on the command line as {name}=VALUE"


def _of_config(error: BaseException) -> str:
    """Hydra's message without the lines that only its developers need, as one line."""
    message = ""
    for line in str(error).splitlines():
        text = line.strip()
        if text.startswith(("Config search path", "Set the environment", "See http")):
            break
        if not text or text.startswith(("object_type=", "reference_type=")):
            continue
        if text.startswith("full_key:"):
            message += f" (at {text.removeprefix('full_key:').strip()})"
        elif not message or message.endswith(":"):
            message += f" {text}"
        else:
            separator = "," if line.startswith("\t") else ";"  # the options of a list are indented
            message = f"{message.rstrip('.')}{separator} {text}"
    return _one_line(message)


@contextlib.contextmanager
def _hydra_raises() -> Iterator[None]:
    """Hydra prints errors and exits by itself, unless it believes that the user wants them raw."""
    before = os.environ.get(_FULL_ERROR)
    os.environ[_FULL_ERROR] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_FULL_ERROR]
        else:
            os.environ[_FULL_ERROR] = before


def _in_sweep() -> bool:
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def _report(error: BaseException) -> None:
    if _program.tracebacks:
        traceback.print_exception(error)
    print(f"error: {sentence(error)}", file=sys.stderr, flush=True)


def _note_error(folder: Path, text: str) -> None:
    """Add the error to the job's summary.json; what a finished part wrote there stays."""
    path = folder / "summary.json"
    # The sentence is on the terminal; a folder that cannot be written must not stop the sweep.
    with contextlib.suppress(OSError):
        try:
            summary = json.loads(path.read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError):
            summary = {}
        path.write_text(json.dumps(summary | {"error": text}, indent=1) + "\n", encoding="utf-8")
