"""What README.md and docs/ show works: programs run, and commands are commands that there are."""

import argparse
import importlib
import importlib.util
import os
import re
import shlex
import socket
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.bags import recording, write_bag
from helpers.hands import hand_estimate, lost_hand
from helpers.programs import QUICK, free_port
from helpers.tracking import ROOT, configuration, run
from helpers.videos import write_grey
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.plugins.launcher import Launcher
from scipy.io import savemat

from toftrack.api import make_device
from toftrack.devices.replay import Sample
from toftrack.frames.estimate import no_estimate
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.lines import json_line
from toftrack.output.results import ResultWriter
from toftrack.programs import convert
from toftrack.programs.main import main
from toftrack.recordings.npz import read_recording

PAGES = {
    path: path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
}
README = "\n".join(PAGES.values())
"""All pages in one."""


def block(name: str) -> str:
    """The code after `<!-- test: name -->`."""
    found = re.findall(rf"<!-- test: {name} -->\n```\w+\n(.*?)```", README, re.DOTALL)
    assert len(found) == 1, f"the pages have {len(found)} blocks marked {name}"
    return found[0]


def commands() -> Iterator[tuple[str, ...]]:
    """Every command in a block for the shell, or that starts so in running text."""
    shell = re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
    lines = [line for text in shell for line in text.splitlines()]
    plain = re.sub(r"```.*?```", "", README, flags=re.DOTALL)
    lines += [
        " ".join(code.split()) for code in re.findall(r"`((?:python|toftrack) [^`]+)`", plain)
    ]
    for line in lines:
        words = shlex.split(line, comments=True)
        while words:
            end = next((i for i, word in enumerate(words) if word in ("&&", "|")), len(words))
            yield with_track_py(words[:end])
            words = words[end + 1 :]


def with_track_py(words: list[str]) -> tuple[str, ...]:
    """`toftrack track ...` as `python track.py ...`, which does the same."""
    if words[:2] == ["toftrack", "track"]:
        words = [re.sub(r"^FILE\..*", "device=replay", word) for word in words[2:]]
        return ("python", "track.py", *(word for word in words if word != "FILE"))
    return tuple(words)


COMMANDS = sorted(set(commands()))
TRACK = [words for words in COMMANDS if words[:2] == ("python", "track.py")]
TRAIN = [words for words in COMMANDS if words[:2] == ("python", "train_pose_space.py")]
DETECTOR = ("python", "-m", "toftrack.training", "train")
"""The one command of a module that takes overrides."""
OTHERS = (DETECTOR, ("python", "-m", "venv", ".venv"))
MODULES = [words for words in COMMANDS if words[:2] == ("python", "-m") and words not in OTHERS]
TOFTRACK = [words for words in COMMANDS if words[0] == "toftrack" and words[1][0] != "-"]
OF_HYDRA = ("-m", "--multirun")


def overrides_of(words: tuple[str, ...]) -> list[str]:
    """The overrides; of a sweep those of its first job, and without launchers that are extras."""
    given = [word for word in words[2:] if word not in OF_HYDRA and word not in ("--cfg", "job")]
    launchers = {plugin.__name__ for plugin in Plugins.instance().discover(Launcher)}
    parsed: list[Override] = OverridesParser.create().parse_overrides(given)
    kept = []
    for override in parsed:
        key = override.get_key_element()
        launcher = f"{str(override.value()).partition('_')[0]}launcher"
        if key == "hydra/launcher" and launcher not in {name.lower() for name in launchers}:
            continue
        if key.lstrip("+").startswith("hydra.launcher."):
            continue
        if override.is_sweep_override():
            kept.append(f"{key}={next(iter(override.sweep_string_iterator()))}")
        else:
            kept.append(override.input_line)
    return kept


def test_there_are_commands_to_check() -> None:
    assert len(TRACK) > 10 and len(TRAIN) >= 1 and len(MODULES) > 2 and len(TOFTRACK) > 9


