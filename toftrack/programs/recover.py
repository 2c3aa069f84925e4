"""Finish the files of a run or a recording that was killed: `toftrack recover RUN|FILE.npz`.

Makes track.npz and summary.json anew from run.json and track.jsonl, which are whole up to the last
frame that was done. The metrics need the recording that was tracked. Of a recording, makes FILE.npz
of the frames in FILE.npz.part.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from toftrack.errors import ToftrackError
from toftrack.frames import Truth
from toftrack.output.evaluation import metrics_table
from toftrack.output.files import LINES, LineFile
from toftrack.output.results import finish, read_run_facts, records_of
from toftrack.output.run_folder import found_again, open_tracked
from toftrack.recordings.store import open_source
from toftrack.recordings.unfinished import is_recording, recover_recording
from toftrack.views.overlay import VIDEO
from toftrack.views.video import cut_to_whole


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line, write the files, print the table. Raises ToftrackError."""
    parser = argparse.ArgumentParser(
        prog="toftrack recover",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "run", metavar="RUN|FILE", help="the output folder of toftrack track, or a recording"
    )
    parser.add_argument("--recording", metavar="FILE", help="where the recording is now")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE.npz")
    options = parser.parse_args(arguments)
    folder = Path(options.run).expanduser()
    if is_recording(folder):
        path, frames = recover_recording(folder, options.overwrite)
        print(f"{path}: {frames} frames")
        return
    print(metrics_table(recover(folder, options.recording)))
    for name in ("track.npz", "summary.json"):
        print(f"  {folder / name}")


def recover(folder: Path, recording: str | Path | None = None) -> dict[str, Any]:
    """Write track.npz and summary.json of a run's folder; returns the summary.

    recording: where the recording is now, when it is not where it was.

    Raises ToftrackError: the folder is no run's, the run still goes on, or nothing can be written.
    """
    facts = read_run_facts(folder)
    if not (folder / LINES).is_file():
        raise ToftrackError(f"'{folder}' has no {LINES}, so there is nothing to recover")
    try:
        lines = LineFile(folder, keep=True)
        try:
            if (folder / VIDEO).is_file():
                cut_to_whole(folder / VIDEO)
            truth = _truth(facts, recording)
            with records_of(folder, facts) as records:
                return finish(folder, facts, truth, records)
        finally:
            lines.close()
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ToftrackError(
            f"'{folder / 'run.json'}' is damaged ({' '.join(repr(error).split())}); put that of "
            "another run with the same settings in its place, or track again"
        ) from error
    except OSError as error:
        raise ToftrackError(
            f"'{folder}' cannot be read or written ({error.strerror or error}); make room, or copy "
            "it to where it can be written"
        ) from error


def _truth(facts: dict[str, Any], recording: str | Path | None) -> Truth | None:
    """Of the run's frames, by their numbers; None where it had none or it cannot be found."""
    if not facts.get("truth"):
        return None
    metadata = facts["metadata"]
    about = metadata.get("device") or {}
    device = (metadata.get("config") or {}).get("device") or {}

    def found(path: str | Path) -> Path:
        return found_again(path, facts.get("working_folder"))

    source = (device.get("emulated") or {}).get("source") if recording is None else None
    if source is not None:  # an emulated camera sees a recording, too
        return open_source(source if source == "sample" else str(found(source))).truth
    try:
        opened = open_tracked(about, device, found, recording)
    except ToftrackError as error:
        if recording is not None:
            raise
        print(f"note: no metrics, because {error}", file=sys.stderr)
        return None
    if opened is None or opened[0].truth is None:
        print("note: no metrics, because it is not known where the truth is", file=sys.stderr)
        return None
    return opened[0].truth
