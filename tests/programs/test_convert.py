"""Converting, recording, and folders of images: nothing is lost that need not be."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.tracking import ROOT

from toftrack.devices.replay import Replay, Sample
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.programs import convert, record
from toftrack.recordings.bare import Given
from toftrack.recordings.image_folder import ImageFolder, write_image_folder
from toftrack.recordings.npz import read_recording
from toftrack.recordings.srs import SrsRecording

EMULATED = ("device.transport=emulated", "device.emulated.fps=500")


@pytest.fixture(scope="module")
def srs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames of the sample, recorded from the virtual camera."""
    path = tmp_path_factory.mktemp("recorded") / "sample.srs"
    record.main([str(path), "--frames", "12", *EMULATED])
    return path


def raw(path: Path) -> list[bytes]:
    recording = SrsRecording(path)
    frames = [recording.raw(index) for index in range(len(recording))]
    recording.close()
    return frames


def test_record_then_replay_is_the_sample(srs: Path) -> None:
    device = Replay(srs)
    assert device.frames == 12
    assert device.metadata == Sample().metadata
    for frame, expected in zip(device, Sample(stop=12), strict=True):
        depth = device.camera.rectify(frame.depth, frame.radial)
        np.testing.assert_allclose(depth, expected.depth, atol=6e-5)
        np.testing.assert_array_equal(frame.amplitude, expected.amplitude)


@pytest.mark.parametrize("between", ["between.npz", "between", "between.srs"])
def test_there_and_back_is_bit_exact(srs: Path, tmp_path: Path, between: str) -> None:
    convert.main([str(srs), str(tmp_path / between)])
    convert.main([str(tmp_path / between), str(tmp_path / "back.srs")])
    assert raw(tmp_path / "back.srs") == raw(srs)
    first, second = SrsRecording(srs), SrsRecording(tmp_path / "back.srs")
    np.testing.assert_array_equal(first.timestamp_s, second.timestamp_s)
    np.testing.assert_array_equal(first.camera.K, second.camera.K)
    assert first.metadata == second.metadata
    assert first.init == second.init or between != "between.srs"


