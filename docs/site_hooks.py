"""What mkdocs.yml needs to make the site of these pages: `mkdocs serve`, `mkdocs build --strict`.

Files keep the paths that they have in the repository, README.md is the first page, and so links
lead to the same places on the site as on a code host. The notebook becomes a page. Docstrings are
shown as they are written, "name: what it is", as lists.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = "docs/tour.ipynb"


PAGE = NOTEBOOK.replace(".ipynb", ".md")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The files of the theme and of docs/, the pages of the navigation, and what they all link."""
    of_theme = [file for file in files if file.src_dir != config.docs_dir]
    paths = {f"docs/{file.src_uri}" for file in files if file.src_dir == config.docs_dir}
    found = linked(paths | set(re.findall(r"[\w./]+\.md", str(config.nav))) - {PAGE})
    place = str(ROOT), config.site_dir, config.use_directory_urls
    made = [File(path, *place) for path in sorted(found)]
    tour = notebook_page(json.loads((ROOT / NOTEBOOK).read_text(encoding="utf-8")))
    return Files([*of_theme, *made, File.generated(config, PAGE, content=tour)])


def linked(paths: set[str]) -> set[str]:
    """Files of the repository, and those that the pages among them link or show."""
    found = set(paths)
    for page in (ROOT / path for path in paths if path.endswith(".md")):
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
            place = (page.parent / target).resolve()
            if place.is_file() and place.is_relative_to(ROOT):
                found.add(place.relative_to(ROOT).as_posix())
    return found if found == paths else linked(found)


def on_page_markdown(markdown: str, **kwargs: object) -> str:
    """A page that links the notebook leads to its page."""
    return markdown.replace("tour.ipynb)", "tour.md)")


def notebook_page(notebook: dict) -> str:
    """The cells of a notebook, and what they printed and showed, in Markdown."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if picture := data.get("image/jpeg"):
                parts.append(f"![What the cell shows](data:image/jpeg;base64,{picture})")
            else:
                text = "".join(output.get("text") or data.get("text/plain", ()))
                parts.append(f"```text\n{text.rstrip()}\n```")
    return "\n\n".join(parts) + "\n"


class Docstrings(griffe.Extension):
    """Docstrings as Markdown."""

    def on_object(self, *, obj: griffe.Object, **kwargs: object) -> None:
        """Each "name: what it is" of a docstring becomes a point of a list."""
        if obj.docstring and (obj.is_function or obj.is_class):
            obj.docstring.value = as_list(obj.docstring.value)


def as_list(text: str) -> str:
    """A docstring whose "name: text", at the beginning of a line or after two blanks, are points of
    a list, and what it returns and raises paragraphs."""
    text = re.sub(r"(?:^|(?<=\S)  +)((?:\w+, )*[A-Za-z]\w*): ", r"\n\n- `\1`: ", text, flags=re.M)
    text = re.sub(r"^(Returns|Raises) ", r"\n\n\1 ", text, flags=re.M)
    return re.sub(r"\n{3,}", "\n\n", text)
