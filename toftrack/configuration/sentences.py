"""Errors, those of Hydra too, as one sentence for the user."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator

import yaml
from hydra.errors import HydraException
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from toftrack.configuration.suggestions import better_sentence
from toftrack.errors import ToftrackError

FULL_ERROR = "HYDRA_FULL_ERROR"
"""The environment variable that asks for tracebacks."""


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
        if isinstance(cause, yaml.YAMLError):
            return f"a file of the configuration is no YAML: {_one_line(str(cause))}; mend it there"
    if any(isinstance(cause, RecursionError) for cause in chain):
        return "a setting or a file is nested too deeply; take out what is not meant"
    if target := re.match(r"Error locating target '([^']+)'", str(error)):
        return (
            f"the _target_ {target[1]} cannot be imported ({_one_line(str(chain[-1]))}); check its "
            "name, and that its module lies beside the program or on PYTHONPATH"
        )
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        reported = next((cause for cause in chain if str(cause).strip()), error)
        return better_sentence(chain) or _of_config(reported) or type(error).__name__
    text = _one_line(str(error))
    name = type(error).__name__
    return f"unexpected {name}{f': {text}' if text else ''} ({FULL_ERROR}=1 shows the traceback)"


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
