"""Parts of one's own, as docs/extending.md and docs/examples/plugins have them: from the folder of
--config-dir and from an installed package, and what is said where one is not there."""

import importlib
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import programs
from helpers.tracking import ROOT, sample
from hydra.core.config_store import ConfigStore
from hydra.utils import instantiate

import toftrack
from toftrack.api import build_model
from toftrack.configuration import plugins
from toftrack.configuration.compose import configuration
from toftrack.devices.replay import Replay, Sample
from toftrack.errors import ToftrackError
from toftrack.files.archives import read_archive, write_archive
from toftrack.pose_space.files import fit_pose_space, load_pose_space, save_pose_space
from toftrack.pose_space.held_out import nearest_latents

PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"<!-- test: extend (\S+) -->\n```\w+\n(.*?)```", PAGE, re.DOTALL))
EXAMPLES = ROOT / "docs" / "examples" / "plugins"
MODULES = {"autoencoder", "point_to_surface", "socket_camera"}
MODULES |= {name.removesuffix(".py") for name in FILES if name.endswith(".py")}
GROUPS = ("pose_space", "likelihood", "renderer", "detector", "stream", "view", "gestures")
OBJECTS = {
    "pose_space": "my_space:Independent",
    "likelihood": "my_likelihood:Overlap",
    "renderer": "my_renderer:make",
    "detector": "my_detector:make",
    "device": "my_device:Millimetres",
    "recordings": "my_reader:Raw16",
    "stream": "my_stream:TipLog",
    "view": "my_view:Snapshots",
    "gestures": "my_gestures:make",
}
FRAMES = 4


