"""How fast hypotheses are scored here: `toftrack benchmark`, one table, `--json FILE`.

All methods are timed in turn within one process, so that what else the machine does hits all of
them alike, and every method is checked against the reference before it is timed. The observation is
the first frame of the packaged recording, cropped around the hand; the hypotheses are spread around
the true wrist as a filter's are. The baselines:

* stepping: the paper's own way (section 2.2), rays stepped in 5 mm to the quadric's crossing, in
  chunks of hypotheses that suit the cache;
* naive: the closed form over whole images of all ellipsoids (ReferenceScorer), in chunks of the
  size that turns out fastest here.

Besides, what decoding 10 000 latents of each pose space takes.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from toftrack.benchmark.decoding import decode_times
from toftrack.benchmark.frames import FrameRow, frame_times
from toftrack.benchmark.table import peak_memory_gb, processor, show
from toftrack.benchmark.timing import (
    Row,
    check_against_reference,
    fastest_chunk,
    filter_states,
    interleaved,
    sample_evidence,
    to_device,
    wait_for,
)
from toftrack.errors import ToftrackError
from toftrack.hand.shape import default_hand_shape
from toftrack.hand.skeleton import forward_kinematics
from toftrack.hand.surface import HandSurface, hand_surface
from toftrack.render.closed_form import project
from toftrack.render.reference import ReferenceScorer
from toftrack.render.scoring import Evidence, Scorer
from toftrack.safe_files import write_whole
from toftrack.tracking.backend import BACK_ENDS, make_scorer

PARTICLES = (100, 300, 1000, 3000, 10_000)
BASELINES = ("stepping", "naive")
_SLOW_PARTICLES = 300
"""The baselines are not timed with more particles than this."""
_SLOW_REPEATS = {"stepping": 3, "naive": 5}
_CHECKED = 24
UPSAMPLED = (0.5, 1.0, 2.0, 3.0)
"""Scales of the image's sides for the growth with the number of pixels."""


class Benchmark:
    """The methods that run here, and what they are timed on."""

    def __init__(self, device: torch.device, seconds: float, baselines: bool = True) -> None:
        """seconds: how long to time each fast method of a table.  baselines: time these, too."""
        self.device = device
        self.seconds = seconds
        self.shape = default_hand_shape().to(device)
        evidence, self.wrist = sample_evidence()
        self.evidence = to_device(evidence, device)
        self.scorers: dict[str, Scorer] = {}
        self.notes: list[str] = []
        self.disagreement_px: dict[str, float] = {}
        if baselines:
            states = self.states(32)
            for name in BASELINES:
                stepping = name == "stepping"
                chunk = fastest_chunk(self.shape, states, self.evidence, stepping)
                self.notes.append(f"{name}: {chunk} hypotheses to a chunk")
                self.scorers[name] = ReferenceScorer(self.shape, chunk, stepping)
        for name in BACK_ENDS:
            if name == "numba" and device.type == "cuda":
                continue  # it would measure the way to the CPU and back
            try:
                scorer = make_scorer(name, self.shape, device)
            except ToftrackError as error:
                self.notes.append(f"{name}: {error}")
                continue
            self.disagreement_px[name] = check_against_reference(
                scorer, self.shape, self.states(_CHECKED), self.evidence
            )
            self.scorers[name] = scorer

    @property
    def fast(self) -> list[str]:
        """Names of the back ends."""
        return [name for name in self.scorers if name not in BASELINES]

    def states(self, n: int) -> Tensor:
        """N hypotheses on the device."""
        return filter_states(n, self.wrist).to(self.device)

    def table(
        self,
        label: str,
        names: Sequence[str],
        states: Tensor,
        evidence: Evidence,
        scorers: dict[str, Scorer] | None = None,
        ellipsoids: int | None = None,
    ) -> list[Row]:
        """Time methods in turn on the same states and evidence."""
        calls = {
            name: (lambda s=(scorers or self.scorers)[name]: s(states, evidence)) for name in names
        }
        repeats = {}
        for name, call in calls.items():
            if name in BASELINES:
                repeats[name] = _SLOW_REPEATS[name]
                continue
            call()
            start = time.perf_counter()
            call()
            wait_for(self.device)
            repeats[name] = min(200, max(3, int(self.seconds / (time.perf_counter() - start))))
        with tqdm(
            total=sum(repeats.values()), desc=f"{label}, N = {len(states)}", delay=2, leave=False
        ) as progress:
            times = interleaved(calls, repeats, self.device, progress)
        count = ellipsoids or len(hand_surface(self.shape))
        return [
            Row(
                label,
                name,
                len(states),
                evidence.hand.numel(),
                count,
                1e3 * min(found),
                1e3 * statistics.median(found),
                len(found),
            )
            for name, found in times.items()
        ]

    def by_particles(self, particles: Sequence[int]) -> list[Row]:
        """The headline: every method, the baselines at few particles only."""
        rows = []
        for n in particles:
            names = [name for name in self.scorers if name not in BASELINES or n <= _SLOW_PARTICLES]
            rows += self.table("particles", names, self.states(n), self.evidence)
        return rows

    def by_pixels(self, n: int = 300) -> list[Row]:
        """The same frame with more pixels."""
        rows = []
        for upsample in UPSAMPLED:
            evidence = to_device(sample_evidence(upsample)[0], self.device)
            rows += self.table("pixels", self.fast, self.states(n), evidence)
        return rows

    def by_ellipsoids(self, n: int = 300) -> list[Row]:
        """Hands of fewer ellipsoids, every second or fourth left out."""
        rows = []
        whole = hand_surface(self.shape)
        for step in (4, 2, 1):
            kept = torch.cat((torch.arange(0, len(whole), step), torch.tensor([len(whole)])))
            surface = HandSurface(*(field[kept.to(field.device)] for field in _fields(whole)))
            scorers = {name: self._with_surface(name, surface) for name in self.fast}
            rows += self.table(
                "ellipsoids",
                self.fast,
                self.states(n),
                self.evidence,
                scorers,
                ellipsoids=len(surface),
            )
        return rows

    def _with_surface(self, name: str, surface: HandSurface) -> Scorer:
        from toftrack.render.numba.scorer import NumbaScorer
        from toftrack.render.torch_scorer import TorchScorer

        kinds: dict[str, Callable[..., Scorer]] = {"torch": TorchScorer, "numba": NumbaScorer}
        if name == "triton":
            from toftrack.render.triton.scorer import TritonScorer

            kinds[name] = TritonScorer
        return kinds[name](self.shape, surface=surface)

    def kinematics(self, n: int = 300) -> list[Row]:
        """Decoding states to conics alone: eager torch, and the share of the compiled kernel."""
        states, surface = self.states(n), hand_surface(self.shape)
        calls: dict[str, Callable[[], object]] = {
            "eager torch": lambda: project(surface.pose(forward_kinematics(states, self.shape)))
        }
        if "numba" in self.scorers:
            # All of the kinematics and none of the pixels: the evidence is a single pixel.
            scorer, tiny = self.scorers["numba"], self.evidence.cropped(0, 0, 1, 1)
            calls["numba"] = lambda: scorer(states, tiny)
        times = interleaved(calls, dict.fromkeys(calls, 30), self.device)
        return [
            Row(
                "kinematics and conics",
                name,
                n,
                0,
                len(surface),
                1e3 * min(found),
                1e3 * statistics.median(found),
                len(found),
            )
            for name, found in times.items()
        ]


