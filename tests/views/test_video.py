"""The video: whole up to the last second however a run ends, and played by a browser."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.tracking import ROOT
from helpers.videos import video_frames

from toftrack.errors import ToftrackError
from toftrack.views.video import VideoFile, cut_to_whole

KILLED = """
import os, signal, sys
from pathlib import Path
import numpy as np
from toftrack.views.video import VideoFile
video = VideoFile(Path(sys.argv[1]), 10.0, (160, 96))
for i in range(35):
    video.add(np.full((96, 160, 3), 7 * i, np.uint8))
os.kill(os.getpid(), signal.SIGKILL)
"""
PLAY = """
const done = arguments[1], video = document.createElement('video');
const tell = what => done([what, video.getVideoPlaybackQuality().totalVideoFrames]);
video.onended = () => tell('ended');
video.onerror = () => tell(video.error.message);
video.muted = true;
video.src = arguments[0];
video.play().catch(error => tell(String(error)));
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of ten frames a second, killed after 35 frames."""
    # In a folder whose name the locale cannot say, besides.
    path = tmp_path_factory.mktemp("vidéo") / "overlay.mp4"
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    environment = os.environ | ascii_only | {"PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)], env=environment)
    assert done.returncode == -signal.SIGKILL
    return path


def greys(path: Path) -> list[float]:
    return [float(frame.mean()) for frame in video_frames(path)]


def test_a_killed_run_leaves_every_second_that_was_whole(killed: Path, tmp_path: Path) -> None:
    whole = killed.read_bytes()
    assert greys(killed) == pytest.approx([7 * i for i in range(30)], abs=4)
    for size, frames in ((len(whole), 30), (len(whole) - 9, 20)):
        cut = tmp_path / "cut.mp4"
        cut.write_bytes(whole[:size])
        cut_to_whole(cut)
        assert len(greys(cut)) == frames
        once = cut.read_bytes()
        cut_to_whole(cut)
        assert cut.read_bytes() == once


def test_a_browser_plays_what_is_finished_and_what_was_killed(
    chromium, killed: Path, tmp_path: Path
) -> None:
    finished = tmp_path / "finished.mp4"
    video = VideoFile(finished, 10.0, (160, 96))
    for i in range(12):
        video.add(np.full((96, 160, 3), 20 * i, np.uint8))
    video.close()
    page = tmp_path / "page.html"
    page.write_text("<title>video</title>")
    chromium.get(page.as_uri())
    for path, frames in ((finished, 12), (killed, 30)):
        assert chromium.execute_async_script(PLAY, path.as_uri()) == ["ended", frames]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_is_reported() -> None:
    with pytest.raises(ToftrackError, match="/dev/full.*free space.*view=none"):
        video = VideoFile(Path("/dev/full"), 10.0, (160, 96))
        for _ in range(12):
            video.add(np.zeros((96, 160, 3), np.uint8))
        video.close()
