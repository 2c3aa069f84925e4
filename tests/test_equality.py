"""Objects that hold arrays are equal only to themselves: `==` of tensors has no truth value."""

import ast
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from toftrack.hand.shape import default_hand_shape
from toftrack.hand.surface import hand_surface

PACKAGE = Path(__file__).parents[1] / "toftrack"


def _dataclasses() -> Iterator[tuple[str, bool, bool]]:
    """Name, whether it holds arrays, and whether it is compared by its fields."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            decorators = map(ast.unparse, getattr(node, "decorator_list", ()))
            made = [text for text in decorators if text.startswith("dataclass")]
            if isinstance(node, ast.ClassDef) and made:
                fields = [one.annotation for one in node.body if isinstance(one, ast.AnnAssign)]
                kinds = {ast.unparse(kind) for kind in fields}
                arrays = bool(kinds & {"Tensor", "np.ndarray"})
                yield node.name, arrays, "eq=False" not in made[0]


def test_classes_that_hold_arrays_are_compared_by_identity() -> None:
    found = list(_dataclasses())
    assert sum(arrays for _, arrays, _ in found) > 20
    assert not {name for name, arrays, by_fields in found if arrays and by_fields}


def test_hands_that_share_their_sizes_are_one_key() -> None:
    """Also under Python 3.13, whose dataclasses compare field by field."""
    hand = default_hand_shape()
    assert replace(hand) == hand and len({replace(hand), hand}) == 1
    assert hand_surface(replace(hand)) is hand_surface(hand)
    assert hand != hand.to(torch.float64) and hand != replace(hand, side="left") and hand != "hand"
