"""`toftrack benchmark [speed | alternating | accuracy | ablation]`: speed where none is named."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence

_MEASUREMENTS = ("speed", "alternating", "accuracy", "ablation")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a measurement; returns the exit status. Raises ToftrackError."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if given[:1] in (["-h"], ["--help"]):
        print(
            "usage: toftrack benchmark [speed] ...       how fast hypotheses and frames are\n"
            "       toftrack benchmark alternating ...   frames, in turn with MediaPipe's; starts\n"
            "       toftrack benchmark accuracy ...      how accurate, on recordings with truth\n"
            "       toftrack benchmark ablation ...      what each part of the tracker brings\n\n"
            "toftrack benchmark speed --help and so on say more"
        )
        return 0
    name, *rest = given if given[:1] and given[0] in _MEASUREMENTS else ("speed", *given)
    return importlib.import_module(f"toftrack.benchmark.{name}").main(rest) or 0
