"""No test falls asleep unnoticed, whichever process runs it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path


def test_a_skip_for_a_reason_that_is_not_allowed_fails_the_run(tmp_path: Path) -> None:
    shutil.copy(Path(__file__).with_name("conftest.py"), tmp_path)
    (tmp_path / "test_it.py").write_text(
        "import pytest\ndef test_one(): pytest.skip('needs a CUDA device')\n"
        "def test_two(): pytest.skip('tired')\ndef test_other(): pass\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-n", "1", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "   1 x needs a CUDA device\n" in done.stdout
    assert "   1 x tired  NOT ALLOWED by tests/conftest.py\n" in done.stdout
