"""`stream=osc`: the documented addresses, read from the datagrams."""

import socket
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.hands import hand_estimate, lost_hand
from helpers.settings import part

from toftrack.errors import ToftrackError
from toftrack.frames.estimate import Estimate, no_estimate
from toftrack.hand.openxr import OPENXR_JOINT_NAMES
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.osc import OscStream

OscBundle = pytest.importorskip("pythonosc.osc_bundle", reason="pip install '.[osc]'").OscBundle


def osc_stream(**changes: Any) -> OscStream:
    return part("stream=osc", "stream", **changes)


def sent(
    receiver: socket.socket, *frames: tuple[Estimate, ...], **changes: Any
) -> list[dict[str, list[Any]]]:
    """What comes of each frame, by its address."""
    host, port = receiver.getsockname()
    came = []
    with osc_stream(host=host, port=port, **changes) as stream:
        for estimates in frames:
            stream.send(estimates)
            messages = list(OscBundle(receiver.recv(65535)))
            came.append({message.address: message.params for message in messages})
            assert len(came[-1]) == len(messages)
    return came


def test_a_tracked_hand_is_reported_with_all_its_joints(receiver: socket.socket) -> None:
    estimate = hand_estimate(7, "left", pinch=0.75, pinching=True)
    (found,) = sent(receiver, (estimate,))
    assert found["/toftrack/frame"] == [7, 7 / 25]
    assert found["/toftrack/left/tracked"] == [1]
    assert found["/toftrack/left/confidence"] == pytest.approx([0.9])
    assert found["/toftrack/left/gesture"] == ["palm", pytest.approx(0.8)]
    assert found["/toftrack/left/pinch"] == [0.75, 1]
    assert found["/toftrack/left/joint_ok"] == [1] * 21
    for name, place in zip(JOINT_NAMES, estimate.joints_m, strict=True):
        assert found[f"/toftrack/left/joint/{name}"] == pytest.approx(place.tolist())
    assert not any("pointing" in address or "openxr" in address for address in found)
    ray = np.arange(6, dtype=np.float32)
    estimate = replace(estimate, pointing_origin_m=ray[:3], pointing_direction=ray[3:])
    doubted = {"joint_ok": np.arange(21) != 8, "gesture": "", "pinch": np.nan}
    (found,) = sent(receiver, (replace(estimate, **doubted, pinching=False),))
    assert found["/toftrack/left/pointing"] == ray.tolist()
    assert found["/toftrack/left/joint_ok"] == [1] * 8 + [0] + [1] * 12
    assert found["/toftrack/left/pinch"] == [0, 0] and "/toftrack/left/gesture" not in found


def test_of_a_lost_hand_nothing_is_sent_but_that(receiver: socket.socket) -> None:
    never, gone = sent(receiver, (lost_hand(2),))[0], replace(hand_estimate(3), lost=True)
    assert never == {"/toftrack/frame": [2, 2 / 25], "/toftrack/hand/tracked": [0]}
    assert set(sent(receiver, (gone,))[0]) == {"/toftrack/frame", "/toftrack/right/tracked"}


def test_a_frame_number_beyond_32_bits_is_sent_without_what_is_beyond(
    receiver: socket.socket,
) -> None:
    (found,) = sent(receiver, (replace(lost_hand(2), index=2**31 + 5),))
    assert found["/toftrack/frame"][0] == 5


RIGHT, LEFT, VACANT = hand_estimate(0), hand_estimate(0, "left"), no_estimate(0, 0, "lost", 4, 0)


def test_hands_of_several_persons_have_the_numbers_of_their_slots(receiver: socket.socket) -> None:
    found = sent(receiver, (RIGHT, LEFT, RIGHT), (RIGHT, VACANT, RIGHT))
    names = [[one.split("/")[2] for one in said if one.endswith("/tracked")] for said in found]
    assert names == [["right_1", "left_2", "right_3"], ["right_1", "right_3", "left_2"]]


def test_a_hand_of_which_nothing_is_said_any_more_is_told_lost_once(
    receiver: socket.socket,
) -> None:
    found = sent(receiver, (RIGHT, LEFT), (VACANT, VACANT), (VACANT, VACANT))
    tracked = [{key[10:]: one[key] for key in one if key.endswith("/tracked")} for one in found]
    assert tracked[0] == {"right/tracked": [1], "left/tracked": [1]}
    assert tracked[1] == {"right/tracked": [0], "left/tracked": [0]}
    assert tracked[2] == {}


def test_landmarks_and_the_joints_of_openxr_are_reported_on_demand(receiver: socket.socket) -> None:
    estimate = hand_estimate(0)
    (found,) = sent(receiver, (estimate,), parts=["landmarks", "openxr"])
    tip = found["/toftrack/right/landmark/index_tip"]
    assert tip == pytest.approx(estimate.landmarks[8].tolist(), abs=1e-6)
    palm = [*estimate.openxr_position_m[0], *estimate.openxr_orientation[0]]
    assert found["/toftrack/right/openxr/palm"] == pytest.approx(
        [*palm, estimate.openxr_radius_m[0]], abs=1e-6
    )
    assert sum("/openxr/" in address for address in found) == len(OPENXR_JOINT_NAMES)
    assert not any("/joint/" in address for address in found)


def test_a_bad_setting_is_one_clear_error() -> None:
    with pytest.raises(ToftrackError, match="stream.parts=bones is unknown; give one of joints"):
        osc_stream(parts=["bones"])
    with pytest.raises(ToftrackError, match="stream.port=0"):
        osc_stream(port=0)
