"""Moves empties in Blender as hands move: `python track.py device=realsense stream=udp hands=2`,
then open this file in Blender's text editor, and run it (Alt+P).
"""

import json
import socket
from contextlib import suppress
from typing import Any

import bpy

receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
receiver.bind(("127.0.0.1", 5005))
receiver.setblocking(False)  # Blender's window must not wait for a line


def receive() -> float:
    newest = None
    with suppress(BlockingIOError):  # no more lines
        while True:
            newest = json.loads(receiver.recv(65535))
    hands = newest.get("hands", [newest]) if newest else []  # with hands=1 the line is the hand
    for hand in hands:
        if not hand["lost"]:
            move(hand)
    return 1 / 60  # s, until Blender calls again


def move(hand: dict[str, Any]) -> None:
    for joint, (x, y, z) in enumerate(hand["joints_m"]):
        name = f"{hand['side']}_{joint}"  # right_8 is the right index finger's tip
        empty = bpy.data.objects.get(name)
        if empty is None:
            empty = bpy.data.objects.new(name, None)
            empty.empty_display_size = 0.01
            bpy.context.scene.collection.objects.link(empty)
        empty.location = (x, z, -y)  # metres; the camera looks along y, and z is up


bpy.app.timers.register(receive)
