"""The programs that make the pages' parts tell what they do, and touch nothing."""

from __future__ import annotations

import subprocess
import sys

import pytest
from helpers.tracking import ROOT


@pytest.mark.parametrize(
    "name", ["make_gallery", "make_moving_picture", "make_rooms", "make_types", "run_notebook"]
)
def test_help_is_given_and_nothing_made(name: str) -> None:
    command = [sys.executable, str(ROOT / "docs" / f"{name}.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith(f"usage: {name}.py"), done.stderr
