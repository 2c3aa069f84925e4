"""Overrides that cannot be meant: one sentence, before anything slow."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from helpers.programs import python
from helpers.tracking import CONF, ROOT
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import toftrack.configuration.check as check
from toftrack import make_tracker
from toftrack.configuration import configuration_folder
from toftrack.configuration.compose import configuration
from toftrack.errors import ToftrackError
from toftrack.programs.main import main

WRONG = [
    ("detector.hypotheses=0", "detector.hypotheses=0 is not possible; give a whole number above 0"),
    ("filter.particles=10000000", "filter.particles=10000000 is not possible"),
    ("filter.exponent=nan", "filter.exponent=nan is not possible; give a number"),
    ("device.repeat=5", "device.repeat=5 is not possible; give true or false"),
    ("device=sr3000 device.fps=-1", "device.fps=-1 is not possible; give a number above 0"),
    ("hands=9", "hands=9 is not possible; give a whole number above 0 and at most 8"),
    (f"seed={10**23}", "is not possible"),
    ("seed=" + "[" * 3000 + "]" * 3000, ""),
    ("+seed.x=" + "{a:" * 400 + "1" + "}" * 400, ""),
    ("filter.spread=3", "it has settings of its own; give these, as filter.spread.translation_m="),
    ("gestures.pinch=null", "it has settings of its own; give these, as gestures.pinch.touching="),
    ("likelihood=3", "a group takes the name of one of its choices"),
    ("hand=[1,2]", "a group takes the name of one of its choices"),
    ("experiment=null", "experiment=none means no experiment"),
    ("filter.spread.depth_m=1e30", "give a number of at least 0 and at most 10"),
    # What was probably meant.
    ("hand.sied=left", "there is no setting hand.sied; did you mean hand.side?"),
    ("particles=3", "did you mean filter.particles?"),
    ("devcie=replay", "there is no setting devcie; did you mean device?"),
    ("view.quux=1", "there is no setting view.quux; this view has none"),
    ("lost.qqzz=1", "there is no setting lost.qqzz; lost has confidence, "),
    ("stream.port=5", "no setting stream.port of this stream; it is one of stream=osc, udp, web"),
    ("quux=1", "there is no setting quux; the configuration has device, "),
    ("device.path=a.npz", "a recording is given by its name alone: toftrack track FILE"),
    ("device=replya", "there is no device=replya; did you mean device=replay? The choices are"),
    ("pose_space=kpca", "there is no pose_space=kpca; did you mean pose_space=kernel_pca?"),
    ("seed=range(0,3)", "has several values; give one (toftrack track -m"),
    ("device=replay device.intrinsics=5,5,3,2", 'give one, or "device.intrinsics=[5,5,3,2]" wh'),
    ("device=replay device.K=[5,5,3,2]", "no setting device.K; did you mean device.intrinsics?"),
    ("view=web", "did you mean view=browser?"),
    ("pose_space.file=a.npz pose_space.data=natural", "data=natural is for learning, but pose_"),
    ("device.path=a (1).npz", 'give the recording by its name alone: toftrack track "a (1)'),
    ("data=leap", "there is no data to choose here; "),
    ("start=rough", "start belongs to experiment=paper; give experiment=paper as well, or leave"),
    ("start.pose=0.1", "start.pose belongs to experiment=paper; "),
    ("experiment=paper start.psoe=0.1", "no setting start.psoe; did you mean start.pose?"),
    # Parts of two trackers do not mix.
    ("detector=none", "detector=none belongs to experiment=paper, the tracker without networks; "),
    ("experiment=paper lost=calibrated", "lost=calibrated works only with networks"),
    ("experiment=paper refine.iterations=3", "refine.iterations=3 works only with networks"),
    ("experiment=paper posterior.overlap=0", "posterior.overlap=0 works only with networks"),
    ("experiment=paper detector=network", "leave it out, or the detector"),
]


@pytest.mark.parametrize(("overrides", "words"), WRONG, ids=lambda text: text[:60])
def test_what_cannot_be_meant_is_refused_in_one_sentence(overrides: str, words: str) -> None:
    given = [overrides] if "(" in overrides else overrides.split()
    with pytest.raises(ToftrackError) as error:
        configuration(*given)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_what_a_space_is_learned_from_is_not_said_as_to_the_tracker() -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        given = ["data=natural"]
        check.check_overrides(compose("train_pose_space", given), "train_pose_space", given)
        given = ["pose_space.data=natural"]
        config = compose("train_pose_space", given)
        with pytest.raises(ToftrackError, match="of the tracker; give data=natural to train$"):
            check.check_overrides(config, "train_pose_space", given)


@pytest.mark.parametrize(
    "overrides",
    [
        ("filter.exponent=30", "filter.particles=100"),  # a whole number is a number
        ("segmentation.reach_m=inf",),
        ("detector.merit=-4",),
        ("device=sr3000", "device.persistence.give_up_s=null", "+device.usb.registers={3: 20}"),
        ("experiment=paper", "start.pose=[0,0,0.4,0,0,0]", "detector=none", "start=rough"),
        ("+device.anything=-1",),
        ("~device.repeat",),
        ("gestures.file=mine.csv", "device.stop=5"),
        ("+a=${hand.side}", "+b=${a} ${a}", "+c=[${b},${likelihood}]", "hand.side=left"),
    ],
)
def test_a_right_value_passes(overrides: tuple[str, ...]) -> None:
    configuration(*overrides)


@pytest.fixture
def own(tmp_path: Path) -> Callable[[str, str | bytes], None]:
    """Writes a file of a configuration of one's own, in `tmp_path`."""

    def write(name: str, text: str | bytes) -> None:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(text.encode() if isinstance(text, str) else text)

    return write


