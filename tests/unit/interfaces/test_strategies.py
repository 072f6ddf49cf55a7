import numpy as np
import pytest

from vibench.errors import RequestError
from vibench.interfaces.strategies import Stop


def test_stops_are_a_tolerance_or_a_size_and_reached_as_they_say() -> None:
    for wrong in ({}, {"tolerance": 0.1, "size": 3}):
        with pytest.raises(RequestError, match="either a tolerance or a size"):
            Stop(**wrong)
    errors = np.array([1.0, 0.1, 0.01])
    assert Stop(tolerance=0.1).first_reached(errors) == 1
    assert Stop(tolerance=1e-3).first_reached(errors) is None
    assert Stop(size=2).first_reached(errors) == 2
    assert Stop(size=2).reached(2, 0.5)
    assert not Stop(size=2).reached(1, 0.0)
    assert (str(Stop(size=2)), str(Stop(tolerance=0.01))) == ("size 2", "tolerance 0.01")
