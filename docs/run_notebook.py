"""Run the code cells of a notebook without Jupyter, and keep what they print and show in it:
`python docs/run_notebook.py docs/tour.ipynb`.

Each cell is run in one namespace, in order; a last line that is an expression is shown, as Jupyter
does: a picture that IPython.display.Image holds, or its text. Where IPython is not installed, a
class that keeps the same picture takes its place.
"""

from __future__ import annotations

import argparse
import ast
import base64
import contextlib
import importlib.util
import io
import json
import sys
import types
from pathlib import Path
from typing import Any


class Image:
    """What the notebook needs of IPython.display.Image."""

    def __init__(self, data: bytes) -> None:
        self.data = data


def run_notebook(path: Path, folder: Path) -> dict[str, Any]:
    """The notebook with the outputs of its cells, run in a folder. Raises what a cell raises."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    names: dict[str, Any] = {"__name__": "__main__"}
    with contextlib.chdir(folder), _display():
        cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
        for number, cell in enumerate(cells, 1):
            cell["outputs"] = _outputs("".join(cell["source"]), names, number)
            cell["execution_count"] = number
    return notebook


def _outputs(source: str, names: dict[str, Any], number: int) -> list[dict[str, Any]]:
    parsed, value, printed = ast.parse(source), None, io.StringIO()
    last = parsed.body.pop() if parsed.body and isinstance(parsed.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(printed):
        exec(compile(parsed, f"cell {number}", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names)
    outputs: list[dict[str, Any]] = []
    if text := printed.getvalue():
        lines = text.splitlines(keepends=True)
        outputs.append({"name": "stdout", "output_type": "stream", "text": lines})
    if value is not None:
        outputs.append(
            {
                "data": _shown(value),
                "execution_count": number,
                "metadata": {},
                "output_type": "execute_result",
            }
        )
    return outputs


def _shown(value: Any) -> dict[str, Any]:
    if isinstance(getattr(value, "data", None), bytes):
        return {"image/jpeg": base64.b64encode(value.data).decode(), "text/plain": ["<Image>"]}
    return {"text/plain": repr(value).splitlines(keepends=True)}


@contextlib.contextmanager
def _display():
    """IPython.display, whether it is installed or not."""
    if importlib.util.find_spec("IPython") is not None:
        yield
        return
    display = types.ModuleType("IPython.display")
    display.Image = Image  # type: ignore[attr-defined]
    sys.modules |= {"IPython": types.ModuleType("IPython"), "IPython.display": display}
    try:
        yield
    finally:
        del sys.modules["IPython"], sys.modules["IPython.display"]


if __name__ == "__main__":
    import tempfile

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("notebook", type=Path)
    place = parser.parse_args().notebook.resolve()
    with tempfile.TemporaryDirectory() as empty:
        done = run_notebook(place, Path(empty))
    place.write_text(json.dumps(done, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
