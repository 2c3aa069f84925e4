"""The command line: one clear sentence for every error, and sweeps that carry on."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import programs
from helpers.programs import hangups_are_handled as hangups_are_handled
from helpers.tracking import CONF
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from toftrack.configuration.sentences import sentence
from toftrack.errors import ToftrackError
from toftrack.files.safe_files import leave_folder
from toftrack.output.files import own_folder
from toftrack.programs import command_line
from toftrack.programs.command_line import FailedJobs, run

pytestmark = pytest.mark.usefixtures("hangups_are_handled")


APP = """
import functools, pathlib, sys
import hydra
from hydra.utils import instantiate
from toftrack.programs.command_line import run, sweep_job
from toftrack.errors import ToftrackError

def tell(task):
    @functools.wraps(task)
    def telling(config):
        value = task(config)
        print("value", value)
        return value
    return telling

@hydra.main(version_base="1.3", config_path="conf", config_name="app")
@tell
@sweep_job
def main(config):
    if config.fail == "clear":
        raise ToftrackError("the reason, and what to do")
    if config.fail == "unexpected":
        raise ValueError("two\\nlines")
    if config.fail == "late":
        folder = pathlib.Path(hydra.core.hydra_config.HydraConfig.get().runtime.output_dir)
        (folder / "summary.json").write_text('{"frames": 3}')
        raise ToftrackError("after three frames")
    print("replayed", instantiate(config.device).frames)
    return 1.0

if __name__ == "__main__":
    sys.exit(run(main))
