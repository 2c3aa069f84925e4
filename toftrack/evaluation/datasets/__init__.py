"""Public data sets of labelled depth recordings, as their authors distribute them."""

from __future__ import annotations

from pathlib import Path

from toftrack.errors import ToftrackError
from toftrack.evaluation.datasets.base import DataSet, LabelledSequence
from toftrack.evaluation.datasets.icvl import ICVL
from toftrack.evaluation.datasets.msra import MSRA14, MSRA15
from toftrack.evaluation.datasets.nyu import NYU

DATA_SETS: dict[str, DataSet] = {
    data_set.name: data_set for data_set in (MSRA14, MSRA15, ICVL, NYU)
}


def open_data_set(name: str, folder: str | Path) -> tuple[DataSet, list[LabelledSequence]]:
    """A data set by its name, and the sequences that lie in a folder.

    Raises ToftrackError: the name is unknown, or the folder does not hold that data set.
    """
    if name not in DATA_SETS:
        raise ToftrackError(f"the data set '{name}' is unknown; known: {', '.join(DATA_SETS)}")
    folder = Path(folder).expanduser()
    if not folder.is_dir():
        raise ToftrackError(f"there is no folder '{folder}'; give the folder of {name}")
    data_set = DATA_SETS[name]
    sequences = data_set.open(folder)
    if not sequences:
        raise ToftrackError(f"the folder '{folder}' does not hold {name}; {data_set.layout}")
    return data_set, sequences
