"""The configuration in conf/: composing it, and telling what is wrong with it."""

from pathlib import Path


def configuration_folder() -> Path:
    """toftrack's own conf/: in the package where a wheel was installed, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"
