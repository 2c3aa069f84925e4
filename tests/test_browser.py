"""`view=browser`: the page, its pictures, its commands, and what must not disturb the tracker."""

from __future__ import annotations

import http.client
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import cv2
import numpy as np
import pytest
from tracking import ROOT, configuration, make_tracker

from toftrack.devices.replay import Replay
from toftrack.devices.sample import Sample
from toftrack.errors import ToftrackError
from toftrack.estimate import no_estimate
from toftrack.results import read_results
from toftrack.views import browser
from toftrack.views.base import Moment
from toftrack.views.browser import BrowserView, LivePicture, browser_view
from toftrack.views.overlay import CAPTION_PX, draw_moment

PATIENCE_S = 20
QUICK = ("start.hypotheses=500", "start.samples=128", "start.islands=16", "filter.particles=100")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
DRIVER = shutil.which("chromedriver")


@cache
def moments() -> tuple[Moment, ...]:
    """Two tracked frames of the sample, which look different."""
    device, tracker = Sample(start=40, stop=46), make_tracker()
    kept = []
    for frame in device:
        depth, shape = device.camera.rectify(frame.depth, frame.radial), tracker.shape
        estimate = tracker.step(depth, device.camera.K, frame.index, frame.timestamp_s)
        kept.append(Moment(frame, depth, device.camera, estimate, shape, tracker.insight))
    return kept[0], kept[-1]


def made(**settings: float) -> BrowserView:
    return browser_view("", 25.0, None, port=0, **settings)


@pytest.fixture
def view() -> Iterator[BrowserView]:
    view = made()
    yield view
    view.close()


def get(view: BrowserView, path: str) -> tuple[dict, bytes]:
    """The facts and the body of an answer."""
    with urlopen(view.url + path, timeout=PATIENCE_S) as answer:
        return json.loads(answer.headers["X-Moment"] or "{}"), answer.read()


