"""docs/examples and the programs of docs/python.md run as they stand, beside stand-ins of Blender,
Unity and ROS 2.
"""

import asyncio
import re
import runpy
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import bags
from helpers.hands import hand_estimate, lost_hand
from helpers.programs import free_port
from helpers.tracking import ROOT, sample

import toftrack
from toftrack.output.lines import json_line

EXAMPLES = ROOT / "docs" / "examples"
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
CODE = dict(re.findall(r"<!-- test: (\w+) -->\n```python\n(.*?)```", PAGE, re.DOTALL))


def play(push: Any) -> None:
    """Four frames in millimetres, at a camera's pace."""
    for index, depth_m in enumerate(sample().depth_m[:4]):
        push(1000 * depth_m, index / 25)
        time.sleep(0.04)


def test_the_program_that_reads_a_file_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "hand.npz", depth_m=sample().depth_m[:3], K=sample().k)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(CODE["track"], "python.md", "exec"), names)
    assert capsys.readouterr().out.count("<frame ") == 6 and (tmp_path / "hand.csv").is_file()
    assert names["tips"].shape == (3, 3) and names["picture"].shape[2] == 3


def test_a_camera_s_callback_and_asyncio_get_estimates(capsys: pytest.CaptureFixture[str]) -> None:
    names = {"toftrack": toftrack, "K": sample().k, "play": play, "asyncio": asyncio}
    exec(compile(CODE["callback"], "python.md", "exec"), names)
    *estimates, dropped = capsys.readouterr().out.splitlines()
    assert len(estimates) + int(dropped.split()[0]) == 4 and estimates[-1].startswith("<frame 3,")
    exec(compile(CODE["asyncio"], "python.md", "exec"), names)
    camera = names["camera"] = toftrack.PushDevice(toftrack.Camera(sample().k, 176, 144), fps=25)
    pusher = threading.Thread(target=lambda: (play(names["on_depth"]), camera.end()))
    pusher.start()
    asyncio.run(names["follow"]())
    pusher.join()
    assert "<frame 3, 0.120 s: " in capsys.readouterr().out


def module(monkeypatch: pytest.MonkeyPatch, name: str, **content: Any) -> None:
    """A stand-in for a module that is not here."""
    made = ModuleType(name)
    vars(made).update(content)
    monkeypatch.setitem(sys.modules, name, made)


def test_blender_s_empties_go_where_the_hands_are(monkeypatch: pytest.MonkeyPatch) -> None:
    objects: dict[str, SimpleNamespace] = {}
    linked: list[SimpleNamespace] = []
    timers: list[Any] = []

    def new(name: str, _: None) -> SimpleNamespace:
        return objects.setdefault(name, SimpleNamespace(name=name))

    scene = SimpleNamespace(collection=SimpleNamespace(objects=SimpleNamespace(link=linked.append)))
    module(
        monkeypatch,
        "bpy",
        data=SimpleNamespace(objects=SimpleNamespace(get=objects.get, new=new)),
        context=SimpleNamespace(scene=scene),
        app=SimpleNamespace(timers=SimpleNamespace(register=timers.append)),
    )
    port = free_port(socket.SOCK_DGRAM)
    code = (EXAMPLES / "blender_receiver.py").read_text().replace("5005", str(port))
    names: dict[str, Any] = {}
    exec(compile(code, "blender_receiver.py", "exec"), names)
    (receive,) = timers
    right, left = hand_estimate(1), hand_estimate(1, "left")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender, names["receiver"]:
        assert receive() > 0 and not objects  # nothing has come
        for line in ((lost_hand(0),), (hand_estimate(0),), (right, left)):
            sender.sendto(json_line(line).encode(), ("127.0.0.1", port))
        receive()
        assert len(linked) == 42
        x, y, z = right.joints_m[8]
        assert np.allclose(objects["right_8"].location, (x, z, -y))
        sender.sendto(json_line((hand_estimate(9),)).encode(), ("127.0.0.1", port))
        receive()
    assert len(linked) == 42 and objects["right_8"].location[0] > x


UNITY = """
namespace UnityEngine {
    public struct Vector3 {
        public float x, y, z;
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
        public static Vector3 one = new Vector3(1, 1, 1);
        public static Vector3 operator *(float f, Vector3 v) =>
            new Vector3(f * v.x, f * v.y, f * v.z);
    }
    public class Transform {
        public Vector3 localPosition, localScale;
        public void SetParent(Transform parent, bool stays) {}
    }
    public enum PrimitiveType { Sphere }
    public class GameObject {
        public Transform transform = new Transform();
        public static GameObject CreatePrimitive(PrimitiveType kind) => new GameObject();
    }
    public class MonoBehaviour { public Transform transform = new Transform(); }
}
class Play {
    const System.Reflection.BindingFlags own = (System.Reflection.BindingFlags) 36;
    static HandReceiver hand = new HandReceiver(), unplayed = new HandReceiver();
    static void Call(string name) => typeof(HandReceiver).GetMethod(name, own).Invoke(hand, null);
    static void Main() {
        Call("Start");
        System.Console.WriteLine("ready");
        System.Console.ReadLine();
        Call("Update");
        var joints = typeof(HandReceiver).GetField("joints", own).GetValue(hand);
        var tip = ((UnityEngine.Transform[]) joints)[8].localPosition;
        System.Console.WriteLine(System.FormattableString.Invariant($"{tip.x} {tip.y} {tip.z}"));
        Call("OnDestroy");
    }
}
"""


