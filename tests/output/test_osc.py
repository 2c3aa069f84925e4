"""`stream=osc`: the documented addresses, read from the datagrams."""

from __future__ import annotations

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


def sent(receiver: socket.socket, estimate: Estimate, **changes: Any) -> dict[str, list[Any]]:
    host, port = receiver.getsockname()
    with osc_stream(host=host, port=port, **changes) as stream:
        stream.send((estimate,))
        return {message.address: message.params for message in OscBundle(receiver.recv(65535))}


def test_a_tracked_hand_is_reported_with_all_its_joints(receiver: socket.socket) -> None:
    estimate = hand_estimate(7, "left", pinch=0.75, pinching=True)
    found = sent(receiver, estimate)
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
    found = sent(receiver, replace(estimate, **doubted, pinching=False))
    assert found["/toftrack/left/pointing"] == ray.tolist()
    assert found["/toftrack/left/joint_ok"] == [1] * 8 + [0] + [1] * 12
    assert found["/toftrack/left/pinch"] == [0, 0] and "/toftrack/left/gesture" not in found


def test_of_a_lost_hand_nothing_is_sent_but_that(receiver: socket.socket) -> None:
    assert sent(receiver, lost_hand(2)) == {
        "/toftrack/frame": [2, 2 / 25],
        "/toftrack/hand/tracked": [0],
    }
    gone = replace(hand_estimate(3), lost=True)
    assert set(sent(receiver, gone)) == {"/toftrack/frame", "/toftrack/right/tracked"}


def test_a_frame_number_beyond_32_bits_is_sent_without_what_is_beyond(
    receiver: socket.socket,
) -> None:
    assert sent(receiver, replace(lost_hand(2), index=2**31 + 5))["/toftrack/frame"][0] == 5


def test_hands_of_several_persons_have_the_numbers_of_their_slots(receiver: socket.socket) -> None:
    host, port = receiver.getsockname()
    right, left, vacant = (
        hand_estimate(0),
        hand_estimate(0, "left"),
        no_estimate(0, 0.0, "lost", 4, 0.0),
    )
    said = []
    with osc_stream(host=host, port=port) as stream:
        for hands in ((right, left, right), (right, vacant, right)):
            stream.send(hands)
            addresses = [message.address for message in OscBundle(receiver.recv(65535))]
            assert len(set(addresses)) == len(addresses)
            said.append([one.split("/")[2] for one in addresses if one.endswith("/tracked")])
    assert said == [["right_1", "left_2", "right_3"], ["right_1", "right_3", "left_2"]]


def test_a_hand_of_which_nothing_is_said_any_more_is_told_lost_once(
    receiver: socket.socket,
) -> None:
    host, port = receiver.getsockname()
    both, vacant = (
        (hand_estimate(0), hand_estimate(0, "left")),
        no_estimate(1, 0.04, "lost", 4, 0.0),
    )
    said = []
    with osc_stream(host=host, port=port) as stream:
        for estimates in (both, (vacant, vacant), (vacant, vacant)):
            stream.send(estimates)
            bundle = {one.address: one.params for one in OscBundle(receiver.recv(65535))}
            said.append({key: value for key, value in bundle.items() if key.endswith("tracked")})
    assert said[0] == {"/toftrack/right/tracked": [1], "/toftrack/left/tracked": [1]}
    assert said[1] == {"/toftrack/right/tracked": [0], "/toftrack/left/tracked": [0]}
    assert said[2] == {}


def test_landmarks_and_the_joints_of_openxr_are_reported_on_demand(receiver: socket.socket) -> None:
    estimate = hand_estimate(0)
    found = sent(receiver, estimate, parts=["landmarks", "openxr"])
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
