"""`view=browser` as a user meets it: recordings that end or repeat, Ctrl-C, and a real browser."""

import io
import re
import sys
import threading
import time
from contextlib import closing
from dataclasses import replace
from itertools import islice
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from helpers import programs
from helpers.browsing import (
    PATIENCE_S,
    Visitor,
    eventually,
    made,
    moments,
    ours,
    shown_again_and_again,
)
from helpers.moments import two_hands, with_hand
from helpers.programs import QUICK, interrupted_when
from helpers.settings import browser_view
from helpers.tracking import configuration

from toftrack.devices.replay import Sample
from toftrack.frames.estimate import no_estimate
from toftrack.output.results import read_results
from toftrack.views.browser import view as browser
from toftrack.views.browser.view import BrowserView


def test_frames_with_an_end_wait_for_a_visitor_but_not_for_ever(capsys, monkeypatch) -> None:
    found = re.compile(r"live view: (http://127\.0\.0\.1:\d+/)#")
    # Reading captured output empties it, and would lose what is written at that moment.
    reported = io.StringIO()
    monkeypatch.setattr(sys, "stderr", reported)
    views: list[BrowserView] = []
    thread = threading.Thread(
        target=lambda: views.append(browser_view("", 25.0, 100, port=0, wait_s=PATIENCE_S))
    )
    thread.start()
    eventually(lambda: found.search(reported.getvalue()))
    with Visitor(found.search(reported.getvalue())[1]) as visitor:
        visitor.say(command="picture")
        thread.join(PATIENCE_S)
    views[0].close()
    browser_view("", 25.0, 100, port=0, wait_s=0.01).close()
    assert capsys.readouterr().out == ""


def test_with_the_page_recordings_keep_their_pace_and_only_the_sample_repeats() -> None:
    recording = ("device=replay", "device.path=x.npz")
    for given, realtime, repeat in (((), True, True), (recording, True, False)):
        device = configuration("view=browser", *given).device
        assert (device.realtime, device.repeat) == (realtime, repeat)
    device = configuration("view=browser", "view.live=false").device
    assert not device.realtime and not device.repeat


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(time, "sleep", lambda s: now.__setitem__(0, now[0] + s))
    return now


@pytest.mark.parametrize("realtime", [False, True])
def test_a_repeated_recording_counts_on(realtime: bool, clock) -> None:
    device = Sample(start=10, stop=13, realtime=realtime, repeat=True)
    assert device.frames is None and device.truth is None and device.description["repeat"]
    frames = list(islice(device, 8))
    assert [frame.index for frame in frames] == list(range(10, 18))
    assert np.allclose([f.timestamp_s for f in frames], np.arange(10, 18) / 25)
    for frame, later in zip(frames, frames[3:], strict=False):
        assert np.array_equal(frame.depth, later.depth)
    assert not np.array_equal(frames[0].depth, frames[1].depth)
    assert device.dropped == 0 and clock[0] == pytest.approx(7 / 25 if realtime else 0, abs=1e-3)


def test_ctrl_c_while_watched_keeps_the_results(tmp_path: Path, monkeypatch) -> None:
    views: list[BrowserView] = []
    made_as_ever = BrowserView.__init__

    def noted(view: BrowserView, *given: object, **settings: object) -> None:
        made_as_ever(view, *given, **settings)
        views.append(view)

    monkeypatch.setattr(BrowserView, "__init__", noted)
    bodies: list[bytes] = []

    def watched() -> bool:
        """Two different pictures were seen."""
        if views and len(bodies) < 2:
            with Visitor(views[0].url) as visitor:
                bodies.extend(visitor.picture()[1] for _ in range(2))
        return len(bodies) == 2

    given = ("view=browser", "view.port=0", "hydra.run.dir=out", *QUICK)
    with interrupted_when(watched):
        status, out, err = programs.call(*given, folder=tmp_path)
    assert status == 130 and "time a frame" in out, err
    assert re.search(r"live view: http://\S+ \(Ctrl-C ends\)\n", err)
    assert "interrupted" in err and "Traceback" not in err
    assert bodies[0] != bodies[1] and ours() == []
    assert len(read_results(tmp_path / "out" / "track.npz")["joints_m"]) >= 2