def _fields(surface: HandSurface) -> tuple[Tensor, Tensor, Tensor]:
    return surface.frame_index, surface.centres_m, surface.axes_m


def ratios(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """How many times faster each back end is than each baseline, medians at the same particles."""
    medians = {
        (row.method, row.particles): row.median_ms for row in rows if row.table == "particles"
    }
    found: dict[str, dict[str, float]] = {}
    for (method, n), median in medians.items():
        for baseline in BASELINES:
            if method not in BASELINES and (baseline, n) in medians:
                found.setdefault(f"{method}, N = {n}", {})[baseline] = medians[baseline, n] / median
    return found


def run(
    particles: Sequence[int] = PARTICLES,
    compute: str = "cpu",
    seconds: float = 1.0,
    frames: bool = False,
    baselines: bool = True,
) -> dict[str, object]:
    """Measure everything; returns what --json writes.

    Raises ToftrackError where there is no such device or a back end disagrees with the reference.
    """
    if compute not in ("cpu", "cuda"):
        raise ToftrackError(f"--compute {compute} is unknown; give cpu or cuda")
    if compute == "cuda" and not torch.cuda.is_available():
        raise ToftrackError("there is no CUDA device here; give --compute cpu")
    device = torch.device(compute)
    benchmark = Benchmark(device, seconds, baselines)
    rows = benchmark.by_particles(particles)
    memory = peak_memory_gb()
    whole: list[FrameRow] = []
    if frames:
        try:
            # On the CPU so many as the table's take seconds; there the configuration's say enough.
            numbers = particles if device.type == "cuda" else ()
            whole = frame_times(seconds, device, particles=numbers)
        except ToftrackError as error:
            benchmark.notes.append(str(error))
    few = min(_SLOW_PARTICLES, max(particles))
    rows += benchmark.kinematics(few)
    rows += benchmark.by_pixels(few)
    rows += benchmark.by_ellipsoids(few)
    return {
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "torch": torch.__version__,
            "device": torch.cuda.get_device_name() if compute == "cuda" else "cpu",
        },
        "image": list(benchmark.evidence.hand.shape),
        "radius_px": benchmark.evidence.radius_px,
        "rows": [asdict(row) for row in rows],
        "ratios": ratios(rows),
        "largest_difference_px": benchmark.disagreement_px,
        "peak_memory_gb": memory,
        "frames": [asdict(row) for row in whole],
        "decoding": [asdict(row) for row in decode_times(device=device)],
        "notes": benchmark.notes,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="toftrack benchmark", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    parser.add_argument("--particles", type=int, nargs="+", default=list(PARTICLES), metavar="N")
    parser.add_argument("--compute", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--seconds", type=float, default=1.0, help="how long to time each method (1)"
    )
    parser.add_argument("--frames", action="store_true", help="time whole frames, too")
    parser.add_argument("--no-baselines", action="store_true", help="leave the slow methods out")
    options = parser.parse_args(arguments)
    if min(options.particles) < 1:
        parser.error("--particles must be above 0")
    try:
        result = run(
            options.particles,
            options.compute,
            options.seconds,
            options.frames,
            not options.no_baselines,
        )
    except ToftrackError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(show(result))
    if options.json:
        write_whole(options.json, json.dumps(result, indent=1) + "\n")
    return 0
