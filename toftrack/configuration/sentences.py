"""Errors, those of Hydra too, as one sentence for the user."""

from __future__ import annotations

import difflib
import os
import re
import sys
import traceback
from collections.abc import Iterator, Sequence

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from toftrack.configuration import configuration_folder
from toftrack.configuration.plugins import ENTRY_POINTS, IMPORTABLE, installed
from toftrack.errors import ToftrackError

FULL_ERROR = "HYDRA_FULL_ERROR"
"""The environment variable that asks for tracebacks."""
_ALIKE, _MOST = 0.6, 12
"""How much of a name must be right, 0..1; so many names are listed at most."""
_MEANT = {"K": "intrinsics", "web": "browser"}
"""What other programs call a setting or a choice."""
_DEFAULTS_LIST = "hydra._internal.defaults_list"
"""Where Hydra looks up choices."""
_HYDRAS = ("joblib", "optuna", "ray")
"""Launchers and sweepers of Hydra that are extras of the package."""
_PAPERS_GROUP = "start"
"""A group that experiment=paper alone has."""
_OF_PAPER = "{0} belongs to experiment=paper; give experiment=paper as well, or leave {0} out"


def sentence(error: BaseException) -> str:
    """What went wrong, where, and what to do: one line for the user, without 'error:'."""
    chain = list(_chain(error))
    for cause in chain:
        if isinstance(cause, ToftrackError):
            return _one_line(str(cause))
    for cause in chain:
        if isinstance(cause, MissingMandatoryValue):
            missing = cause.full_key or str(cause).rpartition(" ")[2]
            return (
                f"the value of {missing} is missing; give it on the command line as {missing}=VALUE"
            )
        if (path := _read_by_hydra(cause)) and not isinstance(cause, HydraException):
            reason = _one_line(str(cause))
            return (
                f"'{path}' cannot be read as YAML ({reason}); mend it there, and save it as UTF-8"
            )
        # Some of Hydra's errors are OSErrors too, without being of the system.
        if isinstance(cause, OSError) and not isinstance(cause, HydraException):
            return _of_system(cause)
    if any(isinstance(cause, RecursionError) for cause in chain):
        return "a setting or a file is nested too deeply; remove what is not meant"
    if target := re.match(r"Error locating target '([^']+)'", str(error)):
        why = _one_line(str(chain[-1]))
        return f"the _target_ {target[1]} cannot be imported ({why}); {IMPORTABLE}"
    text = _one_line(str(error))
    if deleted := re.match(r"Key '([^']+)' is not in struct", text):
        return f"the configuration lacks {deleted[1]}; leave ~{deleted[1]} out"
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        reported = next((cause for cause in chain if str(cause).strip()), error)
        said = _of_config(reported) + place_of(chain[-1])
        return _of_override(chain) or said or type(error).__name__
    *_, (last, _) = [(None, 0), *traceback.walk_tb(error.__traceback__)]
    of_groups = last is not None and last.f_globals.get("__name__") == _DEFAULTS_LIST
    if of_groups or text.startswith("Config group override must be"):
        return (
            "a group takes the name of one of its choices, as likelihood=f_measure, not null, a "
            "number or a list; experiment=none means no experiment"
        )
    name = type(error).__name__ + (f": {text}" if text else "") + place_of(error)
    return f"unexpected {name} ({FULL_ERROR}=1 shows the traceback)"


def place_of(error: BaseException) -> str:
    """Where code of one's own raised it: class, file and line; "" where none did."""
    theirs = {e.module.split(".")[0] for name in ENTRY_POINTS for e in installed(name).values()}
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        code, spec = frame.f_code, frame.f_globals.get("__spec__")
        # Of `python -m` the spec alone says which module it is.
        root = str(getattr(spec, "name", frame.f_globals.get("__name__"))).partition(".")[0]
        ours = root == "toftrack" or root in sys.stdlib_module_names or code.co_filename[0] == "<"
        if root in theirs or not (ours or "-packages" in code.co_filename):
            return f", in {code.co_qualname} ({code.co_filename}, line {line})"
    return ""


def _read_by_hydra(error: BaseException) -> str | None:
    """The file of a configuration in the reading of which it was raised; None for others."""
    frames = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    found = (f.f_locals.get("full_path") for f in frames if f.f_code.co_name == "load_config")
    return next(filter(None, found), None)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """The error and its causes, the error first: Hydra wraps what a constructor raises."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        yield error
        seen.add(id(error))
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _of_system(error: OSError) -> str:
    reason = error.strerror or _one_line(str(error)) or type(error).__name__
    if place := place_of(error):  # as of a camera that is gone, or a file that it needs
        file = "" if error.filename is None else f"'{os.fsdecode(error.filename)}': "
        return f"{file}{reason}{place} ({FULL_ERROR}=1 shows the traceback)"
    if error.filename is None:
        return (
            f"{reason}; free what is needed, or send standard output, or the files of a run "
            "(hydra.run.dir=DIR), elsewhere"
        )
    return (
        f"'{os.fsdecode(error.filename)}' cannot be read or written ({reason}); check the path and "
        "its permissions, or choose another output folder with hydra.run.dir=DIR"
    )


def _of_config(error: BaseException) -> str:
    """Hydra's message without the lines that only its developers need, as one line."""
    message = ""
    for line in str(error).splitlines():
        text = line.strip()
        if text.startswith(("Config search path", "Set the environment", "See http")):
            break
        if not text or text.startswith(("object_type=", "reference_type=")):
            continue
        if text.startswith("full_key:"):
            message += f" (at {text.removeprefix('full_key:').strip()})"
        elif not message or message.endswith(":"):
            message += f" {text}"
        else:
            separator = "," if line.startswith("\t") else ";"  # the options of a list are indented
            message = f"{message.rstrip('.')}{separator} {text}"
    return _one_line(message)


