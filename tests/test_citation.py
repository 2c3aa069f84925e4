"""The version is said in three places, which agree."""

import re
import tomllib

import yaml
from helpers.tracking import ROOT


def test_citation_changelog_and_package_say_the_same_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    latest = re.search(
        r"^## \[(.+?)\] - (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M
    )
    assert latest is not None
    assert citation["version"] == project["version"] == latest[1]
    assert str(citation["date-released"]) == latest[2]
    assert citation["references"][0]["title"].startswith("Model-based hand gesture tracking")
