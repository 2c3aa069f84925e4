"""Requests to end a program: obeyed at once, after what must be whole, or not again."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest
from helpers.programs import hangups_are_handled as hangups_are_handled

from toftrack.programs import shutdown
from toftrack.programs.shutdown import EndedError, exit_status


def ask(number: int = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


pytestmark = pytest.mark.usefixtures("hangups_are_handled")


@pytest.fixture
def listening(hangups_are_handled: None) -> Iterator[None]:
    with shutdown.obeyed():
        yield


@pytest.mark.parametrize("number", shutdown.SHUTDOWN_SIGNALS)
def test_a_request_ends_what_goes_on(listening, number: int) -> None:
    with pytest.raises(EndedError) as end:
        ask(number)
    assert isinstance(end.value, KeyboardInterrupt) and exit_status(end.value) == 128 + number


def test_ctrl_break_of_windows_is_a_request() -> None:
    program = """
import os, signal
signal.SIGBREAK = signal.SIGUSR1
from toftrack.programs import shutdown
try:
    with shutdown.obeyed():
        os.kill(os.getpid(), signal.SIGBREAK)
except shutdown.EndedError:
    print("ended")
"""
    assert subprocess.check_output([sys.executable, "-c", program]).split() == [b"ended"]


def test_what_must_be_whole_is_finished_first(listening) -> None:
    done = []
    with pytest.raises(EndedError, match="SIGHUP"):
        with shutdown.not_now():
            with shutdown.not_now():
                ask(signal.SIGHUP)
                done.append(1)
            done.append(2)
        done.append(3)
    assert done == [1, 2]


def test_whoever_finishes_is_left_alone_until_the_fourth_request(listening) -> None:
    with pytest.raises(EndedError):
        ask()
    ask()
    ask(signal.SIGINT)
    with pytest.raises(EndedError):
        ask()


def test_an_error_is_reported_rather_than_the_request(listening) -> None:
    with pytest.raises(ZeroDivisionError), shutdown.not_now():
        ask()
        1 / 0  # noqa: B018


def test_what_is_ignored_stays_ignored_and_handlers_come_back() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    term = signal.getsignal(signal.SIGTERM)
    try:
        with shutdown.obeyed():
            ask(signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) == term
    finally:
        signal.signal(signal.SIGHUP, before)
