"""Totals and groups over recordings and seeds, and differences of two measurements."""

import json

import numpy as np
import pytest

from toftrack.errors import ToftrackError
from toftrack.evaluation.measures import FLAG_COUNTS, Estimates, measured
from toftrack.evaluation.results import accuracy_tables, compared, markdown, plain, read_rows
from toftrack.evaluation.rows import (
    by_recording,
    group_counts,
    groups,
    image_totals,
    row_figures,
    totals,
)
from toftrack.frames.frame import Truth


def tracked(seed: int, name: str = "set/a", frames: int = 60) -> dict:
    """A row of a track that is off at random."""
    rng = np.random.default_rng(seed)
    true = 0.1 * rng.standard_normal((frames, 21, 3)) + [0, 0, 0.45]
    off = rng.choice([0.005, 0.02, 0.06], (frames, 1, 1)) * np.array([1.0, 0, 0])
    joints = true + off
    joints[rng.random(frames) < 0.1, 8] += 0.08
    joints[rng.random(frames) < 0.05] = np.nan
    lost, visible = rng.random(frames) < 0.2, rng.random(frames) < 0.8
    truth = Truth(true, visible, np.ones(frames, bool), pose_name=np.array(["palm"] * frames))
    found = measured(Estimates(joints, lost), truth)
    row = {"recording": name, "seed": seed, **row_figures(found, np.full(frames, 0.01))}
    row["groups"] = group_counts(found.first, truth, "tof", 170.0)
    return row


def test_a_recording_is_the_mean_of_its_seeds_and_the_total_that_of_recordings() -> None:
    base = {"frames": 10, "visible": 10, "longest_silent": 0, "first_right": 4, "never_right": 0.0}
    rows = [
        base | {"recording": "s/a", "seed": 0, "usable_pct": 80.0, "longest_silent": 3},
        base | {"recording": "s/a", "seed": 1, "usable_pct": 100.0},
        base | {"recording": "s/b", "seed": 0, "usable_pct": 50.0, "never_right": 1.0},
    ]
    rows[2]["first_right"] = None
    total = totals(rows)
    assert total["usable_pct"] == 70 and total["usable_90"] == [50, 90]
    assert (total["recordings"], total["frames"], total["longest_silent"]) == (2, 20, 3)
    assert (total["never_right"], total["median_first_right"]) == (1, 4)


def test_what_is_flagged_is_pooled_over_recordings_and_seeds() -> None:
    counts = {"s/a": (1, 1, 10, 0), "s/b": (9, 3, 30, 4)}
    rows = [
        {"recording": name, "seed": seed, "usable_pct": 80.0, "silent_pct": 0.0}
        | dict(zip(FLAG_COUNTS, numbers, strict=True))
        for name, numbers in counts.items()
        for seed in (0, 1)
    ]
    total = totals(rows)
    assert (total["tips_wrong"], total["tips_right"]) == (10, 40)
    assert (total["wrong_flagged_pct"], total["right_flagged_pct"]) == (40, 10)
    of_one = by_recording(rows)["s/b"]
    assert (of_one["tips_wrong"], of_one["wrong_flagged_pct"]) == (9, pytest.approx(33.333))


def test_a_recording_without_a_visible_hand_has_no_share_of_usable_frames() -> None:
    none = np.zeros(8, bool)
    truth = Truth(np.zeros((8, 21, 3)), none, none)
    row = row_figures(measured(Estimates(np.ones((8, 21, 3)), none), truth), np.ones(8))
    assert row["usable_pct"] is None and row["silent_pct"] == 100 and row["never_right"] is None


def test_groups_pool_frames() -> None:
    rows = [tracked(0), tracked(1)]
    found = groups(rows)
    assert set(found) == {"sensor", "pose", "distance", "hand length"}
    assert set(found["hand length"]) == {"165 to 180 mm"} and set(found["pose"]) == {"palm"}
    both = found["sensor"]["tof"]
    assert both["frames"] == round(sum(row["visible"] for row in rows) / 2)
    counts = [row["usable_pct"] * row["visible"] for row in rows]
    expected = sum(counts) / sum(row["visible"] for row in rows)
    assert both["usable_pct"] == pytest.approx(expected, abs=0.01)
    bands = found["distance"].values()
    assert sum(band["frames"] for band in bands) == pytest.approx(both["frames"], abs=2)


def test_differences_are_of_pairs_and_what_is_alone_is_named() -> None:
    here = [tracked(seed, name) for name in ("s/a", "s/b", "s/c") for seed in (0, 1)]
    there = [row | {"usable_pct": row["usable_pct"] - 2} for row in here[:-1]]
    there.append(there[0] | {"recording": "s/z", "seed": 5})
    found = compared(here, there)
    change = found["differences"]["usable_pct"]
    assert [change[name] for name in ("mean", "low", "high")] == pytest.approx([2, 2, 2])
    assert (found["pairs"], change["recordings"]) == (5, 3)
    assert found["only_here"] == ["s/c, seed 1"] and found["only_there"] == ["s/z, seed 5"]
    assert found["differences"]["mean_mm"]["mean"] == 0


@pytest.mark.parametrize(
    "content",
    [
        [],
        {},
        {"rows": []},
        {"rows": [1]},
        {"rows": [{"recording": "a"}]},
        {"rows": [{"recording": "a", "seed": 0, "usable_pct": "x"}]},
        {"rows": [{"recording": "a", "seed": 0, "usable_pct": float("nan")}]},
    ],
)
def test_what_is_no_measurement_is_not_compared_with(content, tmp_path) -> None:
    file = tmp_path / "a.json"
    file.write_text(json.dumps(content))
    with pytest.raises(ToftrackError, match="give such a file"):
        read_rows(file)


def test_tables_show_what_there_is_and_leave_out_what_there_is_not() -> None:
    rows = [tracked(0), tracked(1)]
    each = {"set/a": {key: rows[0][key] for key in ("usable_pct", "mean_all_mm")}}
    tables = accuracy_tables({"total": totals(rows), "each": each, "groups": groups(rows)})
    text = plain(tables["recordings"])
    assert "usable %" in text and "ghosts" not in text and "90 % interval" in text
    assert len({len(row) for row in tables["recordings"]}) == 1
    assert markdown(tables["pose"]).splitlines()[1].startswith("| --- | ---: |")


def test_labelled_images_count_one_by_one() -> None:
    rows = [
        {"recording": f"k#{n}", "seed": seed, "tips_40_pct": 100.0 * (n != 1), "tips_mm": [n, 9.0]}
        for n in range(4)
        for seed in (0, 1)
    ]
    total = image_totals(rows)
    assert (total["images"], total["tips_40_pct"]) == (4, 75)
    assert total["tips_median_mm"] == 6 and total["tips_mean_mm"] == pytest.approx(5.25)
