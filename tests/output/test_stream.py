"""Estimates for other programs: as lines on standard output, as datagrams, never in the way."""

from __future__ import annotations

import errno
import json
import logging
import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import hydra
import numpy as np
import pytest
from helpers import programs
from helpers.hands import hand_estimate
from helpers.programs import QUICK
from helpers.settings import stdout_stream, udp_stream
from helpers.tracking import CONF, configuration, run

from toftrack.devices.replay import Sample
from toftrack.errors import ToftrackError
from toftrack.output.lines import LINE_FIELDS, json_line
from toftrack.output.results import read_results

COVARIANCE = np.random.default_rng(0).random((10, 10), np.float32)
"""Of as many digits as those of the tracker."""


@contextmanager
def piped() -> Iterator[BinaryIO]:
    """The reading end of a pipe that is this process's standard output meanwhile.

    No fixture: pytest's own capturing begins anew between a fixture and its test.
    """
    sys.stdout.flush()
    kept = os.dup(1)
    reading, writing = os.pipe()
    os.dup2(writing, 1)
    os.close(writing)
    try:
        with os.fdopen(reading, "rb", buffering=0) as pipe:
            yield pipe
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def lines_of(reading: BinaryIO, until: Callable[[bytes], bool]) -> list[dict]:
    content = b""
    while not until(content):
        assert select.select((reading,), (), (), 200)[0], "nothing more comes"
        content += reading.read(1 << 16)
    return [json.loads(line) for line in content.splitlines()]


def ends_with(index: int) -> Callable[[bytes], bool]:
    start = f'{{"index":{index},'.encode()
    return lambda content: content.endswith(b"\n") and content.splitlines()[-1].startswith(start)


def test_a_reader_of_standard_output_gets_every_line_as_in_track_jsonl() -> None:
    sent = [hand_estimate(i) for i in range(5)]
    with piped() as pipe, stdout_stream() as stream:
        for one in sent:
            stream.send((one,))
            assert lines_of(pipe, ends_with(one.index)) == [json.loads(json_line((one,)))]


def test_nothing_else_gets_to_standard_output() -> None:
    script = """
import os
from toftrack.frames.estimate import no_estimate
from toftrack.output.stream import StdoutStream
with StdoutStream(None, 25) as stream:
    print("printed")
    os.system("echo from below")
    stream.send((no_estimate(1, 0.0, 'lost', 4, 0.0),))
print("after")
"""
    command = [sys.executable, "-c", script]
    reported = subprocess.run(command, capture_output=True, text=True, timeout=120)
    first, second = reported.stdout.splitlines()
    assert json.loads(first)["index"] == 1 and second == "after"
    assert "printed" in reported.stderr and "from below" in reported.stderr


