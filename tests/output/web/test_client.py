"""docs/examples/web_client in headless Chromium: three.js draws the hand that is streamed."""

from __future__ import annotations

import functools
import http.server
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.chromium import DRAWS_IN_3D, headless_chromium, picture, shown
from helpers.hands import hand_estimate
from helpers.settings import part
from helpers.tracking import ROOT

CLIENT = ROOT / "docs" / "examples" / "web_client"


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The folder as its README sets it up and serves it."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("needs npm")
    folder = tmp_path_factory.mktemp("client")
    for name in ("index.html", "package.json"):
        shutil.copy(CLIENT / name, folder)
    command = [npm, "install", "--prefer-offline", "--no-audit", "--no-fund", "--ignore-scripts"]
    found = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    if found.returncode:
        pytest.skip("npm could not install three")
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_the_hand_is_drawn_live_and_bends(address: str, tmp_path: Path) -> None:
    said = "document.querySelector('output').value"
    heights = []
    with (
        part("stream=websocket", "stream", port=0, origins=[address]) as stream,
        headless_chromium(tmp_path / "profile", *DRAWS_IN_3D) as page,
    ):
        page.get(f"{address}/?server={stream.url.removeprefix('http://').rstrip('/')}")
        for index, bent in ((1, 0.0), (2, 1.2)):
            estimate = hand_estimate(index, bent=bent)
            shown(page, f"{said}.startsWith('{index} ')", lambda now=estimate: stream.send((now,)))
            page.execute_async_script("requestAnimationFrame(() => setTimeout(arguments[0], 50))")
            drawn = picture(page)
            assert drawn.mean() > 0.005
            heights.append(np.ptp(np.nonzero(drawn)[0]))
        logged = [entry for entry in page.get_log("browser") if "favicon" not in entry["message"]]
    assert heights[1] < 0.8 * heights[0]
    assert logged == []