@pytest.fixture(autouse=True)
def paths(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a run adds to the paths of modules is gone after it, with the modules."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))
    yield
    for group in plugins.ENTRY_POINTS:
        for name in ("theirs.yaml", "late.yaml"):
            ConfigStore.instance().repo.get(group, {}).pop(name, None)
    for name in MODULES:
        sys.modules.pop(name, None)


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A folder with all that the page shows, in `my_conf`, and a recording for its readers."""
    for name, text in FILES.items():
        path = tmp_path / "my_conf" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    steps = [np.rint(np.minimum(f.depth, 65) * 1000).astype(np.uint16) for f in Sample(stop=FRAMES)]
    np.save(tmp_path / "images.npy", np.stack(steps))
    np.stack(steps).tofile(tmp_path / "images.raw16")
    return tmp_path


@pytest.fixture
def package(mine: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same, of an installed package that calls each part `theirs`."""
    site = mine / "site"
    facts = site / "mine-1.0.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    lines = []
    for group, value in OBJECTS.items():
        name = "raw16" if group == "recordings" else "theirs"
        lines += [f"[{plugins.ENTRY_POINTS[group]}]", f"{name} = {value}"]
    (facts / "entry_points.txt").write_text("\n".join(lines) + "\n")
    for name in FILES:
        if name.endswith(".py"):
            (site / name).write_text(FILES[name], encoding="utf-8")
    monkeypatch.syspath_prepend(site)
    importlib.invalidate_caches()
    return mine


def test_a_folder_of_ones_own_brings_every_kind(mine: Path) -> None:
    chosen = [f"{group}=mine" for group in GROUPS]
    given = ("--config-dir", "my_conf", *chosen, "device=mine", "device.path=images.npy")
    more = ("view.every=2", "likelihood.false_weight=0.5", "hydra.run.dir=out")
    status, _, err = programs.call(*given, *more, folder=mine)
    assert status == 0, err
    with np.load(mine / "out" / "track.npz") as track:
        facts = json.loads(track["metadata"].item())
        assert not track["lost"].all() and len(track["lost"]) == FRAMES
    assert facts["renderer"] == "coarse" and facts["pose_space"]["kind"] == "Independent"
    assert facts["device"]["device"] == "Millimetres"
    assert {"00000.png", "00002.png"} < {path.name for path in (mine / "out").iterdir()}
    assert len((mine / "tips.txt").read_text().splitlines()) > 0
    run = toftrack.read_run(mine / "out")
    with pytest.raises(ToftrackError, match="has a pose space of its own, my_space.Independent"):
        run.pose_space()


def test_a_reader_of_ones_own_plays_a_range_and_takes_a_name(mine: Path) -> None:
    given = ("--config-dir", "my_conf", "device=raw16", "images.raw16", "device.start=1")
    status, _, err = programs.call(*given, "view=none", "hydra.run.dir=out", folder=mine)
    assert status == 0, err
    with np.load(mine / "out" / "track.npz") as track:
        assert track["index"].tolist() == list(range(1, FRAMES))


def test_an_installed_package_brings_every_kind(package: Path) -> None:
    head = ["tolerance_m=0.02", "neighbourhood_m=0.02", "false_weight=1"]
    given = [f"likelihood.{word}" for word in head] + ["pose_space.iterations=400"]
    chosen = [f"{group}=theirs" for group in GROUPS]
    camera = ("device=theirs", f"device.path='{package}/images.npy'", "device.focal_px=200")
    config = configuration(*chosen, *given, *camera, "stream.path=tips.txt", "view.every=5")
    assert config.stream["_target_"] == "my_stream.TipLog"
    assert not MODULES & set(sys.modules), "what is not used is not imported"
    model = build_model(config)
    assert model.space.kind == "Independent" and "horns" in model.gestures.names
    assert type(model.likelihood).__name__ == "Overlap" and model.backend.make_scorer is not None
    assert type(model.detector).__name__ == "Nearest"
    assert instantiate(config.device).frames == FRAMES
    view = instantiate(config.view, folder=package, fps=25.0, frames=FRAMES)
    assert view.every == 5 and instantiate(config.stream).path == "tips.txt"
    assert Replay(package / "images.raw16").frames == FRAMES
    with pytest.raises(ToftrackError, match="pose_space.iteration is no setting of theirs"):
        toftrack.make_tracker("pose_space=theirs", "pose_space.iteration=4")


def test_an_installed_reader_may_compute_its_camera(package: Path) -> None:
    file = package / "site" / "my_reader.py"
    code = file.read_text().replace("self.camera =", "self.own =")
    file.write_text(code + "\n    camera = property(lambda self: self.own)\n")
    assert Replay(package / "images.raw16").camera.width == 176


def test_an_installed_part_stands_behind_toftracks_own(package: Path) -> None:
    entry = package / "site" / "mine-1.0.dist-info" / "entry_points.txt"
    entry.write_text("[toftrack.pose_spaces]\npca = nowhere:Thing\nlate = nowhere:Thing\n")
    assert configuration("pose_space=pca").pose_space.kind == "pca"
    with pytest.raises(ToftrackError, match="pose space late names nowhere:Thing, which cannot"):
        toftrack.make_tracker("pose_space=late")


@pytest.mark.parametrize(
    "text", ["[toftrack.devices]\nlate = not one!\n", "[toftrack.devices]\nx", "\ufeff["]
)
def test_what_a_damaged_package_brings_is_left_out(package: Path, text: str) -> None:
    (package / "site" / "mine-1.0.dist-info" / "entry_points.txt").write_text(text, "utf-8")
    with pytest.raises(ToftrackError, match="there is no device=late"):
        configuration("device=late")
    assert configuration("seed=1").seed == 1


def test_a_part_that_exits_while_it_loads_is_told(package: Path) -> None:
    (package / "my_camera.py").write_text("raise SystemExit(0)")
    (package / "my.yaml").parent.joinpath("device").mkdir()
    (package / "device" / "odd.yaml").write_text("_target_: my_camera.Camera\n")
    status, _, err = programs.call("--config-dir", ".", "device=odd", folder=package)
    assert (status, "Traceback" in err) == (1, False)
    assert "error: a part that is not toftrack's ended the program, in <module> (" in err


KIND = "the pose space kind 'autoencoder.Autoencoder' is unknown; known are"


def test_a_model_file_names_its_kind_and_imports_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    own = fit_pose_space("autoencoder.Autoencoder", 3, steps=5)
    model = tmp_path / "model.npz"
    save_pose_space(own, model)
    again = load_pose_space(model, "autoencoder.Autoencoder")
    assert again.kind == "Autoencoder" and again.dims == 3
    angles = again.decode(again.training_latents)
    assert torch.allclose(angles, own.decode(own.training_latents))
    del sys.modules["autoencoder"]
    with pytest.raises(ToftrackError, match="kind 'Autoencoder' is unknown"):
        load_pose_space(model)
    content = read_archive(model)
    header = json.loads(str(content["header"])) | {"kind": "autoencoder.Autoencoder"}
    write_archive(model, content | {"header": np.array(json.dumps(header))})
    with pytest.raises(ToftrackError, match=KIND):
        load_pose_space(model)
    assert "autoencoder" not in sys.modules


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("nowhere.Space", "pose_space.kind names nowhere.Space, which cannot be imported (No modu"),
        ("json.JSONDecoder", "pose_space.kind=json.JSONDecoder is no subclass of PoseSpace"),
        ("toftrack.pose_space.base.PoseSpace", "has no class method fit, and cannot be learned"),
        ("magic", "pose space kind 'magic' is unknown; known are"),
    ],
)
def test_a_kind_that_cannot_be_used_is_one_sentence(kind: str, words: str) -> None:
    with pytest.raises(ToftrackError, match=re.escape(words)):
        fit_pose_space(kind, 3)