def test_unity_s_component_compiles_and_moves_its_balls(tmp_path: Path) -> None:
    if shutil.which("mcs") is None:
        pytest.skip("there is no C# compiler (mcs)")
    port = free_port(socket.SOCK_DGRAM)
    code = (EXAMPLES / "HandReceiver.cs").read_text().replace("5005", str(port))
    (tmp_path / "HandReceiver.cs").write_text(code)
    (tmp_path / "Unity.cs").write_text(UNITY)
    command = ["mcs", "-out:play.exe", "HandReceiver.cs", "Unity.cs"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    if shutil.which("mono") is None:
        pytest.skip("there is no C# compiler's runtime (mono)")
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    estimate = hand_estimate(3)
    with (
        subprocess.Popen(["mono", "play.exe"], cwd=tmp_path, **pipes) as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        assert process.stdout.readline() == "ready\n"
        sender.sendto(json_line((estimate,)).encode(), ("127.0.0.1", port))
        printed, _ = process.communicate("\n", timeout=60)
    assert np.allclose([float(word) for word in printed.split()], estimate.joints_m[8] * [1, -1, 1])


class Message(SimpleNamespace):
    """Of any kind."""


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The names of ros2_node.py, with stand-ins of ROS; what is published is in `published`."""
    published: list[tuple[str, Any]] = []

    class Node:
        def __init__(self, name: str) -> None: ...

        def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
            return SimpleNamespace(publish=lambda message: published.append((topic, message)))

        def create_subscription(self, *_: Any) -> None: ...

        def get_logger(self) -> SimpleNamespace:
            return SimpleNamespace(fatal=lambda words: published.append(("fatal", words)))

    module(monkeypatch, "rclpy")
    module(monkeypatch, "rclpy.node", Node=Node)
    module(monkeypatch, "rclpy.qos", qos_profile_sensor_data=None)
    for package in ("geometry_msgs", "sensor_msgs", "std_msgs"):
        kinds = dict.fromkeys(
            "Point Pose PoseArray CameraInfo Image Header String".split(), Message
        )
        module(monkeypatch, f"{package}.msg", **kinds)
    return runpy.run_path(str(EXAMPLES / "ros2_node.py")) | {"published": published}


def image(depth_m: np.ndarray, encoding: str, number: int = 0, big: bool = False) -> Message:
    """A sensor_msgs/Image whose rows are padded by 3 bytes."""
    stamp = Message(sec=1_900_000_000, nanosec=40_000_000 * number)
    header = Message(stamp=stamp, frame_id="depth_optical")
    return Message(header=header, **bags.image(depth_m, encoding, big, pad=3))


def test_ros_images_become_depth(ros: dict[str, Any]) -> None:
    depth_m = sample().depth_m[0]
    for encoding, big in (("16UC1", False), ("16UC1", True), ("32FC1", False), ("32FC1", True)):
        found = ros["depth_of"](image(depth_m, encoding, big=big))
        assert found.dtype == np.float32 and np.allclose(found, depth_m, atol=6e-4)
    with pytest.raises(ValueError, match="rgb8 is no depth"):
        ros["depth_of"](image(depth_m, "rgb8"))


def test_the_ros_node_publishes_the_joints_with_their_image_s_header(ros: dict[str, Any]) -> None:
    node, published = ros["HandNode"](), ros["published"]
    projection = np.column_stack([sample().k, np.zeros(3)])
    raw = np.diag([90.0, 90.0, 1.0])  # of the lens whose images were rectified
    info = Message(k=raw.ravel(), p=projection.ravel(), width=176, height=144)
    node.on_image(image(sample().depth_m[0], "16UC1"))  # before the lens is known
    node.on_info(info)
    follower = threading.enumerate()[-1]
    for number in range(4):
        node.on_image(image(sample().depth_m[number], "16UC1", number))
        time.sleep(0.04)
    node.camera.end()
    follower.join(120)
    (_, poses), (topic, gesture) = published[-2:]
    assert (topic, gesture.data) == ("hand/gesture", "palm")
    assert poses.header.stamp.nanosec == 120_000_000 and poses.header.frame_id == "depth_optical"
    places = [[pose.position.x, pose.position.y, pose.position.z] for pose in poses.poses]
    assert np.linalg.norm(places - sample().joints_m[3], axis=1).max() < 0.04
