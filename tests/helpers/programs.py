"""Programs: within the tests' process, which has loaded everything already, or in their own."""

import io
import logging
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from helpers.tracking import ROOT
from hydra.core.singleton import Singleton

QUICK = ("filter.particles=100",)
"""Overrides for runs whose accuracy is of no matter."""


@pytest.fixture
def hangups_are_handled() -> Iterator[None]:
    """Also where the tests were started so that they outlive their terminal."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@contextmanager
def _as_a_process(folder: Path, *arguments: str) -> Iterator[None]:
    """The folder, the arguments and the environment; and all that Hydra changes changes back.

    So does what Ctrl-C does, which a program that is loaded for the first time changes.
    """
    kept, root = Singleton.get_state(), logging.getLogger()
    handlers, level, argv = list(root.handlers), root.level, sys.argv
    raw, pressed = os.environ.pop("HYDRA_FULL_ERROR", None), signal.getsignal(signal.SIGINT)
    sys.argv = list(arguments)
    try:
        with chdir(folder):
            yield
    finally:
        sys.argv = argv
        if raw is not None:
            os.environ["HYDRA_FULL_ERROR"] = raw
        signal.signal(signal.SIGINT, pressed)
        Singleton.set_state(kept)
        root.handlers[:], root.level = handlers, level


def call(*arguments: str, folder: Path, program: str = "track.py") -> tuple[int, str, str]:
    """Status, standard output and standard error of a program that is run in a folder."""
    out, err = io.StringIO(), io.StringIO()
    with _as_a_process(folder, program, *arguments), redirect_stdout(out), redirect_stderr(err):
        try:
            runpy.run_path(str(ROOT / program), run_name="__main__")
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
    return status, out.getvalue(), err.getvalue()


def python(*words: str, folder: Path = ROOT, **environment: str) -> subprocess.CompletedProcess:
    """What Python says in a process of its own."""
    command, env = [sys.executable, *words], os.environ | environment
    given = {"cwd": folder, "env": env, "timeout": 600}
    return subprocess.run(command, **given, capture_output=True, text=True, check=False)


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket(socket.AF_INET, kind) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@contextmanager
def interrupted_when(ready: Callable[[], object]) -> Iterator[None]:
    """Ctrl-C comes as soon as `ready` says something true, or raises: then this raises it, too."""
    over = threading.Event()
    raised: list[BaseException] = []

    def press() -> None:
        try:
            while not ready():
                if over.wait(0.01):
                    return
        except BaseException as error:
            raised.append(error)
        if not over.is_set():
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=press)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        for error in raised:
            raise error


def killed_when(ready: Callable[[], object], *words: str) -> None:
    """`toftrack WORDS` in a process of its own gets kill -9 as soon as `ready` says so."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen([sys.executable, "-m", "toftrack", *words], cwd=ROOT, **quiet)
    try:
        deadline = time.monotonic() + 60
        while not ready():
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.02)
    finally:
        process.kill()
        process.wait()