def test_the_autoencoder_is_trained_in_a_sweep_and_tracks_from_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sweep's jobs may run anywhere: another process finds the module, too."""
    given = ("--config-dir", str(EXAMPLES), "-m", "pose_space=autoencoder", "compare=[]")
    sweep = ("hydra.sweep.dir=sweep", "pose_space.dims=2,3", "pose_space.steps=9")
    program = "train_pose_space.py"
    monkeypatch.setattr("toftrack.programs.train.write_figures", lambda *_: [])
    status, out, err = programs.call(*given, *sweep, folder=tmp_path, program=program)
    assert status == 0, err
    assert "#1 pose_space=autoencoder compare=[] pose_space.dims=3" in out
    model = tmp_path / "sweep" / "1" / "pose_space.npz"
    load = "from toftrack.pose_space.files import load_pose_space as load\n"
    load += f"print(load({str(model)!r}, 'autoencoder.Autoencoder').dims)"
    done = subprocess.run([sys.executable, "-c", load], capture_output=True, text=True)
    assert done.stdout == "3\n", done.stderr


def test_pose_spaces_without_a_class_are_not_trained(tmp_path: Path) -> None:
    (tmp_path / "my_conf" / "pose_space").mkdir(parents=True)
    (tmp_path / "my_conf" / "pose_space" / "own.yaml").write_text("_target_: mine.make\n")
    given = ("--config-dir", "my_conf", "pose_space=own")
    status, _, err = programs.call(*given, folder=tmp_path, program="train_pose_space.py")
    assert status == 1 and "pose_space._target_=mine.make cannot be learned here" in err


def test_distances_of_points_from_an_ellipsoid_are_exact_on_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    distances = importlib.import_module("point_to_surface").distances
    axes_m = torch.diag(torch.tensor([0.02, 0.05, 0.01]))[None, None]
    centre_m = torch.tensor([[[0.1, 0.0, 0.5]]])
    points_m = centre_m[0] + torch.tensor([[0.02, 0, 0], [0, 0, -0.01], [0, 0.053, 0], [0, 0, 0]])
    found = distances(points_m, centre_m, axes_m)[0]
    assert torch.allclose(found[:3], torch.tensor([0.0, 0.0, 0.003]), atol=1e-6)
    assert 0.005 < found[3] < 0.05, "the middle is inside"


