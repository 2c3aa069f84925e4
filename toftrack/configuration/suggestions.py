"""What was probably meant by a setting, a group or a choice that does not exist."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

_ALIKE = 0.6
"""How much of a name must be right, 0..1."""
_MOST = 12
"""So many names are listed at most."""
_PAPERS_GROUP = "start"
"""A group that experiment=paper alone has."""


def nearest(word: str, names: Sequence[str]) -> str | None:
    """The name that is most like a word; None where none is."""
    found = difflib.get_close_matches(word, names, n=1, cutoff=_ALIKE)
    return found[0] if found else None


def better_sentence(chain: Sequence[BaseException]) -> str | None:
    """One sentence for an override that means nothing; None for every other error.

    chain: the error and its causes, the error first.
    """
    for error in chain:
        if isinstance(error, OverrideParseException):
            return _of_syntax(error)
        if isinstance(error, MissingConfigException) and error.missing_cfg_file:
            return _of_choice(error.missing_cfg_file, error.options or ())
    return _of_key(chain)


def _of_syntax(error: OverrideParseException) -> str:
    key, separator, value = error.override.partition("=")
    text = f"'{error.override}' cannot be read as a setting"
    if not separator:
        return f"{text}; settings are given as KEY=VALUE, as in hand.side=left"
    if key == "device.path":
        return f"{text}; give the recording by its name alone: toftrack track '{value}'"
    return (
        f"{text}; where a value has blanks, commas, brackets or other signs, put it in two pairs of"
        f""" quotes: '{key}="..."'"""
    )


def _of_choice(missing: str, options: Sequence[str]) -> str | None:
    group, _, word = missing.rpartition("/")
    if not group or not options:
        return None
    likely = nearest(word, options)
    hint = f"did you mean {group}={likely}? The choices are" if likely else "give one of"
    return f"there is no {group}={word}; {hint} {', '.join(options)}"


def _of_key(chain: Sequence[BaseException]) -> str | None:
    reported = re.match(r"Could not override '([^']+)'", str(chain[0]))
    if not reported:
        return None
    key = reported[1]
    for error in chain:
        parent = getattr(error, "parent_node", None)
        if isinstance(error, OmegaConfBaseException) and isinstance(parent, DictConfig):
            return _unknown_key(key, parent)
    return _of_paper(key) if key == _PAPERS_GROUP else None


def _of_paper(key: str) -> str:
    return f"{key} belongs to experiment=paper; give experiment=paper as well, or leave {key} out"


def _unknown_key(key: str, parent: DictConfig) -> str:
    root = parent._get_root()
    assert isinstance(root, DictConfig)
    if key.partition(".")[0] == _PAPERS_GROUP and _PAPERS_GROUP not in root:
        return _of_paper(key)
    known = OmegaConf.to_container(root)
    keys = [name for name in _keys(known) if not name.startswith("hydra.") or key[:5] == "hydra"]
    last = key.rpartition(".")[2]
    same = [name for name in keys if name.rpartition(".")[2] == last]
    likely = nearest(key, [name for name in keys if not key.startswith(f"{name}.")]) or (
        same[0] if same else None
    )
    text = f"there is no setting {key}"
    if key == "device.path":
        return f"{text} of this device; a recording is given by its name alone: toftrack track FILE"
    if likely is not None:
        return f"{text}; did you mean {likely}?"
    where = key.rpartition(".")[0]
    while where and not isinstance(OmegaConf.select(root, where), DictConfig):
        where = where.rpartition(".")[0]
    inside = OmegaConf.select(root, where) if where else root
    some = [str(name) for name in inside if name not in ("_target_", "hydra")]
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
