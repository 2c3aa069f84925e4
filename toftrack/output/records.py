"""A run's frames as records on the disk: they become track.npz with little memory, and at once.

While a run goes on, each frame is kept in a nameless file of records of one size, beside its line
in track.jsonl; those of a run that was killed are made of its lines, which takes 0.7 ms a line. At
the end each field's column is copied from there into the archive, piece by piece. Some 25 bytes a
frame are held meanwhile.

With several slots every field that speaks of a hand, not of the frame, has an axis of slots behind
that of the frames. A slot without a hand is lost, its numbers are NaN, its texts empty.
"""

from __future__ import annotations

import itertools
import math
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from tqdm import tqdm

from toftrack.errors import ToftrackError
from toftrack.files.archives import Pieces, write_archive
from toftrack.files.safe_files import open_to_read
from toftrack.frames.estimate import Estimate, is_vacant, no_estimate
from toftrack.hand.openxr import OPENXR_JOINT_NAMES, OPENXR_PARENTS
from toftrack.hand.skeleton import ANGLE_NAMES, JOINT_PARENTS
from toftrack.output.lines import FRAME_FIELDS, HAND_FIELDS, KINDS, damaged, read_lines

_PIECE = 256
"""Records that are in memory at a time; a line's numbers take some 10 kB as Python objects."""
_LEVEL = 1
"""Of the compression: a third faster than the usual one, and as small, as most digits are noise."""
_SOON_S = 2.0


class Records:
    """The frames of a run, until `close`; each field is a column.

    They are kept in the folder, under no name. latent_size: of the pose space.  slots: of each
    frame; of several, a line has `hands`.

    Raises OSError (by `append`, too) when the records cannot be kept there.
    """

    def __init__(self, folder: Path, latent_size: int, slots: int) -> None:
        self.slots, self.count = slots, 0
        self._words: dict[str, int] = {}
        unknown = dict.fromkeys(("score", "confidence", "effective_sample_size"), math.nan)
        vacant = no_estimate(0, 0, "", latent_size, 0).updated(**unknown).values()
        self._vacant = {name: vacant[name] for name in HAND_FIELDS}
        of_slots = (slots,) if slots > 1 else ()
        axes = {name: of_slots if name in HAND_FIELDS else () for name in KINDS}
        self._kind = np.dtype(  # texts are numbers of words
            [
                (name, np.int32 if kind is np.str_ else kind, axes[name] + np.shape(vacant[name]))
                for name, kind in KINDS.items()
            ]
        )
        self._file: IO[bytes] = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115

    @classmethod
    def of_lines(cls, lines: Path, latent_size: int, slots: int) -> Records:
        """The records of a track.jsonl, which is read at once.

        Raises ToftrackError for a damaged line, OSError when the lines cannot be read.
        """
        with open_to_read(lines) as stream:
            count = sum(1 for _ in stream)
        records, last = cls(lines.parent, latent_size, slots), 0
        try:
            read = read_lines(lines)
            with _bar("reading the lines", count) as bar:
                while piece := list(itertools.islice(read, _PIECE)):
                    last += len(piece)
                    records._keep(piece)
                    bar.update(len(piece))
        except BaseException as error:
            records.close()
            if isinstance(error, KeyError) and error.args[0] in KINDS:
                raise ToftrackError(
                    f"'{lines}' is of another toftrack: its lines have no '{error.args[0]}'; use "
                    "the version that run.json names as 'toftrack'"
                ) from None
            if isinstance(error, (ArithmeticError, LookupError, TypeError, ValueError)):
                raise damaged(lines, last, f"it or one shortly before: {error!r}") from None
            raise
        return records

    def append(self, estimates: Sequence[Estimate]) -> None:
        """Keep a frame, of which there is an estimate for each slot."""
        line = estimates[0].values()
        if self.slots > 1:
            there = [pair for pair in enumerate(estimates) if not is_vacant(pair[1])]
            line["hands"] = [{"slot": slot} | estimate.values() for slot, estimate in there]
        self._keep([line])

    def close(self) -> None:
        """The records are gone; a second call does nothing."""
        self._file.close()

    def column(self, name: str, rows: np.ndarray | None = None) -> np.ndarray:
        """A whole column, or its rows (not decreasing); texts as texts."""
        rows = np.arange(self.count) if rows is None else rows
        nothing = np.zeros((0, *self.shape(name)), self.kind(name))
        return np.concatenate((nothing, *self.pieces(name, rows)))

    def pieces(self, name: str, rows: np.ndarray) -> Iterator[np.ndarray]:
        """Some rows (not decreasing) of a column, in pieces."""
        kind = self.kind(name)
        words = np.array(list(self._words), kind) if kind.kind == "U" else None
        for begin in range(0, len(rows), _PIECE):
            some = rows[begin : begin + _PIECE]
            values = self._read(int(some[0]), int(some[-1]) + 1)[name][some - some[0]]
            yield values.astype(kind) if words is None else words[values]

    def kind(self, name: str) -> np.dtype:
        """Of a column's values."""
        if KINDS[name] is not np.str_:
            return self._kind[name].base
        # Of all texts, since a longer one costs nothing once the archive is compressed.
        return np.dtype(f"<U{max(map(len, self._words), default=1) or 1}")

    def shape(self, name: str) -> tuple[int, ...]:
        """Of one frame's values."""
        return self._kind[name].shape

    def _read(self, begin: int, end: int) -> np.ndarray:
        self._file.seek(begin * self._kind.itemsize)  # which also writes what waits
        return np.frombuffer(self._file.read((end - begin) * self._kind.itemsize), self._kind)

    def _keep(self, lines: Sequence[Mapping[str, Any]]) -> None:
        """Append lines; their numbers are in lists or in arrays."""
        if self.slots > 1:
            lines = [self._side_by_side(line) for line in lines]
        records = np.zeros(len(lines), self._kind)
        for name in KINDS:
            values = [line[name] for line in lines]
            if KINDS[name] is np.str_:
                values = [self._number(word) for word in values]
            with np.errstate(over="ignore"):  # what float32 cannot say is infinite
                array = np.array(values, self._kind[name].base)
            if array.dtype.kind == "f":
                array[np.isinf(array)] = np.nan  # as in the lines
            if array.shape != records[name].shape:
                raise ValueError(f"{name!r} has the shape {array.shape[1:]}")
            records[name] = array
        self._file.write(records.tobytes())
        self.count += len(lines)

    def _number(self, words: Any) -> Any:
        """Of a word, or of those in a list."""
        if isinstance(words, list):
            return [self._number(word) for word in words]
        return self._words.setdefault(str(words), len(self._words))

    def _side_by_side(self, line: Mapping[str, Any]) -> dict[str, Any]:
        """A line of several hands whose fields are lists with a value for each slot."""
        slots = [self._vacant] * self.slots
        for hand in line["hands"]:
            slots[hand["slot"]] = hand
        frame = {name: line[name] for name in FRAME_FIELDS if name in KINDS}
        return frame | {name: [hand[name] for hand in slots] for name in self._vacant}