"""


def test_full_errors_show_the_traceback_and_the_sentence(monkeypatch, capsys) -> None:
    def main() -> None:
        raise ToftrackError("the reason")

    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    assert run(main) == 1
    err = capsys.readouterr().err
    assert "Traceback" in err and "in main" in err and err.endswith("\nerror: the reason\n")


@pytest.fixture
def app(tmp_path: Path) -> Path:
    folder = tmp_path / "app"
    (folder / "conf" / "device").mkdir(parents=True)
    (folder / "app.py").write_text(APP)
    (folder / "conf" / "app.yaml").write_text(
        'defaults: [_self_, {device: sample}]\nfail: ""\nseed: 1\n'
        "hydra: {callbacks: {failed_jobs: {_target_: toftrack.programs.command_line.FailedJobs}}}\n"
    )
    (folder / "conf" / "device" / "sample.yaml").write_text(
        "_target_: toftrack.devices.replay.Sample\n"
    )
    (folder / "conf" / "device" / "replay.yaml").write_text(
        "_target_: toftrack.devices.replay.Replay\npath: ???\n"
    )
    return folder


def call(app: Path, *arguments: str) -> tuple[int, str, str]:
    """Within this process."""
    return programs.call(*arguments, folder=app, program=str(app / "app.py"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fail=clear"], "error: the reason, and what to do"),
        (["fail=unexpected"], "app.py, line 23) (HYDRA_FULL_ERROR=1 shows the traceback)"),
        (["device=replay"], "device.path is missing; give it on the command line"),
        (["seed=[1"], "'seed=[1' cannot be read as a setting"),
        (["hydra.run.dir=app.py/out"], "'app.py/out' cannot be read or written"),
        (["+device.bogus=1"], "unexpected keyword argument 'bogus'"),
    ],
)
def test_an_error_is_one_sentence(app: Path, arguments: list[str], words: str) -> None:
    status, out, err = call(app, *arguments)
    assert status == 1
    assert words in err
    assert err.startswith("error: ")
    assert err.count("\n") == 1, "one line, and no traceback"
    assert "replayed" not in out


def test_a_failing_run_leaves_no_folder_but_keeps_one_with_files(app: Path) -> None:
    """Whoever gives a folder that there is finds it as it was."""
    (app / "mine").mkdir()
    (app / "mine" / "notes.txt").touch()
    before = set(app.rglob("*"))
    for words in (
        ("fail=clear",),
        ("fail=clear", "hydra.run.dir=deep/er"),
        ("-m", "nope=1,2"),
    ):
        assert call(app, *words)[0] == 1
        assert set(app.rglob("*")) == before, words
    assert call(app, "fail=clear", "hydra.run.dir=mine")[0] == 1
    assert (app / "mine" / "notes.txt").exists()
    assert call(app, "fail=late", "hydra.run.dir=late")[0] == 1
    assert (app / "late" / "summary.json").exists(), "what was written is kept"


def test_a_folder_into_which_a_run_is_writing_stays_as_it_is(app: Path) -> None:
    """Of two that begin at once into a new folder; the first one may not have written yet."""
    shared = app / "deep" / "shared"
    lock = own_folder(shared)
    status, out, err = call(app, "hydra.run.dir=deep/shared")
    assert (status, out) == (1, "") and err.startswith("error: another run is writing into")
    assert err.count("\n") == 1 and not list(shared.iterdir())
    leave_folder(lock)
    assert call(app, "fail=clear", "hydra.run.dir=deep/shared")[0] == 1, "and nobody has it still"
    assert call(app, "hydra.run.dir=deep/shared")[0] == 0 and (shared / ".hydra").exists()


def test_a_request_that_comes_with_the_end_of_the_terminal_gives_the_status(monkeypatch) -> None:
    """What is finished after it says something still, and fails."""
    reader, writer = os.pipe()
    os.close(reader)
    monkeypatch.setattr(sys, "stderr", os.fdopen(writer, "w"))

    def main() -> None:
        try:
            os.kill(os.getpid(), signal.SIGHUP)
        finally:
            print("100 frames", file=sys.stderr, flush=True)

    assert run(main) == 129
    monkeypatch.undo()
    assert run(lambda: 1 / 0) == 1, "and of the next one nothing was asked"


@pytest.mark.parametrize("words", [["hydra.run.dir="], ["-m", "seed=1", "hydra.sweep.dir="]])
def test_a_folder_without_a_name_is_not_the_current_one(app: Path, words: list[str]) -> None:
    before = set(app.rglob("*"))
    status, out, err = call(app, *words)
    assert (status, out) == (1, "") and "dir is empty; give a folder" in err
    assert set(app.rglob("*")) == before


def test_one_failing_job_does_not_stop_the_others(app: Path) -> None:
    arguments = ["-m", "hydra.sweep.dir=sweep", "fail=clear,late,unexpected,''"]
    status, out, err = call(app, *arguments)
    assert status == 1, "a sweep with failed jobs is not a success"
    assert "replayed 100" in out, "the last job ran"
    values = [line for line in out.splitlines() if line.startswith("value ")]
    assert values == ["value inf"] * 3 + ["value 1.0"], "a sweeper dies of NaN"
    assert "Traceback" not in err
    assert err.splitlines() == [
        "error: #0 fail=clear: the reason, and what to do",
        "error: #1 fail=late: after three frames",
        "error: #2 fail=unexpected: unexpected ValueError: two lines, in main"
        f" ({app / 'app.py'}, line 23) (HYDRA_FULL_ERROR=1 shows the traceback)",
        "error: 3 of the jobs failed, see above",
    ]

    def summary(number: int) -> dict[str, object]:
        return json.loads((app / "sweep" / str(number) / "summary.json").read_text())

    assert summary(0) == {"error": "the reason, and what to do"}
    assert summary(1) == {"frames": 3, "error": "after three frames"}
    assert not (app / "sweep" / "3" / "summary.json").exists()


def test_jobs_that_fail_in_other_processes_are_counted(tmp_path: Path, capsys) -> None:
    """As the launchers joblib, submitit and ray run them: their files alone tell of it."""
    config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}})

    def finish(number: int, **facts: object) -> None:
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "summary.json").write_text(json.dumps(facts))

    def main() -> None:
        jobs = FailedJobs()
        jobs.on_multirun_start(config)
        for number, facts in enumerate(({"error": "no"}, {"frames": 3}, {"error": "no"})):
            finish(number, **facts)
        jobs.on_multirun_end(config)

    finish(7, error="of an earlier sweep")
    assert run(main) == 1
    assert capsys.readouterr().err == "error: 2 of the jobs failed, see above\n"


def test_the_programs_count_jobs_that_failed_elsewhere() -> None:
    for name in ("config", "train_pose_space", "train_detector"):
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = compose(name, return_hydra_config=True)
        assert isinstance(instantiate(config.hydra.callbacks.failed_jobs), FailedJobs)


@pytest.mark.parametrize(("log", "files"), [("toftrack", 1), ("disabled", 0)])
def test_a_log_takes_any_folder_s_name_and_may_be_left_out(log, files, tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"\xff")
    logs = f"hydra/job_logging={log}", f"hydra/hydra_logging={log}"
    words = ("device.stop=1", "view=none", f"hydra.run.dir={folder}", *logs, *programs.QUICK)
    for _ in range(2):  # the second run logs which folder it replaces
        status, _, err = programs.call(*words, folder=tmp_path)
        assert status == 0 and "Logging error" not in err
    assert len(list(folder.glob("*.log"))) == files


def test_that_matplotlib_has_found_fonts_is_not_told(tmp_path: Path) -> None:
    words = ("-m", "toftrack", "train", "compare=[]", f"hydra.run.dir={tmp_path / 'run'}")
    done = programs.python(*words, MPLCONFIGDIR=str(tmp_path))  # as at a user's first picture
    assert done.returncode == 0 and "fontManager" not in done.stderr


def test_a_run_that_hydra_pickled_runs_again(tmp_path: Path) -> None:
    pickles = "+hydra.callbacks.p._target_=hydra.experimental.callbacks.PickleJobInfoCallback"
    words = ("device.stop=1", "view=none", "hydra.run.dir=run", pickles, *programs.QUICK)
    assert programs.call(*words, folder=tmp_path)[0] == 0
    again = ("--experimental-rerun", "run/.hydra/config.pickle")
    with pytest.warns(UserWarning, match="[Ee]xperimental"):
        assert programs.call(*again, folder=tmp_path)[0] == 0


def test_environment_is_as_before_after_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    assert run(lambda: None) == 0
    assert "HYDRA_FULL_ERROR" not in os.environ
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    assert run(lambda: None) == 0
    assert os.environ["HYDRA_FULL_ERROR"] == "0"


@pytest.mark.parametrize(("code", "status"), [(None, 0), (0, 0), (1, 1), (2, 1), ("text", 1)])
def test_exit_requests_keep_to_the_promised_statuses(
    code: object, status: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_line, "place_of", lambda _: "")  # as if Hydra's were asked for

    def main() -> None:
        raise SystemExit(code)

    assert run(main) == status


@pytest.mark.parametrize("words", ["--help", "train --help", "fit-confidence --help"])
def test_help_of_a_module_that_is_run_is_no_error(words: str) -> None:
    done = programs.python("-m", "toftrack.training", *words.split())
    assert done.returncode == 0 and "usage: python -m toftrack.training" in done.stdout


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_log_on_a_full_disk_ends_no_run(tmp_path: Path) -> None:
    words = "track view=none device.stop=2 experiment=paper hydra.run.dir=.".split()
    with open("/dev/full", "wb") as full:
        done = subprocess.run([sys.executable, "-m", "toftrack", *words], cwd=tmp_path, stderr=full)
    assert done.returncode == 0
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 2


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_run_whose_log_nobody_reads_on_keeps_its_results(unbuffered: str, tmp_path: Path) -> None:
    words = "track view=none device.stop=2 experiment=paper hydra.run.dir=."
    subprocess.run(
        f"{sys.executable} -m toftrack {words} 2>&1 | head -n 1",
        env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
        cwd=tmp_path,
        shell=True,
        check=True,
    )
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] in (0, 1, 2)


@pytest.mark.parametrize(("closed", "status"), [("0<&-", 0), ("2>&-", 0), ("1>&-", 1)])
def test_a_program_runs_with_closed_streams_but_streams_to_none(
    closed: str, status: int, tmp_path: Path
) -> None:
    stream = "stream=stdout" if status else "stream=none"
    words = f"{sys.executable} -m toftrack track {stream} view=none device.stop=2 experiment=paper"
    command = ["sh", "-c", f"{words} hydra.run.dir=run {closed}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stderr
    assert (len(done.stderr.splitlines()) > 0) == (closed != "2>&-")
    if status:
        assert "standard output cannot be used (it is closed)" in done.stderr
    else:
        assert json.loads((tmp_path / "run" / "summary.json").read_text())["frames"] == 2


def test_a_cause_deep_inside_is_what_is_reported() -> None:
    try:
        try:
            try:
                raise ToftrackError("the\n cause")
            except ToftrackError as error:
                raise RuntimeError("wrapped") from error
        except RuntimeError as error:
            raise TypeError("wrapped again") from error
    except TypeError as error:
        assert sentence(error) == "the cause"


@pytest.mark.parametrize(("system", "quote"), [("posix", "'"), ("nt", '"')])
def test_a_command_is_quoted_as_the_system_s_shells_read_it(system, quote, monkeypatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(command_line.os, "name", system)
        said = command_line.typed(["toftrack", "track", r"C:\a b\x.npz"])
    assert said == rf"toftrack track {quote}C:\a b\x.npz{quote}"
