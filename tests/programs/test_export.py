"""`toftrack export RUN --to ...`: the file goes into the run's folder."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.hands import hand_estimate, lost_hand

from toftrack.errors import ToftrackError
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import JOINT_NAMES
from toftrack.output.results import ResultWriter
from toftrack.programs import export


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    with ResultWriter(folder, {"config": {}}, JOINT_NAMES) as results:
        default_hand_shape().save(folder / "hand_shape.json")
        for index in range(5):
            results.append(hand_estimate(index))
    return folder


@pytest.mark.parametrize(("kind", "begin"), [("bvh", b"HIERARCHY"), ("csv", b"index,timestamp_s,")])
def test_the_file_is_in_the_folder_and_told(run: Path, kind: str, begin: bytes, capsys) -> None:
    export.main([str(run), "--to", kind])
    made = run / f"hand.{kind}"
    assert made.read_bytes().startswith(begin)
    assert capsys.readouterr().out.split() == [str(made)]


def test_a_glb_is_one_whole_file(run: Path) -> None:
    pytest.importorskip("pygltflib", reason="pip install '.[export]'")
    (made,) = export.export(run, "glb")
    data = made.read_bytes()
    assert data[:4] == b"glTF" and int.from_bytes(data[8:12], "little") == len(data)


def test_what_is_no_run_or_has_no_hand_is_told(run: Path, tmp_path: Path) -> None:
    with pytest.raises(ToftrackError, match="is not the output folder of a run"):
        export.main([str(tmp_path), "--to", "csv"])
    with ResultWriter(run, {}, JOINT_NAMES) as results:
        results.append(lost_hand(0))
    with pytest.raises(ToftrackError, match="nothing to export"):
        export.main([str(run), "--to", "bvh"])


def test_an_unknown_format_is_refused(run: Path, capsys) -> None:
    with pytest.raises(SystemExit):
        export.main([str(run), "--to", "fbx"])
    assert "glb" in capsys.readouterr().err