@pytest.mark.parametrize("given", [True, False])
def test_a_likelihood_tracks_as_the_page_says_and_else_hears_of_its_threshold(
    given: bool, tmp_path: Path
) -> None:
    (line,) = re.findall(r"^python track.py (.* likelihood=point_to_surface .*)$", PAGE, re.M)
    words = line.replace("docs/examples/plugins", str(EXAMPLES)).split()
    threshold = "lost.score=0.2"
    assert threshold in words and any(word.startswith("filter.exponent=") for word in words)
    kept = [word for word in words if given or word != threshold]
    more = ("device.stop=5", "view=none", "hydra.run.dir=out")
    status, _, err = programs.call(*kept, *more, folder=tmp_path)
    assert status == 0, err
    assert given == (
        json.loads((tmp_path / "out" / "summary.json").read_text())["lost_frames"] == 0
    )
    assert given == (
        re.search(r"the mean score is 0\.3\d, and a frame below lost.score=0.5", err) is None
    )
    assert "overlay.png" not in err and ("5 of 5 frames were lost" in err) != given


PAPER = ("experiment=paper", "gestures=none", "hand.side=right")


@pytest.mark.parametrize(
    ("score", "said"),
    [
        ("counts.correct / union", r"gives \[nan, nan\] where correct is \[0.0, 0.0\]"),
        ("(counts.correct / union.clamp(min=1)).numpy()", "gives ndarray; it must give a tensor"),
        ("counts.correct / union.clamp(min=1) - 1", r"gives \[-1.0, -1.0\]"),
        ("counts.correct.mean()", "gives 0.0 where"),
        ("1 / union.clamp(min=1)", r"gives \[1.0, 1.0\]"),
        (
            "counts.correct",
            r"gives \[\d+.0\] where correct is \[\d+.0\]; it must give \(N,\) numbers",
        ),
    ],
)
def test_a_score_that_is_none_is_one_sentence(score: str, said: str, mine: Path) -> None:
    module = mine / "my_conf" / "my_likelihood.py"
    text = FILES[module.name]
    assert "counts.correct / union.clamp(min=1)" in text
    module.write_text(text.replace("counts.correct / union.clamp(min=1)", score))
    with pytest.raises(ToftrackError, match=f"^likelihood: Overlap.score {said}"):
        tracker = toftrack.make_tracker("likelihood=mine", *PAPER, config_dir=mine / "my_conf")
        tracker.step(sample().depth_m[0], sample().k)


def test_a_likelihood_of_the_page_prefers_the_true_pose(mine: Path) -> None:
    given = ("likelihood=depths", "lost.score=0.2", "filter.exponent=20", *PAPER)
    tracker = toftrack.make_tracker(*given, config_dir=mine / "my_conf")
    scene = sample()
    for index in range(3):
        estimate = tracker.step(scene.depth_m[index], scene.k, index, index / 25)
    assert not estimate.lost
    assert 1e3 * np.linalg.norm(estimate.joints_m - scene.joints_m[2], axis=1).mean() < 25


def test_a_space_of_ones_own_is_measured_in_double_and_swept_from_its_file(mine: Path) -> None:
    sys.path.append(str(mine / "my_conf"))
    space = fit_pose_space("my_space.Independent", 4)
    poses = space.decode(space.training_latents[:2])
    assert nearest_latents(space, poses).dtype == torch.float64
    assert space.encode(poses).dtype == torch.float32
    (mine / "models").mkdir()
    save_pose_space(space, mine / "models" / "mine.npz")
    given = ("--config-dir", "my_conf", "-m", "pose_space=pca,saved", "device.stop=1", "view=none")
    status, out, err = programs.call(*given, "hydra.sweep.dir=sweep", folder=mine)
    assert status == 0 and "#1 pose_space=saved" in out, err
    given = (f"pose_space.file={mine / 'models' / 'mine.npz'}", "pose_space=mine")
    for words, said in (
        ("pose_space.dims=3", "is a 4-dimensional Independent .*; give pose_space.dims=4$"),
        (
            "pose_space.iterations=5",
            "^pose_space.iterations=5 is for learning, but pose_space.file=",
        ),
    ):
        with pytest.raises(ToftrackError, match=said):
            toftrack.make_tracker(*given, words, config_dir=mine / "my_conf")


