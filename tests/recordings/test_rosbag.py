"""ROS bags: every kind of bag, image and lens gives the frames that went in; bad ones are told."""

import contextlib
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.bags import (
    CAMERA_INFO,
    COMPRESSED,
    DEPTH,
    IMAGE,
    INFO,
    KINDS,
    Message,
    camera_info,
    compressed,
    image,
    recorded_ns,
    recording,
    rvl,
    write_bag,
)
from helpers.damage import damaged

from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.frames.camera import Camera
from toftrack.recordings import ros_messages
from toftrack.recordings.ros_messages import camera_of, decoded_rvl
from toftrack.recordings.rosbag import RosBag, is_bag
from toftrack.recordings.store import open_recording

CAMERA = Camera(np.array([[40.0, 0, 15.5], [0, 41.0, 11.5], [0, 0, 1]]), 32, 24)
COLOUR = "/camera/color/image_raw"
JPEG = {"format": "16UC1; jpeg compressed bgr8", "data": np.zeros(9, np.uint8)}


def some_depth(count: int = 6) -> np.ndarray:
    """(count, 24, 32) float32 metres in whole millimetres, with holes."""
    depth = np.random.default_rng(0).integers(300, 2000, (count, 24, 32)).astype(np.float32) / 1000
    depth[:, :3] = 0
    return depth


def colour(topic: str = COLOUR) -> Message:
    fields = image(np.zeros((24, 96)), "rgb8")
    return Message(topic, IMAGE, fields | {"width": 32}, recorded_ns(0))


def test_rvl_is_unpacked_and_whatever_is_damaged_in_it_reported() -> None:
    random = np.random.default_rng(0)
    pixels = random.integers(0, 65536, (24, 32)) * (random.random((24, 32)) > 0.4)
    pixels[3:6] = 0
    pixels = pixels.astype(np.uint16)
    for some in (pixels, np.zeros_like(pixels), np.full_like(pixels, 700)):
        np.testing.assert_array_equal(decoded_rvl(rvl(some)), some)
    content = rvl(pixels)
    sizes = [struct.pack("<II", *size) for size in ((2**31, 2**31), (0, 5), (32, 25), (31, 24))]
    cut = [content[:length] for length in (0, 7, 9, 40, len(content) - 8)]
    for bad in (*cut, *(size + content[8:] for size in sizes), content[:8] + b"\xff" * 400):
        with pytest.raises(ToftrackError, match="RVL is damaged"):
            decoded_rvl(bad)
    for seed in range(200):
        with contextlib.suppress(ToftrackError):
            assert decoded_rvl(damaged(content, seed)).dtype == np.uint16


@pytest.mark.parametrize(
    ("kind", "encoding"),
    [
        ("bag", "16UC1"),
        ("bag", "16UC1; compressedDepth rvl"),
        ("db3", "32FC1"),
        ("mcap", "16UC1; compressedDepth"),
    ],
)
def test_every_kind_of_bag_gives_the_frames_that_went_in(
    tmp_path: Path, kind: str, encoding: str
) -> None:
    depth = some_depth()
    path = write_bag(tmp_path, kind, [colour(), *recording(depth, CAMERA, encoding)])
    device = Replay(path)
    frames = list(device)
    assert [frame.index for frame in frames] == list(range(6))
    np.testing.assert_allclose([frame.depth for frame in frames], depth, atol=1e-6)
    assert frames[0].depth.dtype == np.float32 and not frames[0].radial
    taken = [(recorded_ns(n) - 7_000_000) / 1e9 for n in range(6)]
    np.testing.assert_allclose([frame.timestamp_s for frame in frames], taken, atol=1e-6)
    assert device.fps == pytest.approx(25)
    np.testing.assert_array_equal(device.camera.K, CAMERA.K)
    assert (device.camera.width, device.camera.height) == (32, 24)
    assert "image_raw" in device.description["topic"]
    assert is_bag(path)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_of_one_time_are_told_apart(tmp_path: Path, kind: str) -> None:
    depth = some_depth(9)
    messages = recording(depth, CAMERA)
    for message in messages[3:7]:
        message.recorded_ns = messages[3].recorded_ns  # a recorder that was late
    store = RosBag(write_bag(tmp_path, kind, messages))
    for number in (4, 2, 3, 8, 0, 1):
        np.testing.assert_allclose(store.image(number)[0], depth[number], atol=1e-6)
    store.close()


