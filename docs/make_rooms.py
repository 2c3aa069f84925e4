"""The picture of the rooms, docs/rooms.svg, made from the code: python docs/make_rooms.py

Rows are the layers of `[tool.importlinter]` in pyproject.toml, which import only what stands below
them; each box is a package or module of toftrack/ with what it imports of the others.
"""

from __future__ import annotations

import argparse
import ast
import functools
import re
import tomllib
from html import escape
from pathlib import Path

ROOT = Path(__file__).parents[1]
PICTURE = Path(__file__).with_name("rooms.svg")
WIDTH, MARGIN, LINE, LETTER = 1180, 10, 15, 6.1
"""Of the picture, between boxes, of a line of text, and of a letter; pixels."""


def layers() -> list[list[str]]:
    """The rooms of each layer, the highest first."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    rows = contracts["contracts"][0]["layers"]
    return [re.findall(r"\w+", row) for row in rows]


@functools.cache
def imports(room: str) -> list[str]:
    """The other rooms that a room imports, in the order of their names."""
    path = ROOT / "toftrack" / room
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    found = set()
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            modules += [one.name for one in node.names] if isinstance(node, ast.Import) else []
            found |= {name.split(".")[1] for name in modules if name.startswith("toftrack.")}
    return sorted(found - {room})


def wrapped(words: list[str], width: float) -> list[str]:
    """Words in lines that are at most so many pixels wide."""
    lines = [""]
    for word in words:
        longer = f"{lines[-1]} {word}".strip()
        if len(longer) * LETTER > width and lines[-1]:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def picture() -> str:
    """The picture, as SVG."""
    rows = layers()
    known = [room for row in rows for room in row]
    parts, top = [], MARGIN
    for row in rows:
        wide = (WIDTH - MARGIN * (len(row) + 1)) / len(row)
        texts = []
        for room in row:
            below = [name for name in known if name in imports(room)]
            texts.append(wrapped(below, wide - 130) if below else [])
        high = LINE * max(1, *map(len, texts)) + MARGIN
        for column, (room, lines) in enumerate(zip(row, texts, strict=True)):
            left = MARGIN + column * (wide + MARGIN)
            parts.append(
                f'<rect x="{left:.0f}" y="{top}" width="{wide:.0f}" height="{high}" rx="4"/>'
                f'<text class="room" x="{left + 8:.0f}" y="{top + LINE}">{escape(room)}</text>'
            )
            parts += [
                f'<text x="{left + 118:.0f}" y="{top + LINE * (1 + n)}">{escape(line)}</text>'
                for n, line in enumerate(lines)
            ]
        top += high + 6
    style = (
        "text{font:11px sans-serif;fill:#333}.room{font-weight:bold;fill:#000}"
        "rect{fill:#eef3fa;stroke:#7a92b5}"
    )
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {top + MARGIN}">'
    return "\n".join([head, f"<style>{style}</style>", *parts, "</svg>", ""])


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    PICTURE.write_text(picture())