def next_picture(view: BrowserView, facts: dict) -> tuple[dict, bytes]:
    """Ask, as the page does, until there is a newer picture."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        facts, body = get(
            view, f"moment?run={facts.get('run', '')}&after={facts.get('version', 0)}"
        )
        if body:
            return facts, body
    raise AssertionError("no picture came")


def post(view: BrowserView, body: object, path: str = "command", **headers: str) -> int:
    """The status of a POST as the page sends it, but for the given headers."""
    headers = {"Content-Type": "application/json"} | {
        name.replace("_", "-"): value for name, value in headers.items()
    }
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    try:
        with urlopen(Request(view.url + path, data, headers), timeout=PATIENCE_S) as answer:
            return answer.status
    except HTTPError as error:
        return error.code


def raw(view: BrowserView) -> socket.socket:
    url = urlsplit(view.url)
    return socket.create_connection((url.hostname, url.port), PATIENCE_S)


def ours() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith("browser-")]


def eventually(told: Callable[[], object]) -> object:
    """Wait until `told` says something true."""
    deadline = time.monotonic() + PATIENCE_S
    while not (value := told()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return value


@contextmanager
def shown_again_and_again(view: BrowserView) -> Iterator[list[str]]:
    """A thread that does what the tracker does: shows frames and takes commands."""
    taken: list[str] = []
    stop = threading.Event()

    def run() -> None:
        count = 0
        while not stop.is_set():
            taken.extend(view.commands())
            moment, count = moments()[count // 5 % 2], count + 1
            side = next((c for c in reversed(taken) if c != "restart"), "right")
            shape = moment.shape.of_side(side) if side != moment.shape.side else moment.shape
            estimate = replace(moment.estimate, index=count)
            view.show(replace(moment, estimate=estimate, shape=shape))
            stop.wait(0.02)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield taken
    finally:
        stop.set()
        thread.join()


def test_the_page_comes_with_all_that_it_needs(view) -> None:
    with urlopen(view.url, timeout=PATIENCE_S) as answer:
        page = answer.read().decode()
        assert answer.headers.get_content_type() == "text/html"
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
    assert "Start again" in page and "Left hand" in page
    assert not re.search(r"(?:src|href)=\"(?!data:)|https?:|@import|url\(", page)


def test_the_picture_is_the_overlay_of_the_newest_frame(view) -> None:
    first, second = moments()
    view.show(first)
    view.show(second)
    facts, body = next_picture(view, {})
    picture = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_COLOR)
    panel = draw_moment(second)[CAPTION_PX:]
    assert picture.shape == panel.shape
    assert np.abs(picture.astype(int) - panel).mean() < 3
    assert np.abs(picture.astype(int) - draw_moment(first)[CAPTION_PX:]).mean() > 3
    estimate = second.estimate
    assert (facts["phase"], facts["index"]) == ("live", estimate.index)
    assert facts["score"] == pytest.approx(estimate.score, abs=1e-3)
    assert (facts["state"], facts["lost"]) == (estimate.state_name, estimate.lost)
    assert facts["gesture"] == estimate.gesture and facts["side"] == "right"
    assert facts["ms"] == pytest.approx(1e3 * estimate.compute_s, abs=1e-3)


def test_pictures_follow_one_another_and_none_comes_twice(view) -> None:
    facts, bodies = {}, []
    for count in range(6):
        view.show(moments()[count % 2])
        facts, body = next_picture(view, facts)
        bodies.append(body)
    assert all(a != b for a, b in zip(bodies, bodies[1:], strict=False))
    assert get(view, f"moment?run={facts['run']}&after={facts['version']}")[1] == b""


def test_a_page_of_an_earlier_run_gets_this_runs_picture_at_once(view) -> None:
    view.show(moments()[0])
    assert next_picture(view, {"run": "another", "version": 10**9})[1]


def test_a_frame_without_a_hand_is_shown_as_lost(view) -> None:
    moment = moments()[0]
    view.show(replace(moment, estimate=no_estimate(7, 0.28, "lost", 4, 0.01), insight=None))
    facts, _ = next_picture(view, {})
    assert facts["lost"] and facts["index"] == 7 and facts["gesture_probability"] is None


def test_before_the_first_frame_and_after_the_last_the_page_is_told_so(monkeypatch) -> None:
    moments()
    view = made(linger_s=PATIENCE_S)
    lingering, end = threading.Event(), threading.Event()
    monkeypatch.setattr(view, "_linger", lambda: lingering.set() or end.wait(PATIENCE_S))

    def run() -> None:
        with view:
            view.show(moments()[0])

    with urlopen(view.url + "moment", timeout=PATIENCE_S) as answer:
        assert answer.status == 204
        assert json.loads(answer.headers["X-Moment"])["phase"] == "starting"
    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert lingering.wait(PATIENCE_S)
        facts, body = next_picture(view, {})
        assert facts["phase"] == "over" and body
    finally:
        end.set()
        thread.join()


def test_who_waits_is_told_of_the_end_at_once(view) -> None:
    view.show(moments()[0])
    facts, _ = next_picture(view, {})
    told: list[dict] = []
    path = f"moment?run={facts['run']}&after={facts['version']}"
    visitor = threading.Thread(target=lambda: told.append(get(view, path)[0]))
    visitor.start()
    eventually(lambda: view._picture._waiting)
    view.close()
    visitor.join()
    assert told[0]["phase"] == "stopped"


def test_commands_arrive_in_order_and_once(view) -> None:
    origin = view.url.rstrip("/")
    for command in ("left", "restart", "right"):
        assert post(view, {"command": command}, Origin=origin) == 204
    assert view.commands() == ["left", "restart", "right"]
    assert view.commands() == []


@pytest.mark.parametrize(
    ("body", "changes", "status"),
    [
        ({"command": "stop"}, {}, 400),
        ({"command": ["left"]}, {}, 400),
        (["left"], {}, 400),
        (b"left", {}, 400),
        (b"\xff\xfe", {}, 400),
        (b" " * 2000, {}, 413),
        ({"command": "left"}, {"Content_Type": "text/plain"}, 415),
        ({"command": "left"}, {"Origin": "http://evil.example"}, 403),
        ({"command": "left"}, {"Origin": "null"}, 403),
        ({"command": "left"}, {"Host": "evil.example", "Origin": "http://evil.example"}, 403),
        ({"command": "left"}, {"path": "elsewhere"}, 404),
    ],
)
def test_anything_but_a_command_from_its_own_page_is_refused(view, body, changes, status) -> None:
    assert post(view, body, **changes) == status
    assert view.commands() == []
    assert post(view, {"command": "left"}) == 204


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
def test_a_foreign_name_gets_nothing(view, host: str) -> None:
    url = urlsplit(view.url)
    connection = http.client.HTTPConnection(url.hostname, url.port, timeout=PATIENCE_S)
    for path in ("/", "/moment"):
        connection.request("GET", path, headers={"Host": host})
        answer = connection.getresponse()
        assert answer.status == 403 and b"<html" not in answer.read()
    connection.request("GET", "/", headers={"Host": f"localhost:{url.port}"})
    assert connection.getresponse().status == 200
    connection.close()


@pytest.mark.parametrize(("path", "status"), [("other", 404), ("moment?after=-1", 400)])
def test_what_is_not_there_is_refused(view, path: str, status: int) -> None:
    with pytest.raises(HTTPError) as caught:
        urlopen(view.url + path, timeout=PATIENCE_S)
    assert caught.value.code == status
    caught.value.close()


def test_nothing_is_drawn_while_nobody_watches(monkeypatch) -> None:
    drawn: list[int] = []
    monkeypatch.setattr(browser, "_encode", lambda m, _: drawn.append(m.estimate.index) or b"jpeg")
    picture = LivePicture(80, 1000)
    try:
        for _ in range(20):
            picture.put(moments()[0])
        time.sleep(0.1)
        assert drawn == []
        picture.put(moments()[1])
        assert picture.after(0, PATIENCE_S).jpeg == b"jpeg"
        assert drawn == [moments()[1].estimate.index]  # the others were never drawn
    finally:
        picture.close()


def test_showing_a_frame_never_waits_for_the_drawing(monkeypatch) -> None:
    go = threading.Event()
    monkeypatch.setattr(browser, "_encode", lambda *_: go.wait(PATIENCE_S) and b"jpeg")
    picture = LivePicture(80, 1000)
    try:
        visitor = threading.Thread(target=picture.after, args=(0, PATIENCE_S))
        visitor.start()
        picture.put(moments()[0])
        eventually(lambda: not picture._undrawn)  # it is being drawn
        for _ in range(3):
            picture.put(moments()[1])
        assert visitor.is_alive()
        go.set()
        visitor.join()
    finally:
        go.set()
        picture.close()


def test_what_goes_wrong_in_drawing_reaches_the_tracker(monkeypatch) -> None:
    def fail(*_: object) -> bytes:
        raise ToftrackError("the picture cannot be drawn")

    monkeypatch.setattr(browser, "_encode", fail)
    picture = LivePicture(80, 1000)
    try:
        picture.put(moments()[0])
        picture.after(0, 0.1)
        eventually(lambda: picture._error)
        with pytest.raises(ToftrackError, match="cannot be drawn"):
            picture.put(moments()[0])
    finally:
        picture.close()


def test_ten_visitors_and_one_who_never_reads_all_get_on(view) -> None:
    counts = [0] * 10

    def watch(number: int) -> None:
        facts: dict = {}
        for _ in range(5):
            facts, _ = next_picture(view, facts)
            counts[number] += 1

    with shown_again_and_again(view), raw(view) as deaf:
        deaf.settimeout(0.2)
        try:  # requests without end, until nothing goes into the pipe any more
            while True:
                deaf.sendall(b"GET /moment HTTP/1.1\r\nHost: localhost\r\n\r\n" * 100)
        except TimeoutError:
            pass
        visitors = [threading.Thread(target=watch, args=(n,)) for n in range(10)]
        for visitor in visitors:
            visitor.start()
        for visitor in visitors:
            visitor.join(PATIENCE_S)
        assert counts == [5] * 10
        view.close()  # although one is still connected
        assert ours() == []


def test_a_tab_closed_in_the_middle_is_no_error(view, capfd) -> None:
    with shown_again_and_again(view):
        for request in (b"", b"GET /mom", b"GET /moment HTTP/1.1\r\nHost: localhost\r\n\r\n"):
            for _ in range(3):
                connection = raw(view)
                connection.sendall(request)
                # Closing with a reset, as a browser that is killed.
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                connection.close()
        with raw(view) as nonsense:
            nonsense.sendall(b"\x16\x03\x01 https\r\n\r\n")
            assert b"400" in nonsense.recv(1000)
        assert next_picture(view, {})[1]
    view.close()
    assert capfd.readouterr().err == "" and ours() == []


def test_a_taken_port_is_one_clear_sentence_and_leaves_no_thread(view) -> None:
    port = urlsplit(view.url).port
    before = ours()
    with pytest.raises(ToftrackError, match=rf"port {port} of 127.0.0.1 is taken.*view\.port=PORT"):
        browser_view("", 25.0, None, port=port)
    assert ours() == before


@pytest.mark.parametrize(
    "settings",
    [
        {"port": 65536},
        {"port": "http"},
        {"quality": 0},
        {"most_fps": 0},
        {"wait_s": -1},
        {"linger_s": float("nan")},
        {"host": "192.0.2.1"},
    ],
)
def test_a_bad_setting_is_named(settings: dict) -> None:
    with pytest.raises(ToftrackError, match=f"view.{next(iter(settings))}="):
        browser_view("", 25.0, None, **{"port": 0} | settings)
    assert ours() == []


def test_closing_leaves_no_thread_and_frees_the_port() -> None:
    view = made()
    with raw(view), raw(view) as idle:  # browsers keep connections open
        idle.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert idle.recv(10)
        view.close()
        view.close()
        assert ours() == []
    browser_view("", 25.0, None, port=urlsplit(view.url).port).close()
    with pytest.raises(URLError):
        urlopen(view.url, timeout=PATIENCE_S)


def test_frames_with_an_end_wait_for_a_visitor_but_not_for_ever(capsys) -> None:
    found = re.compile(r"live view: (http://127\.0\.0\.1:\d+/)")
    views: list[BrowserView] = []
    thread = threading.Thread(
        target=lambda: views.append(browser_view("", 25.0, 100, port=0, wait_s=PATIENCE_S))
    )
    thread.start()
    told = ""
    while not found.search(told):
        told += capsys.readouterr().err
    urlopen(found.search(told)[1] + "moment", timeout=PATIENCE_S).close()
    thread.join(PATIENCE_S)
    views[0].close()
    browser_view("", 25.0, 100, port=0, wait_s=0.01).close()
    assert capsys.readouterr().out == ""


def test_with_the_page_recordings_keep_their_pace_and_only_the_sample_repeats() -> None:
    device = configuration("view=browser").device
    assert device.realtime and device.repeat
    device = configuration("view=browser", "device=replay", "device.path=x.npz").device
    assert device.realtime and not device.repeat
    device = configuration("view=browser", "view.live=false").device
    assert not device.realtime and not device.repeat
    assert not configuration("device=folder", "device.path=x").device.realtime


@pytest.mark.parametrize("realtime", [False, True])
def test_a_repeated_recording_counts_on(realtime: bool, monkeypatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(time, "sleep", lambda s: clock.__setitem__(0, clock[0] + s))
    device = Sample(start=10, stop=13, realtime=realtime, repeat=True)
    assert device.frames is None and device.truth is None and device.description["repeat"]
    frames = list(islice(device, 8))
    assert [frame.index for frame in frames] == list(range(10, 18))
    assert np.allclose([f.timestamp_s for f in frames], np.arange(10, 18) / 25)
    for frame, later in zip(frames, frames[3:], strict=False):
        assert np.array_equal(frame.depth, later.depth)
    assert not np.array_equal(frames[0].depth, frames[1].depth)
    assert device.dropped == 0 and clock[0] == pytest.approx(7 / 25 if realtime else 0, abs=1e-3)


def test_a_repeated_recording_drops_what_comes_too_late_over_its_end(monkeypatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(time, "sleep", lambda s: clock.__setitem__(0, clock[0] + s))
    device = Replay(ROOT / "toftrack/data/sample.npz", 0, 5, realtime=True, repeat=True)
    indices = []
    for frame in islice(device, 4):
        indices.append(frame.index)
        clock[0] = round(clock[0] + 0.1201, 4)  # three frames' time
    assert indices == [0, 3, 6, 9] and device.dropped == 6


def test_ctrl_c_while_watched_keeps_the_results(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, str(ROOT / "track.py"), "view=browser", "view.port=0", *QUICK],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    told = process.stderr.readline()
    url = re.fullmatch(r"live view: (http://\S+) \(Ctrl-C ends\)\n", told)[1]
    bodies, facts = [], {"version": 0, "run": ""}
    while len(bodies) < 2:
        path = f"{url}moment?run={facts['run']}&after={facts['version']}"
        with urlopen(path, timeout=PATIENCE_S) as answer:
            facts = json.loads(answer.headers["X-Moment"])
            bodies += [answer.read()] if answer.status == 200 else []
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and out == "", err
    assert "interrupted" in err and "Traceback" not in err
    assert bodies[0] != bodies[1]
    (results,) = tmp_path.glob("outputs/*/*/track.npz")
    assert len(read_results(results)["joints_m"]) >= 2


def test_the_page_stays_after_the_last_frame_until_ctrl_c(monkeypatch, capsys) -> None:
    stayed: list[float] = []

    def interrupted(seconds: float) -> None:
        stayed.append(seconds)
        raise KeyboardInterrupt

    monkeypatch.setattr(browser, "_stay", interrupted)
    for linger_s, words in ((5.0, "for 5 s (Ctrl-C ends it)"), (float("inf"), "until Ctrl-C")):
        with made(linger_s=linger_s):
            pass  # ends without an error: everything was done
        assert words in capsys.readouterr().err
    assert stayed == [5.0, float("inf")]
    with pytest.raises(ZeroDivisionError), made():
        1 / 0  # noqa: B018
    assert len(stayed) == 2 and ours() == []


@pytest.fixture
def chromium(tmp_path: Path) -> Iterator:
    """Headless Chromium under WebDriver."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="pip install '.[browser-test]'")
    if not (CHROMIUM and DRIVER):
        pytest.skip("needs chromium and chromedriver (Debian: chromium, chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        f"--user-data-dir={tmp_path / 'profile'}",
        "--window-size=1200,900",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


def test_the_page_works_in_a_browser(chromium, view) -> None:
    def text(name: str) -> str:
        return chromium.execute_script(f"return document.getElementById('{name}').textContent")

    def picture(name: str) -> str:
        return chromium.execute_script(f"return document.getElementById('{name}').toDataURL()")

    def press(words: str) -> None:
        chromium.find_element("xpath", f"//button[text()='{words}']").click()

    def pressed() -> list[str]:
        found = chromium.find_elements("css selector", "button[aria-pressed=true]")
        return [button.text for button in found]

    with shown_again_and_again(view) as taken:
        chromium.get(view.url)
        eventually(lambda: text("phase") == "live")
        eventually(lambda: text("fps") != "–")
        before = {name: picture(name) for name in ("image", "model")}
        number = int(text("index"))
        eventually(lambda: all(picture(name) != old for name, old in before.items()))
        eventually(lambda: int(text("index")) > number)
        assert text("score") in {f"{moment.estimate.score:.2f}" for moment in moments()}
        assert text("ms").endswith(" ms") and text("gesture") != ""

        eventually(lambda: pressed() == ["Right hand"])
        press("Start again")
        eventually(lambda: taken == ["restart"])
        eventually(lambda: "anew" in text("told"))
        press("Left hand")
        eventually(lambda: taken == ["restart", "left"])
        eventually(lambda: pressed() == ["Left hand"])

        for width in (1200, 500):
            chromium.set_window_size(width, 900)
            over = (
                "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
            )
            assert chromium.execute_script(over) <= 0
        left, right = (chromium.find_element("id", name).rect for name in ("image", "model"))
        assert right["y"] > left["y"] + left["height"] and left["width"] > 400
    view.show(replace(moments()[0], estimate=no_estimate(9, 0.36, "lost", 4, 0.01), insight=None))
    eventually(lambda: text("state") == "LOST" and text("phase") == "the hand is lost")
    assert chromium.get_log("browser") == []

    view._picture.set_phase("over")
    eventually(lambda: text("phase") == "the recording is over")
    assert chromium.find_element("xpath", "//button[text()='Start again']").get_property("disabled")
    view.close()
    time.sleep(0.2)
    assert text("phase") == "the recording is over"
    again = browser_view("", 25.0, None, port=urlsplit(view.url).port)
    try:
        again.show(moments()[0])
        eventually(lambda: text("phase") == "live")  # by itself
        again._server.close()
        eventually(lambda: text("phase") == "connection lost; trying again")
    finally:
        again.close()