def _nearest(word: str, names: Sequence[str]) -> str | None:
    """The name that is most like a word; None where none is."""
    return next(iter(difflib.get_close_matches(word, names, n=1, cutoff=_ALIKE)), None)


def _of_override(chain: Sequence[BaseException]) -> str | None:
    """For an override that means nothing; None for every other error."""
    for error in chain:
        if isinstance(error, OverrideParseException):
            return _of_syntax(error)
        if several := re.match("(?:Ambiguous|Sweep param)[^']*'(.*)'", str(error)):
            return _of_several(several[1])
        if isinstance(error, MissingConfigException) and error.missing_cfg_file:
            return _of_choice(error.missing_cfg_file, error.options or ())
    return _of_key(chain)


def _of_syntax(error: OverrideParseException) -> str:
    key, separator, value = error.override.partition("=")
    text = f"'{error.override}' cannot be read as a setting"
    if not separator:
        return f"{text}; settings are given as KEY=VALUE, as in hand.side=left"
    if key == "device.path":
        return f'{text}; give the recording by its name alone: toftrack track "{value}"'
    return (
        f"{text}; where a value has blanks, commas, brackets or other signs, put it in two pairs of"
        f""" quotes: "{key}='...'\""""
    )


def _of_several(override: str) -> str:
    key, _, value = override.partition("=")
    may_be_list = "(" not in value and not (configuration_folder() / key).is_dir()
    hint = f', or "{key}=[{value}]" where it takes a list,' if may_be_list else ""
    return f"{override} has several values; give one{hint} (toftrack track -m takes each in turn)"


def _of_choice(missing: str, options: Sequence[str]) -> str | None:
    group, _, word = missing.rpartition("/")
    if not group or not options:
        return None
    shortened = re.compile(".*".join(map(re.escape, word))).match  # kpca, of kernel_pca
    likely = next(filter(shortened, options), None) or _nearest(_MEANT.get(word, word), options)
    hint = f"did you mean {group}={likely}? The choices are" if likely else "give one of"
    extra = f' (or pip install "toftrack[{word}]")' if word in _HYDRAS else ""
    return f"there is no {group}={word}{extra}; {hint} {', '.join(options)}"


def _of_key(chain: Sequence[BaseException]) -> str | None:
    reported = re.match(r"Could not override '([^']+)'", str(chain[0]))
    if not reported:
        return None
    key = reported[1]
    for error in chain:
        parent = getattr(error, "parent_node", None)
        if isinstance(error, OmegaConfBaseException) and isinstance(parent, DictConfig):
            return _unknown_key(key, parent)
    if key != _PAPERS_GROUP and "No match in the defaults list" in str(chain[0]):
        return f"there is no {key} to choose here; leave it out, or see what --help lists"
    return _OF_PAPER.format(key) if key == _PAPERS_GROUP else None


def _unknown_key(key: str, parent: DictConfig) -> str:
    root = parent._get_root()
    assert isinstance(root, DictConfig)
    if key.partition(".")[0] == _PAPERS_GROUP and _PAPERS_GROUP not in root:
        return _OF_PAPER.format(key)
    known = OmegaConf.to_container(root)
    keys = [name for name in _keys(known) if not name.startswith("hydra.") or key[:5] == "hydra"]
    last = key.rpartition(".")[2]
    same = [name for name in keys if name.rpartition(".")[2] == last]
    meant = key.removesuffix(last) + _MEANT.get(last, last)
    others = [name for name in keys if not key.startswith(f"{name}.")]
    likely = _nearest(meant, others) or next(iter(same), None)
    text = f"there is no setting {key}"
    if key == "device.path":
        if "device.bag" in keys:
            return f"{text} of this device; its recordings are given as device.bag=FILE"
        return f"{text} of this device; a recording is given by its name alone: toftrack track FILE"
    group, _, name = key.partition(".")
    files = sorted((configuration_folder() / group).glob("*.yaml"))
    line = re.compile(rf"^{re.escape(name)}:", re.MULTILINE)
    having = [file.stem for file in files if line.search(file.read_text("utf-8"))]
    if having:
        return f"{text} of this {group}; it is one of {group}={', '.join(having)}"
    if likely is not None:
        return f"{text}; did you mean {likely}?"
    where = parent._get_full_key(None)
    some = [str(name) for name in parent if name not in ("_target_", "hydra")]
    if not some:
        return f"{text}; this {where} has none"
    if len(some) > _MOST:
        some = [*some[:_MOST], "..."]
    return f"{text}; {where or 'the configuration'} has {', '.join(some)}"


def _keys(config: object, prefix: str = "") -> Iterator[str]:
    """Every group and setting of a configuration's plain dictionary, dotted."""
    if isinstance(config, dict):
        for name, value in config.items():
            if name != "_target_":
                yield f"{prefix}{name}"
                yield from _keys(value, f"{prefix}{name}.")
