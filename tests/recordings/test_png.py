"""PNG images of others: what is damaged is none, and never makes the decoder allocate."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from toftrack.recordings.png import decoded_png

IMAGE = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
CONTENT = cv2.imencode(".png", IMAGE)[1].tobytes()


def test_a_whole_image_is_decoded() -> None:
    assert (decoded_png(CONTENT) == IMAGE).all()


@pytest.mark.parametrize("length", [0, 8, 20, len(CONTENT) // 2, len(CONTENT) - 1])
def test_an_image_that_was_cut_off_is_none(length: int) -> None:
    assert decoded_png(CONTENT[:length]) is None


def test_a_chunk_that_claims_gigabytes_is_not_handed_to_the_decoder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    at = CONTENT.index(b"IDAT") - 4
    assert decoded_png(CONTENT[:at] + struct.pack(">I", 2**31 - 1) + CONTENT[at + 4 :]) is None
    huge = CONTENT[:16] + struct.pack(">II", 50_000, 50_000) + CONTENT[24:]
    assert decoded_png(huge) is None
