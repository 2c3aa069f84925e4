"""The two programs that Hydra runs: `toftrack track` and `toftrack train`; and
`toftrack track FILE`: a recording's name in place of device=replay device.path=FILE.
"""

from __future__ import annotations

import argparse
import logging
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Sequence

import hydra
from hydra.utils import instantiate
from omegaconf import DictConfig

from toftrack.configuration import configuration_folder
from toftrack.configuration.compose import (
    devices_of_files,
    modest_files,
    quoted,
    searched,
    setting_names,
)
from toftrack.configuration.plugins import offer_installed
from toftrack.errors import ToftrackError
from toftrack.programs import command_line, shutdown
from toftrack.recordings.rosbag import is_bag

_WITH_VALUE = frozenset(
    "--config-path -cp --config-name -cn --config-dir -cd --cfg -c --package -p "
    "--experimental-rerun".split()
)
"""Hydra's options that are followed by a value."""
_SHORT = tuple("-h -c -p -r -m -sc -i".split())
_LONG = (
    "--help --hydra-help --version --cfg --resolve --package --run --multirun --shell-completion "
    "--config-path --config-name --config-dir --experimental-rerun --info"
).split()
"""All of Hydra's options."""
_INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
"""What may follow Hydra's --info, or be left out."""
_KEY = re.compile(r"[+~]{0,2}[\w./@:]+")


@command_line.sweep_job
def track_job(config: DictConfig) -> float:
    """Track, write the results, and return what a sweep minimises."""
    # The device comes before the seconds that torch takes: a missing camera is reported at once.
    device = instantiate(config.device)
    from toftrack.programs.ahead import compiling_ahead

    with compiling_ahead():
        from toftrack.programs.track import track

        return track(config, device)


@command_line.sweep_job
def train_job(config: DictConfig) -> float:
    """Train, write the model and its figures, and return what a sweep minimises."""
    from toftrack.programs.train import train  # takes seconds: an override's error comes before

    return train(config)


def track(arguments: Sequence[str]) -> None:
    """Track as a command line says, which may name a recording."""
    start(track_job, "toftrack track", "config", with_recording(arguments))


def train(arguments: Sequence[str]) -> None:
    """Train as a command line says."""
    start(train_job, "toftrack train", "train_pose_space", arguments)


def start(
    job: Callable[[DictConfig], float], program: str, config: str, arguments: Sequence[str]
) -> None:
    """Run a Hydra application; it reads the command line of the process."""
    folder, words = str(configuration_folder()), options_last(arguments)
    for own in config_folders(arguments):
        searched(own)
    offer_installed()
    application = hydra.main(version_base="1.3", config_path=folder, config_name=config)(job)
    before, told = sys.argv, logging.raiseExceptions
    if "-sc" in arguments:  # Hydra tells a shell to complete what the program is called by
        program = before[0]
        os.environ["COMP_LINE"] = _line_to_complete(os.environ.get("COMP_LINE", ""))
    sys.argv = [program, *words]
    logging.raiseExceptions = False  # what Hydra logs of --info may have no reader any more
    try:
        with modest_files():
            application()
    except BrokenPipeError:  # of what Hydra itself tells, as --hydra-help: nobody reads on
        shutdown.forget_streams()
    finally:
        sys.argv, logging.raiseExceptions = before, told


def _line_to_complete(line: str) -> str:
    """A command line that a shell has for Hydra: one program, its settings, and the word that is
    being typed. A recording's name, or most options, would be an error.
    """
    *words, last = line.split(" ")
    sweep = ["-m"] if "-m" in words else []
    settings = (_readable(word) for word in words if "=" in word and word[0] != "-")
    return " ".join(["toftrack", *sweep, *settings, last if last[:1] != "-" else ""])


