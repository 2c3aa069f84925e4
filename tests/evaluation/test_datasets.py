"""Public data sets: written in their formats, read back, and broken."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers.data_sets import PARTS, scene, write, write_icvl, write_msra
from scipy.io import savemat

from toftrack.errors import ToftrackError
from toftrack.evaluation import datasets
from toftrack.evaluation.datasets import DATA_SETS, INTEL_CREATIVE, open_data_set

FRAMES = 3


def refusal(name: str, folder: Path) -> str:
    """The one sentence that opening the data set or reading its first image fails with."""
    with pytest.raises(ToftrackError) as caught:
        _, sequences = open_data_set(name, folder)
        sequences[0].frame(0)
    text = str(caught.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize("name", list(DATA_SETS))
def test_what_was_written_is_read(name: str, tmp_path: Path) -> None:
    seen = write(name, tmp_path, FRAMES)
    data_set, (read,) = open_data_set(name, tmp_path)
    assert read.name == ("test_seq_1" if name == "ICVL" else PARTS[name])
    assert read.side == ("left" if name == "ICVL" else "right")
    assert (len(read.images), read.left_out) == (FRAMES, 0)
    np.testing.assert_array_equal(read.camera.K, seen.k)
    for index in range(FRAMES):
        depth = read.frame(index)
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, seen.depth_m[index], rtol=0, atol=0.00051)
    np.testing.assert_allclose(
        read.joints_m, seen.joints_m[:, list(data_set.joints)], rtol=0, atol=5e-6
    )


def test_the_folder_of_a_part_or_sequence_will_do(tmp_path: Path) -> None:
    for name, part in PARTS.items():
        write(name, tmp_path / name, FRAMES)
        assert len(open_data_set(name, tmp_path / name / part)[1]) == 1


def test_sequences_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    seen = scene(INTEL_CREATIVE, 1)
    for subject in (10, 2, 1):
        write_msra(tmp_path / f"Subject{subject}", seen, boxed=False)
    _, sequences = open_data_set("MSRA14", tmp_path)
    assert [s.name for s in sequences] == ["Subject1", "Subject2", "Subject10"]


def test_a_file_of_icvl_may_hold_several_sequences(tmp_path: Path) -> None:
    seen = scene(INTEL_CREATIVE, 2)
    write_icvl(tmp_path, seen, "a")
    write_icvl(tmp_path, seen, "b")
    joined = (tmp_path / "a.txt").read_text() + (tmp_path / "b.txt").read_text()
    (tmp_path / "b.txt").unlink()
    (tmp_path / "a.txt").write_text(joined)
    _, sequences = open_data_set("ICVL", tmp_path)
    assert [(s.name, len(s.images)) for s in sequences] == [("a", 2), ("b", 2)]


def test_the_two_persons_of_nyu_are_two_sequences(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(datasets, "_TEST_FRAMES", 3)
    monkeypatch.setattr(datasets, "_FIRST_PERSON", 1)
    seen = write("NYU", tmp_path, FRAMES)
    _, sequences = open_data_set("NYU", tmp_path)
    assert [(s.name, len(s.images)) for s in sequences] == [("test_1", 1), ("test_2", 2)]
    np.testing.assert_allclose(sequences[1].frame(0), seen.depth_m[1], atol=0.00051)


def test_msra14_may_come_without_the_number_of_frames(tmp_path: Path) -> None:
    write("MSRA14", tmp_path, FRAMES)
    labels = tmp_path / "Subject1" / "joint.txt"
    labels.write_text("\n".join(labels.read_text().splitlines()[1:]))
    _, (read,) = open_data_set("MSRA14", tmp_path)
    assert len(read.images) == FRAMES


@pytest.mark.parametrize("name", list(DATA_SETS))
def test_labels_without_an_image_are_left_out(name: str, tmp_path: Path) -> None:
    seen = write(name, tmp_path, FRAMES)
    sorted(path for path in tmp_path.rglob("*") if path.suffix in IMAGES)[1].unlink()
    data_set, (read,) = open_data_set(name, tmp_path)
    assert (len(read.images), read.left_out) == (FRAMES - 1, 1)
    kept = seen.joints_m[[0, 2]][:, list(data_set.joints)]
    np.testing.assert_allclose(read.joints_m, kept, atol=5e-6)
    np.testing.assert_allclose(read.frame(1), seen.depth_m[2], atol=0.00051)


def test_readings_beyond_reason_are_none(tmp_path: Path) -> None:
    seen = scene(INTEL_CREATIVE, 1)
    seen.depth_m[0, 0, :3] = (32.001, np.inf, np.nan)
    write_msra(tmp_path / "Subject1", seen, boxed=False)
    _, (read,) = open_data_set("MSRA14", tmp_path)
    np.testing.assert_array_equal(read.frame(0)[0, :3], 0)


def file_of(folder: Path, *suffixes: str) -> Path:
    return min(path for path in folder.rglob("*") if path.suffix in suffixes)


IMAGES, LABELS = (".bin", ".png"), (".txt", ".mat")


@pytest.mark.parametrize("content", [None, b"", np.random.default_rng(0).bytes(999)])
@pytest.mark.parametrize("kind", [IMAGES, LABELS])
@pytest.mark.parametrize("name", list(DATA_SETS))
def test_damaged_files_give_one_sentence(
    name: str, kind: tuple[str, ...], content: bytes | None, tmp_path: Path
) -> None:
    write(name, tmp_path, 1)
    path = file_of(tmp_path, *kind)
    if path.suffix == ".txt" and content is None:
        path.write_text(path.read_text().rstrip().rpartition(" ")[0])
    else:
        path.write_bytes(path.read_bytes()[:-5] if content is None else content)
    text = refusal(name, tmp_path)
    assert str(path) in text or (content == b"" and str(tmp_path) in text)


@pytest.mark.parametrize(
    "header", [(320, 240, 0, 0, 330, 1), (320, 240, 5, 0, 4, 1), (640, 480, 0, 0, 1, 1)]
)
def test_a_box_outside_of_the_image_is_refused(header: tuple[int, ...], tmp_path: Path) -> None:
    write("MSRA15", tmp_path, 1)
    file_of(tmp_path, ".bin").write_bytes(np.array(header, "<i4").tobytes() + bytes(4))
    assert "damaged" in refusal("MSRA15", tmp_path)


@pytest.mark.parametrize(
    ("name", "line", "end", "reason"),
    [
        ("MSRA15", 0, "7", "announces 7 frames, but has 3"),
        ("ICVL", 1, " x", "line 2"),
        ("ICVL", 1, " nan", "line 2"),
        ("ICVL", 1, " 1 2", "line 2"),
    ],
)
def test_wrong_numbers_of_labels_are_refused(
    name: str, line: int, end: str, reason: str, tmp_path: Path
) -> None:
    write(name, tmp_path, FRAMES)
    labels = file_of(tmp_path, ".txt")
    lines = labels.read_text().splitlines()
    lines[line] = lines[line].rstrip().rpartition(" ")[0] + end
    labels.write_text("\n".join(lines))
    assert reason in refusal(name, tmp_path)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ({"joint_uvd": np.zeros((3, 1, 36, 3))}, "no array named joint_xyz"),
        ({"joint_xyz": "text"}, "does not consist of real numbers"),
        ({"joint_xyz": np.zeros((3, 1, 35, 3))}, "shape (3, 1, 35, 3)"),
        ({"joint_xyz": np.full((3, 1, 36, 3), np.nan)}, "NaN"),
    ],
)
def test_other_contents_of_joint_data_are_refused(content: dict, reason: str, tmp_path) -> None:
    write("NYU", tmp_path, 1)
    savemat(file_of(tmp_path, ".mat"), content)
    assert reason in refusal("NYU", tmp_path)


def test_colour_images_in_place_of_depth_are_refused(tmp_path: Path) -> None:
    write("ICVL", tmp_path, 1)
    assert cv2.imwrite(str(file_of(tmp_path, ".png")), np.zeros((240, 320), np.uint8))
    assert "is 320x240 of uint8, but must be 320x240 of uint16" in refusal("ICVL", tmp_path)


@pytest.mark.parametrize("name", list(DATA_SETS))
def test_what_a_folder_lacks_is_reported(name: str, tmp_path: Path) -> None:
    assert "there is no folder" in refusal(name, tmp_path / "nowhere")
    assert "does not hold" in refusal(name, tmp_path)
    write(name, tmp_path, 1)
    file_of(tmp_path, *IMAGES).unlink()
    assert "there is no image" in refusal(name, tmp_path)
