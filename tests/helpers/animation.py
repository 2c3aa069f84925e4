"""Readers of animations, by the rules of their formats."""

import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation


class Gltf:
    """A .glb, read by the rules of the format."""

    def __init__(self, data: bytes) -> None:
        magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
        assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
        self.document = json.loads(data[20 : 20 + size])
        self._binary = data[28 + size :]
        assert data[24 + size : 28 + size] == b"BIN\0"

    def array(self, number: int) -> np.ndarray:
        accessor = self.document["accessors"][number]
        view = self.document["bufferViews"][accessor["bufferView"]]
        kinds = {5121: np.uint8, 5125: np.uint32, 5126: np.float32}
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor["type"]]
        start = view.get("byteOffset", 0)
        data = self._binary[start : start + view["byteLength"]]
        return np.frombuffer(data, kinds[accessor["componentType"]]).reshape(-1, width)

    def channels(self) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray, str]]:
        """Times, values and interpolation of each animated property of a node."""
        (animation,) = self.document["animations"]
        found = {}
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            node = self.document["nodes"][channel["target"]["node"]]["name"]
            time, values = self.array(sampler["input"])[:, 0], self.array(sampler["output"])
            found[node, channel["target"]["path"]] = time, values, sampler["interpolation"]
        return found

    def world(self, frame: int) -> dict[str, np.ndarray]:
        """(4, 4) of every animated joint in a frame."""
        nodes, channels = self.document["nodes"], self.channels()
        parents = {child: i for i, node in enumerate(nodes) for child in node.get("children", ())}

        def matrix(number: int) -> np.ndarray:
            name, own = nodes[number]["name"], np.eye(4)
            if (name, "rotation") in channels:
                turn = channels[name, "rotation"][1][frame]
                own[:3, :3] = Rotation.from_quat(turn).as_matrix()
                own[:3, 3] = channels[name, "translation"][1][frame]
            return matrix(parents[number]) @ own if number in parents else own

        return {node["name"]: matrix(number) for number, node in enumerate(nodes)}


def read_bvh(text: str) -> tuple[list[str], np.ndarray]:
    """Names of the joints as they begin, and places (T, joints, 3) of all as they end, in cm."""
    hierarchy, _, motion = text.partition("MOTION\n")
    frames = np.array([line.split() for line in motion.splitlines()[2:]], float)
    names: list[str] = []
    places, column, stack = [], 0, []
    for line in hierarchy.splitlines()[1:]:
        match line.split():
            case ["ROOT" | "JOINT", name]:
                names.append(name)
            case ["End", "Site"]:
                names.append(f"end of {names[-1]}")
            case ["OFFSET", *offset]:
                origin, turn = stack[-1] if stack else (np.zeros((len(frames), 3)), None)
                shift = np.array(offset, float)
                here = origin + (shift if turn is None else turn.apply(shift))
                stack.append((here, turn))
            case ["CHANNELS", count, *kinds]:
                here, turn = stack[-1]
                values = frames[:, column : column + int(count)]
                column += int(count)
                order = "".join(kind[0] for kind in kinds if kind.endswith("rotation"))
                if int(count) == 6:
                    here = here + values[:, :3]
                own = Rotation.from_euler(order, values[:, -3:], degrees=True)
                stack[-1] = here, own if turn is None else turn * own
            case ["}"]:
                places.append(stack.pop()[0])
    assert column == frames.shape[1] and not stack
    return names, np.stack(places, 1)
