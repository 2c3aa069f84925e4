"""Finish the files of a run or a recording that was killed: `toftrack recover RUN|FILE.npz`.

Makes track.npz and summary.json anew from run.json and track.jsonl, which are whole up to the last
frame that was done. The metrics need the recording that was tracked. A track.npz that has more
frames than that is kept, unless --replace is given. For a recording, makes FILE.npz from the frames
in FILE.npz.part.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from toftrack.errors import ToftrackError
from toftrack.files.json_text import read_object
from toftrack.files.safe_files import check_replaceable, remove_partial
from toftrack.frames.frame import Truth
from toftrack.output.files import LINES, WHOLE_FILES, cut_unfinished_line, locked_lines
from toftrack.output.results import count_frames, finish, read_results, read_run_facts, records_of
from toftrack.output.run_folder import found_again, open_tracked
from toftrack.output.summary import metrics_table
from toftrack.programs.command_line import note, plain_parser
from toftrack.recordings.store import open_source
from toftrack.recordings.unfinished import is_recording, recover_recording
from toftrack.views.overlay import VIDEO
from toftrack.views.video import cut_to_whole

_MADE = ("track.npz", "summary.json")


def main(arguments: Sequence[str]) -> None:
    """Parse the command line, write the files, print the table. Raises ToftrackError."""
    parser = plain_parser("toftrack recover", __doc__)
    about = "the output folder of toftrack track, or a recording"
    parser.add_argument("run", metavar="RUN|FILE", help=about)
    parser.add_argument("--recording", metavar="FILE", help="where the recording is now")
    about = "replace an existing FILE.npz, or a track.npz that has more frames"
    parser.add_argument("--replace", action="store_true", help=about)
    options = parser.parse_args(arguments)
    folder = Path(options.run).expanduser()
    if is_recording(folder):
        path, frames = recover_recording(folder, options.replace)
        print(f"{path}: {frames} frames")
        return
    print(metrics_table(recover(folder, options.recording, options.replace)))
    for name in _MADE:
        print(f"  {folder / name}")


def recover(
    folder: Path, recording: str | Path | None = None, replace: bool = False
) -> dict[str, Any]:
    """Write track.npz and summary.json of a run's folder; returns the summary.

    recording: where the recording is now, when it is not where it was.  replace: also a track.npz
    that cannot be read, or that has more frames than will be made.

    Raises ToftrackError: the folder is no run's, the run still goes on, less would be made than
    there is, or nothing can be written.
    """
    facts = read_run_facts(folder)
    try:
        with locked_lines(folder), closing(records_of(folder, facts)) as records:
            for name in _MADE:
                check_replaceable(folder / name)
            earlier = read_object(folder / "summary.json")  # of the run itself
            if not replace:
                _check_not_less(folder, count_frames(records))
            if records.count:
                cut_unfinished_line(folder)
            with suppress(FileNotFoundError):
                cut_to_whole(folder / VIDEO)
            remove_partial(folder, WHOLE_FILES)
            truth = _truth(facts, recording)
            whole = earlier.get("frames") == count_frames(records)
            complete = whole and earlier.get("complete") is True
            return finish(folder, facts, truth, records, complete, earlier.get("realtime"))
    except FileNotFoundError:
        raise ToftrackError(f"'{folder}' has no {LINES}, so there is nothing to recover") from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ToftrackError(
            f"'{folder / 'run.json'}' is damaged ({' '.join(repr(error).split())}); put that of "
            "another run with the same settings in its place, or track again"
        ) from error
    except OSError as error:
        raise ToftrackError(
            f"'{error.filename or folder}' cannot be read or written ({error.strerror or error}); "
            "make room, or copy the folder to where it can be written"
        ) from error


def _check_not_less(folder: Path, frames: int) -> None:
    """ToftrackError where there is a track.npz that has more frames, or that cannot be read."""
    path, there = folder / "track.npz", 0
    hint = "nothing was changed; with --replace it is made anew from the lines"
    try:
        if path.exists():
            there = len(read_results(path)["lost"])
    except ToftrackError:
        what = (
            f"there is a '{path}' that is damaged or not a run's, and {LINES} has {frames} frames"
        )
        raise ToftrackError(f"{what}; {hint}") from None
    if there > frames:
        raise ToftrackError(f"'{path}' has {there} frames, but {LINES} only {frames}; {hint}")


def _truth(facts: dict[str, Any], recording: str | Path | None) -> Truth | None:
    """Of the run's frames, by their numbers; None where it had none or it cannot be found."""
    if not facts.get("truth"):
        return None
    metadata, ran_in = facts["metadata"], facts.get("working_folder")
    device = (metadata.get("config") or {}).get("device") or {}
    source = (device.get("emulated") or {}).get("source") if recording is None else None
    if source is not None:  # an emulated camera sees a recording, too
        return open_source(source if source == "sample" else str(found_again(source, ran_in))).truth
    why = "it is not known where the truth is"
    try:
        opened = open_tracked(metadata, ran_in, recording)
        if opened is not None and opened[0].truth is not None:
            return opened[0].truth
    except ToftrackError as error:
        if recording is not None:
            raise
        why = str(error)
    note(f"no metrics, because {why}")
    return None
