"""README.md, CONTRIBUTING.md and docs/: links lead to a file, and to a heading or mark in it; the
picture of the rooms is that of the code; docs/figures.json is the one source of figures."""

import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.tracking import ROOT

import toftrack

sys.path.insert(0, str(ROOT / "docs"))
from figure_tables import HISTORY_HEAD, NOT_YET, history_row, history_rows, with_tables
from make_rooms import PICTURE, imports, layers, picture

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FIGURES = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))
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


def marks(page: Path) -> set[str]:
    """The anchors of a page, headings as GitHub names them."""
    text = page.read_text(encoding="utf-8")
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.M)
    named = {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in headings}
    return named | set(re.findall(r'id="([\w-]+)"', text))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere_and_marked_tables_are_those_of_the_figures(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for file, mark in re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)\)", text):
        if file.startswith("http"):
            continue
        target = page.parent / file if file else page
        assert target.exists(), file
        assert not mark or mark in marks(target), f"{file}#{mark}"
    assert text.count("<!-- figures: ") == text.count("<!-- end -->")
    assert with_tables(text, FIGURES) == text, "run: python docs/make_figures.py --tables"


def test_every_page_stands_in_the_navigation_and_every_public_name_in_the_reference() -> None:
    """Links and pictures are checked by mkdocs build --strict, in CI."""
    named = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))
    there = {str(page.relative_to(ROOT)) for page in PAGES} | {"docs/tour.md"}
    assert there <= named, "a page is missing in mkdocs.yml"
    assert all((ROOT / name).exists() for name in named - {"docs/tour.md"})
    reference = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^::: toftrack\.(\w+)$", reference, re.M))
    assert shown == set(toftrack.__all__) - {"__version__"}


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (toftrack.BaseDevice, "camera fps frames truth live dropped description metadata"),
        (toftrack.Tracking, "device camera depth_m"),
        (toftrack.Camera, "K width height distortion"),
        (toftrack.Run, "folder results frames"),
    ],
)
def test_the_reference_shows_every_attribute_with_what_it_is(kind: type, names: str) -> None:
    """mkdocs shows those alone that are assigned by themselves and have a text below."""
    source = inspect.getsource(kind)
    for name in names.split():
        assert re.search(rf'^ +(self\.)?{name}(: .+| = .+)\n +"""', source, re.M), name


def test_the_notebook_becomes_a_page() -> None:
    for package in ("mkdocs", "griffe"):  # the latter by the extra docs alone
        pytest.importorskip(package, reason="mkdocs is not installed")
    from site_hooks import as_list, notebook_page

    page = notebook_page(json.loads((ROOT / "docs" / "tour.ipynb").read_text(encoding="utf-8")))
    assert page.startswith("# ") and page.count("data:image/jpeg;base64,") == 2
    assert "```python\nimport" in page and "30 frames, 0 of them lost" in page
    points = "Draws.\n\nimage: (H, W), 0 = no\nreading.  camera: of it.\nReturns it."
    assert as_list(points).split("\n\n")[1:] == [
        "- `image`: (H, W), 0 = no\nreading.",
        "- `camera`: of it.",
        "Returns it.",
    ]


def test_the_picture_of_the_rooms_is_of_this_code() -> None:
    assert PICTURE.read_text() == picture(), "make it anew: python docs/make_rooms.py"
    order = [room for row in layers() for room in row]
    assert set(imports("tracking")) >= {"detector", "render", "refinement"}
    for place, room in enumerate(order):
        assert all(order.index(name) > place for name in imports(room) if name in order), room


@pytest.mark.parametrize(
    "name",
    "make_gallery make_moving_picture make_rooms make_types measure_angles run_notebook".split(),
)
def test_the_programs_of_the_pages_tell_what_they_do(name: str) -> None:
    command = [sys.executable, str(ROOT / "docs" / f"{name}.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith(f"usage: {name}.py"), done.stderr


def test_the_figures_are_in_the_readme_and_say_where_they_were_made() -> None:
    assert "<!-- figures: readme -->" in PAGES[0].read_text(encoding="utf-8")
    history = (ROOT / "docs" / "lab" / "history.md").read_text(encoding="utf-8")
    kept = {name: row for name, row in FIGURES["rows"].items() if name.startswith("strangers")}
    assert kept == history_rows(history)
    assert "| " + " | ".join(HISTORY_HEAD) + " |" in history
    for row in FIGURES["rows"].values():
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
    assert "87 %" in with_tables(page, {"rows": history_rows(history_row(ROW))})
