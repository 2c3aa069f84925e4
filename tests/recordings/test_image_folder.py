"""A folder or `.zip` of images: its camera, what in it is depth, images of others, hostile ones."""

import contextlib
import io
import logging
import struct
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.damage import damaged
from helpers.programs import QUICK
from helpers.tracking import code_of

from toftrack.api import make_device
from toftrack.devices.replay import Replay
from toftrack.errors import ToftrackError
from toftrack.output.run_folder import read_run
from toftrack.programs import convert
from toftrack.programs.main import main
from toftrack.recordings import image_folder
from toftrack.recordings.bare import Given
from toftrack.recordings.image_folder import ImageFolder
from toftrack.recordings.images import decoded_png

LENS = "device.intrinsics=[201,202,87,71]"
K = [[201, 0, 87], [0, 202, 71], [0, 0, 1]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two frames of the sample, without a camera."""
    made = tmp_path / "images"
    made.mkdir()
    with make_device("device=sample", "device.stop=2") as sample:
        for frame in sample:
            cv2.imwrite(str(made / f"{frame.index}.png"), (1000 * frame.depth).astype(np.uint16))
    return made


def test_the_camera_file_that_the_page_shows_is_read(folder: Path) -> None:
    (folder / "camera.json").write_text(code_of("formats.md", "camera.json"))
    read = ImageFolder(folder)
    np.testing.assert_array_equal(read.camera.K, [[200, 0, 88], [0, 200, 72], [0, 0, 1]])
    assert (read.camera.width, read.camera.height) == (176, 144)
    assert (read.unit_m, read.fps, read.radial) == (0.001, 25, False)


def test_a_folder_is_tracked_with_the_lens_that_the_command_line_tells(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["view=none", "hand.side=right", f"hydra.run.dir='{tmp_path}/run'", *QUICK]
    assert main(["track", str(folder), *words]) == 1
    assert "device.intrinsics=[FX,FY,CX,CY]" in capsys.readouterr().err
    assert main(["track", str(folder), LENS, "device.fps=50", *words]) == 0
    run = read_run(tmp_path / "run")
    np.testing.assert_array_equal(run.results["metadata"]["camera"]["K"], K)
    np.testing.assert_allclose(run.results["timestamp_s"], [0, 0.02])
    footage = run.footage()
    assert footage is not None, "figures are drawn with the same lens"
    np.testing.assert_array_equal(footage.camera.K, K)
    assert len(repr(footage)) < 200


@pytest.mark.parametrize("given", ["[200,200,88]", "[-1,200,88,72]", "200", "[1,1,88,72]"])
def test_lenses_that_are_none_are_reported(given: str, folder: Path) -> None:
    with pytest.raises(ToftrackError, match="intrinsics|of 176x144 pixels"):
        make_device("device=folder", f"device.path='{folder}'", f"device.intrinsics={given}")


def test_a_lens_is_reported_once(folder: Path) -> None:
    ImageFolder(folder, Given([201, 202, 87, 71])).camera.save(folder / "mine.json")
    words = ["device=folder", f"device.path='{folder}'", f"camera.file='{folder}/mine.json'"]
    with make_device(*words) as device:
        np.testing.assert_array_equal(device.camera.K, K)
    with pytest.raises(ToftrackError, match="both give the lens; leave one out"):
        make_device(*words, LENS)


IMAGE = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
CONTENT = cv2.imencode(".png", IMAGE)[1].tobytes()


def test_an_image_that_was_cut_off_is_none() -> None:
    assert (decoded_png(CONTENT) == IMAGE).all()
    for length in (0, 8, 20, len(CONTENT) // 2, len(CONTENT) - 1):
        assert decoded_png(CONTENT[:length]) is None


def test_a_chunk_that_claims_gigabytes_is_not_handed_to_the_decoder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    at = CONTENT.index(b"IDAT") - 4
    assert decoded_png(CONTENT[:at] + struct.pack(">I", 2**31 - 1) + CONTENT[at + 4 :]) is None
    huge = CONTENT[:16] + struct.pack(">II", 50_000, 50_000) + CONTENT[24:]
    assert decoded_png(huge) is None


COLOUR = cv2.imencode(".png", np.zeros((24, 32, 3), np.uint8))[1].tobytes()
GIVEN = Given((40.0, 40.0, 15.5, 11.5))
DEPTH = np.random.default_rng(0).uniform(0.3, 2, (3, 24, 32)).astype(np.float32)


def png(number: int) -> bytes:
    return cv2.imencode(".png", np.rint(1000 * DEPTH[number]).astype(np.uint16))[1].tobytes()


def tiff(number: int) -> bytes:
    return cv2.imencode(".tif", DEPTH[number])[1].tobytes()


def exr(number: int, names: str = "Z", seen: Any = True) -> bytes:
    """As Blender has it, there is 1e10 where nothing is seen."""
    library = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
    target = io.BytesIO()
    depth = np.where(seen, DEPTH[number], np.float32(1e10))
    channels = {name: depth for name in names.split()}
    library.File({"compression": library.ZIP_COMPRESSION}, channels).write(target)
    return target.getvalue()


def laid_out(at: Path, files: dict[str, bytes], zipped: bool) -> Path:
    if zipped:
        with zipfile.ZipFile(at / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return at / "a.zip"
    for name, content in files.items():
        (at / "a" / name).parent.mkdir(parents=True, exist_ok=True)
        (at / "a" / name).write_bytes(content)
    return at / "a"


LAYOUTS: dict[str, dict[str, Any]] = {
    "plain": {"{}.png": png},
    "colour beside": {"color_{}.png": COLOUR, "depth_{}.png": png, "c{}.jpg": b"", "a.txt": b""},
    "infrared beside": {"{}_infrared.png": png(0), "{}_depth.png": png, "._{}_depth.png": b"junk"},
    "folders": {"rgb/{}.png": COLOUR, "depth/{}.png": png, "camera.txt": b""},
    "float TIFF": {"{}.tif": tiff, "{}.jpg": b""},
    "EXR": {"{}.exr": exr},
    "rendered EXR": {"{}.exr": lambda number: exr(number, "B G R View.Depth.Z View.Normal.Z")},
}


@pytest.mark.parametrize("zipped", [False, True], ids=["folder", "zip"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_depth_among_the_images_is_read_and_the_rest_told(
    tmp_path: Path, layout: str, zipped: bool, caplog: pytest.LogCaptureFixture
) -> None:
    files = {
        pattern.format(number): content(number) if callable(content) else content
        for number in range(3)
        for pattern, content in LAYOUTS[layout].items()
    }
    path = laid_out(tmp_path, files, zipped)
    store = ImageFolder(path, GIVEN)
    np.testing.assert_allclose([store.image(n)[0] for n in (0, 1, 2)], DEPTH, atol=0.00051)
    store.close()
    assert (store.left_out is not None) == any(
        word in pattern for pattern in LAYOUTS[layout] for word in ("rgb", "color", "infra", "jpg")
    )
    with caplog.at_level(logging.WARNING), Replay(path, intrinsics=GIVEN.intrinsics) as device:
        assert len(list(device)) == 3
    assert ("are left out" in caplog.text) == (store.left_out is not None)


def test_where_a_rendered_image_shows_nothing_there_is_no_reading(tmp_path: Path) -> None:
    seen = DEPTH[0] < 0.8  # less than half of it
    store = ImageFolder(laid_out(tmp_path, {"1.exr": exr(0, "Depth.V", seen)}, False), GIVEN)
    np.testing.assert_array_equal(store.image(0)[0], np.where(seen, DEPTH[0], 0))


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"1.png": COLOUR, "2.jpg": b""}, "no depth image.*'1.png' is a picture of colours"),
        ({"a/1.png": png(0), "b/1.png": png(0)}, "in 2 folders, a, b; give one"),
        ({"1.exr": b"\x76\x2f\x31\x01junk"}, "1.exr.*damaged"),
        ({"1.tif": tiff(0)[:90]}, "1.tif.*damaged"),
        ({"1.tif": b"nonsense"}, "1.tif.*another kind"),
        ({"1.tif": cv2.imencode(".tif", 1000 * DEPTH[0])[1].tobytes()}, "plainly in another unit"),
    ],
)
def test_images_that_are_no_depth_are_reported(
    tmp_path: Path, files: dict[str, bytes], words: str
) -> None:
    if "1.exr" in files:
        exr(0)
    for zipped in (False, True):
        with pytest.raises(ToftrackError, match=words):
            ImageFolder(laid_out(tmp_path, files, zipped), GIVEN)


@pytest.mark.parametrize(
    ("name", "mode", "method", "words"),
    [
        *(
            (name, 0, zipfile.ZIP_DEFLATED, "leads out of it")
            for name in ("../1.png", "/1.png", "a\\..\\1.png", "C:/1.png", "\0")
        ),
        ("1.png", 0o120777, zipfile.ZIP_DEFLATED, "is a link"),
        ("1.png", 0, zipfile.ZIP_LZMA, "compression is unknown"),
    ],
)
def test_archives_that_lead_elsewhere_are_refused(
    tmp_path: Path, name: str, mode: int, method: int, words: str
) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        entry = zipfile.ZipInfo(name)
        entry.filename, entry.external_attr, entry.compress_type = name, mode << 16, method
        archive.writestr(entry, png(0))
    with pytest.raises(ToftrackError, match=words):
        ImageFolder(tmp_path / "a.zip", GIVEN)


def test_archives_that_lie_or_would_fill_the_memory_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(image_folder, "_MOST_BYTES", 2**20)
    path = laid_out(tmp_path, {"1.png": png(0) + bytes(2**22)}, True)
    with pytest.raises(ToftrackError, match="larger than 1 MB"):
        ImageFolder(path, GIVEN)
    content = laid_out(tmp_path, {"1.png": png(0)}, True).read_bytes()
    for size in (20, 2**31):  # in both places that tell it
        forged = content.replace(struct.pack("<I", len(png(0))), struct.pack("<I", size))
        path.write_bytes(forged)
        with pytest.raises(ToftrackError, match="1.png.*cannot be (read|used)"):
            ImageFolder(path, GIVEN)
    for seed in range(60):
        path.write_bytes(damaged(content, seed))
        with contextlib.suppress(ToftrackError):
            ImageFolder(path, GIVEN).image(0)


@pytest.mark.parametrize("text", ["1 " * 2**20, "x" * 2**22, "nan"])
def test_times_that_cannot_be_meant_take_no_time_and_no_page(tmp_path: Path, text: str) -> None:
    path = laid_out(tmp_path, {"1.png": png(0), "timestamps.txt": text.encode()}, True)
    with pytest.raises(ToftrackError, match="timestamps.txt") as caught:
        ImageFolder(path, GIVEN)
    assert len(str(caught.value)) < 999


def test_names_of_others_do_not_command_the_terminal(tmp_path: Path) -> None:
    path = laid_out(tmp_path, {"a\x1b[2J\n.png": b"nonsense"}, True)
    with pytest.raises(ToftrackError) as caught:
        ImageFolder(path, GIVEN)
    assert str(caught.value).isprintable()


def test_an_exr_that_is_damaged_is_read_or_told(tmp_path: Path) -> None:
    content = exr(0)
    for seed in range(100):  # OpenEXR's older interface ended the process at one of twenty
        path = laid_out(tmp_path, {"1.exr": damaged(content, seed)}, False)
        with contextlib.suppress(ToftrackError):
            ImageFolder(path, GIVEN)


def test_an_archive_is_converted_with_its_camera_and_times(tmp_path: Path) -> None:
    files = {f"take/depth/{n}.png": png(n) for n in range(3)} | {"take/rgb/1.png": COLOUR}
    ImageFolder(laid_out(tmp_path, files, True), GIVEN).camera.save(tmp_path / "c.json")
    mark = b"\xef\xbb\xbf"  # as editors of Windows write it
    files |= {"take/camera.json": mark + (tmp_path / "c.json").read_bytes()}
    files |= {"take/depth/timestamps.txt": mark + b"1 1.5 2"}
    convert.main([str(laid_out(tmp_path, files, True)), str(tmp_path / "out.npz")])
    with make_device("device=replay", f"device.path='{tmp_path}/out.npz'") as device:
        assert [frame.timestamp_s for frame in device] == [1, 1.5, 2]
        assert device.camera.K[0, 0] == 40
