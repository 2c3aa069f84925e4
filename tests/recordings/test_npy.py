"""Stacks of depth images, `.npy`: damaged headers are told in one sentence."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from toftrack.errors import ToftrackError
from toftrack.recordings.store import open_recording


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<u2', 'fortran_order': False, 'shape': (-1, 24, 32), }",
        "{'descr': '<u2', 'fortran_order': False, 'shape': (3, 24, 32, }",
        "{'descr': '<u2', 'fortran_order': False, 'shape': (3, 24, 32), }" + 10_000 * " ",
        "{'descr': '<u2', 'fortran_order': False, 'shape': (3, 24, " + 30 * "9" + "), }",
    ],
    ids=("negative", "not closed", "long", "huge"),
)
def test_a_damaged_header_is_reported(header: str, tmp_path: Path) -> None:
    text = header.encode() + b"\n"
    path = tmp_path / "stack.npy"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(4608))
    with pytest.raises(ToftrackError) as reported:
        open_recording(path)
    assert str(path) in str(reported.value)
    assert "\n" not in str(reported.value)
