"""Old settings, choices, classes and programs end with one sentence that names the new one."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf

from toftrack import make_tracker
from toftrack.configuration.compose import configuration, configuration_folder, one_sentence
from toftrack.configuration.renamed import GONE, MOVED, PAPERS, PROGRAMS, TARGETS
from toftrack.errors import ToftrackError


def _sentence(*overrides: str) -> str:
    with pytest.raises(ToftrackError) as error:
        configuration(*overrides)
    assert "\n" not in str(error.value)
    return str(error.value)


def _setting(name: str) -> str:
    return name if "=" in name else f"{name}=1"


@pytest.mark.parametrize("name", MOVED)
def test_an_old_name_is_answered_with_the_new_one(name: str) -> None:
    what = name if "=" in name else f"setting {name}"
    said = f"there is no {what} any more; give {MOVED[name]}"
    assert _sentence(_setting(name)) == said
    if "=" not in name:
        assert _sentence(f"+{name}=1") == said


@pytest.mark.parametrize("name", MOVED)
def test_the_new_name_is_one(name: str) -> None:
    key, _, choice = MOVED[name].partition("=")
    config = configuration(*([MOVED[name]] if choice else []))
    assert OmegaConf.select(config, key, default=config) is not config


@pytest.mark.parametrize("name", GONE)
def test_what_is_gone_is_answered_with_what_to_give(name: str) -> None:
    said = _sentence(_setting(name))
    assert said.startswith("there is no ") and name in said and said.endswith(GONE[name])


@pytest.mark.parametrize("name", [name for name in PAPERS if name != "start"])
def test_the_papers_settings_say_where_they_belong(name: str) -> None:
    assert "belongs to experiment=paper" in _sentence(_setting(name))
    configuration("experiment=paper", name if "=" in name else f"{name}=0.1")


@pytest.mark.parametrize("target", TARGETS)
def test_an_old_class_is_answered_with_the_new_one(target: str) -> None:
    with pytest.raises(ToftrackError) as error, one_sentence():
        instantiate({"_target_": target})
    assert str(error.value) == (f"there is no {target} any more; give _target_: {TARGETS[target]}")
    assert callable(get_object(TARGETS[target]))


@pytest.mark.parametrize(
    ("file", "words", "reported"),
    [
        (
            "lost/calibrated.yaml",
            ("toftrack.tracking.confidence.JointC", "toftrack.tracking.mine.JointC"),
            "the _target_ toftrack.tracking.mine.JointConfidence cannot be imported",
        ),
        (
            "refine/gauss_newton.yaml",
            ("damping:", "swaps: 3\ndamping:"),
            "there is no setting refine.swaps any more; give hysteresis.exchanged",
        ),
        (
            "hand/default.yaml",
            ("  keypoints:", "  votes:"),
            "there is no setting hand.adapt.votes any more; give hand.adapt.keypoints",
        ),
        (
            "config.yaml",
            ("  - hysteresis: default\n", ""),
            "the configuration has no hysteresis; add '- hysteresis: default' to the defaults",
        ),
        (
            "config.yaml",
            ("  - detector: network\n", "  - detector@relocation: network\n"),
            "there is no setting relocation any more; give detector",
        ),
    ],
)
def test_a_folder_of_ones_own_is_answered_alike(
    file: str, words: Sequence[str], reported: str, tmp_path: Path
) -> None:
    folder = tmp_path / "conf"
    shutil.copytree(configuration_folder(), folder)
    text = (folder / file).read_text(encoding="utf-8")
    assert words[0] in text
    (folder / file).write_text(text.replace(*words), encoding="utf-8")
    with pytest.raises(ToftrackError) as error:
        make_tracker(config_dir=folder)
    assert str(error.value).startswith(reported) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", PROGRAMS)
def test_an_old_program_says_the_new_one(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", f"toftrack.programs.{name}"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr == (
        f"error: there is no toftrack.programs.{name} any more; "
        f"give python -m toftrack.programs.{PROGRAMS[name]}\n"
    )