def test_a_file_of_a_ros_2_bag_is_one_too_and_so_is_a_folder_without_metadata(
    tmp_path: Path,
) -> None:
    depth = some_depth()
    for kind in ("mcap", "db3"):
        folder = write_bag(tmp_path, kind, recording(depth, CAMERA))
        file = next(folder.glob(f"*.{kind}"))
        assert len(open_recording(file)) == 6
        (folder / "metadata.yaml").unlink()
        assert is_bag(folder)
        np.testing.assert_allclose(open_recording(folder).image(5)[0], depth[5], atol=1e-6)


def test_a_camera_info_may_come_late_and_without_one_a_camera_file_serves(tmp_path: Path) -> None:
    late = write_bag(tmp_path, "mcap", recording(some_depth(), CAMERA, info_at=5))
    np.testing.assert_array_equal(RosBag(late).camera.K, CAMERA.K)
    path = write_bag(tmp_path, "bag", recording(some_depth(), CAMERA, info_at=99))
    with pytest.raises(ToftrackError, match=f"no message of {INFO}.*camera.file=FILE"):
        RosBag(path)
    CAMERA.save(tmp_path / "camera.json")
    assert Replay(path, camera_file=tmp_path / "camera.json").camera.K[0, 0] == 40


def test_a_camera_of_another_size_is_refused_before_its_lens_is_laid_out(tmp_path: Path) -> None:
    bent = Camera(CAMERA.K * [[900], [900], [1]], 32 * 900, 24 * 900, (0.1, 0.0, 0.0, 0.0))
    path = write_bag(tmp_path, "mcap", recording(some_depth(), bent))
    with pytest.raises(ToftrackError, match="32x24 pixels, but its camera 28800x21600"):
        RosBag(path)


def test_two_topics_of_depth_are_listed_and_one_is_chosen(tmp_path: Path) -> None:
    aligned = [
        Message("/camera/aligned/image", IMAGE, image(frame / 2), recorded_ns(n))
        for n, frame in enumerate(some_depth())
    ]
    info = Message("/camera/aligned/camera_info", CAMERA_INFO, camera_info(CAMERA), recorded_ns(0))
    path = write_bag(tmp_path, "bag", [*recording(some_depth(), CAMERA), *aligned, info])
    with pytest.raises(ToftrackError, match=rf"2 topics.*device.topic=.*/aligned/image.*{DEPTH}"):
        Replay(path)
    depth = next(iter(Replay(path, topic="camera/aligned/image"))).depth
    np.testing.assert_allclose(depth, some_depth()[0] / 2, atol=0.0006)
    with pytest.raises(ToftrackError, match="no images of the topic /nowhere"):
        Replay(path, topic="/nowhere")


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        ([colour()], rf"no depth images.*{COLOUR} \(rgb8\)"),
        ([Message("/depth/compressedDepth", COMPRESSED, JPEG, recorded_ns(0))], "no depth.*jpeg"),
        ([colour(topic="/device_0/sensor_0/Depth_0/image/data")], "device=realsense device.bag="),
    ],
)
def test_bags_without_depth_are_reported(
    tmp_path: Path, messages: list[Message], words: str
) -> None:
    path = write_bag(tmp_path, "bag", messages)
    with pytest.raises(ToftrackError, match=words):
        RosBag(path)


def test_a_missing_extra_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rosbags.rosbag1", None)
    (tmp_path / "a.bag").write_bytes(b"")
    with pytest.raises(ToftrackError, match=r'rosbags.*pip install "toftrack\[ros\]"'):
        Replay(tmp_path / "a.bag")


def test_a_damaged_message_ends_the_recording_before_it(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "bag", recording(some_depth(), CAMERA))
    content = path.read_bytes()
    at = [i for i in range(len(content)) if content.startswith(b"16UC1", i)][4]
    # The length of the text before it.
    path.write_bytes(content[: at - 4] + b"\xff\xff\xff\x7f" + content[at:])
    store = RosBag(path)
    assert len(store) == 4 and "cannot be read" in (store.damage or "")
    assert len(list(Replay(path))) == 4


# Images and lenses, without a bag.


def as_message(fields: dict) -> SimpleNamespace:
    """The fields as an object, as rosbags parses them."""
    fields = dict(fields)
    if "roi" in fields:
        fields["roi"] = SimpleNamespace(**fields["roi"])
    return SimpleNamespace(**fields)


