"""`toftrack benchmark accuracy` and `ablation`: what they measure, write and refuse."""

import gc
import json

import cv2
import numpy as np
import pytest
from helpers.tracking import ROOT
from omegaconf import OmegaConf

from toftrack.configuration.compose import configuration
from toftrack.devices.replay import Sample
from toftrack.errors import ToftrackError
from toftrack.evaluation import accuracy, results, runs
from toftrack.frames.estimate import Estimate
from toftrack.programs import benchmark

QUICK = ("experiment=paper", "filter.particles=30")
"""Overrides with which a start takes no time; how good the track is does not matter."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two short recordings with truth, and one file without."""
    where = tmp_path_factory.mktemp("sets") / "short"
    where.mkdir()
    with np.load(ROOT / "toftrack" / "data" / "sample.npz") as sample:
        for name, begin in (("a", 0), ("b", 30)):
            rows = slice(begin, begin + 4)
            arrays = {k: v[rows] if v.shape[:1] == (100,) else v for k, v in sample.items()}
            np.savez(where / f"{name}.npz", **arrays)
        np.savez(where.parent / "bare.npz", depth_m=sample["depth_m"][:2], K=sample["K"])
    return where


@pytest.fixture(scope="module")
def measurement(folder):
    """The command, once, with two seeds: its result, and the folder that it wrote into."""
    out = folder.parent / "out"
    out.mkdir()
    files = ["--json", out / "a.json", "--markdown", out / "a.md", "--picture", out / "a.png"]
    benchmark.main(["accuracy", str(folder), "--seeds", "0,1", *map(str, files), *QUICK])
    return json.loads((out / "a.json").read_text()), out


def test_every_recording_is_measured_with_every_seed(measurement) -> None:
    result, out = measurement
    pairs = [(row["recording"], row["seed"]) for row in result["rows"]]
    assert pairs == [("short/a", 0), ("short/a", 1), ("short/b", 0), ("short/b", 1)]
    assert set(result["each"]) == {"short/a", "short/b"}
    total = result["total"]
    promised = (
        "usable_pct usable_90 partly_pct silent_pct longest_silent false_alarm_pct never_right "
        "median_first_right mean_all_mm"
    )
    assert set(promised.split()) <= set(total) and total["frames"] == 8
    assert set(result["groups"]) >= {"sensor", "distance", "hand length"}
    assert result["overrides"] == list(QUICK) and result["command"].startswith("toftrack bench")
    text = (out / "a.md").read_text()
    assert text.startswith("`toftrack benchmark accuracy") and "| short/b |" in text
    picture = cv2.imread(str(out / "a.png"))
    assert picture is not None and picture.shape[1] > 900


def test_differences_to_an_earlier_measurement_are_reported(measurement, folder, capsys) -> None:
    _, out = measurement
    arguments = [str(folder), "--seeds", "1,2", "--compare", str(out / "a.json"), *QUICK]
    benchmark.main(["accuracy", *arguments, "--json", str(out / "b.json")])
    said = capsys.readouterr().out
    found = json.loads((out / "b.json").read_text())["comparison"]
    assert found["pairs"] == 2 and found["differences"]["silent_pct"]["recordings"] == 2
    # The same seed gives the same figures, in another run, too.
    assert found["differences"]["mean_all_mm"]["mean"] == 0
    assert "intervals of fewer than 5 recordings say little" in said
    assert "2 only here, not compared: short/a, seed 2; short/b, seed 2" in said
    assert "2 only there, not compared: short/a, seed 0; short/b, seed 0" in said


@pytest.mark.slow
def test_figures_depend_neither_on_processes_nor_on_threads(folder) -> None:
    overrides = ("filter.particles=60",)
    found = runs.sources([folder])
    results = []
    for workers in (1, 2):
        todo = runs.jobs(found, [3], "told", overrides)
        rows = [row for more in runs.run_jobs(todo, workers) for row in more]
        timeless = [{k: v for k, v in row.items() if not k.endswith("_ms")} for row in rows]
        results.append(sorted(timeless, key=lambda row: row["recording"]))
    assert results[0] == results[1]


def test_of_frames_that_are_measured_no_estimates_are_kept() -> None:
    def estimates() -> int:
        return sum(type(one) is Estimate for one in gc.get_objects())

    before, job = estimates(), runs.Job(runs.Source(ROOT, "", 12), 0)
    reported, _ = runs._tracked(Sample(stop=12), job, "right")
    assert len(reported) == 12 and estimates() - before < 6


