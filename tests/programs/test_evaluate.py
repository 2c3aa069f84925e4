"""`toftrack evaluate` on a tiny data set."""

import json
from pathlib import Path

import pytest
from helpers.data_sets import scene, write_msra

from toftrack.evaluation.datasets import INTEL_CREATIVE
from toftrack.programs import command_line
from toftrack.programs.evaluate import main

FEW = "filter.particles=60"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two sequences of the same six frames."""
    seen = scene(INTEL_CREATIVE, 6)
    for gesture in ("1", "TIP"):
        write_msra(tmp_path / "P0" / gesture, seen, boxed=True)
    return tmp_path


def test_the_table_and_the_file_say_how_good_it_is(folder: Path, tmp_path, capsys) -> None:
    report = tmp_path / "report.json"
    main(["MSRA15", str(folder), FEW, "--json", str(report)])
    printed = capsys.readouterr()
    firsts = [line.split()[0] for line in printed.out.splitlines()]
    assert firsts == ["sequence", "P0/1", "P0/TIP", "mean", "compared:", "tips:"]
    assert not printed.err
    facts = json.loads(report.read_text())
    assert (facts["data_set"], facts["overrides"]) == ("MSRA15", [FEW])
    assert facts["tip_inset_mm"] == 7
    assert len(facts["joints"]) == 21
    assert facts["total"]["frames"] == 12
    # Two trackers that begin alike see the same; the palm at the start is easy.
    assert facts["sequences"]["P0/1"] == facts["sequences"]["P0/TIP"]
    assert facts["total"]["mean_mm"] < 15


def test_sequences_and_frames_can_be_chosen_and_labels_without_image_are_told(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "P0" / "TIP" / "000005_depth.bin").unlink()
    main(["MSRA15", str(folder), "--sequences", "P0/TIP", "--frames", "2", "--tip-inset", "0", FEW])
    printed = capsys.readouterr()
    assert "P0/1" not in printed.out
    assert "note: P0/TIP: 1 labels have no image" in printed.err
    assert "ours are moved 0 mm" in printed.out


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["MSRA", "."], "one of MSRA14, MSRA15, ICVL, NYU"),
        (["MSRA15", ".", "--sequences", "P9/1"], "--sequences=P9/1 is unknown; give one of P0/1"),
        (["MSRA15", ".", "nonsense=1"], "nonsense"),
        (["MSRA15", ".", "--frames", "1", "--json", "no/such/file"], "cannot be written"),
    ],
)
def test_errors_are_one_sentence(
    arguments: list[str],
    reason: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    assert command_line.run(lambda: main(arguments)) == 1
    last = capsys.readouterr().err.rstrip().splitlines()[-1]
    assert last.startswith("error: ") and reason in last
