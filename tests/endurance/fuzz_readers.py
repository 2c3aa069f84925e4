"""Fuzz of every reader, guided by coverage: what is no valid file is refused with one sentence.

    pip install '.[endurance]'
    python tests/endurance/fuzz_readers.py --minutes 20

Begins with valid files of every kind (helpers/readers.py) and changes them: bytes, members and
headers of archives, values in JSON. Prints a table: reader, inputs tried, refused with a sentence,
read, crashes. A crash is any other exception, a refusal of more than one line, the end of the
process, more than 5 s of computing or more than 1 GB more memory. What crashed stays in --findings.
Status 1 when something did.

Atheris (libFuzzer) chooses the inputs. It runs in a process of its own, which is started again
when one kills it.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

MOST_S, MOST_BYTES = 5.0, 2**30
_KINDS = ("tried", "refused", "read", "crashes")
_MOST_INPUT_BYTES = 400_000
_INSTRUMENTED = (
    "toftrack.archives",
    "toftrack.camera",
    "toftrack.gestures.files",
    "toftrack.hand.shape",
    "toftrack.json_text",
    "toftrack.output.lines",
    "toftrack.output.records",
    "toftrack.output.results",
    "toftrack.output.run_folder",
    "toftrack.pose_space.data",
    "toftrack.pose_space.files",
    "toftrack.recordings",
    "toftrack.detector.weights",
    "rosbags",
)
"""Where libFuzzer sees what an input reaches."""


class Tally:
    """How often what happened, by reader; kept in a file, as the process may die."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "tally.json"
        self.counts: dict[str, dict[str, int]] = {}
        self.findings: dict[str, str] = {}
        """What crashed, by reader, exception and place: the input that did it first."""
        if self.file.exists():
            content = json.loads(self.file.read_text())
            self.counts, self.findings = content["counts"], content["findings"]

    def count(self, reader: str, *kinds: str) -> None:
        row = self.counts.setdefault(reader, dict.fromkeys(_KINDS, 0))
        for kind in kinds:
            row[kind] += 1

    def found(self, folder: Path, reader: str, what: str, content: bytes) -> None:
        self.count(reader, "crashes")
        key = f"{reader}: {what}"
        if key not in self.findings:
            name = f"{''.join(c if c.isalnum() else '_' for c in reader)}-{zlib.crc32(content):08x}"
            (folder / name).write_bytes(content)
            self.findings[key] = name
        self.save()

    def save(self) -> None:
        self.file.write_text(json.dumps({"counts": self.counts, "findings": self.findings}))

    def table(self) -> str:
        rows = [("reader", *_KINDS)]
        rows += [(name, *(str(row[k]) for k in _KINDS)) for name, row in self.counts.items()]
        total = [sum(row[kind] for row in self.counts.values()) for kind in _KINDS]
        rows.append(("all", *map(str, total)))
        lines = [f"{row[0]:28s}" + "".join(f"{cell:>10s}" for cell in row[1:]) for row in rows]
        return "\n".join([*lines, "", *(f"{k}  ({v})" for k, v in self.findings.items())])


def mutated_archive(random: np.random.Generator, content: bytes) -> bytes:
    """An `.npz` of which a member is missing, renamed, doubled, another array or damaged."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    at = int(random.integers(len(members)))
    name, data = members[at]
    choice = random.integers(6)
    if choice == 0:
        del members[at]
    elif choice == 1:
        members.append((members[int(random.integers(len(members)))][0], data))
    elif choice == 2:
        members[at] = (name, _odd_array(random, data))
    elif choice == 3:
        members[at] = (name, _odd_header(random, data))
    elif choice == 4:
        members[at] = (name, _odd_numbers(random, data))
    else:
        members[at] = (name, _odd_bytes(random, data))
    target = io.BytesIO()
    ways = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2)
    with warnings.catch_warnings(), zipfile.ZipFile(target, "w", ways[random.integers(3)]) as out:
        warnings.simplefilter("ignore")  # a name twice is meant
        for name, data in members:
            out.writestr(name, data)
    return target.getvalue()


def _saved(array: np.ndarray) -> bytes:
    target = io.BytesIO()
    np.save(target, array, allow_pickle=False)
    return target.getvalue()


def _odd_array(random: np.random.Generator, data: bytes) -> bytes:
    """Another array: of a random type and of the same or a random shape; or other JSON."""
    from helpers.readers import odd_json

    try:
        old = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception:  # damaged before
        old = np.zeros(3)
    if old.dtype.kind == "U" and old.ndim == 0 and random.random() < 0.8:
        try:
            return _saved(np.array(odd_json(random, old.item().encode()).decode()))
        except ValueError:
            pass
    shape = old.shape
    if random.random() < 0.6:
        shape = tuple(int(n) for n in random.integers(0, 5, random.integers(0, 5)))
    kinds = "? i1 u1 i2 u4 i8 u8 f2 f4 f8 >f4 >u2 c8 c16 U0 U3 S4 M8[s] m8[s] V3 f4,i2".split()
    kind = np.dtype(kinds[random.integers(len(kinds))])
    if kind.kind in "US":
        return _saved(np.full(shape, "ab", kind))
    size = int(np.prod(shape)) * kind.itemsize
    return _saved(np.frombuffer(random.bytes(size), kind).reshape(shape))


def _odd_header(random: np.random.Generator, data: bytes) -> bytes:
    """Other words in the array's header, of the same length."""
    words = [
        b"(",
        b")",
        b"'",
        b"{",
        b"}",
        b",",
        b"L",
        b"-1",
        b"True",
        b"'|O'",
        b"9e9",
        b"\\",
        b"\0",
    ]
    end = max(12, data.find(b"\n", 0, 200))
    place = int(random.integers(6, end))
    word = words[random.integers(len(words))]
    return data[:place] + word + data[place + len(word) :]