def test_labelled_images_are_measured_too(folder, tmp_path, capsys) -> None:
    called = {"image_size": [176, 144], "side": "right", "shown_frames": 2}
    called |= {"images": [1, 2], "called": {"1": ["palm"], "2": ["fist"]}}
    (tmp_path / "stills.json").write_text(json.dumps(called))
    bare = str(folder.parent / "bare.npz")
    reported = ["--labels", str(tmp_path / "stills.json"), "--json", str(tmp_path / "out.json")]
    benchmark.main(["accuracy", bare, *reported, *QUICK])
    result = json.loads((tmp_path / "out.json").read_text())
    (images,) = result["images"].values()
    assert len(result["rows"]) == 2 and set(images["by"]) == {"1", "2"}
    assert result["total"] is None and "named rightly %" in capsys.readouterr().out


def test_one_recording_has_no_interval_and_few_have_no_star() -> None:
    of = {"here": 2.0, "there": 1.0, "mean": 1.0, "low": 1.0, "high": 1.0}
    rows = results.difference_table(
        {"a": of | {"recordings": 1}, "b": of | {"recordings": 4}, "c": of | {"recordings": 5}}
    )[1:]
    ends = [row[4:] for row in rows]
    assert ends == [["-", "1", ""], ["+1.00 to +1.00", "4", ""], ["+1.00 to +1.00", "5", "*"]]


def test_what_cannot_be_measured_is_said_in_one_sentence(folder, tmp_path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "text.npz").write_text("nothing")
    (tmp_path / "old.json").write_text("{}")
    (tmp_path / "labels.json").write_text("[")
    cases = [
        ([str(empty)], "holds no recording with truth"),
        ([str(folder.parent / "bare.npz")], "bare.npz' is no recording with truth (an .npz with"),
        ([str(tmp_path / "text.npz")], "text.npz"),
        ([str(folder), str(folder)], "two recordings are called 'short/a'"),
        ([str(folder), "--compare", str(tmp_path / "old.json")], "has no 'rows'"),
        ([str(folder), "--labels", str(tmp_path / "labels.json")], "cannot be read"),
        (
            [str(folder), "--labels", "labels.json", "--hands", "2"],
            "leave out --hands, or --labels",
        ),
        ([str(folder), "--json", str(tmp_path / "no" / "a.json")], "its folder does not exist"),
        ([str(folder), "hand.side=left"], "--side"),
        ([str(folder), "pose_space=pca,lle"], "pose_space=pca,lle has several values; give one"),
    ]
    for arguments, reported in cases:
        with pytest.raises(ToftrackError) as error:
            benchmark.main(["accuracy", *arguments])
        assert reported in str(error.value) and "\n" not in str(error.value)


def test_a_side_that_nobody_knows_cannot_be_given(folder, tmp_path) -> None:
    with np.load(folder / "a.npz") as arrays:
        np.savez(tmp_path / "x.npz", **{k: v for k, v in arrays.items() if k != "metadata"})
    with pytest.raises(ToftrackError, match="give --side auto"):
        benchmark.main(["accuracy", str(tmp_path), *QUICK])


def test_an_interruption_reports_what_is_done(folder, tmp_path, monkeypatch) -> None:
    def interrupted(todo, workers):
        yield runs.rows_of_job(todo[0])
        raise KeyboardInterrupt

    monkeypatch.setattr(accuracy, "run_jobs", interrupted)
    with pytest.raises(KeyboardInterrupt):
        benchmark.main(["accuracy", str(folder), "--json", str(tmp_path / "a.json"), *QUICK])
    result = json.loads((tmp_path / "a.json").read_text())
    assert result["interrupted"] and len(result["rows"]) == 1


def test_an_ablation_has_the_differences_of_each_variant(folder, tmp_path, capsys) -> None:
    files = ["--json", str(tmp_path / "a.json"), "--markdown", str(tmp_path / "a.md")]
    chosen = ["--variants", "few-particles,no-refinement"]
    benchmark.main(["ablation", str(folder), *chosen, *files])
    said = capsys.readouterr().out
    assert "20 particles" in said and "no refinement" in said
    result = json.loads((tmp_path / "a.json").read_text())
    assert set(result["variants"]) == {"default", "few-particles", "no-refinement"}
    assert result["variants"]["default"]["differences"]["usable_pct"]["mean"] == 0
    text = (tmp_path / "a.md").read_text()
    assert "    toftrack benchmark ablation" in text and "| no refinement |" in text
    with pytest.raises(ToftrackError, match="--variants=no-luck is unknown"):
        benchmark.main(["ablation", str(folder), "--variants", "no-luck"])


def test_the_variants_are_of_settings_that_there_are() -> None:
    config = configuration()
    for variant in accuracy.VARIANTS.values():
        given = (one.partition("=")[0] for one in variant.overrides)
        assert all(OmegaConf.select(config, key) is not None for key in given)