def test_the_page_stays_after_the_last_frame_until_ctrl_c(monkeypatch, capsys) -> None:
    stayed: list[float] = []

    def interrupted(event: threading.Event, seconds: float) -> None:
        stayed.append(seconds)
        raise KeyboardInterrupt

    monkeypatch.setattr(browser, "wait", interrupted)
    for linger_s, words in ((5.0, "for 5 s (Ctrl-C ends it)"), (float("inf"), "until Ctrl-C")):
        with made(linger_s=linger_s):
            pass  # ends without an error: everything was done
        assert words in capsys.readouterr().err
    assert stayed == [5.0, float("inf")]
    with pytest.raises(ZeroDivisionError), made():
        1 / 0  # noqa: B018
    assert len(stayed) == 2 and ours() == []


def test_ctrl_c_ends_a_wait_also_where_the_system_s_own_go_on(monkeypatch) -> None:
    waits: list[float | None] = []

    def deaf(event: threading.Event, timeout: float | None = None) -> None:
        waits.append(timeout)
        if len(waits) == 3:  # as on Windows, between two waits
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(threading.Event, "wait", deaf)
        with pytest.raises(KeyboardInterrupt):
            browser.wait(threading.Event())
    assert all(seconds is not None and seconds < 1 for seconds in waits)


def test_the_page_works_in_a_browser(chromium, view) -> None:
    def text(name: str) -> str:
        found = f"document.querySelector('#{name}, #newest .{name}')"
        return chromium.execute_script(f"return {found}.textContent")

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
        assert "whole address" in text("told")
        restart = chromium.find_element("xpath", "//button[text()='Start again']")
        assert restart.get_property("disabled")
        chromium.get(view.address)
        eventually(lambda: text("phase") == "live")
        eventually(lambda: text("fps") != "–")
        before = {name: picture(name) for name in ("image", "model")}
        number = int(text("index"))
        eventually(lambda: all(picture(name) != old for name, old in before.items()))
        eventually(lambda: int(text("index")) > number)
        eventually(lambda: pressed() == ["Right hand"])
        press("Start again")
        eventually(lambda: taken == ["restart"])
        eventually(lambda: "anew" in text("told"))
        press("Left hand")
        eventually(lambda: taken == ["restart", "left"])
        eventually(lambda: pressed() == ["Left hand"])
        press("Either hand")
        eventually(lambda: taken[2:] == ["auto"] and pressed() == ["Either hand"])

        for width in (1400, 400):  # the last one is a phone's
            size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width == 400}
            chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            wide = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
            assert chromium.execute_script(f"return {wide}") <= 0
            clipped = "return [...document.querySelectorAll('dd, #phase')].filter(shown => shown"
            clipped += ".scrollWidth > shown.clientWidth + 1).map(shown => shown.textContent)"
            assert chromium.execute_script(clipped) == []
        left, right = (chromium.find_element("id", name).rect for name in ("image", "model"))
        assert right["y"] > left["y"] + left["height"] and left["width"] > 350
    lost = no_estimate(9, 0.36, "lost", 4, 0.01)
    hint = ("Nothing was within reach: hold the hand nearer.",)
    view.show(replace(with_hand(moments()[0], estimate=lost, insight=None), advice=hint))
    eventually(lambda: text("state") == "LOST" and text("phase") == "lost: no hand found")
    assert "LOST" in text("legend") and text("doubted") == "all doubtful"
    assert text("advice") == hint[0]

    def of_slots(name: str) -> list[str]:
        script = f"return [...document.querySelectorAll('.hand .{name}')].map(e => e.textContent)"
        return chromium.execute_script(script)

    view.show(two_hands(moments()[1], side_probability=0.83, gesture="ok", pinching=True))
    eventually(lambda: of_slots("side") == ["right", "left 83 %"])
    assert of_slots("state") == ["tracking", "tracking"] and of_slots("gesture")[1] == "ok"
    view.show(two_hands(moments()[1], lost=True))
    eventually(lambda: of_slots("state") == ["tracking", "LOST"])
    doubted = replace(moments()[1].estimates[0], joint_ok=np.arange(21) > 3)
    view.show(replace(with_hand(moments()[1], estimate=doubted), dropped=7))
    eventually(lambda: of_slots("state") == [] and text("state") == "tracking")
    assert (text("doubted"), text("fingers")) == ("4 doubtful", "wrist, thumb")
    assert "dashed" in text("legend") and text("dropped") == "7"
    assert chromium.get_log("browser") == []

    view._end("over")
    eventually(lambda: text("phase") == "the recording is over")
    assert chromium.find_element("xpath", "//button[text()='Start again']").get_property("disabled")
    view.close()
    with closing(browser_view("", 25.0, None, port=urlsplit(view.url).port)) as again:
        again.show(moments()[0])
        eventually(lambda: text("phase") == "live")  # by itself
        again._server.close()
        eventually(lambda: text("phase") == "connection lost; trying again")
