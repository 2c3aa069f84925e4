"""`stream=websocket` in headless Chromium: its pages, those of docs/, and the web client there."""

import functools
import http.server
import json
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.browsing import eventually
from helpers.chromium import DRAWS_IN_3D, headless_chromium
from helpers.hands import hand_estimate
from helpers.settings import part
from helpers.tracking import ROOT, code_of

from toftrack.devices.replay import Sample
from toftrack.frames.estimate import Estimate
from toftrack.gestures.pinch import PinchState, pinch_of, update_pinch
from toftrack.gestures.recognition import pointing_ray
from toftrack.output.lines import json_line

WIDTH_M = 0.5


@pytest.fixture(scope="module")
def stream() -> Iterator[Any]:
    with part("stream=websocket", "stream", port=0) as opened:
        yield opened


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with headless_chromium(tmp_path_factory.mktemp("profile"), *DRAWS_IN_3D) as driver:
        yield driver


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """The browser with its usual window, whose console must stay empty."""
    browser.set_window_size(1200, 900)
    yield browser
    assert browser.get_log("browser") == []


def select(browser: Any, stream: Any, estimate: Estimate) -> np.ndarray:
    def send() -> None:
        stream.send((estimate,))

    reported = f"/^frame {estimate.index}\\b/.test(by('facts').value)"
    for _ in range(25):  # the view follows the hand smoothly
        shown(browser, reported, send)
    return picture_of(browser)


def shown(browser: Any, reported: str, send: Callable[[], None]) -> Any:
    """Send until the page says something true in JavaScript, which is returned."""

    def answered() -> Any:
        send()
        return browser.execute_script(f"return {reported}")

    return eventually(answered)