def test_every_command_is_of_a_program_that_there_is() -> None:
    for words in COMMANDS:
        if words[0] != "python" or words[1] == "client.py":
            continue
        if words[1] == "-m":
            assert importlib.util.find_spec(words[2]) is not None, words
        else:
            assert (ROOT / words[1]).is_file(), words


@pytest.mark.parametrize("words", TRACK + TRAIN, ids=" ".join)
def test_a_command_composes(words: tuple[str, ...]) -> None:
    name, own = "config" if words[1] == "track.py" else "train_pose_space", ()
    if "--config-dir" in words:
        at = words.index("--config-dir")
        folder, words = ROOT / words[at + 1], words[:at] + words[at + 2 :]
        if not folder.is_dir():  # the reader's own
            given = [word for word in words[2:] if word not in OF_HYDRA]
            assert OverridesParser.create().parse_overrides(given)
            return
        own = (f"hydra.searchpath=[file://{folder}]",)
    assert configuration(*own, *overrides_of(words), name=name)


def test_the_command_that_trains_networks_is_shown_and_composes() -> None:
    assert DETECTOR in COMMANDS
    assert configuration(name="train_detector").poses.images > 0


class ParsedError(BaseException):
    """The command line was understood."""


@pytest.mark.parametrize("words", MODULES + TOFTRACK, ids=" ".join)
def test_a_command_parses(words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("parse_args", "parse_intermixed_args"):
        original = getattr(argparse.ArgumentParser, name)

        def parse(parser: argparse.ArgumentParser, *given: object, original=original) -> None:
            raise ParsedError(original(parser, *given))

        monkeypatch.setattr(argparse.ArgumentParser, name, parse)
    with pytest.raises(ParsedError):
        if words in TOFTRACK:
            main(words[1:])
        else:
            importlib.import_module(f"{words[2]}.__main__").main(list(words[3:]))


def test_every_extra_that_is_named_is_there() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for names in re.findall(r"\.\[([\w,-]+)\]", README):
        assert set(names.split(",")) <= set(project["optional-dependencies"]), names


def test_every_file_of_this_repository_that_is_named_is_there() -> None:
    for target in re.findall(r"`((?:toftrack|conf|tests)/[\w/.]+\.\w+)`", README):
        assert (ROOT / target).exists(), target


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A recording for each of the names that README.md uses, of a few frames."""
    folder = tmp_path_factory.mktemp("recordings")
    whole = read_recording(ROOT / "toftrack" / "data" / "sample.npz")
    part = folder / "FILE.npz"
    np.savez(part, depth_m=whole.depth[:4], K=whole.camera.K, amplitude=whole.amplitude[:4])
    for name in ("hand.srs", "FOLDER", "pictures"):
        convert.main([str(part), str(folder / name)])
    (folder / "pictures" / "camera.json").rename(folder / "camera.json")
    words = np.rint(1000 * whole.depth[:4].astype(np.float32)).astype(np.uint16)
    np.save(folder / "depth.npy", words)
    savemat(folder / "depth.mat", {"depths": words.transpose(1, 2, 0)})
    write_grey(folder / "depth.mkv", words)
    return {path.name: path for path in folder.iterdir()}


@pytest.mark.parametrize("name", ["FILE.npz", "hand.srs", "FOLDER"])
def test_a_recording_of_one_s_own_is_tracked_as_it_is_shown(
    name: str, recordings: dict[str, Path], tmp_path: Path
) -> None:
    (words,) = (words for words in TRACK if words[-1] == f"device.path={name}" and words[2] != "-m")
    shown = [word.replace(name, str(recordings[name])) for word in words[2:]]
    run(tmp_path, make_device(*shown, "device.stop=2"), *shown, *QUICK)
    for made in ("track.npz", "track.jsonl", "summary.json", "overlay.mp4", "overlay.png"):
        assert (tmp_path / made).stat().st_size > 0


CONVERSIONS = [words[2:] for words in TOFTRACK if words[1] == "convert"]


@pytest.mark.parametrize("words", CONVERSIONS, ids=" ".join)
def test_a_conversion_works_as_it_is_shown(
    words: tuple[str, ...], recordings: dict[str, Path], tmp_path: Path
) -> None:
    source, target, *options = words
    if source == "BAG":
        messages = recording(read_recording(recordings["FILE.npz"]).depth, Sample().camera)
        for message in messages:
            message.topic = message.topic.replace("image_raw", "image_rect_raw")
        bag = write_bag(tmp_path, "bag", messages)
    else:
        bag = recordings[source]
    given = [str(recordings.get(word, word)) for word in options]
    convert.main([str(bag), str(tmp_path / target), *given])
    assert len(read_recording(tmp_path / target)) == 4


@contextmanager
def client(name: str, folder: Path, *changes: tuple[str, str]) -> Iterator[subprocess.Popen[str]]:
    """The page's client of that name, with changes to its code, as a process."""
    code = block(name)
    for old, new in changes:
        assert old in code
        code = code.replace(old, new)
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-c", code], cwd=folder, env=environment, **pipes)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def send(stream: str, folder: Path, *overrides: str) -> None:
    """Track six frames with the overrides of the page's command for a stream."""
    (words,) = (words for words in TRACK if f"stream={stream}" in words)
    given = [word for word in words[2:] if not word.startswith("device")]
    run(folder, Sample(stop=6), *given, "view=none", *QUICK, *overrides)


def read(printed: list[str]) -> list[int]:
    """The frames that a client printed, each with a gesture and coordinates, some with a pinch."""
    rows = [line.split() for line in printed]
    assert all(len(row) in (5, 6) and 0.3 < float(row[-1]) < 1.0 for row in rows)
    return [int(row[0]) for row in rows]


def test_the_client_of_standard_output_gets_every_frame(tmp_path, capfd) -> None:
    send("stdout", tmp_path)
    with client("stdout-client", tmp_path) as process:
        printed, _ = process.communicate(capfd.readouterr().out, timeout=60)
    assert read(printed.splitlines()) == list(range(6))


@pytest.mark.parametrize("gestures", ["default", "none"])
def test_the_client_of_datagrams_gets_every_frame(gestures: str, tmp_path: Path) -> None:
    port = str(free_port(socket.SOCK_DGRAM))
    assert "5005" in " ".join(word for words in TRACK for word in words)
    ready = ("while True", 'print("ready", flush=True)\nwhile True')
    with client("udp-client", tmp_path, ready, ("5005", port)) as process:
        assert process.stdout.readline() == "ready\n"
        send("udp", tmp_path, f"stream.port={port}", f"gestures={gestures}")
        assert read([process.stdout.readline() for _ in range(6)]) == list(range(6))


def test_the_client_for_two_hands_prints_each_that_there_is(capsys, monkeypatch) -> None:
    none = no_estimate(3, 0.12, "searching", 4, 0.01)
    there = replace(none, lost=False, side="left", state=np.zeros(27), joints_m=np.ones((21, 3)))
    lines = [json_line(both) for both in ((none, none), (none, there), (there, there))]
    monkeypatch.setattr(sys, "stdin", lines)
    exec(compile(block("hands-client"), "streams.md", "exec"), {})
    printed = [line.split()[:3] for line in capsys.readouterr().out.splitlines()]
    assert printed == [["3", slot, "left"] for slot in ("1", "0", "1")]


def test_the_program_in_python_tracks(capsys, monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    code = block("python")
    few = code.replace('"device=sample"', '"device=sample", "device.stop=4"')
    assert few != code
    exec(compile(few, "README.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 4 and all("right hand, wrist at" in line for line in printed)


def test_results_are_read_without_this_package_as_it_is_shown(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with ResultWriter(tmp_path, {}, JOINT_NAMES) as results:
        for estimate in (lost_hand(0), hand_estimate(1), hand_estimate(2)):
            results.append((estimate,))
    monkeypatch.chdir(tmp_path)
    exec(compile(block("npz"), "formats.md", "exec"), {})
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["1", "2"]
