"""Numbers of settings: what cannot be meant is refused in one sentence."""

import math

import numpy as np
import pytest

from toftrack.errors import ToftrackError, check_number


def test_a_sentence_stays_one_however_much_of_a_file_is_in_it() -> None:
    assert len(str(ToftrackError("the file says " + 10_000 * "x"))) < 2100


@pytest.mark.parametrize("value", [0, 0.5, 1, np.float32(0.5), np.int64(1)])
def test_numbers_within_the_bounds_are_fine(value: object) -> None:
    check_number("group.key", value, 0, 1)


@pytest.mark.parametrize("value", [-1, 1.01, math.nan, math.inf, "much", None, True, [1]])
def test_everything_else_is_refused(value: object) -> None:
    with pytest.raises(ToftrackError) as caught:
        check_number("group.key", value, 0, 1)
    wanted = f"group.key={value} is not possible; give a number of at least 0 and at most 1"
    assert str(caught.value) == wanted


def test_whole_numbers_and_open_bounds() -> None:
    check_number("group.key", 3, 1, whole=True)
    check_number("group.key", 1e-9, 0, above=True)
    with pytest.raises(ToftrackError, match="give a whole number of at least 1, or none$"):
        check_number("group.key", 2.5, 1, whole=True, remedy=", or none")
    with pytest.raises(ToftrackError, match="give a number above 0$"):
        check_number("group.key", 0, 0, above=True)
