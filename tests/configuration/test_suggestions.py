"""Overrides that mean nothing: what was probably meant."""

from __future__ import annotations

import pytest

from toftrack.configuration.compose import configuration
from toftrack.errors import ToftrackError


@pytest.mark.parametrize(
    ("override", "reported"),
    [
        ("hand.sied=left", "there is no setting hand.sied; did you mean hand.side?"),
        ("hnad.side=left", "there is no setting hnad.side; did you mean hand.side?"),
        ("particles=3", "did you mean filter.particles?"),
        ("filter.partciles=3", "did you mean filter.particles?"),
        ("devcie=replay", "there is no setting devcie; did you mean device?"),
        ("hydra.run.dri=x", "did you mean hydra.run.dir?"),
        ("view.quux=1", "there is no setting view.quux; view has "),
        ("quux=1", "there is no setting quux; the configuration has device, "),
        ("device.path=a.npz", "a recording is given by its name alone: toftrack track FILE"),
        ("device=replya", "there is no device=replya; did you mean device=replay? The choices are"),
        ("experiment=papre", "did you mean experiment=paper?"),
        ("view=quux", "there is no view=quux; give one of browser, none, rerun, video"),
        ("device.path=a (1).npz", "give the recording by its name alone: toftrack track 'a (1)"),
        ("seed=[1", "'seed=[1' cannot be read as a setting"),
        ("start=search", "there is no start=search any more, since the networks find hands: leave"),
        ("lost=score", "there is no lost=score any more, since the networks' features count"),
        ("start.hypotheses=9", "or give detector.hypotheses"),
        ("start.islands=9", "there is no setting start.islands any more, since the networks"),
        (
            "lost.score=0.5",
            "lost.confidence says which estimates count: give that, or give experiment",
        ),
        (
            "hand.fit.prior=0.1",
            "no setting hand.fit.prior any more, since the whole shape",
        ),
    ],
)
def test_a_misspelt_override_gets_the_nearest_one(override: str, reported: str) -> None:
    with pytest.raises(ToftrackError) as error:
        configuration(override)
    assert reported in str(error.value) and "\n" not in str(error.value)
