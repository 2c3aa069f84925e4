"""What the benchmark prints, and the facts of the machine it ran on: see scoring.py."""

from __future__ import annotations

import platform
import sys
from pathlib import Path

from toftrack.benchmark.frames import BUDGET_MS


def peak_memory_gb() -> float:
    """The most main memory this process has held so far."""
    try:
        import resource
    except ImportError:  # not on Windows
        return float("nan")
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def processor() -> str:
    """The processor's name, as well as it is known here."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def show(result: dict) -> str:
    """The result as one table of text."""
    machine = result["machine"]
    height, width = result["image"]
    lines = [
        f"{machine['processor']}, {machine['threads']} threads, torch {machine['torch']},"
        f" {machine['device']}; crop {width} x {height} px, radius {result['radius_px']:.1f} px",
        f"{'what grows':<22}{'method':<13}{'N':>7}{'pixels':>9}{'ellips.':>9}"
        f"{'min ms':>11}{'median ms':>11}{'repeats':>9}",
    ]
    for row in result["rows"]:
        lines.append(
            f"{row['table']:<22}{row['method']:<13}{row['particles']:>7}{row['pixels']:>9}"
            f"{row['ellipsoids']:>9}{row['min_ms']:>11.3f}{row['median_ms']:>11.3f}"
            f"{row['repeats']:>9}"
        )
    for row in result["frames"]:
        lines.append(
            f"{'whole frame':<16}{row['configuration']:<19}{row['particles']:>7}{'':>18}"
            f"{row['min_ms']:>11.3f}{row['median_ms']:>11.3f}{row['repeats']:>9}"
            f"   {1e3 / row['median_ms']:.1f} frames/s"
        )
        aims = BUDGET_MS if row["configuration"] == "default" else {}
        for part, took in row["parts"].items():
            aim = f"   (budget: {aims[part]:g})" if part in aims else ""
            lines.append(f"    {part:<56}{took:>15.3f}{aim}")
    for row in result["decoding"]:
        aim = "" if row["aim_ms"] is None else f"   (aim: at most {row['aim_ms']:g})"
        lines.append(
            f"{'decoding latents':<22}{row['space']:<13}{row['latents']:>7}{'':>18}"
            f"{row['min_ms']:>11.3f}{row['median_ms']:>11.3f}{row['repeats']:>9}{aim}"
        )
    for name, against in result["ratios"].items():
        parts = ", ".join(f"{ratio:.0f} x {baseline}" for baseline, ratio in against.items())
        lines.append(f"{name}: {parts} (ratio of medians)")
    for name, worst in result["largest_difference_px"].items():
        lines.append(f"{name}: counts within {worst:.0f} px of the reference")
    lines.append(f"peak memory after the particles' table: {result['peak_memory_gb']:.2f} GB")
    lines += result["notes"]
    lines.append("The baselines are timed on fewer repeats and at few particles only.")
    return "\n".join(lines)
