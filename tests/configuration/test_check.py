"""Overrides that cannot be meant: one sentence, before anything slow."""

from __future__ import annotations

import subprocess
import sys

import pytest
import yaml
from helpers.tracking import CONF, ROOT
from omegaconf import OmegaConf

import toftrack.configuration.check as check
from toftrack.configuration.compose import configuration
from toftrack.configuration.sentences import sentence
from toftrack.errors import ToftrackError

WRONG = (
    ("detector.hypotheses=0", "detector.hypotheses=0 .*whole number above 0"),
    ("filter.spread.depth_m=-0.1", "filter.spread.depth_m=-0.1 .*at least 0"),
    ("filter.particles=many", "filter.particles=many .*a whole number"),
    ("filter.exponent=nan", "filter.exponent=nan .*a number"),
    ("refine.point_m=[1]", "refine.point_m=.*a number"),
    ("device.repeat=5", "device.repeat=5 .*true or false"),
    ("hands=9", "hands=9 .*whole number above 0 and at most 8"),
)


@pytest.mark.parametrize(("override", "words"), WRONG)
def test_a_wrong_value_is_refused_in_one_sentence(override: str, words: str) -> None:
    with pytest.raises(ToftrackError, match=words) as error:
        configuration(override)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "overrides",
    [
        ("filter.exponent=30", "filter.particles=100"),  # a whole number is a number
        ("view=browser", "view.linger_s=inf"),
        ("experiment=paper", "filter.particles=10"),
        ("segmentation.reach_m=inf",),
        ("detector.merit=-4",),
        ("device=sr3000", "device.persistence.give_up_s=null", "+device.usb.registers={3: 20}"),
        ("experiment=paper", "start.pose=[0,0,0.4,0,0,0]", "detector=none", "start=rough"),
        ("refine=none", "detector.places=1", "posterior.keypoints=0"),
        ("+device.anything=-1",),
        ("~device.repeat",),
        ("gestures.file=mine.csv", "device.stop=5"),
    ],
)
def test_a_right_value_passes(overrides: tuple[str, ...]) -> None:
    configuration(*overrides)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (
            ("detector=none",),
            "detector=none belongs to experiment=paper, .* give experiment=paper, or leave",
        ),
        (("lost=never",), "lost=never belongs to experiment=paper; .* leave lost=never out"),
        (
            ("experiment=paper", "lost=calibrated"),
            "lost=calibrated goes with these alone; leave lost=calibrated out",
        ),
        (
            ("experiment=paper", "refine=gauss_newton"),
            "refine=gauss_newton goes with these alone; leave refine=gauss_newton out",
        ),
    ],
)
def test_parts_of_two_trackers_do_not_mix(overrides: tuple[str, ...], words: str) -> None:
    with pytest.raises(ToftrackError, match=words) as error:
        configuration(*overrides)
    assert "\n" not in str(error.value)


def test_what_a_part_of_somebody_else_s_accepts_is_not_judged(tmp_path) -> None:
    (tmp_path / "device").mkdir()
    (tmp_path / "device" / "raw.yaml").write_text("_target_: mine.Raw\ngain: 1\n")
    (tmp_path / "config.yaml").write_text("defaults:\n  - device: raw\n  - _self_\n")
    assert configuration("device.gain=-0.5", config_dir=tmp_path).device.gain == -0.5


@pytest.mark.parametrize(
    "text",
    [
        "a: [",
        "defaults: 5",
        "a: ${ 5://b}",
        "seed: " + "9" * 5000,
        "[" * 3000,
        "1: 2",
    ],
)
@pytest.mark.parametrize("name", ["config.yaml", "device/raw.yaml"])
def test_a_configuration_that_is_damaged_is_one_sentence(tmp_path, name: str, text: str) -> None:
    (tmp_path / "device").mkdir()
    (tmp_path / "device" / "raw.yaml").write_text("gain: 1\n")
    (tmp_path / "config.yaml").write_text("defaults:\n  - device: raw\n  - _self_\nseed: 0\n")
    (tmp_path / name).write_text(text)
    if (name, text) == ("device/raw.yaml", "1: 2"):
        assert configuration("seed=1", config_dir=tmp_path).seed == 1
        return
    with pytest.raises(ToftrackError) as error:
        configuration("seed=1", config_dir=tmp_path)
    assert str(error.value) and "\n" not in str(error.value)


def test_the_file_and_the_line_that_are_no_yaml_are_reported() -> None:
    with pytest.raises(yaml.YAMLError) as error:
        yaml.safe_load("a: 1\nb: [")
    reported = sentence(error.value)
    assert reported.startswith("a file of the configuration is no YAML: ") and "line 2" in reported


def test_the_program_ends_without_torch_having_been_loaded(tmp_path) -> None:
    command = [sys.executable, "-X", "importtime", str(ROOT / "track.py"), "filter.passes=0"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("error: filter.passes=0 is not possible")
    assert "| torch\n" not in done.stderr


def test_every_setting_of_the_tables_is_one() -> None:
    keys = set(map(str, OmegaConf.load(CONF / "config.yaml")))
    for path in CONF.glob("*/*.yaml"):
        pending = [(path.parent.name, OmegaConf.create(yaml.safe_load(path.read_text())))]
        while pending:
            prefix, node = pending.pop()
            for name in node:
                keys.add(f"{prefix}.{name}")
                if not OmegaConf.is_missing(node, name) and OmegaConf.is_dict(node._get_node(name)):
                    pending.append((f"{prefix}.{name}", node[name]))
    bounded = check._ABOVE_ZERO | check._AT_MOST.keys() | check._OPEN_ENDED
    assert bounded | check._MAY_BE_NONE <= keys
