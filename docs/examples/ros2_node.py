"""A ROS 2 node that follows a hand: `python3 ros2_node.py --ros-args
-r depth:=/camera/camera/depth/image_rect_raw -r camera_info:=/camera/camera/depth/camera_info`,
which are RealSense's topics. It takes rectified depth images, 16UC1 in mm or 32FC1 in m. While the
hand is not lost it publishes `hand/joints` (PoseArray) and `hand/gesture` (String).
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose, PoseArray
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header, String

import toftrack

KINDS = {"16UC1": ("u2", 0.001), "32FC1": ("f4", 1.0)}  # the numbers, and how many metres one is


def depth_of(image: Image) -> np.ndarray[Any, np.dtype[np.float32]]:
    """(H, W) metres of a sensor_msgs/Image, whose rows may be padded."""
    if image.encoding not in KINDS:
        raise ValueError(f"{image.encoding} is no depth; remap depth to images of {tuple(KINDS)}")
    kind, unit_m = KINDS[image.encoding]
    words = np.dtype((">" if image.is_bigendian else "<") + kind)
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    numbers = rows[:, : image.width * words.itemsize].copy().view(words)
    return numbers.astype(np.float32) * np.float32(unit_m)


def seconds_of(header: Header) -> float:
    return float(header.stamp.sec + 1e-9 * header.stamp.nanosec)


def poses_of(estimate: toftrack.Estimate, header: Header) -> PoseArray:
    """The joints of JOINT_NAMES, whose axes are those of ROS's optical frames."""
    places = [Point(x=x, y=y, z=z) for x, y, z in estimate.joints_m.tolist()]
    return PoseArray(header=header, poses=[Pose(position=place) for place in places])


class HandNode(Node):  # type: ignore[misc]  # rclpy has no types
    """ROS's thread takes the images; one of ours tracks the newest, the others are dropped."""

    def __init__(self) -> None:
        super().__init__("toftrack")
        self.camera: toftrack.PushDevice | None = None
        self.headers: deque[Header] = deque(maxlen=100)
        self.joints = self.create_publisher(PoseArray, "hand/joints", 10)
        self.gesture = self.create_publisher(String, "hand/gesture", 10)
        self.create_subscription(CameraInfo, "camera_info", self.on_info, qos_profile_sensor_data)
        self.create_subscription(Image, "depth", self.on_image, qos_profile_sensor_data)

    def on_info(self, info: CameraInfo) -> None:
        if self.camera is None:
            # What rectified images are seen through is P, which some drivers leave out.
            p, k = np.reshape(info.p, (3, 4))[:, :3], np.reshape(info.k, (3, 3))
            k = p if p[0, 0] > 0 else k
            self.camera = toftrack.PushDevice(toftrack.Camera(k, info.width, info.height))
            threading.Thread(target=self.follow, args=(self.camera,), daemon=True).start()

    def on_image(self, image: Image) -> None:
        if self.camera is not None:
            self.headers.append(image.header)
            self.camera.push(depth_of(image), seconds_of(image.header))

    def follow(self, camera: toftrack.PushDevice) -> None:
        try:
            for estimate in toftrack.track(camera):
                headers = {seconds_of(header): header for header in list(self.headers)}
                if not estimate.lost and estimate.timestamp_s in headers:
                    self.joints.publish(poses_of(estimate, headers[estimate.timestamp_s]))
                    self.gesture.publish(String(data=estimate.gesture))
        except toftrack.ToftrackError as error:
            self.get_logger().fatal(str(error))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(HandNode())
