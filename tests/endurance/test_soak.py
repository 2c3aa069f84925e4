"""A live run over an emulated camera that fails now and then: it ends, and nothing grows."""

import sys

import pytest
from endurance import soak

pytestmark = pytest.mark.endurance


def test_what_grows_is_named() -> None:
    first = soak.Sample(700.0, 7, 9)
    assert soak.grown([first] * 5 + [first._replace(memory_mb=720.0, threads=8)] * 5) == []
    for name, more in (("memory_mb", 740.0), ("threads", 9), ("handles", 11)):
        assert soak.grown([first] * 5 + [first._replace(**{name: more})] * 5) == [name]


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
@pytest.mark.parametrize(("stream", "hands"), [("udp", 1), ("websocket", 2)])
def test_a_live_run_with_faults_a_visitor_and_a_stream(tmp_path, stream: str, hands: int) -> None:
    observation = soak.soak(0.3, tmp_path, stream, [f"hands={hands}"])
    words = (tmp_path / "err.txt").read_text()
    assert observation.status == 143, words[-2000:]
    assert soak.grown(observation.samples) == []
    assert observation.pictures > 0 < observation.visits
    assert observation.lines > 0
    for name in ("track.npz", "summary.json", "track.jsonl"):
        assert (tmp_path / "run" / name).stat().st_size > 0
