"""Overrides that mean nothing: what was probably meant."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from toftrack import make_tracker
from toftrack.configuration import configuration_folder
from toftrack.configuration.compose import configuration
from toftrack.errors import ToftrackError


@pytest.mark.parametrize(
    ("override", "reported"),
    [
        ("hand.sied=left", "there is no setting hand.sied; did you mean hand.side?"),
        ("particles=3", "did you mean filter.particles?"),
        ("devcie=replay", "there is no setting devcie; did you mean device?"),
        ("view.quux=1", "there is no setting view.quux; view has "),
        ("quux=1", "there is no setting quux; the configuration has device, "),
        ("device.path=a.npz", "a recording is given by its name alone: toftrack track FILE"),
        ("device=replya", "there is no device=replya; did you mean device=replay? The choices are"),
        ("view=quux", "there is no view=quux; give one of browser, none, rerun, video"),
        ("device.path=a (1).npz", "give the recording by its name alone: toftrack track 'a (1)"),
        (
            "start=rough",
            "start belongs to experiment=paper; give experiment=paper as well, or leave",
        ),
        ("start.pose=0.1", "start.pose belongs to experiment=paper; "),
    ],
)
def test_a_misspelt_override_gets_the_nearest_one(override: str, reported: str) -> None:
    with pytest.raises(ToftrackError) as error:
        configuration(override)
    assert reported in str(error.value) and "\n" not in str(error.value)


def test_a_misspelt_setting_of_the_papers_tracker_gets_the_nearest_one() -> None:
    with pytest.raises(ToftrackError, match="no setting start.psoe; did you mean start.pose?"):
        configuration("experiment=paper", "start.psoe=0.1")


@pytest.mark.parametrize(
    ("file", "words", "reported"),
    [
        (
            "lost/calibrated.yaml",
            ("toftrack.tracking.confidence.", "toftrack.tracking.mine."),
            "the _target_ toftrack.tracking.mine.make_confidence cannot be imported",
        ),
        (
            "refine/gauss_newton.yaml",
            ("angle_rad:", "nope: 3\nangle_rad:"),
            "argument 'nope'.*at refine",
        ),
        (
            "config.yaml",
            ("  - posterior: default\n", ""),
            "the configuration has no posterior; add '- posterior: default' to the defaults",
        ),
    ],
)
def test_what_is_wrong_in_a_folder_of_ones_own_is_named(
    file: str, words: tuple[str, str], reported: str, tmp_path: Path
) -> None:
    folder = tmp_path / "conf"
    shutil.copytree(configuration_folder(), folder)
    text = (folder / file).read_text(encoding="utf-8")
    assert words[0] in text
    (folder / file).write_text(text.replace(*words), encoding="utf-8")
    with pytest.raises(ToftrackError, match=reported) as error:
        make_tracker(config_dir=folder)
    assert "\n" not in str(error.value)