def test_the_truth_is_kept_and_depth_in_a_folder_is_millimetres(tmp_path, capsys) -> None:
    whole = ROOT / "toftrack" / "data" / "sample.npz"
    with np.load(whole) as sample:
        depth = sample["depth_m"][:4]
        few = {name: sample[name][:4] for name in ("depth_m", "amplitude", "joints_m")}
        np.savez(tmp_path / "few.npz", K=sample["K"], **few)
    for name in ("copy.npz", "copy.srs", "folder"):
        convert.convert(tmp_path / "few.npz", tmp_path / name)
    assert read_recording(tmp_path / "copy.npz").truth is not None
    assert "ground truth" in capsys.readouterr().err
    image = cv2.imread(str(tmp_path / "folder" / "depth_000003.png"), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    np.testing.assert_array_equal(image, np.rint(1000 * depth[3].astype(np.float64)))


def test_bare_images_are_converted_when_their_lens_is_given(tmp_path: Path) -> None:
    words = np.random.default_rng(0).integers(1, 5000, (3, 24, 32)).astype(np.uint16)
    path = tmp_path / "a.npy"
    np.save(path, words)
    lens = ["--intrinsics", "30", "31", "15.5", "11.5"]
    rest = ["--source-unit", "0.0005", "--fps", "12.5"]
    convert.main([str(path), str(tmp_path / "out.npz"), *lens, *rest])
    made = read_recording(tmp_path / "out.npz")
    np.testing.assert_allclose(made.depth, words * 0.0005, rtol=1e-6)
    np.testing.assert_array_equal(made.camera.K, [[30, 0, 15.5], [0, 31, 11.5], [0, 0, 1]])
    assert made.fps == pytest.approx(12.5)
    for more, said in ([], "--intrinsics"), ([*lens, "--dataset", "x"], "has no dataset x"):
        with pytest.raises(ToftrackError, match=said):
            convert.main([str(path), str(tmp_path / "other.npz"), *more])


def test_the_lens_goes_before_an_npz_s_own_and_other_facts_stand_in_for_missing_ones(
    tmp_path: Path,
) -> None:
    depth = np.full((3, 6, 8), 0.5, np.float32)
    np.savez(tmp_path / "bare.npz", depth_m=depth)
    np.savez(tmp_path / "whole.npz", depth_m=depth, K=np.diag((9.0, 9, 1)), fps=10.0)
    lens = Given((30.0, 30.0, 3.5, 2.5), fps=12.0)
    convert.convert(tmp_path / "bare.npz", tmp_path / "made.npz", lens)
    made = read_recording(tmp_path / "made.npz")
    assert (made.camera.K[0, 0], made.fps) == (30, pytest.approx(12))
    with pytest.raises(ToftrackError, match=r"says its fps itself.*--fps"):
        convert.convert(tmp_path / "whole.npz", tmp_path / "no.npz", lens)
    convert.convert(tmp_path / "whole.npz", tmp_path / "other.npz", replace(lens, fps=None))
    other = read_recording(tmp_path / "other.npz")
    assert (other.camera.K[0, 0], other.fps) == (30, pytest.approx(10))
    Camera(np.diag((9.0, 9, 1)), 9, 6).save(tmp_path / "wide.json")
    wide = Given(camera_file=tmp_path / "wide.json")
    with pytest.raises(ToftrackError, match="9x6 pixels, but the recording has 8x6"):
        convert.convert(tmp_path / "bare.npz", tmp_path / "no.npz", wide)
    with pytest.raises(ToftrackError, match="key 'K'.*--intrinsics"):
        convert.convert(tmp_path / "bare.npz", tmp_path / "no.npz")


def test_convert_errors(srs: Path, tmp_path: Path) -> None:
    (tmp_path / "there.npz").write_bytes(b"")
    Camera(np.eye(3), 8, 6).save(tmp_path / "camera.json")
    camera = ("--camera", str(tmp_path / "camera.json"))
    for target, options, words in (
        ("there.npz", (), "exists already"),
        ("a.bag", (), "neither"),
        (srs, (), "itself"),
        ("a.npz", camera, "8x6"),
        ("a", ("--unit", "2.0"), "--unit"),
        ("b", (*camera, *"--intrinsics 30 30 16 12".split()), "--camera and --intrinsics. both"),
    ):
        with pytest.raises(ToftrackError, match=words):
            convert.main([str(srs), str(tmp_path / target), *options])


@pytest.mark.parametrize("name", ["there.npz", "there.srs"])
def test_what_is_there_stays_until_the_new_recording_is_whole(
    name: str, srs: Path, tmp_path: Path
) -> None:
    convert.convert(srs, tmp_path / "images")
    (tmp_path / "images" / "depth_000007.png").write_bytes(b"damaged")
    there = tmp_path / name
    there.write_text("mine")
    with pytest.raises(ToftrackError, match="depth_000007.png"):
        convert.convert(tmp_path / "images", there, overwrite=True)
    assert there.read_text() == "mine"
    assert {file.name for file in tmp_path.iterdir()} == {"images", name}
    convert.convert(srs, there, overwrite=True)
    assert there.stat().st_size > 1000


@pytest.mark.parametrize("mine", ["camera.json", "depth_1.PNG"])
def test_a_folder_that_holds_images_or_their_facts_is_left_as_it_is(
    mine: str, srs: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "notes.txt").write_text("these may be there")
    (folder / mine).write_text("mine")
    with pytest.raises(ToftrackError, match="already; choose an empty one"):
        convert.convert(srs, folder, overwrite=True)
    assert {file.name for file in folder.iterdir()} == {mine, "notes.txt"}
    assert (folder / mine).read_text() == "mine"
    (folder / mine).unlink()
    assert convert.convert(srs, folder) == 12


def test_lens_and_polynomial_are_not_lost_in_npz(tmp_path: Path) -> None:
    camera = Camera(np.diag((30.0, 31, 1)), 32, 24, np.full(4, 0.1), (0.01,), lens="fisheye")
    camera.save(tmp_path / "camera.json")
    np.save(tmp_path / "a.npy", np.ones((2, 24, 32)))
    given = Given(camera_file=tmp_path / "camera.json")
    convert.convert(tmp_path / "a.npy", tmp_path / "out.npz", given)
    assert read_recording(tmp_path / "out.npz").camera.to_dict() == camera.to_dict()


def test_recordings_of_another_size_do_not_fit_the_camera(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", depth_m=np.ones((2, 6, 8), np.float32), K=np.diag((9.0, 9, 1)))
    with pytest.raises(ToftrackError, match="176x144"):
        convert.convert(tmp_path / "a.npz", tmp_path / "a.srs")
    assert convert.convert(tmp_path / "a.npz", tmp_path / "folder") == 2


# Folders of images.

PNG = cv2.imencode(".png", np.full((6, 8), 100, np.uint16))[1].tobytes()


def images(folder: Path, **changes: Any) -> Path:
    """Three images of 8 x 6 pixels whose names sort by number."""
    folder.mkdir()
    for number in (1, 2, 10):
        image = np.full((6, 8), 100 * number, np.uint16)
        cv2.imwrite(str(folder / f"{number}.png"), changes.get(f"image_{number}", image))
    content = Camera(np.diag((9.0, 9, 1)), 8, 6).to_dict() | changes.get("camera", {})
    (folder / "camera.json").write_text(json.dumps(content))
    return folder


def test_images_come_by_their_numbers_with_what_the_folder_states_or_is_given(tmp_path) -> None:
    frames = list(Replay(images(tmp_path / "f")))
    assert [float(frame.depth[0, 0]) for frame in frames] == pytest.approx([0.1, 0.2, 1.0])
    assert [frame.timestamp_s for frame in frames] == pytest.approx([0, 0.04, 0.08])
    assert not frames[0].radial and frames[0].amplitude is None
    stated = images(tmp_path / "g", camera={"depth_unit_m": 0.0002, "fps": 10, "radial": True})
    for given, fps, depth_m in (({}, 10, 0.02), ({"unit_m": 0.01, "fps": 50}, 50, 1.0)):
        first = next(iter(device := Replay(stated, **given)))
        assert (first.radial, device.fps) == (True, fps)
        assert first.depth[0, 0] == pytest.approx(depth_m)


def test_what_is_no_reading_or_beyond_16_bits_is_none_in_a_folder(tmp_path: Path) -> None:
    depth = np.ones((1, 6, 8), np.float32)
    depth[0, 0, :5] = (0, np.nan, np.inf, -1, 70)
    np.savez(tmp_path / "a.npz", depth_m=depth, K=np.diag((9.0, 9, 1)))
    write_image_folder(tmp_path / "f", read_recording(tmp_path / "a.npz"), 0.0005)
    np.testing.assert_array_equal(ImageFolder(tmp_path / "f").image(0)[0][0], [0] * 5 + [1] * 3)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"image_1": np.ones((6, 9), np.uint16)}, "1.png.*9x6"),
        ({"timestamps.txt": b"0\n1\n"}, "3 finite times"),
        ({"amplitude_1.png": PNG}, "3 depth and 1 amplitude"),
    ],
)
def test_broken_folders_are_reported(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    folder = images(tmp_path / "f", **changes)
    for name, content in changes.items():
        if isinstance(content, bytes):
            (folder / name).write_bytes(content)
    with pytest.raises(ToftrackError, match=words):
        ImageFolder(folder).image(0)
