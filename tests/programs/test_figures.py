"""The figures of a finished run: what they count, what they show, and how the command fails."""

import json
import shutil
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
from helpers import programs
from helpers.programs import QUICK
from helpers.settings import f_measure, nearest_surface
from helpers.tracking import ROOT, make_tracker, sample

from toftrack.errors import ToftrackError
from toftrack.hand.shape import default_hand_shape
from toftrack.output.lines import HAND_FIELDS
from toftrack.output.run_folder import read_run
from toftrack.programs import command_line, figures
from toftrack.programs.figures import draw_figures
from toftrack.render.model_image import model_range_image, posed_hand
from toftrack.render.reference import ReferenceScorer, render_range_images
from toftrack.render.segmentation import Expected
from toftrack.tracking.backend import make_scorer
from toftrack.views.classified import CLASSES, classify
from toftrack.views.figures import chart, runs
from toftrack.views.skeleton import SLOT_RGB

NAMES = ("measurement", "filmstrip", "lost", "course", "latent")
FRAMES = 12
SAMPLE = ROOT / "toftrack" / "data" / "sample.npz"


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run over a recording of twelve frames, which lies beside it."""
    folder = tmp_path_factory.mktemp("tracked")
    with np.load(SAMPLE) as whole:
        short = {key: v[:FRAMES] if v.shape[:1] == (100,) else v for key, v in whole.items()}
    np.savez(folder / "hand.npz", **short)
    given = ("device=replay", "device.path=hand.npz", "view=none", "hydra.run.dir=run")
    status, _, err = programs.call(*given, *QUICK, folder=folder)
    assert status == 0, err
    return folder / "run"


@pytest.fixture
def run(tracked: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may spoil, with its recording."""
    shutil.copy(tracked.parent / "hand.npz", tmp_path / "hand.npz")
    return Path(shutil.copytree(tracked, tmp_path / "run"))


def blank(*_: object) -> np.ndarray:
    return np.zeros((9, 9, 3), np.uint8)