def with_recording(arguments: Sequence[str], folders: Sequence[str] = ()) -> list[str]:
    """The arguments with a file's name as overrides.

    What begins with a group or a setting and has a = is an override, whatever files there are.
    Where no device is chosen, rosbag is taken for a ROS bag, folder for another folder, and replay
    for everything else. Raises ToftrackError for two recordings, or one beside a device that plays
    none.
    """
    known = setting_names()
    others: list[str] = []
    files: list[str] = []
    for word, is_value in _words(arguments):
        (others if is_value or not _is_file(word, known) else files).append(word)
    if not files:
        return others
    if "" in files:
        raise ToftrackError("the recording's name is empty; give that of a file")
    for word in files:
        setting = word.rstrip(":")
        if not _exists(word) and (setting in (*known, "") or "=" in (word[0], word[-1])):
            key = setting if setting in known and setting else "device"
            raise ToftrackError(
                f"'{word}' is no recording; settings are given without blanks as {key}=VALUE"
            )
    if len(files) > 1:
        options_last(others)  # an option that there is not tells more than the word after it
        raise ToftrackError(
            f"there are two recordings, '{files[0]}' and '{files[1]}'; give one at a time, or quote"
            " a name that has blanks in it"
        )
    if "${" in files[0]:  # OmegaConf would look for a setting of that name, however it is quoted
        raise ToftrackError(
            f"the recording's name, '{files[0]}', has ${{ in it, which means something else in "
            "settings; rename the file"
        )
    device = next((word for word in others if word.startswith("device=")), None)
    if device is not None and device.removeprefix("device=") not in devices_of_files(
        [*config_folders(arguments), *folders]
    ):
        raise ToftrackError(
            f"{device} and the recording '{files[0]}' both give the frames; leave one out"
        )
    # What the shell has left of a ~ is the file's own, where there is one.
    name = f"./{files[0]}" if files[0][0] == "~" and os.path.exists(files[0]) else files[0]
    chosen: list[str] = []
    if device is None:
        path = os.path.expanduser(name)
        player = "rosbag" if is_bag(path) else "folder" if os.path.isdir(path) else "replay"
        chosen = [f"device={player}"]
    return [*chosen, f"device.path={quoted(name)}", *others]


def config_folders(arguments: Sequence[str]) -> list[str]:
    """What follows --config-dir on a command line."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", "-cd", action="append", default=[])
    found: list[str] = parser.parse_known_args(list(arguments))[0].config_dir
    return found


def options_last(arguments: Sequence[str]) -> list[str]:
    """The arguments in an order that Hydra's parser reads: all overrides, and then options. After
    --info, whose value may be left out, it would take an override for that.
    """
    options: list[str] = []
    overrides: list[str] = []
    for word, is_value in _words(arguments):
        if word == "--":
            continue  # what it parts comes in the other order
        if is_value:
            options.append(word)
        elif word.startswith("-"):
            _check_option(word.partition("=")[0])
            options.append(word)
        else:
            overrides.append(_readable(word))
    return [*overrides, *options]


def _words(arguments: Sequence[str]) -> Iterator[tuple[str, bool]]:
    """The arguments, each with whether it is the value of an option."""
    before, is_value = "", False
    for word in arguments:
        told = before in _WITH_VALUE or before in ("--info", "-i") and word in _INFO
        is_value = told and not is_value
        yield word, is_value
        before = word
    if before in _WITH_VALUE and not is_value:
        raise ToftrackError(f"{before} has no value; --hydra-help tells which there are")


def _check_option(word: str) -> None:
    """ToftrackError for an option that is none of Hydra's, which would print all that it has."""
    if not word.startswith(_SHORT) and not any(o.startswith(word) for o in _LONG):
        raise ToftrackError(
            f"there is no option {word}; settings are given as KEY=VALUE, without dashes and "
            "blanks, and --help lists them"
        )


def _readable(override: str) -> str:
    """Outside of quotes Hydra reads letters of ASCII alone, as in a folder's name, and no ~ of a
    short name of Windows; of the two signs that begin the name of another machine it reads one.
    """
    key, _, value = override.partition("=")
    plain = value.isascii() and "~" not in value[1:] and not value.startswith("\\\\")
    if plain or set(value) & set("""'"[]{}(),$"""):
        return override
    return f"{key}={quoted(value)}"


def _is_file(argument: str, known: Collection[str]) -> bool:
    if argument.startswith("-") and argument != "-" and not os.path.exists(argument):
        return False
    key, separator, _ = argument.partition("=")
    if not separator:  # without one, only a deletion is an override
        return not argument.startswith("~") or _exists(argument)
    if not _KEY.fullmatch(key):
        return True
    first = re.split(r"[./@:]", key.lstrip("+~"))[0]
    return first not in known and _exists(argument)


def _exists(name: str) -> bool:
    return os.path.exists(name) or os.path.exists(os.path.expanduser(name))
