"""docs/figures.json is the one source of the figures in README.md and docs/."""

from __future__ import annotations

import json
import sys

import pytest
from helpers.tracking import ROOT

sys.path.insert(0, str(ROOT / "docs"))
from figure_tables import HISTORY_HEAD, NOT_YET, history_row, history_rows, with_tables

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ROW = {
    "date": "2026-01-02",
    "commit": "abc1234+",
    "method": "toftrack",
    "hands": "bare",
    "seeds": [0, 1, 2],
    "side": "told",
    "machine": "a processor, 2 cores",
    "versions": "toftrack 1, torch 2",
    "usable_pct": 87.25,
    "usable_90": [82.0, 92.5],
    "silent_pct": 0.0,
}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_marked_tables_are_those_of_the_figures(page) -> None:
    figures = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))
    text = page.read_text(encoding="utf-8")
    assert text.count("<!-- figures: ") == text.count("<!-- end -->")
    assert with_tables(text, figures) == text, "run: python docs/make_figures.py --tables"


def test_the_readme_has_its_table() -> None:
    assert "<!-- figures: readme -->" in PAGES[0].read_text(encoding="utf-8")


def test_the_public_test_sets_rows_are_those_of_the_history() -> None:
    figures = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))
    history = (ROOT / "docs" / "lab" / "history.md").read_text(encoding="utf-8")
    kept = {name: row for name, row in figures["rows"].items() if name.startswith("strangers")}
    assert kept == history_rows(history)
    assert "| " + " | ".join(HISTORY_HEAD) + " |" in history


def test_every_row_says_where_it_was_made() -> None:
    figures = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))
    for row in figures["rows"].values():
        assert {"commit", "seeds", "machine", "versions"} <= set(row)


def test_a_row_of_the_history_is_read_as_it_was_written() -> None:
    later = ROW | {"usable_pct": 90.0, "method": "mediapipe"}
    found = history_rows("\n".join(["text", history_row(ROW), history_row(later)]))
    assert set(found) == {"strangers, bare", "strangers, bare, mediapipe"}
    row = found["strangers, bare"]
    assert row["usable_pct"] == pytest.approx(87.25) and row["usable_90"] == [82.0, 92.5]
    assert row["silent_pct"] == 0.0 and row["seeds"] == [0, 1, 2] and row["commit"] == "abc1234+"
    assert "mean_mm" not in row and history_rows("nothing | here") == {}
    newer = history_rows("\n".join([history_row(ROW), history_row(ROW | {"usable_pct": 91.0})]))
    assert newer["strangers, bare"]["usable_pct"] == 91.0, "the last row counts"


def test_what_was_not_measured_says_so() -> None:
    page = "before\n<!-- figures: readme -->\nSTALE\n<!-- end -->\nafter\n"
    text = with_tables(page, {"rows": {}})
    assert NOT_YET in text and "STALE" not in text
    assert text.startswith("before\n") and text.endswith("<!-- end -->\nafter\n")
    history = history_rows(history_row(ROW))
    assert "87 %" in with_tables(page, {"rows": history})
