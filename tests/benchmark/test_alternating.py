"""Programs that are timed in turn."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from toftrack.benchmark import alternating, command, peer
from toftrack.benchmark.alternating import FIRST, PEER_HANDS, Program, Runner, Start, Times, show
from toftrack.errors import ToftrackError

LEFT = str(Path(alternating.__file__).parents[1] / "data" / "sample_left_hand.npz")


def times(name: str, *rounds: float) -> Times:
    """Of ten frames a round, all but two of which take as long."""
    return Times(name, [[ms] * 8 + [0.5 * ms, 3 * ms] for ms in rounds])


def test_rounds_are_compared_one_by_one() -> None:
    ours, other = times(FIRST, 5.0, 20.0, 8.0), times("other", 10.0, 20.0, 16.0)
    assert ours.least == 2.5 and ours.medians == [5.0, 20.0, 8.0]
    assert ours.over(other) == [0.5, 1.0, 0.5]
    assert all(1 < tail < 3 for tail in ours.tails)


def test_the_table_has_the_ratios_and_the_starts() -> None:
    peer_name = next(iter(PEER_HANDS))
    found = [
        times(FIRST, 5.0, 6.0),
        times("a, one hand", 10.0, 10.0),
        times("a, both", 15.0, 16.0),
        times(peer_name, 20.0, 20.0),
    ]
    begun = [Start(False, 12.0, 14.0, 20.0, 1.7), Start(True, 3.0, 3.9, 4.0, 0.5)]
    said = show(found, begun).splitlines()
    assert said[1].startswith(FIRST) and "0.28 (0.25, 0.30)" in said[1]
    assert said[5].startswith("a, both over one hand: median 1.55 (1.50, 1.60)")
    assert said[6].startswith("three frames without kernels") and "14.0" in said[6]
    assert said[7].startswith("three frames with kernels") and "3.9" in said[7]


def test_every_frame_of_the_packaged_recording_counts_forwards_and_backwards() -> None:
    once = alternating._one_round(Program("few particles", ("filter.particles=20",)))
    found = once()
    assert len(found) == 198 and min(found) > 0


def test_of_a_recording_frames_count_in_which_the_hands_are_believed() -> None:
    once = alternating._one_round(Program("one", ("hand.side=left",), LEFT, hands=1))
    assert 0 < len(once()) <= 90
    two = alternating._one_round(Program("two", ("hands=2",), LEFT, hands=2))
    with pytest.raises(ToftrackError, match="2 hands were in none"):
        two()


def test_what_a_program_s_process_cannot_do_is_one_sentence() -> None:
    with pytest.raises(ToftrackError, match="wrong"), Runner(Program("wrong", ("nothing=1",))):
        pass


def test_a_peer_searches_for_as_many_hands_as_it_should(tmp_path, monkeypatch) -> None:
    file = tmp_path / "fake.py"
    file.write_text(
        "import json, sys\n"
        "sys.stdout.buffer.write(b'{\"ready\": {}}\\n'); sys.stdout.flush()\n"
        "line = json.loads(sys.stdin.buffer.readline())\n"
        "import numpy as np\n"
        "answer = np.full(66, float(line['begin']['hands'])); answer[63] = 0.002\n"
        "for line in iter(sys.stdin.buffer.readline, b''):\n"
        "    sys.stdin.buffer.read(6 * 144 * 176)\n"
        "    sys.stdout.buffer.write(answer.tobytes()); sys.stdout.flush()\n",
        encoding="utf-8",
    )
    monkeypatch.setitem(peer.PEERS, "mediapipe", str(file))
    for name in PEER_HANDS:
        with alternating._PeerRunner(name, sys.executable) as runner:
            assert np.allclose(runner.round(), 2.0), "milliseconds"


def test_the_command_writes_what_it_prints(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(alternating, "timed", lambda *given: [times(FIRST, 5.0, 6.0)])
    monkeypatch.setattr(
        alternating, "starts", lambda times: [Start(True, 3.0, 3.9, 4.0, 0.5)] * times
    )
    file = tmp_path / "alternating.json"
    assert command.main(["alternating", "--rounds", "2", "--starts", "1", "--json", str(file)]) == 0
    written = json.loads(file.read_text(encoding="utf-8"))
    assert len(written["frames"][0]["rounds"]) == 2 and len(written["starts"]) == 1
    assert FIRST in capsys.readouterr().out


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen here")
def test_more_cores_than_there_are_is_one_sentence() -> None:
    with pytest.raises(ToftrackError, match="can be used here"):
        alternating.main(["--cores", "4096", "--rounds", "0"])
