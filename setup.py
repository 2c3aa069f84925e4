"""The build step that pyproject.toml cannot say: conf/ goes into the package, as toftrack/conf."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithConfiguration(build_py):
    """In a checkout conf/ stays beside the package, where it can be edited."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for source in sorted(Path("conf").rglob("*.yaml")):
                target = Path(self.build_lib, "toftrack", source)
                self.mkpath(str(target.parent))
                self.copy_file(str(source), str(target))


setup(cmdclass={"build_py": BuildWithConfiguration})