def test_an_error_in_code_of_ones_own_names_class_file_and_line(mine: Path) -> None:
    path = mine / "my_conf" / "my_space.py"
    before, _, after = FILES[path.name].partition("return self.mean")
    path.write_text(f"{before}return self.nope{after}")
    line = 1 + before.count("\n")
    given = ("--config-dir", "my_conf", "pose_space=mine", "device.stop=1", "view=none")
    status, _, err = programs.call(*given, folder=mine)
    assert status == 1 and f", in Independent.decode_freely ({path}, line {line})" in err, err


def test_a_group_that_is_taken_away_and_needed_is_named(tmp_path: Path) -> None:
    status, _, err = programs.call("~hand", folder=tmp_path)
    assert status == 1 and "error: the configuration lacks hand; leave ~hand out" in err


def test_toftrack_track_takes_a_folder_of_ones_own(mine: Path) -> None:
    folder, few = mine / "my_conf", ("device.stop=1", "filter.particles=20")
    words = ("device=mine", f"device.path='{mine}/images.npy'", few[1])
    assert len(list(toftrack.track(*words, config_dir=folder))) == FRAMES
    found = toftrack.track(mine / "images.raw16", "device=raw16", *few, config_dir=folder)
    assert len(list(found)) == 1
    with Sample(stop=1) as device:
        assert len(list(toftrack.track(device, "pose_space=mine", config_dir=folder))) == 1


def test_the_camera_behind_a_socket_is_tracked(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = np.stack([frame.depth for frame in Sample(stop=FRAMES)])
    np.savez(mine / "hand.npz", depth_m=images, K=Sample().camera.K, fps=10.0)
    monkeypatch.syspath_prepend(EXAMPLES)
    serve, port = importlib.import_module("socket_camera").serve, programs.free_port()
    threading.Thread(target=serve, args=(mine / "hand.npz", port), daemon=True).start()
    overrides, seen = ("device=socket", f"device.port={port}"), []
    device = toftrack.make_device(*overrides, config_dir=EXAMPLES)
    for _ in range(100):  # until it listens
        with suppress(ToftrackError):
            device.open()
            break
        time.sleep(0.05)
    with closing(device):
        assert device.live and device.fps == 10
        for frame in device:
            seen.append(frame.index)
            np.testing.assert_allclose(frame.depth, images[frame.index], atol=6e-4)
    assert seen[-1] == FRAMES - 1 and len(seen) + device.dropped == FRAMES


ABOUT = b'{"width": 4, "height": 3, "K": [[9,0,2],[0,9,1],[0,0,1]], "unit_m": 0.001, "fps": 9}\n'


@pytest.mark.parametrize(
    ("sent", "words"),
    [
        (None, "no camera at 127.0.0.1 port 1 "),
        (b"\x00\xff garbage\n", "begins with no line that describes it"),
        (ABOUT.replace(b"4", b"-4"), "begins with no line that describes it"),
        (b"1" * 20_000, "begins with no line that describes it"),
        (ABOUT + b"\0" * 5, "sent nothing for 0.2 s"),
    ],
)
def test_what_a_socket_sends_wrongly_is_one_sentence(sent: bytes | None, words: str) -> None:
    with ExitStack() as opened:
        server = opened.enter_context(socket.create_server(("127.0.0.1", 0)))
        if sent is not None:

            def send() -> None:
                opened.enter_context(server.accept()[0]).sendall(sent)

            threading.Thread(target=send, daemon=True).start()
        port = 1 if sent is None else server.getsockname()[1]
        patience = f"device.timeout_s={0.2 if 'nothing' in words else 60}"
        overrides = ("device=socket", f"device.port={port}", patience)
        with pytest.raises(ToftrackError, match=words):
            device = toftrack.make_device(*overrides, config_dir=EXAMPLES)
            next(iter(opened.enter_context(device)))


@pytest.mark.slow
def test_the_examples_have_strict_types() -> None:
    pytest.importorskip("mypy")
    files = sorted(path.name for path in EXAMPLES.glob("*.py"))
    command = [sys.executable, "-m", "mypy", "--strict", *files]
    done = subprocess.run(command, cwd=EXAMPLES, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