def test_what_a_part_of_somebody_else_s_accepts_is_not_judged(own, tmp_path) -> None:
    own("device/raw.yaml", "_target_: mine.Raw\ngain: 1\n")
    own("config.yaml", "defaults:\n  - device: raw\n  - _self_\n")
    assert configuration("device.gain=-0.5", config_dir=tmp_path).device.gain == -0.5


@pytest.mark.parametrize(
    ("file", "words", "reported"),
    [
        (
            "lost/calibrated.yaml",
            ("toftrack.tracking.confidence.", "toftrack.tracking.mine."),
            "_target_ toftrack.tracking.mine.make_confidence cannot be imported.*of --config-dir",
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


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("config.yaml", "defaults: 5"),
        ("config.yaml", "1: 2"),
        ("config.yaml", "[" * 1000),
        ("device/raw.yaml", "a: ${ 5://b}"),
        ("device/raw.yaml", "seed: " + "9" * 5000),
    ],
    ids=lambda text: text[:15],
)
def test_a_configuration_that_is_damaged_is_one_sentence(
    own, tmp_path, name: str, text: str
) -> None:
    own("device/raw.yaml", "gain: 1\n")
    own("config.yaml", "defaults:\n  - device: raw\n  - _self_\nseed: 0\n")
    own(name, text)
    with pytest.raises(ToftrackError) as error:
        configuration("seed=1", config_dir=tmp_path)
    assert str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("content", "words"), [(b"a: 1\nb: [", "line 2"), (b"name: caf\xe9", "'utf-8' codec")]
)
def test_the_file_that_is_no_yaml_is_named(own, tmp_path: Path, content: bytes, words: str) -> None:
    own("device/mine.yaml", content)
    with pytest.raises(ToftrackError, match=f"device/mine.yaml' cannot be read as YAML.*{words}"):
        configuration("device=mine", config_dir=tmp_path)


def test_the_program_ends_without_torch_having_been_loaded(tmp_path) -> None:
    words = ("-X", "importtime", str(ROOT / "track.py"), "filter.passes=0")
    done = python(*words, folder=tmp_path)
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


@pytest.mark.parametrize(
    "text",
    [
        "a0: &a0 [1, 1, 1, 1, 1]\n"
        + "".join(f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9)),
        f"many: [{'1,' * 20_000}]\n",
        "#" * 200_000,
    ],
    ids=["aliases", "values", "letters"],
)
def test_a_file_that_is_large_or_grows_by_its_aliases_is_refused_at_once(
    text: str, own, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    own("stream/mine.yaml", f"_target_: mine.Stream\n{text}")
    assert main(["track", "--config-dir", str(tmp_path), "stream=mine", "--cfg", "job"]) == 1
    said = capsys.readouterr().err
    assert "mine.yaml' is too large for a file of the configuration" in said
    assert said.count("\n") == 1
    with pytest.raises(ToftrackError, match="is too large"):
        configuration("stream=mine", config_dir=tmp_path)


def test_aliases_and_anchors_of_usual_size_are_read(own, tmp_path: Path) -> None:
    own("stream/mine.yaml", "a: &a [1, 2]\nb: &b {one: *a, two: *a}\nc: [*b, *b]\n")
    stream = configuration("stream=mine", config_dir=tmp_path).stream
    assert stream.c == [{"one": [1, 2], "two": [1, 2]}] * 2


@pytest.mark.parametrize(
    "first, doubled",
    [("''", "${v{0}}${v{0}}"), ("[1]", "[${v{0}},${..v{0}}]"), ("x", "${oc.select:v{0}}${v{0}}")],
    ids=["texts", "lists", "resolvers"],
)
def test_interpolations_that_grow_by_one_another_are_refused_at_once(
    first: str, doubled: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    rising = [f"+v{i}='{doubled.replace('{0}', str(i - 1))}'" for i in range(1, 29)]
    overrides = [f"+v0={first}", *(one.replace("'", "") if "[" in one else one for one in rising)]
    folder = tmp_path / "runs"
    assert main(["track", *overrides, f"hydra.run.dir='{folder}/${{v28}}'"]) == 1
    said = capsys.readouterr().err
    assert "make the configuration too large" in said and said.count("\n") == 1
    assert not folder.exists()
    with pytest.raises(ToftrackError, match="too large"):
        configuration(*overrides)
