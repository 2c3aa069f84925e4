"""Names are the field's words: what a reader of the literature would not know stays out of them."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
OTHERS = {
    "glance glances glanced glancing look looks looked looking": "detect, compare, detection",
    "heard hears told": "considered, reported, given",
    "relocaliser relocation relocating": "detector",
    "vote votes voted": "keypoint",
    "signs": "feature",
    "settled contest turns": "select, hysteresis, schedule, rotations",
    "worn": "applied",
    "room rooms": "package, layer",
    "ending endings ahead spending": "shutdown, at_quality",
    "lasted longer": "Duration",
}
"""Words that are in no name, and what to say instead."""
WORDS = {word: say for words, say in OTHERS.items() for word in words.split()}
NAMES = re.compile(r"bad_for|known_scores|joints_word|_known|un(looked|searched|sought)_s")
"""Whole names that are none either."""
ALLOWED = {
    "train_relocaliser": "a program that says its new name",
    "test_the_told_side_goes_before_the_surer_hand": "the benchmark's --side told",
}
SOURCES = sorted([*(ROOT / "toftrack").rglob("*.py"), *(ROOT / "tests").rglob("*.py")])
CONF = sorted((ROOT / "conf").rglob("*.yaml"))


def _faults(names: Iterator[tuple[str, int]]) -> list[str]:
    faults = []
    for name, line in names:
        parts = [part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]
        say = [f"{part} -> {WORDS[part]}" for part in parts if part in WORDS]
        if name not in ALLOWED and (say or NAMES.fullmatch(name)):
            faults.append(f"line {line}: {name} ({'; '.join(say) or 'another name'})")
    return faults


def _defined(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Names of classes, functions, arguments, variables and attributes, and their lines."""
    for node in ast.walk(tree):
        match node:
            case ast.ClassDef() | ast.FunctionDef() | ast.AsyncFunctionDef():
                yield node.name, node.lineno
            case ast.arg():
                yield node.arg, node.lineno
            case ast.Name(ctx=ast.Store()):
                yield node.id, node.lineno
            case ast.Attribute(ctx=ast.Store()):
                yield node.attr, node.lineno
            case ast.alias(asname=str(name)) | ast.ExceptHandler(name=str(name)):
                yield name, node.lineno


def _keys(node: object) -> Iterator[str]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield str(key)
            yield from _keys(value)


@pytest.mark.parametrize("folder", ["toftrack", "tests"])
def test_names_in_the_code_are_the_fields(folder: str) -> None:
    faults = []
    for path in SOURCES:
        place = path.relative_to(ROOT)
        if place.parts[0] == folder:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            modules = ((part, 0) for part in place.with_suffix("").parts)
            faults += [f"{place}, {fault}" for fault in _faults(modules)]
            faults += [f"{place}, {fault}" for fault in _faults(_defined(tree))]
    assert not faults, "\n".join(faults)


def test_names_of_settings_are_the_fields() -> None:
    faults = []
    for path in CONF:
        place = path.relative_to(ROOT)
        text = path.read_text(encoding="utf-8")
        names = [*place.with_suffix("").parts, *_keys(yaml.safe_load(text))]
        faults += [f"{place}: {fault}" for fault in _faults((name, 0) for name in names)]
    assert CONF and not faults, "\n".join(faults)


def test_a_name_that_is_none_is_found() -> None:
    names = "looks_ahead votes HeardTwice bad_for worn_shape".split()
    code = "def {}({}):\n    self.{} = {} = 1\nimport a as {}".format(*names)
    found = {fault.split()[2] for fault in _faults(_defined(ast.parse(code)))}
    assert found == set(names)
    fine = "def lookup(outlook_s, known):\n    looked_up_by_keyword(votes=1, looks=heard)"
    assert not _faults(_defined(ast.parse(fine)))
