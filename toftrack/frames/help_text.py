"""What `help` shows of a dataclass: its fields, too, with what is written below each."""

from __future__ import annotations

import ast
import inspect
import textwrap
from typing import TypeVar

_Class = TypeVar("_Class")


def fields_in_help(kind: type[_Class]) -> type[_Class]:
    """Decorator of a dataclass whose fields have a text below them, which Python forgets: they go
    to the end of the class's own, with their types. Without the source it stays as it is.
    """
    try:
        source = inspect.getsource(kind)
    except (OSError, TypeError):
        return kind
    (parsed,) = ast.parse(textwrap.dedent(source)).body
    assert isinstance(parsed, ast.ClassDef)
    lines = []
    for field, below in zip(parsed.body, [*parsed.body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign):
            lines.append(f"    {ast.unparse(field.target)}: {ast.unparse(field.annotation)}")
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                about = inspect.cleandoc(str(below.value.value))
                lines.append(textwrap.indent(about, " " * 8))
    kind.__doc__ = "\n".join((inspect.cleandoc(kind.__doc__ or ""), "", "Fields:", *lines))
    return kind
