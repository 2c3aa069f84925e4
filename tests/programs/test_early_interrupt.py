"""Ctrl-C in the first second: whatever is being imported, the status is 130, with no traceback."""

import os
import signal
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from helpers.programs import python
from helpers.tracking import ROOT

_AT_IMPORT = """
import os, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == os.environ["INTERRUPT_AT"]:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupting())
"""


def interrupted(tmp_path: Path, moment: str, *words: str) -> CompletedProcess:
    """A program that gets SIGINT where it begins to import a module."""
    (tmp_path / "sitecustomize.py").write_text(_AT_IMPORT)
    places = os.pathsep.join((str(tmp_path), str(ROOT)))
    return python(*words, folder=tmp_path, PYTHONPATH=places, INTERRUPT_AT=moment)


@pytest.mark.parametrize(
    ("moment", "words"),
    [
        ("torch", [str(ROOT / "track.py"), "view=none"]),
        ("hydra", ["-m", "toftrack", "record", "x"]),
    ],
)
def test_an_interrupt_while_a_program_is_loaded(tmp_path, moment: str, words: list[str]) -> None:
    reported = interrupted(tmp_path, moment, *words)
    assert reported.returncode == 130 and reported.stderr.startswith("interrupted")
    assert reported.stderr.count("\n") == 1


def test_an_ignored_interrupt_stays_ignored(tmp_path: Path) -> None:
    """As after nohup, or in the background of a script."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        report = ("-m", "toftrack", "report", str(tmp_path / "none"))
        reported = interrupted(tmp_path, "hydra", *report)
    finally:
        signal.signal(signal.SIGINT, before)
    assert reported.returncode == 1 and "no folder" in reported.stderr
