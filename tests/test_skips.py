"""No test falls asleep unnoticed, whichever process runs it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    ("reason", "status", "note"),
    [("needs a CUDA device", 0, ""), ("tired", 1, "  NOT ALLOWED by tests/conftest.py")],
)
def test_a_skip_for_a_reason_that_is_not_allowed_fails_the_run(
    reason: str, status: int, note: str, tmp_path: Path
) -> None:
    shutil.copy(Path(__file__).with_name("conftest.py"), tmp_path)
    (tmp_path / "test_it.py").write_text(
        f"import pytest\ndef test_one(): pytest.skip({reason!r})\ndef test_other(): pass\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-n", "1", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == status, done.stdout + done.stderr
    assert f"   1 x {reason}{note}\n" in done.stdout
