"""`toftrack label`: what its page is told and may change, and a real browser with real clicks."""

import io
import json
import re
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.browsing import PATIENCE_S, eventually, ours
from helpers.programs import interrupted_when
from websockets.sync.client import connect

from toftrack.devices.replay import Sample
from toftrack.errors import ToftrackError
from toftrack.evaluation.image_labels import read_labels
from toftrack.evaluation.labelling import LABELLED, LabelFile, LabelFrame
from toftrack.evaluation.trust import tips_inset
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.programs import label
from toftrack.programs.main import main
from toftrack.views.labelling.page import LabelPage

DEPTH_MM = np.arange(12, dtype="<u2").reshape(3, 4)


def made(folder: Path, side: str | None = "left") -> LabelPage:
    labels = LabelFile(folder / "labels.json", "a.npz", (4, 3), 9, side)
    labels.begin([2, 5])
    frames = [LabelFrame(number, DEPTH_MM, (1.5, 1.0), 2.0, 300.0, 500.0) for number in (2, 5)]
    return LabelPage(labels, frames, ("palm", "fist"), 0)


@pytest.fixture
def page(tmp_path) -> Iterator[LabelPage]:
    with closing(made(tmp_path)) as page:
        yield page
    assert ours() == []


@pytest.fixture
def visitor(page) -> Iterator[SimpleNamespace]:
    """The page, without a browser."""
    address = page.address.removeprefix("http").partition("#")[0]
    with connect(f"ws{address}labels") as socket:

        def ask(**content: Any) -> Any:
            socket.send(json.dumps({"token": page.token} | content))
            return json.loads(socket.recv(PATIENCE_S))

        yield SimpleNamespace(socket=socket, ask=ask)


def test_the_page_is_told_what_there_is_and_shown_frames(page, visitor) -> None:
    about = visitor.ask(about=True)["about"]
    assert about["joints"] == list(LABELLED) and about["side"] == "left"
    assert [frame["number"] for frame in about["frames"]] == [2, 5]
    facts = visitor.ask(frame=5)
    assert (facts["size"], facts["centre"], facts["near"]) == ([4, 3], [1.5, 1.0], 300)
    assert visitor.socket.recv(PATIENCE_S) == DEPTH_MM.tobytes()


def test_every_click_is_saved_before_it_is_answered(page, visitor) -> None:
    assert visitor.ask(point=[5, "index_tip", [1, 2, "visible"]]) == {"saved": 1}
    assert read_labels(page.labels.path).frames == {2: {}, 5: {8: (1.0, 2.0)}}
    visitor.ask(side="right")
    visitor.ask(gesture=[5, "fist"])
    assert read_labels(page.labels.path).side == "right"
    assert visitor.ask(about=True)["about"]["frames"][1]["gesture"] == "fist"
    assert visitor.ask(point=[5, "index_tip", None]) == {"saved": 0}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"token": "guessed", "about": True}, "the whole address"),
        ({"token": "\ud800", "side": "right"}, "the whole address"),
        ({"side": "both"}, "right or left"),
        ({"frame": [5]}, "no such frame"),
        ({"point": [5, "wrist", [9, 9, "visible"]]}, "within the image"),
        ({"point": [5, "wrist"]}, "none that this server knows"),
        ({"gesture": [5, 7]}, "a short name"),
    ],
)
def test_what_cannot_be_meant_is_refused_and_changes_nothing(page, visitor, content, words) -> None:
    before = page.labels.path.read_bytes()
    assert words in visitor.ask(**content)["failed"]
    assert page.labels.path.read_bytes() == before


def without_truth(folder: Path, count: int) -> tuple[Path, np.ndarray]:
    """The sample's first frames as a recording of one's own, and the true joints in pixels, with
    tips 5 mm inside: (T, 21, 2).
    """
    device = Sample(stop=count)
    depth = np.stack([frame.depth for frame in device])
    np.savez(folder / "own.npz", depth_m=depth, K=device.camera.K)
    joints_m = tips_inset(device.truth.joints_m, 0.005) @ device.camera.K.T
    return folder / "own.npz", joints_m[..., :2] / joints_m[..., 2:]


