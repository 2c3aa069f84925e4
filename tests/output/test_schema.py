"""docs/track_line.schema.json describes the lines as they are, and the types follow from it."""

import copy
import importlib.util
import json
from dataclasses import replace
from typing import Any

import pytest
from helpers.hands import hand_estimate
from helpers.tracking import ROOT

from toftrack.frames.estimate import STATES, no_estimate
from toftrack.output.lines import FRAME_FIELDS, HAND_FIELDS, json_line

SCHEMA = json.loads((ROOT / "docs/track_line.schema.json").read_text(encoding="utf-8"))
ONE = json.loads(json_line([hand_estimate(3)]))
TWO = json.loads(json_line([hand_estimate(3), hand_estimate(3, "left")]))


def refused(line: Any) -> bool:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    return not jsonschema.Draft202012Validator(SCHEMA).is_valid(line)


def test_lines_of_one_hand_of_two_and_of_none_are_as_the_schema_says() -> None:
    nobody = no_estimate(0, 0.0, "searching", 4, 0.01)
    lost = replace(hand_estimate(4), lost=True, side="", state_name="hidden")
    for hands in ([nobody], [lost], [nobody, nobody], [hand_estimate(1), nobody]):
        assert not refused(json.loads(json_line(hands))), hands
    assert not refused(ONE) and not refused(TWO)


@pytest.mark.parametrize(
    "changes",
    [{"lost": "no"}, {"joints_m": [[0, 0, 0]]}, {"confidence": 2}, {"unknown": 1}, {"slot": 0}],
    ids=lambda changes: next(iter(changes)),
)
def test_a_line_that_is_none_is_refused(changes: dict[str, Any]) -> None:
    assert refused(ONE | changes)
    other = copy.deepcopy(TWO)
    other["hands"][1] |= changes if "slot" not in changes else {"slot": 8}
    assert refused(other)


def test_the_schema_has_each_field() -> None:
    parts = SCHEMA["$defs"]
    assert set(parts["frame"]["properties"]) == set(FRAME_FIELDS)
    assert set(parts["hand"]["properties"]) == set(parts["hand"]["required"]) == set(HAND_FIELDS)
    assert set(parts["hand"]["properties"]["state_name"]["enum"]) == set(STATES) - {"dropped"}


def test_the_types_are_those_that_the_schema_makes() -> None:
    path = ROOT / "docs" / "make_types.py"
    spec = importlib.util.spec_from_file_location("make_types", path)
    assert spec is not None and spec.loader is not None
    program = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(program)
    assert program.TYPES.read_text(encoding="utf-8") == program.types(SCHEMA), (
        "docs/track_line.schema.json has changed; run python docs/make_types.py"
    )
