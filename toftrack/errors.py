"""The one exception that users are meant to see, and checks that raise it."""

from __future__ import annotations

import contextlib
import importlib
import math
import re
from collections.abc import Collection, Iterator
from numbers import Integral, Real
from types import ModuleType
from typing import Any

MOST_HANDS = 8
"""That are followed at once."""
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]+")
_LONGEST, _LONGEST_REASON = 2000, 300
"""Letters of a message, and of a library's words in it: some repeat the whole input."""


class ToftrackError(Exception):
    """Bad input or environment; the message is one clear sentence: what, where, what to do."""

    def __str__(self) -> str:
        text = one_line(super().__str__())
        return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."


def one_line(text: str) -> str:
    """A text with names that others chose, as a terminal may show it: no line ends, no escapes."""
    return _CONTROL.sub(" ", text)


def check_choice(key: str, value: Any, known: Collection[str], remedy: str = "") -> None:
    """Raise ToftrackError unless a setting is one of those that are known.

    key: the setting's name on the command line.  remedy: what else to do, added to the sentence.
    """
    if value not in known:
        raise ToftrackError(f"{key}={value} is unknown; give one of {', '.join(known)}{remedy}")


def check_format(path: Any, content: Any, form: str, version: int, kind: str, remedy: str) -> None:
    """Raise ToftrackError unless the content of a file, "a camera file", is of that format of ours,
    and of that version.
    """
    if not isinstance(content, dict) or content.get("format") != form:
        raise ToftrackError(f"'{path}' is not {kind}: its format is not '{form}'; {remedy}")
    if (found := content.get("version")) != version:
        raise ToftrackError(
            f"'{path}' is {kind} of version {found}, and this toftrack reads version {version}; "
            f"{remedy}"
        )


@contextlib.contextmanager
def reported_errors(what: str, remedy: str, *kinds: type[Exception]) -> Iterator[None]:
    """Errors of some kinds, by default the system's, become one sentence: what, their words, and
    what to do. A ToftrackError stays as it is.
    """
    expected = kinds or (OSError,)
    try:
        yield
    except ToftrackError:
        raise
    except expected as error:
        words = " ".join(str(getattr(error, "strerror", None) or error).split())
        reason = words[:_LONGEST_REASON] or type(error).__name__
        raise ToftrackError(f"{what} ({reason}); {remedy}") from error


def module_of_extra(name: str, what: str, extra: str) -> ModuleType:
    """A module that an extra of this package brings; ToftrackError where it is not installed.

    what: "this needs that package".
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ToftrackError(
            f'{what}, which is not installed: pip install "toftrack[{extra}]"'
        ) from None


def check_number(
    key: str,
    value: Any,
    least: float = -math.inf,
    most: float = math.inf,
    *,
    above: bool = False,
    whole: bool = False,
    remedy: str = "",
) -> None:
    """Raise ToftrackError unless a setting is a finite number between two bounds.

    key: the setting's name on the command line.  above: `least` itself is not allowed.
    whole: only whole numbers are.  remedy: what else to do, added to the sentence.
    """
    number = isinstance(value, Integral if whole else Real) and not isinstance(value, bool)
    finite = number and -math.inf < value < math.inf  # of whole numbers beyond floats, too
    if finite and least <= value <= most and (value > least or not above):
        return
    bounds = []
    if least > -math.inf:
        bounds.append(f"{'above' if above else 'of at least'} {least:g}")
    if most < math.inf:
        bounds.append(f"at most {most:g}")
    wanted = f"{'a whole number' if whole else 'a number'} {' and '.join(bounds)}".strip()
    raise ToftrackError(f"{key}={value} is not possible; give {wanted}{remedy}")