def test_a_frame_is_labelled_by_clicks_and_measured(
    chromium, tmp_path, monkeypatch, capsys
) -> None:
    own, truth = without_truth(tmp_path, 12)
    said = io.StringIO()
    monkeypatch.setattr(sys, "stderr", said)
    from selenium.webdriver.common.action_chains import ActionChains

    ready = "Boolean(view && socket?.readyState === 1)"

    def eventual(script: str) -> None:
        eventually(lambda: chromium.execute_script(f"return {script}"))

    def press(words: str) -> None:
        chromium.find_element("xpath", f"//button[text()='{words}']").click()

    def click(u: float, v: float) -> ActionChains:
        box, at = "const box = canvas.getBoundingClientRect();", f"place({u}, {v})"
        x, y = chromium.execute_script(f"{box} return {at}.map((p, i) => p + [box.x, box.y][i])")
        chain = ActionChains(chromium, duration=0)
        chain.w3c_actions.pointer_action.move_to_location(round(x), round(y))
        return chain

    def clicked() -> bool:
        """All that somebody does with the first of two frames, and a little with the other."""
        if not (found := re.search(r"label at: (\S+) \(Ctrl-C ends\)", said.getvalue())):
            return False
        chromium.get(found[1])
        eventual(ready)
        click(*truth[3, 4]).click().perform()
        assert "right or a left" in chromium.find_element("id", "told").text
        press("right hand")
        for name in LABELLED[:-1]:
            assert chromium.execute_script("return joint") == name
            click(*truth[3, JOINT_NAMES.index(name)]).click().perform()
        click(20, 20).click_and_hold().perform()
        chromium.execute_script("canvas.oncontextmenu(new PointerEvent('contextmenu'))")  # by touch
        ActionChains(chromium).release().perform()
        eventual("about.frames[0].points.wrist?.[2] === 'visible'")
        ActionChains(chromium).key_down("\ue009").send_keys("z").key_up("\ue009").perform()
        click(80, 80).context_click().perform()  # the wrist, not visible
        press("palm")
        eventual("about.frames[0].gesture === 'palm'")
        assert not chromium.find_element("id", "overlay").is_displayed()
        ActionChains(chromium).send_keys("\ue014").perform()
        eventual(f"at === 1 && {ready}")
        press("Rest not visible")
        eventual("document.getElementById('told').textContent.startsWith('1 of 2 frames saved')")
        for width in (1400, 320):
            chromium.set_window_size(width, 900)
            wide = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
            assert chromium.execute_script(f"return {wide}") <= 0
        chromium.refresh()  # what was clicked is still there
        eventual(f"{ready} && about.frames[1].points.wrist[2] === 'absent'")
        assert chromium.get_log("browser") == []
        return True

    target = tmp_path / "labels.json"
    given = ("label", str(own), "--frames", "2", "--output", str(target), "--no-browser")
    with interrupted_when(clicked):
        assert main(given) == 0
    command = f"toftrack benchmark accuracy {own} --labels {target}"
    assert capsys.readouterr().out == (
        f"{target}: 1 of 2 frames are labelled\nmeasure the tracker: {command}\n"
    )
    content = json.loads(target.read_text())
    assert content["side"] == "right" and content["frames"]["3"]["gesture"] == "palm"
    assert content["frames"]["3"]["points"]["wrist"] == [None, None, "absent"]
    points = content["frames"]["3"]["points"]
    for name in LABELLED[:-1]:
        off = np.subtract(points[name][:2], truth[3, JOINT_NAMES.index(name)])
        assert np.abs(off).max() < 0.4 and points[name][2] == "visible"  # pixels
    assert {flag for *_, flag in content["frames"]["9"]["points"].values()} == {"absent"}
    found = tmp_path / "found.json"
    assert main([*command.split()[1:], "--json", str(found)]) == 0
    (row,) = json.loads(found.read_text())["rows"]
    assert row["recording"].endswith("#0003") and row["tips_20_pct"] == 100
    assert max(row["tips_mm"]) < 15


@pytest.mark.parametrize(
    ("words", "reported"),
    [
        (["device=sample"], "which recording is to be labelled?"),
        (["seed=1"], "which recording is to be labelled?"),
        (["gone.npz"], "no file 'gone.npz'"),
        (["OWN", "--frames", "0"], "--frames=0"),
        (["OWN", "--output", "link.json"], "it is a symbolic link"),
        (["OWN", "device.start=1"], "leave out device.start"),
    ],
)
def test_what_cannot_be_labelled_is_one_sentence(words, reported, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("link.json").symlink_to("elsewhere.json")
    own = str(without_truth(tmp_path, 3)[0])
    given = [own if word == "OWN" else word for word in words]
    with pytest.raises(ToftrackError, match=re.escape(reported)):
        label.main([*given, "--no-browser"])
