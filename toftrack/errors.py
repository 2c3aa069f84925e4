"""The one exception that users are meant to see."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from types import ModuleType


class ToftrackError(Exception):
    """Bad input or environment; the message is one clear sentence: what, where, what to do."""


@contextlib.contextmanager
def reported_errors(what: str, remedy: str, *kinds: type[Exception]) -> Iterator[None]:
    """Errors of some kinds, by default the system's, become one sentence: what, their words, and
    what to do.
    """
    expected = kinds or (OSError,)
    try:
        yield
    except expected as error:
        reason = " ".join(str(getattr(error, "strerror", None) or error).split())
        raise ToftrackError(f"{what} ({reason}); {remedy}") from error


def module_of_extra(name: str, what: str, extra: str) -> ModuleType:
    """A module that an extra of this package brings; ToftrackError where it is not installed.

    what: "this needs that package".
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ToftrackError(
            f"{what}, which is not installed: pip install 'toftrack[{extra}]', in a checkout "
            f"pip install -e '.[{extra}]'"
        ) from None
