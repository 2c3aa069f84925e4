"""The one exception that users are meant to see."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


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