def _odd_numbers(random: np.random.Generator, data: bytes) -> bytes:
    """Some numbers are NaN, infinite, negative or huge."""
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False).copy()
    except Exception:  # damaged before
        return data
    if array.dtype.kind not in "fiu" or not array.size:
        return data
    odd = (np.nan, np.inf, -np.inf, 0, -1, 1e30, -1e30, 1e-30, 2**31, 255)
    with np.errstate(all="ignore"):
        value = np.array(odd[random.integers(len(odd))]).astype(array.dtype)
    rows = random.random(array.shape) < random.choice([0.01, 0.3, 1])
    return _saved(np.where(rows, value, array))


def _odd_bytes(random: np.random.Generator, data: bytes) -> bytes:
    """Some bytes are others, or a piece is missing."""
    broken = bytearray(data)
    if len(broken) > 1 and random.random() < 0.3:
        begin, end = sorted(int(n) for n in random.integers(0, len(broken), 2))
        del broken[begin:end]
    for _ in range(int(random.integers(1, 6)) if broken else 0):
        reach = len(broken) if random.random() < 0.5 else min(len(broken), 256)
        broken[random.integers(reach)] = random.choice([0, 1, 127, 128, 255, random.integers(256)])
    return bytes(broken)


def mutated(random: np.random.Generator, suffix: str, content: bytes, plain: Any) -> bytes:
    """A changed file. plain: libFuzzer's own way, which knows nothing of the format."""
    from helpers.readers import odd_json

    if random.random() < 0.6:
        try:
            if suffix == ".npz":
                return mutated_archive(random, content)
            if suffix == ".json":
                return odd_json(random, content)
            if suffix == ".jsonl":
                lines = content.splitlines(keepends=True)
                at = int(random.integers(len(lines)))
                lines[at] = odd_json(random, lines[at]) + b"\n"
                return b"".join(lines)
        except Exception:  # too damaged already for anything but bytes
            pass
        if suffix == ".npy":
            return (
                _odd_array(random, content)
                if random.random() < 0.5
                else _odd_header(random, content)
            )
    if random.random() < 0.3:
        return _odd_bytes(random, content)
    return plain(content, len(content) + 64)


class Guard:
    """Computing time and memory of an input."""

    def __init__(self) -> None:
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        self._began_s, self._had = time.process_time(), self._peak()

    def complaint(self) -> str | None:
        """What was too much, if anything was."""
        took_s, more = time.process_time() - self._began_s, self._peak() - self._had
        if took_s > MOST_S:
            return f"took {took_s:.0f} s"
        return f"took {more / 1e9:.1f} GB" if more > MOST_BYTES else None

    @staticmethod
    def _peak() -> int:
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.split("VmHWM:")[1].split()[0])


