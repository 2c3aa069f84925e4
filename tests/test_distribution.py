"""What a wheel, a source archive and an editable installation hold."""

import re
import shutil
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from helpers.programs import python
from helpers.tracking import ROOT

pytest.importorskip("hatchling", reason="hatchling is not installed")
from hatchling import build
from hatchling.builders.sdist import SdistBuilder


def _files(folder: str) -> set[str]:
    paths = (path for path in (ROOT / folder).rglob("*") if path.is_file())
    return {str(path.relative_to(ROOT)) for path in paths if "__pycache__" not in path.parts}


def _names(wheel: zipfile.ZipFile) -> set[str]:
    return {name for name in wheel.namelist() if ".dist-info/" not in name}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel unpacked, which is what installing one does."""
    folder = tmp_path_factory.mktemp("wheel")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        wheel = zipfile.ZipFile(folder / build.build_wheel(str(folder)))
    package = _files("toftrack")
    assert {"toftrack/py.typed", "toftrack/data/sample.npz", "toftrack/data/detector.npz"} < package
    assert _names(wheel) == package | {f"toftrack/{name}" for name in _files("conf")}
    wheel.extractall(folder / "site")
    return folder / "site"


def _python(site: Path, folder: Path, *words: str) -> str:
    done = python(*words, folder=folder, PYTHONPATH=str(site))
    return done.stdout + done.stderr


def test_an_installed_package_brings_its_configuration(site: Path, tmp_path: Path) -> None:
    code = """
import toftrack
from toftrack.configuration.compose import configuration
print(toftrack.__file__, configuration("smooth=one_euro").smooth.results)
"""
    path, smooth = _python(site, tmp_path, "-c", code).split()
    assert Path(path).is_relative_to(site) and smooth == "False"


@pytest.mark.slow
def test_a_type_checker_in_another_folder_knows_the_types(site: Path, tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "client.py").write_text(
        "import toftrack\n"
        "from toftrack import *\n"
        "reveal_type(read_run)\n"
        "toftrack.make_racket\n"
        "estimate = toftrack.make_tracker().step([[0.5]], [[1.0]])\n"
        "reveal_type(estimate.confidence)\n"
        "reveal_type(toftrack.read_run('x').camera)\n"
        "estimate.no_such_field\n"
    )
    said = _python(site, tmp_path, "-m", "mypy", "--strict", "client.py")
    assert 'Revealed type is "float"' in said, said
    assert 'Revealed type is "toftrack.frames.camera.Camera"' in said
    assert '"Estimate" has no attribute "no_such_field"' in said
    assert 'Revealed type is "def (folder: ' in said, "import * brings the names"
    assert 'Module has no attribute "make_racket"' in said


def test_an_editable_installation_is_the_path_of_the_checkout(tmp_path, monkeypatch) -> None:
    """So that type checkers and editors find the package."""
    monkeypatch.chdir(ROOT)
    with zipfile.ZipFile(tmp_path / build.build_editable(str(tmp_path))) as wheel:
        [path] = _names(wheel)
        assert path.endswith(".pth") and wheel.read(path).decode().strip() == str(ROOT)


def test_the_wheel_says_on_which_pythons_it_runs(site: Path) -> None:
    [metadata] = site.glob("toftrack-*.dist-info/METADATA")
    said = message_from_bytes(metadata.read_bytes())
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(said.get_all("Classifier", [])))
    assert named == ["3.11", "3.12", "3.13"] and said["Requires-Python"] == f">={named[0]}"


def test_the_image_gets_all_that_the_wheel_is_made_of(site: Path, tmp_path, monkeypatch) -> None:
    """What the Dockerfile copies, as there is no Docker in a test."""
    copied = re.findall(r"^COPY (.+) (\S+)$", (ROOT / "Dockerfile").read_text(), re.M)
    for names, target in copied:
        place = tmp_path / target.lstrip("/")
        for name in names.split():
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, place, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                place.mkdir(exist_ok=True)
                shutil.copy(ROOT / name, place)
    monkeypatch.chdir(tmp_path / "src")
    with zipfile.ZipFile(tmp_path / build.build_wheel(str(tmp_path))) as wheel:
        made = {str(path.relative_to(site)) for path in site.rglob("*") if path.is_file()}
        assert {name for name in made if "__pycache__" not in name} == set(wheel.namelist())


def test_the_source_archive_holds_no_tests_and_no_pages() -> None:
    held = {file.distribution_path for file in SdistBuilder(str(ROOT)).recurse_included_files()}
    programs = {"track.py", "train_pose_space.py"}
    assert held == _files("toftrack") | _files("conf") | programs