def picture_of(browser: Any) -> np.ndarray:
    """(H, W) bool: where something is drawn, between the page's words."""
    # A frame that is asked for is drawn before this is answered.
    browser.execute_async_script("requestAnimationFrame(() => setTimeout(arguments[0], 50))")
    data = np.frombuffer(browser.get_screenshot_as_png(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR).astype(int)[60:-60]
    return np.ptp(image, axis=2) > 25  # skin is coloured, the ground is not


def test_the_hand_is_drawn_bends_and_becomes_grey_when_it_is_lost(stream: Any, page: Any) -> None:
    page.get(stream.url)
    open_hand = select(page, stream, hand_estimate(1))
    rows, columns = np.nonzero(open_hand)
    assert open_hand.mean() > 0.03 and np.ptp(rows) > 250 and np.ptp(columns) > 150
    assert "frame 1" in page.find_element("tag name", "header").text
    live = "document.body.dataset.phase === 'live'"  # a slow browser waits for lines meanwhile
    shown(page, live, lambda: stream.send((hand_estimate(1),)))
    fist = select(page, stream, hand_estimate(2, bent=1.2))
    assert np.ptp(np.nonzero(fist)[0]) < 0.8 * np.ptp(rows)
    lost = select(page, stream, replace(hand_estimate(3), lost=True))
    assert lost.mean() < 0.01  # grey has no colour
    assert "lost" in page.find_element("tag name", "header").text
    both = hand_estimate(9), hand_estimate(9, "left")
    shown(page, "hands.length === 2", lambda: stream.send(both))


def test_a_bone_to_a_joint_that_is_not_ok_is_grey_and_of_one_piece(stream: Any, page: Any) -> None:
    page.get(stream.url)
    ok = np.arange(21) != 12  # the middle finger's tip
    whole, doubted = (
        select(page, stream, hand_estimate(index, joint_ok=flags))
        for index, flags in ((1, np.ones(21, bool)), (2, ok))
    )
    top, lower = (np.nonzero(one.any(1))[0][0] for one in (whole, doubted))
    assert lower > top + 10
    grey = cv2.imdecode(np.frombuffer(page.get_screenshot_as_png(), np.uint8), 0)[60:-60]
    assert (grey[top + 3 : lower] > 40).any(1).all()


def test_the_hand_comes_back_when_the_graphics_were_lost(stream: Any, page: Any) -> None:
    page.get(stream.url)
    before = select(page, stream, hand_estimate(1))
    page.execute_script("window.loss = gl.getExtension('WEBGL_lose_context'); loss.loseContext()")
    eventually(lambda: page.execute_script("return gl.isContextLost()"))
    page.execute_async_script("setTimeout(arguments[0], 50)")  # it can be restored from then on
    page.execute_script("loss.restoreContext()")
    eventually(lambda: not page.execute_script("return gl.isContextLost()"))
    page.get_log("browser")
    assert select(page, stream, hand_estimate(2)).sum() > 0.9 * before.sum()


def test_a_drag_turns_the_hand_also_where_the_browser_tells_no_movement(
    stream: Any, page: Any
) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    page.get(stream.url)
    page.execute_script("Object.defineProperty(MouseEvent.prototype, 'movementX', { value: 0 })")
    before = page.execute_script("return turn[0]")
    canvas = page.find_element("tag name", "canvas")
    ActionChains(page).click_and_hold(canvas).move_by_offset(100, 0).release().perform()
    elsewhere = page.find_element("id", "mirror")
    ActionChains(page).click_and_hold(elsewhere).move_to_element(canvas).release().perform()
    assert page.execute_script("return turn[0]") == pytest.approx(before - 0.8, abs=0.02)


def pointing(index: int, x: float, y: float, **changes: Any) -> Estimate:
    """A hand that points at a place of the screen, in parts of its width from its upper left."""
    origin = np.array([0.05, 0.1, 0.5])
    # The camera sits in the middle of the upper edge, and its right is the person's left.
    there = np.array([WIDTH_M * (0.5 - x), WIDTH_M * y, 0.0])
    way = (there - origin) / np.linalg.norm(there - origin)
    ray = {"pointing_origin_m": origin, "pointing_direction": way}
    return replace(hand_estimate(index), gesture="pointing", **ray | changes)


def test_the_cursor_follows_the_ray_and_a_pinch_presses(stream: Any, page: Any) -> None:
    """Three targets are pointed at and pinched, one of them beside it first."""
    page.get(f"{stream.url}point?seed=3&targets=3&width={WIDTH_M}")
    wide = page.execute_script("return innerWidth")
    count = 0

    def aim(x: float, y: float, pinch: bool = False) -> None:
        nonlocal count
        count += 1
        nowhere = {name: np.full(3, np.nan) for name in ("pointing_origin_m", "pointing_direction")}
        changes = {"pinching": True, **nowhere} if pinch else {}  # who pinches does not point
        stream.send((pointing(count, x, y, **changes),))

    for hits in range(3):
        at = page.execute_script("return game.target")
        x, y = at["x"] / wide, at["y"] / wide
        for beside in (0.15,) if hits == 1 else ():
            rest(page, lambda x=x + beside, y=y: aim(x, y))
            shown(page, "game.misses === 1", lambda: aim(0, 0, pinch=True))
            shown(page, "!pinching", lambda: aim(0, 0))
        rest(page, lambda x=x, y=y: aim(x, y))
        cursor = page.execute_script("return game.cursor")
        assert cursor == pytest.approx([at["x"], at["y"]], abs=1.5)
        shown(page, f"game.hits === {hits + 1}", lambda: aim(0, 0, pinch=True))
        shown(page, "!pinching", lambda x=x, y=y: aim(x, y))
    game = page.execute_script("return game")
    assert game["over"] and game["misses"] == 1 and len(game["times"]) == 3
    score = page.find_element("id", "score").text
    assert score.startswith("done: 3 of 3 hit, 1 missed, ") and score.endswith("s a target")


def rest(page: Any, aim: Callable[[], None]) -> None:
    """Point at a place for longer than a press looks back."""
    until = time.monotonic() + 0.5
    while time.monotonic() < until:
        shown(page, "game.cursor !== null", aim)


CURSOR_PAGE = """
document.body.innerHTML = "<div id=cursor></div>";
document.body.firstChild.style = "position: fixed; left: 0; top: 0; pointer-events: none";
window.clicks = [];
for (let k = 0; k < 10; k++) {
  const column = document.createElement("button");
  column.style = `position: fixed; left: ${10 * k}%; width: 10%; top: 0; height: 100%`;
  column.onclick = () => clicks.push(k);
  document.body.append(column);
}
"""


def test_the_docs_cursor_follows_the_fingertip_and_a_pinch_clicks_where_it_was(
    stream: Any, page: Any
) -> None:
    code = code_of("streams.md", "cursor")
    page.get(f"{stream.url}feed.js")  # no page, but of this origin
    eventually(lambda: not stream._server.clients)
    assert "ws://127.0.0.1:8766/" in code and "u: [0.37, 0.76]" in code
    here = code.replace("ws://127.0.0.1:8766/", f"ws{stream.url.removeprefix('http')}")
    page.execute_script(CURSOR_PAGE + here)
    eventually(lambda: stream._server.clients)
    not_ok, pinch, lost = {"joint_ok": np.zeros(21, bool)}, {"pinching": True}, {"lost": True}
    frames = [(0.25, {})] * 10 + [(0.35, {})] * 5  # the fingers close
    frames += [(0.45, pinch), (0.45, pinch), (0.9, pinch | not_ok), (0.9, lost), (0.45, pinch)]
    frames += [(0.45, {})] * 8 + [(0.45, pinch)]
    # Nothing is known of 0.28 s before: no click, neither after a loss nor of what was before it.
    frames += [(0.05, {})] * 8 + [(0.05, lost), *[(0.15, {})] * 3, (0.15, pinch)]
    frames += [(0.45, {})] * 9 + [(0.45, pinch), (0.45, lost)]
    for index, (at, changes) in enumerate(frames):
        landmarks = np.full((21, 3), (0.37 + 0.39 * at, 0.755, 0.0))
        stream.send((hand_estimate(index, landmarks=landmarks, **changes),))
    assert shown(page, "clicks.length > 2 && clicks", lambda: None) == [7, 5, 5]
    *there, wide, high = page.execute_script(
        "return [...cursor.style.translate.split(' ').map(parseFloat), innerWidth, innerHeight]"
    )
    assert there == pytest.approx([0.55 * wide, 0.5 * high], abs=0.1)
    assert shown(page, "cursor.style.opacity === '0'", lambda: None)


GAME = "point?seed=15411478&width=1&reach=0.5"
"""The game that the sample of pointing and pinching was drawn for (docs/streams.md)."""


def test_a_disc_is_in_the_window_whatever_becomes_of_that(stream: Any, page: Any) -> None:
    page.set_window_size(1000, 700)
    page.get(f"{stream.url}point?seed=7&reach=0.1")
    before = page.execute_script("return {...game.target}")
    page.execute_script("for (let i = 0; i < 50; i++) next()")
    page.set_window_size(500, 800)
    inside = (
        "const { x, y, radius } = game.target; "
        "return innerWidth < 700 && radius <= x && x <= innerWidth - radius"
        " && radius <= y && y <= innerHeight - radius"
    )
    eventually(lambda: page.execute_script(inside))
    after = page.execute_script("return game.target")
    assert (after["across"], after["down"]) != (before["across"], before["down"])


def test_the_view_has_every_hand_in_it(stream: Any, page: Any) -> None:
    page.set_window_size(800, 700)
    page.get(stream.url)
    shift = np.array([0.45, 0.0, 0.0], np.float32)
    one, other = hand_estimate(9), hand_estimate(9, "left")
    apart = replace(other, openxr_position_m=other.openxr_position_m + shift)
    for _ in range(60):
        shown(page, "hands.length === 2", lambda: stream.send((one, apart)))
    drawn = picture_of(page)
    columns = np.flatnonzero(drawn.any(0))
    assert 10 < columns[0] and columns[-1] < drawn.shape[1] - 10
    assert (np.diff(columns) > 20).any()  # two of them


PLAY = """
let now = 0;
performance.now = () => now;
for (const line of arguments[0]) { now = 1000 * line.timestamp_s; take([line], line); }
return game;
"""


def test_the_sample_of_pointing_and_pinching_hits_every_target(stream: Any, page: Any) -> None:
    """By its true joints; how many are hit by tracked ones is left to docs/streams.md."""
    settings, pinch, lines = part("gestures=default", "gestures.pinch"), PinchState(), []
    device, nowhere = Sample(name="point_and_pinch"), np.full(3, np.nan)
    hand = hand_estimate(0)
    for index, joints in enumerate(device.truth.joints_m):
        pinch = update_pinch(pinch, pinch_of(joints, settings), settings, 1.0)
        origin, way = (nowhere, nowhere) if pinch.pinching else pointing_ray(joints)
        ray = {"pointing_origin_m": origin, "pointing_direction": way}
        seen = {"index": index, "timestamp_s": index / device.fps, "pinching": pinch.pinching}
        fields = ("lost", "gesture", "gesture_probability", "pinch", *seen, *ray)
        lines.append(json.loads(json_line([replace(hand, **seen | ray)], fields)))
    page.get(f"{stream.url}{GAME}")
    game = page.execute_script(PLAY, lines)
    assert (game["hits"], game["misses"], game["over"]) == (12, 0, True)


CLIENT = ROOT / "docs" / "examples" / "web_client"


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture
def client_address(tmp_path: Path) -> Iterator[str]:
    """The folder as its README sets it up and serves it."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("needs npm")
    for name in ("index.html", "package.json"):
        shutil.copy(CLIENT / name, tmp_path)
    command = [npm, "install", "--prefer-offline", "--no-audit", "--no-fund", "--ignore-scripts"]
    if subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=120).returncode:
        pytest.skip("npm could not install three")
    handler = functools.partial(_Quiet, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_the_docs_client_draws_the_hand_live_and_bends_it(
    client_address: str, browser: Any
) -> None:
    said = "document.querySelector('output').value"
    heights = []
    with part("stream=websocket", "stream", port=0, origins=[client_address]) as stream:
        browser.get(f"{client_address}/?server={stream.url.removeprefix('http://').rstrip('/')}")
        for index, bent in ((1, 0.0), (2, 1.2)):
            one = (hand_estimate(index, bent=bent),)
            shown(browser, f"{said}.startsWith('{index} ')", lambda now=one: stream.send(now))
            drawn = picture_of(browser)
            assert drawn.mean() > 0.005
            heights.append(np.ptp(np.nonzero(drawn)[0]))
        logged = [one for one in browser.get_log("browser") if "favicon" not in one["message"]]
        browser.get("data:,")
    assert heights[1] < 0.8 * heights[0]
    assert logged == []


def test_the_pages_say_when_the_tracker_has_gone(browser: Any, tmp_path: Path) -> None:
    with part("stream=websocket", "stream", port=0) as stream:
        browser.get(stream.url)
        shown(browser, "by('facts').value", lambda: stream.send((hand_estimate(1),)))
    gone = "document.body.dataset.phase === 'broken'"
    shown(browser, gone, lambda: None)
    browser.get("data:,")
    reported = browser.get_log("browser")  # by the browser itself, which the page cannot help
    assert all("ERR_CONNECTION_REFUSED" in entry["message"] for entry in reported)