@pytest.mark.parametrize(
    "fields",
    [
        image(some_depth(1)[0], pad=6),
        image(some_depth(1)[0], big=True),
        image(some_depth(1)[0], "32FC1", big=True),
        compressed(some_depth(1)[0], "16UC1"),  # the oldest ones name no transport
    ],
)
def test_images_of_every_layout_are_read(fields: dict) -> None:
    kind = COMPRESSED if "format" in fields else IMAGE
    found = ros_messages.depth_image(as_message(fields), kind, 0.001)
    np.testing.assert_allclose(found, some_depth(1)[0], atol=1e-6)


def test_no_reading_is_zero_in_every_encoding() -> None:
    depth = some_depth(1)[0]
    depth[0, :4] = (np.nan, np.inf, -1, 0)
    found = ros_messages.depth_image(as_message(image(depth, "32FC1")), IMAGE, 0.001)
    assert (found[0, :4] == 0).all() and np.isfinite(found).all()


@pytest.mark.parametrize("packed", ["png", "rvl"])
def test_quantised_inverse_depth_is_exact_to_its_steps(packed: str) -> None:
    depth = some_depth(1)[0]
    message = as_message(compressed(depth, f"32FC1; compressedDepth {packed}"))
    found = ros_messages.depth_image(message, COMPRESSED, 0.001)
    # A step of 1 / z is 1 / 10100 m.
    np.testing.assert_array_less(np.abs(found - depth), depth**2 / 10100 / 2 + 1e-5)
    assert (found[:3] == 0).all()


def test_an_image_with_too_few_bytes_is_reported() -> None:
    fields = image(some_depth(1)[0])
    for change in ({"data": fields["data"][:-70]}, {"step": 3}, {"height": 0}, {"width": 2**31}):
        with pytest.raises(ToftrackError, match="too few"):
            ros_messages.depth_image(as_message(fields | change), IMAGE, 0.001)


LENSES = {
    "plumb_bob": (0.1, -0.2, 0.001, -0.002, 0.05),
    "rational_polynomial": (0.5, -0.1, 2e-3, -1e-3, 0.01, 0.85, 0.02, -0.005),
    "equidistant": (0.05, -0.02, 0.01, -0.004),
}


@pytest.mark.parametrize("model", LENSES)
def test_every_lens_model_of_ros_is_taken(model: str) -> None:
    info = as_message(camera_info(CAMERA, model, D=np.array(LENSES[model])))
    camera = camera_of(info, rectified=False)
    np.testing.assert_array_equal(camera.distortion, LENSES[model])
    assert camera.lens == ("fisheye" if model == "equidistant" else "opencv")
    assert not camera_of(info, rectified=True).distortion.any()


def test_rectified_images_are_seen_through_p() -> None:
    P = np.array([30.0, 0, 16, 0, 0, 31, 12, 0, 0, 0, 1, 0])
    info = as_message(camera_info(CAMERA, D=np.ones(5), P=P))
    camera = camera_of(info, rectified=True)
    np.testing.assert_array_equal(camera.K, [[30, 0, 16], [0, 31, 12], [0, 0, 1]])
    assert not camera.distortion.any()
    assert camera_of(info, rectified=False).K[0, 0] == 40


def test_a_part_of_the_sensor_and_binning_move_the_lens() -> None:
    roi = {"x_offset": 8, "y_offset": 4, "height": 16, "width": 20, "do_rectify": False}
    camera = camera_of(
        as_message(camera_info(CAMERA, roi=roi, binning_x=2, binning_y=2)), rectified=False
    )
    assert (camera.width, camera.height) == (10, 8)
    np.testing.assert_allclose(camera.K, [[20, 0, 3.75], [0, 20.5, 3.75], [0, 0, 1]])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"K": np.zeros(9), "P": np.zeros(12)}, "not calibrated"),
        ({"distortion_model": "mei", "D": np.ones(5)}, "'mei' is none of plumb_bob"),
        ({"D": np.ones(7)}, "4, 5, 8, 12, 14 numbers"),
    ],
)
def test_a_camera_info_that_tells_no_lens_is_reported(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ToftrackError, match=words):
        camera_of(as_message(camera_info(CAMERA, **changes)), rectified=False)
