"""The command `toftrack`: its programs, its help, and recordings given by name."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.tracking import ROOT, configuration
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser

import toftrack
from toftrack.errors import ToftrackError
from toftrack.programs import main as front
from toftrack.programs.applications import options_last, quoted, with_recording

ODD = ("two words.npz", "[1] (2) {3}.npz", "a=b.npz", "Übung ß.npz", "it's.npz", 'a "b".npz')
ODDER = ("1,2,3.npz", "$HOME.npz", "back\\slash\\'s", "ends\\", "#", "-")


@pytest.mark.parametrize("words", [["--help"], ["train", "device=x", "-h"]])
def test_help_begins_with_what_it_does_and_three_examples_and_loads_little(words) -> None:
    command = [sys.executable, "-X", "importtime", "-m", "toftrack", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    what, empty, *examples = done.stdout.splitlines()[:5]
    assert done.returncode == 0 and what.startswith("toftrack ") and not empty
    assert all(line.startswith("  toftrack t") for line in examples)
    for slow in ("torch", "hydra", "numpy", "cv2"):
        assert f"| {slow}\n" not in done.stderr


@pytest.mark.parametrize(
    "words", [["track", "--help"], ["track", "--hydra-help"], ["track", "--info"]]
)
def test_help_that_nobody_reads_is_no_traceback(words: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as pipe:
        command = [sys.executable, "-m", "toftrack", *words]
        done = subprocess.run(command, stdout=pipe, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (0, b"")


def test_long_help_names_every_group_and_choice() -> None:
    text = front.long_help("track")
    for path in (ROOT / "conf").glob("*/*.yaml"):
        if path.parent.name != "data":
            assert f"  {path.parent.name} " in text and path.stem in text
    assert "  data " in front.long_help("train")


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (["trak"], "did you mean toftrack track?"),
        (["version"], "did you mean toftrack --version?"),
        (["hand.side=left"], "did you mean toftrack track hand.side=left?"),
        (["gone.npz"], "did you mean toftrack track gone.npz?"),
        (["xyz"], "give one of track, train"),
    ],
)
def test_a_command_that_there_is_not_is_reported(words, reported, capsys) -> None:
    assert front.main(words) == 1
    err = capsys.readouterr().err
    assert err.startswith("error: there is no command") and reported in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        ("benchmark acuracy", "accuracy"),
        ("convert a.npz b.npz --unt 0.001", "--unit"),
        ("track a.npz --hands 2", "--hands"),
        ("track --cfg", "error: --cfg has no value"),
        ("track --config-dir", "error: --config-dir has no value"),
    ],
)
def test_what_was_mistyped_is_named_with_what_may_be_meant(words, meant, capsys) -> None:
    assert front.main(words.split()) == 1
    assert meant in capsys.readouterr().err


def test_help_of_a_command_is_its_own(capsys) -> None:
    assert front.main(["help", "convert"]) == 0
    assert capsys.readouterr().out.startswith("usage: toftrack convert ")


def test_a_program_s_status_and_errors_are_those_of_the_command(capsys, tmp_path) -> None:
    assert front.main(["report", str(tmp_path)]) == 1
    assert front.main(["convert", str(tmp_path / "gone.npz"), str(tmp_path / "x.srs")]) == 1
    assert "gone.npz" in capsys.readouterr().err.splitlines()[-1]
    assert front.main(["figures", "--help"]) == 0
    assert capsys.readouterr().out.startswith("usage: toftrack figures ")


@pytest.mark.parametrize("name", [*ODD, *ODDER])
def test_any_name_arrives_as_it_is(name: str, tmp_path, monkeypatch) -> None:
    config = configuration("device=replay", f"device.path={quoted(name)}")
    assert config.device.path == name
    monkeypatch.chdir(tmp_path)
    Path(name).touch()
    path = f"device.path={quoted(name)}"
    assert with_recording([name, "seed=1"]) == ["device=replay", path, "seed=1"]


@pytest.mark.parametrize("name", ["a.MCAP", "ros2", "cut", "~x.bag"])
def test_a_ros_bag_is_known_by_its_name_or_its_folder(name: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for folder, file in (("ros2", "metadata.yaml"), ("cut", "cut_0.mcap"), ("other", "1.png")):
        Path(folder).mkdir()
        (Path(folder) / file).touch()
    Path("~x.bag").touch()
    assert with_recording([name, "device.topic=/a"])[0] == "device=rosbag"
    assert with_recording(["other"])[0] == "device=folder"


@pytest.mark.parametrize(
    "words",
    [
        ["hand.side=left", "seed=1"],
        ["~device.repeat", "+new.key=1", "++device.x=2", "hydra/launcher=joblib"],
        ["--config-dir", "my_conf", "device@other=raw", "--cfg", "job"],
        ["-m", "seed=1,2"],
        ["hand.sied=left", "hnad.side=left"],
    ],
)
def test_settings_and_options_are_no_files(words: list[str], tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("my_conf").mkdir()
    Path("seed=1").mkdir()  # as sweeps name their folders
    assert with_recording(words) == words


@pytest.mark.parametrize(
    "words",
    [
        *("a.npz -m seed=1,2 view=none", "-m seed=1,2 view=none a.npz"),
        "-m -- seed=1,2 view=none a.npz",
    ],
)
def test_a_sweep_of_a_recording_may_be_written_in_any_order(words: str) -> None:
    *overrides, option = options_last(with_recording(words.split()))
    assert option == "-m"
    assert set(overrides) == {"device=replay", "device.path='a.npz'", "seed=1,2", "view=none"}


@pytest.mark.parametrize("info", ["--info", "-i defaults"])
def test_options_keep_their_values(info: str) -> None:
    words = ["--config-dir", "my", *info.split(), "view=none", "--cfg", "job"]
    read = get_args_parser().parse_args(options_last(with_recording(["seed=1", *words])))
    assert (read.config_dir, read.cfg, read.overrides) == ("my", "job", ["seed=1", "view=none"])
    assert read.info == (info.partition(" ")[2] or "all")


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("toftrack tr", {"track", "train"}),
        ("toftrack label fi", set()),
        ("toftrack track --c", {"device="}),
        ("toftrack track a.npz -m --cfg job seed=1,2 device=sa", {"device=sample"}),
        ("toftrack train ", {"pose_space=", "data="}),
        ("toftrack track ", {"hand.", "hands="}),
    ],
)
def test_a_shell_completes_commands_and_settings(line, offered, capsys, monkeypatch) -> None:
    monkeypatch.setenv("COMP_LINE", line)
    assert front.main(["-sc", "query=bash"]) == 0
    words = set(capsys.readouterr().out.split())
    assert offered <= words and bool(offered) == bool(words)


@pytest.mark.parametrize(("called", "by"), [("bin/toftrack", "toftrack"), ("track.py", "python")])
def test_completion_is_of_what_is_typed(called: str, by: str, capsys, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", [called])
    monkeypatch.setenv("COMP_LINE", "")
    assert front.main(["track", "-sc", "install=bash"]) == 0
    assert capsys.readouterr().out.endswith(f"hydra_bash_completion {by}\n")


@pytest.mark.parametrize("words", ["track --device sample", "track -o x", "recover", "export x"])
def test_an_option_that_there_is_not_is_one_sentence(words: str, capsys) -> None:
    assert front.main(words.split()) == 1
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and "--help" in said


@pytest.mark.parametrize(
    "name", ["手 يد/it", r"C:\new\run", r"C:\Users\MAXMUS~1\run", r"\\machine\runs", "C:\\runs\\"]
)
def test_a_folder_s_name_may_be_of_any_script_and_of_windows(name: str) -> None:
    (override,) = options_last([f"hydra.run.dir={name}"])
    read = OverridesParser.create().parse_override(override)
    assert (read.key_or_group, read.value()) == ("hydra.run.dir", name)


@pytest.mark.parametrize("words", ["--version", "track seed=1 --version"])
def test_the_version_is_ours(words: str, capsys) -> None:
    assert front.main(words.split()) == 0
    assert capsys.readouterr().out == f"toftrack {toftrack.__version__}\n"


def test_a_device_that_plays_files_may_be_chosen_beside_the_name() -> None:
    words = ["device=folder", "device.unit_m=0.0001"]
    assert with_recording([*words, "a b"]) == ["device.path='a b'", *words]


def test_a_name_that_begins_with_a_tilde_is_not_somebody_s_home(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert with_recording(["~x"]) == ["~x"]
    Path("~x").touch()
    assert with_recording(["~x"])[1] == "device.path='./~x'"


def test_what_is_neither_is_taken_for_a_file_so_that_the_error_says_it_is_missing() -> None:
    for name in ("gone.npz", "gone [2]=x.npz", "-"):
        assert with_recording([name])[1] == f"device.path={quoted(name)}"


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        ([""], "name is empty"),
        (["a.npz", "b.npz"], "two recordings, 'a.npz' and 'b.npz'"),
        (["${x}.npz"], "rename the file"),
        (["device", "=", "sample"], "'device' is no recording; .*without blanks as device=VALUE"),
        (["view"], "'view' is no recording; .* view=VALUE"),
        (["a.npz", "device=sr3000"], "device=sr3000 and the recording 'a.npz'"),
    ],
)
def test_what_cannot_be_one_recording_is_reported(words: list[str], reported: str) -> None:
    with pytest.raises(ToftrackError, match=reported):
        with_recording(words)