@pytest.fixture
def draws_only(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Of the figures but these nothing is drawn, which takes most of the time."""

    def only(*drawn: str) -> None:
        for name in set(NAMES) - {*drawn}:
            monkeypatch.setattr(figures, f"{name}_figure", blank)

    return only


@pytest.fixture
def undrawn(draws_only: Callable[..., None]) -> None:
    draws_only()


def change(path: Path, **arrays: Callable[[np.ndarray], object]) -> None:
    """Change arrays of a file; those of which None is left go."""
    with np.load(path) as archive:
        content = dict(archive)
    content |= {key: edit(content[key]) for key, edit in arrays.items()}
    np.savez(path, **{key: value for key, value in content.items() if value is not None})


def edited(edit: Callable[[dict], object]) -> Callable[[np.ndarray], np.ndarray]:
    """For `change`: the metadata, of which something was edited."""

    def changed(metadata: np.ndarray) -> np.ndarray:
        content = json.loads(metadata.item())
        edit(content)
        return np.array(json.dumps(content))

    return changed


def share(picture: np.ndarray, colour: str | tuple[int, ...]) -> float:
    """Of the pixels of a BGR picture that have a colour, as #rrggbb or BGR."""
    bgr = bytes.fromhex(colour[1:])[::-1] if isinstance(colour, str) else bytes(colour)
    return float((picture == np.frombuffer(bgr, np.uint8)).all(-1).mean())


@cache
def states() -> list[np.ndarray]:
    """Hands near the sample's 30th frame: one that fits, one beside it, one half out of sight."""
    tracker, scene = make_tracker(*QUICK), sample()
    state = tracker.step(scene.depth_m[30], scene.k, 30, 0.0).state
    moved = [state.copy() for _ in range(3)]
    moved[1][0] += 0.03
    moved[2][0] -= 0.13
    return moved


def test_classified_pixels_are_those_that_the_scorers_count() -> None:
    scene, shape, likelihood = sample(), default_hand_shape(), f_measure(residual_weight=1.0)
    plain = nearest_surface()(scene.depth_m[30], scene.k)
    hidden = nearest_surface()(
        np.where(np.arange(176) < 60, np.float32(0.3), scene.depth_m[30]),
        scene.k,
        Expected(plain.nearest_m, plain.nearest_m + 0.1),
    )
    assert hidden.occluder.any()
    fast = make_scorer("numba", shape, torch.device("cpu"))
    for observation in (plain, hidden):
        evidence = likelihood.evidence(observation)
        for state in states():
            range_m, labels = classify(state, shape, observation, likelihood)
            found = np.bincount(labels.ravel(), minlength=len(CLASSES))[2:].tolist()
            assert not (np.isin(labels, (1, 4)) & (range_m > 0)).any()
            batch = torch.from_numpy(state)[None]
            exact = [int(count) for count in ReferenceScorer(shape)(batch, evidence)[:3]]
            # Batched or not, sums are rounded otherwise, and a pixel at the tolerance may fall
            # on either side.
            np.testing.assert_allclose(found, exact, atol=1)
            assert sum(found) > 100 or observation is hidden  # all of it may be
            np.testing.assert_allclose(found, [float(c) for c in fast(batch, evidence)[:3]], atol=3)


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_range_image_is_that_of_the_closed_form(side: str) -> None:
    shape, k = default_hand_shape(side=side), sample().k
    for state in states():
        hand, _ = posed_hand(state, shape)
        exact = render_range_images(hand, torch.tensor(k, dtype=torch.float32), 144, 176)[0]
        drawn = model_range_image(state, shape, k, 144, 176)
        assert drawn.any()
        # A tenth of a millimetre: at the rim a ray only just meets the surface.
        # Where two surfaces meet at a pixel, rounding decides which of them it shows.
        assert (np.abs(drawn - exact.numpy()) > 1e-4).mean() < 2e-4


def test_five_figures_are_written_that_show_something(run: Path) -> None:
    written = draw_figures(run)
    assert [path.name for path in written] == [f"{name}.png" for name in NAMES]
    assert all(path.parent == run / "figures" for path in written)
    for path in written:
        picture = cv2.imread(str(path))
        assert min(picture.shape[:2]) > 250 and picture.std() > 10, path.name


def test_the_papers_run_is_drawn_though_json_has_no_infinity(run: Path, undrawn: None) -> None:
    def endless(facts: dict) -> None:
        assert isinstance(facts["config"]["segmentation"]["reach_m"], float)
        facts["config"]["segmentation"]["reach_m"] = None

    change(run / "track.npz", metadata=edited(endless))
    assert draw_figures(run)


def test_the_recording_is_found_from_another_folder(
    run: Path, tracked: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    # The configuration says `hand.npz`, and .hydra where that was.
    footage = read_run(tracked).footage()
    assert footage is not None and len(footage.truth) == FRAMES


def test_lost_frames_are_shown_and_shaded(
    run: Path, tmp_path: Path, draws_only: Callable[..., None]
) -> None:
    draws_only("lost", "course")
    before = draw_figures(run, out=tmp_path / "before")
    change(run / "track.npz", lost=lambda lost: np.arange(len(lost)) >= 8)
    after = draw_figures(run, out=tmp_path / "after")
    for name in ("lost", "course"):
        old, new = (
            cv2.imread(str(next(p for p in paths if p.stem == name))) for paths in (before, after)
        )
        assert share(new, chart.SHADE) > share(old, chart.SHADE) + 0.01, name


def test_two_hands_have_figures_of_their_own_and_one_filmstrip(run: Path, monkeypatch) -> None:
    """The second slot has a hand from frame 4 on, of which the recording knows nothing."""

    def beside(values: np.ndarray) -> np.ndarray:
        second = values.copy()
        if second.dtype.kind in "fbU":
            second[:4] = {"f": np.nan, "b": True, "U": ""}[second.dtype.kind]
        return np.stack([values, second], 1)

    with np.load(run / "track.npz") as archive:
        change(run / "track.npz", **{name: beside for name in HAND_FIELDS if name in archive})
    shutil.copy(run / "hand_shape.json", run / "hand_shape_2.json")
    summary = json.loads((run / "summary.json").read_text())
    summary["metrics"]["slot"] = 0
    (run / "summary.json").write_text(json.dumps(summary))
    monkeypatch.setattr(chart, "titled", titled := Mock(wraps=chart.titled))
    shown = {path.stem: cv2.imread(str(path)) for path in draw_figures(run)}
    titles = "".join(call.args[1] for call in titled.call_args_list)
    assert titles.count("Slot 0, right hand. ") == titles.count("Slot 1, right hand. ") == 4
    assert list(shown) == [*NAMES, *(f"{name}_2" for name in NAMES if name != "filmstrip")]
    assert share(shown["course"], chart.BLUE) > 0 == share(shown["course_2"], chart.BLUE)
    assert share(shown["filmstrip"], SLOT_RGB[1][::-1]) > 0
    one = read_run(run).slot(1)
    assert np.isnan(one.estimate(3).score) and one.estimate(5).joints_m.shape == (21, 3)


def test_without_truth_the_score_stands_alone(run: Path, draws_only: Callable[..., None]) -> None:
    draws_only("course")
    change(run.parent / "hand.npz", joints_m=lambda _: None)
    course = next(p for p in draw_figures(run, run.parent / "hand.npz") if p.stem == "course")
    picture = cv2.imread(str(course))
    assert share(picture, chart.GREEN) > 0 and share(picture, chart.BLUE) == 0


def test_a_space_that_has_changed_is_reported_and_used_anew(run: Path) -> None:
    before, note = runs.latents(read_run(run), read_run(run).pose_space())
    assert note == ""
    np.testing.assert_array_equal(before, read_run(run).results["latent"])
    change(run / "track.npz", latent=lambda latent: latent + 1)
    after, note = runs.latents(read_run(run), read_run(run).pose_space())
    assert "changed" in note
    np.testing.assert_allclose(after, before, atol=1e-3)


def test_a_live_run_gets_the_figures_that_need_no_images(run: Path, undrawn: None, capsys) -> None:
    live = edited(lambda facts: facts.update(device={"device": "sr3000"}))
    change(run / "track.npz", metadata=live)
    assert [path.stem for path in draw_figures(run)] == ["course", "latent"]
    assert "live camera" in capsys.readouterr().err
    # A recording that was made beside it can be named.
    assert len(draw_figures(run, run.parent / "hand.npz")) == 5


@pytest.mark.parametrize("gone", ["track.npz", "hand_shape.json"])
def test_a_missing_file_is_named(run: Path, gone: str) -> None:
    (run / gone).unlink()
    with pytest.raises(ToftrackError, match=f"lacks {gone}"):
        draw_figures(run)


def test_a_recording_that_moved_is_asked_for(run: Path, tracked: Path, undrawn: None) -> None:
    absent = run.parent / "else.npz"
    with pytest.raises(ToftrackError, match="is not there; say where .* --recording"):
        draw_figures(run, absent)
    (run / ".hydra" / "hydra.yaml").unlink()  # so that only the path itself is left
    (tracked.parent / "hand.npz").rename(absent)
    try:
        with pytest.raises(ToftrackError, match="not there any more; say where it is"):
            draw_figures(run)
        assert len(draw_figures(run, absent)) == 5
    finally:
        absent.rename(tracked.parent / "hand.npz")


def test_another_recording_is_refused(run: Path) -> None:
    with pytest.raises(ToftrackError, match="has 100 frames instead of 12"):
        draw_figures(run, SAMPLE)
    change(run.parent / "hand.npz", fps=lambda fps: fps / 2)
    with pytest.raises(ToftrackError, match="other times"):
        draw_figures(run, run.parent / "hand.npz")


def test_a_run_says_no_code_to_execute_and_what_needs_none_is_drawn(run: Path, capsys) -> None:
    spoilt = {"likelihood": {"_target_": "os.system", "command": "true"}}
    change(run / "track.npz", metadata=edited(lambda facts: facts["config"].update(spoilt)))
    names = {path.name for path in draw_figures(run)}
    assert names >= {"course.png", "latent.png"} and "measurement.png" not in names
    said = capsys.readouterr().err
    assert (
        "note: without measurement.png: " in said and "likelihood of its own, os.system, " in said
    )
    make = "toftrack.pose_space.files.make_pose_space"
    own = {"pose_space": {"_target_": make, "kind": make}}
    change(run / "track.npz", metadata=edited(lambda facts: facts["config"].update(own)))
    with pytest.raises(ToftrackError, match=f"pose space of its own, {make}, "):
        read_run(run).pose_space()


def test_the_command_answers_errors_with_a_sentence(run: Path, undrawn: None, capsys) -> None:
    assert command_line.run(lambda: figures.main([str(run), "--frame", "99"])) == 1
    assert "error: the run has no frame 99; give --frame from 0 to 11" in capsys.readouterr().err
    (run / "file").touch()
    assert command_line.run(lambda: figures.main([str(run), "--out", str(run / "file")])) == 1
    assert "cannot be written" in capsys.readouterr().err
    assert command_line.run(lambda: figures.main([str(run), "--out", str(run / "own")])) == 0
    assert str(run / "own" / "latent.png") in capsys.readouterr().out


def test_a_missing_matplotlib_is_one_sentence_and_leaves_out_plots_alone(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ToftrackError, match=r'pip install "toftrack\[figures\]"'):
        draw_figures(run)
    drawn = [
        ("plot.png", lambda: chart.picture_of(chart.new_figure(90, 90))),
        ("picture.png", blank),
    ]
    assert chart.write_figures(run, drawn) == [run / "picture.png"]
    assert "without plot.png: figures need matplotlib" in capsys.readouterr().err