def test_a_reader_that_falls_behind_gets_the_newest_and_whole_lines(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    found: list[dict] = []
    with piped() as pipe:
        reader = threading.Thread(target=lambda: found.extend(lines_of(pipe, ends_with(299))))
        with stdout_stream(waiting=3) as stream:
            for i in range(300):
                stream.send((hand_estimate(i),))
            reader.start()
        reader.join(20)
    indices = [line["index"] for line in found]
    assert indices == sorted(set(indices)) and indices[-3:] == [297, 298, 299]
    assert indices[0] == 0 and 5 < len(indices) < 200
    assert f"{len(indices)} estimates sent" in caplog.text
    assert f"{300 - len(indices)} dropped (the reader was too slow)" in caplog.text


def test_a_terminal_that_stands_still_stops_nothing() -> None:
    main, terminal = os.openpty()
    before = os.dup(1)
    os.dup2(terminal, 1)
    alarm = threading.Timer(10, os.close, (main,))  # lets go of what hangs
    alarm.start()
    try:
        with stdout_stream(waiting=1) as stream:
            for i in range(60):
                stream.send((hand_estimate(i),))
            assert stream.dropped > 10 and alarm.is_alive()
        assert os.get_blocking(1)
    finally:
        alarm.cancel()
        os.dup2(before, 1)
        for descriptor in (before, main, terminal):
            with suppress(OSError):
                os.close(descriptor)


def test_a_datagram_is_a_whole_line(receiver: socket.socket) -> None:
    with udp_stream(*receiver.getsockname()) as stream:
        for i in range(3):
            stream.send(((one := hand_estimate(i)),))
            assert receiver.recv(65535).decode() == json_line((one,)) + "\n"


def test_a_line_fits_into_a_datagram_also_where_few_are_so_long(receiver, monkeypatch) -> None:
    class OfMacOS(socket.socket):
        room = 9216

        def getsockopt(self, *_: int) -> int:
            return self.room

        def setsockopt(self, level: int, option: int, value: int) -> None:
            self.room = value

        def sendto(self, data: bytes, address: tuple) -> int:
            if len(data) > self.room:
                raise OSError(errno.EMSGSIZE, "Message too long")
            return super().sendto(data, address)

    estimate = hand_estimate(3)
    assert len(json_line((estimate,) * 2)) > OfMacOS.room
    monkeypatch.setattr(socket, "socket", OfMacOS)
    with udp_stream("127.0.0.1", receiver.getsockname()[1]) as stream:
        stream.send((estimate,) * 2)
    assert stream.sent == 1 and len(json.loads(receiver.recv(65535))["hands"]) == 2


def test_a_name_of_two_addresses_is_that_of_ipv4(
    receiver: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = receiver.getsockname()[1]
    v4, v6 = (socket.getaddrinfo(at, port, type=socket.SOCK_DGRAM) for at in ("127.0.0.1", "::1"))
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: v6 + v4)
    with udp_stream("localhost", port) as stream:
        stream.send((hand_estimate(3),))
    assert json.loads(receiver.recv(65535))["index"] == 3


@pytest.mark.parametrize(
    ("host", "words"),
    [
        ("127.0.0.1", "50 estimates sent to 127.0.0.1 port {port}, 0 dropped"),
        # A broadcast address, which needs a permission that the stream does not ask for.
        ("255.255.255.255", "0 estimates sent to 255.255.255.255 port {port}, 50 dropped ("),
    ],
)
def test_datagrams_that_nobody_takes_stop_nothing_and_are_counted(
    host: str, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    port = programs.free_port(socket.SOCK_DGRAM)
    with udp_stream(host, port) as stream:
        for i in range(50):
            stream.send((hand_estimate(i),))
    assert words.format(port=port) in caplog.text


def test_only_the_wanted_fields_are_sent(receiver: socket.socket) -> None:
    with udp_stream(*receiver.getsockname(), fields=["lost", "joints_m", "index"]) as stream:
        stream.send((hand_estimate(7),))
    line = json.loads(receiver.recv(65535))
    assert list(line) == ["lost", "joints_m", "index"] and line["index"] == 7


def test_the_fields_that_the_configuration_advises_fit_into_one_ethernet_frame() -> None:
    text = (CONF / "stream" / "udp.yaml").read_text()
    assert "[index,timestamp_s,lost,joints_m]" in text
    found = hand_estimate(10000, covariance=COVARIANCE)
    # Numbers of as many digits as there are; only depth is never negative.
    joints = np.full((21, 3), -0.12345678, np.float32) * np.float32([1, 1, -1])
    wanted = ("index", "timestamp_s", "lost", "joints_m")
    line = json_line((replace(found, joints_m=joints, timestamp_s=12345.678901),), wanted)
    assert len(line) + 1 <= 1472
    assert 6000 < len(json_line((found,))) < 10000, "and all fields are as long as it says"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["stream=udp", "stream.port=0"], "stream.port=0"),
        (["stream=udp", "stream.host=" + "a" * 70], "stream.host=aaa"),
        (["stream=udp", "stream.fields=[joints]"], "stream.fields=joints is unknown"),
        (["stream=stdout", "stream.fields=[]"], "stream.fields is empty"),
        (["stream=stdout", "stream.waiting=0"], "stream.waiting=0"),
    ],
)
def test_a_bad_setting_is_one_clear_error(overrides: list[str], words: str) -> None:
    with pytest.raises(hydra.errors.InstantiationException) as caught:
        hydra.utils.instantiate(configuration(*overrides).stream)
    assert isinstance(caught.value.__cause__, ToftrackError)
    assert words in str(caught.value.__cause__)


GIVEN = ("stream=stdout", "view=none", "hydra.run.dir=out", *QUICK)


def test_a_reader_that_has_enough_ends_the_tracking_and_its_results_are_kept(
    tmp_path: Path,
) -> None:
    first: list[dict] = []

    def read_two(pipe: BinaryIO) -> None:
        with pipe:
            first.extend(lines_of(pipe, lambda content: content.count(b"\n") >= 2)[:2])

    with piped() as pipe, ThreadPoolExecutor() as pool:
        reader = pool.submit(read_two, pipe)
        status, _, err = programs.call(*GIVEN, folder=tmp_path)
        reader.result()
    assert status == 0, err
    assert "standard output takes no more lines (Broken pipe): tracking ends here" in err
    assert "Traceback" not in err and "error:" not in err
    lines = (tmp_path / "out" / "track.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines[:2]] == first
    assert tuple(first[0]) == LINE_FIELDS
    done = read_results(tmp_path / "out" / "track.npz")
    assert len(done["lost"]) == len(lines) < 100
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["frames"] == len(lines)


@pytest.mark.parametrize("results", [False, True])
def test_what_is_streamed_is_smooth_and_the_files_are_only_if_asked(
    tmp_path: Path, receiver: socket.socket, results: bool
) -> None:
    port = f"stream.port={receiver.getsockname()[1]}"
    smooth = ("smooth=one_euro", f"smooth.results={results}")
    run(tmp_path, Sample(stop=5), "stream=udp", port, *smooth, "view=none", *QUICK)
    sent = [json.loads(receiver.recv(65535)) for _ in range(5)]
    kept = [json.loads(line) for line in (tmp_path / "track.jsonl").read_text().splitlines()]
    assert (sent == kept) == results
    assert [line["score"] for line in sent] == [line["score"] for line in kept]