def place(error: BaseException) -> str:
    """An exception's type, and the innermost lines of it, toftrack's and another's."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "toftrack" in frame.filename.split("tests")[-1]]
    last = {f"{Path(f.filename).name}:{f.lineno}" for f in (frames[-1], *ours[-1:])}
    return f"{type(error).__name__} in {', '.join(sorted(last))}: {str(error)[:80]!r}"


def others() -> list[str]:
    """The modules of toftrack that are not to be instrumented: numba cannot compile what is."""
    root = Path(__file__).parents[2]
    files = [file.relative_to(root).with_suffix("") for file in root.glob("toftrack/**/*.py")]
    names = [".".join(file.parts).removesuffix(".__init__") for file in files]
    return [
        name
        for name in names
        if not any(name == kept or name.startswith(f"{kept}.") for kept in _INSTRUMENTED)
    ]


def work(folder: Path, until: float, seed: int) -> None:
    """The process that reads: does not return."""
    import atheris

    sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]
    with atheris.instrument_imports(["toftrack", "rosbags"], others(), False):
        from helpers.readers import write_readers

        import toftrack.output.run_folder  # noqa: F401
        from toftrack.errors import ToftrackError

    readers = write_readers(Path(tempfile.mkdtemp(dir=folder)))
    tally = Tally(folder)
    seeds = folder / "corpus"
    if not seeds.exists():
        seeds.mkdir()
        for number, reader in enumerate(readers):
            (seeds / f"valid{number}").write_bytes(bytes([number]) + reader.file.read_bytes())
    valid = [reader.file.read_bytes() for reader in readers]
    current = folder / "current"
    saved_s = time.monotonic()

    def one_input(data: bytes) -> None:
        nonlocal saved_s
        if time.time() > until:
            tally.save()
            os._exit(0)
        if not data:
            return
        number = data[0] % len(readers)
        reader, content = readers[number], data[1:]
        current.write_bytes(data)
        reader.file.write_bytes(content)
        guard = Guard()
        try:
            reader.read(reader.given)
            outcome = "read"
        except ToftrackError as error:
            outcome = "refused"
            if "\n" in str(error) or not str(error):
                tally.found(folder, reader.name, f"a refusal of several lines: {error}", content)
        except BaseException as error:
            outcome = "crashed"
            tally.found(folder, reader.name, place(error), content)
        if complaint := guard.complaint():
            tally.found(folder, reader.name, complaint, content)
        tally.count(reader.name, "tried", *(k for k in _KINDS if k == outcome))
        reader.file.write_bytes(valid[number])
        if time.monotonic() > saved_s + 10:
            tally.save()
            saved_s = time.monotonic()

    def mutator(data: bytes, most: int, seed: int) -> bytes:
        random = np.random.default_rng(seed)
        # Every reader has its turn, also those whose inputs reach nothing new any more.
        number = data[0] % len(readers) if data else 0
        content = data[1:]
        if random.random() < 0.5:
            number = int(random.integers(len(readers)))
            content = valid[number]
        for _ in range(int(random.integers(1, 4))):
            content = mutated(random, readers[number].file.suffix, content, atheris.Mutate)
        return bytes([number]) + content[: most - 1]

    options = (
        f"-max_len={_MOST_INPUT_BYTES}",
        "-rss_limit_mb=6000",
        "-timeout=60",
        "-len_control=0",
        "-verbosity=0",
        f"-seed={seed}",
        f"-artifact_prefix={folder}/killed-",
        str(seeds),
    )
    atheris.Setup([sys.argv[0], *options], one_input, custom_mutator=mutator)
    atheris.Fuzz()


def main() -> int:
    arguments = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    arguments.add_argument("--minutes", type=float, default=20.0)
    arguments.add_argument("--findings", type=Path, help="a folder; by default a new one")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--until", type=float, help=argparse.SUPPRESS)
    given = arguments.parse_args()
    folder: Path = given.findings or Path(tempfile.mkdtemp(prefix="fuzz-"))
    if given.until is not None:
        work(folder, given.until, given.seed)
    folder.mkdir(parents=True, exist_ok=True)
    until = time.time() + 60 * given.minutes
    seed = given.seed
    while time.time() < until:
        command = [sys.executable, __file__, "--findings", str(folder), "--until", str(until)]
        with open(folder / "log", "ab") as log:
            ended = subprocess.run(
                [*command, "--seed", str(seed)], check=False, stdout=log, stderr=log
            )
        if ended.returncode == 0:
            break
        current = folder / "current"
        if not current.exists():
            print((folder / "log").read_text()[-2000:], file=sys.stderr)
            return 1
        what = f"the process ended with {ended.returncode}"
        Tally(folder).found(folder, f"reader {current.read_bytes()[0]}", what, current.read_bytes())
        seed += 1
    tally = Tally(folder)
    print(f"{tally.table()}\nfindings: {folder}")
    return 1 if tally.findings else 0


if __name__ == "__main__":
    sys.exit(main())