def write_results(
    path: Path, records: Records, rows: np.ndarray, arrays: dict[str, np.ndarray]
) -> None:
    """Write the `.npz` of some rows of all columns. Raises OSError.

    rows: not decreasing.  arrays: in place of columns of these names, or besides.
    """
    names = [name for name in KINDS if name not in arrays]
    with _bar("writing the results", len(rows)) as bar:

        def pieces(name: str) -> Iterator[np.ndarray]:
            for piece in records.pieces(name, rows):
                yield piece
                bar.update(len(piece) / len(names))

        columns = {
            name: Pieces((len(rows), *records.shape(name)), records.kind(name), pieces(name))
            for name in names
        }
        write_archive(path, columns | arrays, _LEVEL)


def _bar(words: str, frames: int) -> tqdm:
    """Of what may take long; not seen before it took two seconds."""
    shape = "{desc}: {percentage:3.0f}%|{bar}| {total_fmt} frames"
    return tqdm(
        desc=words,
        total=frames,
        delay=_SOON_S,
        leave=False,
        bar_format=shape,
        file=sys.stderr,
        disable=None,
    )


_README = """Hands that toftrack followed, a row for each frame of the input. Metres, seconds and
radians. Camera axes: x right, y down, z forward; pixel centres lie at whole numbers, so that
u = K[0,0] x/z + K[0,2], v = K[1,1] y/z + K[1,2] in the undistorted image of image_size_px (width,
height). joint_names, joint_parents: of joints_m and landmarks, in MediaPipe's order;
angle_names: of the 21 joint angles, radians, flexion positive, which are state[..., 6:];
openxr_joint_names, openxr_joint_parents: of openxr_*, whose axes are x right, y up, -z forward. The
parent of a root is -1. Do not use rows with lost, nor joints without joint_ok; NaN is unknown.
metadata is JSON."""


def facts_for_readers(metadata: dict[str, Any]) -> dict[str, np.ndarray]:
    """Arrays beside those of the frames: skeletons, a text that explains them, and the camera where
    the run's metadata tell it.
    """
    facts = {
        "readme": np.array(_README),
        "angle_names": np.array(ANGLE_NAMES),
        "joint_parents": np.array(JOINT_PARENTS),
        "openxr_joint_names": np.array(OPENXR_JOINT_NAMES),
        "openxr_joint_parents": np.array(OPENXR_PARENTS),
    }
    camera = metadata.get("camera") or {}
    if camera.get("K"):
        facts["K"] = np.array(camera["K"], np.float64)
        facts["image_size_px"] = np.array([camera["width"], camera["height"]])
    return facts
