import numpy as np
import pytest

from motionlab.errors import DataError, MissingData, ShapeError
from motionlab.io.reading import checked_array, frame_rate, reading


@pytest.mark.parametrize(
    "error", [KeyError("x"), IndexError(), ShapeError("x"), RecursionError(), MemoryError(), OSError("disk")]
)
def test_every_exception_becomes_a_data_error_with_its_cause(tmp_path, error):
    with pytest.raises(DataError, match=r"file\.abc, line 3: .*remedy: try again") as caught:
        with reading(tmp_path / "file.abc", "try again") as at:
            at.place = "line 3"
            raise error
    assert caught.value.__cause__ is error


@pytest.mark.parametrize("error", [DataError("x", path="p"), MissingData("x", "y"), KeyboardInterrupt()])
def test_errors_that_already_say_it_pass_through(tmp_path, error):
    with pytest.raises(type(error)) as caught, reading(tmp_path):
        raise error
    assert caught.value is error


def test_numbers_and_rates(tmp_path):
    with reading(tmp_path) as at:
        assert checked_array(at, [[1, 2, 3]], "T 3").dtype == np.float64
        assert frame_rate(at, np.array([30])) == 30.0
        for array, shape in (([1, 2], "3"), (np.zeros((0, 3)), "T 3"), (["a"], "1"), ([np.nan], "1"), ([1e18], "1")):
            with pytest.raises(DataError):
                checked_array(at, array, shape, "here")
        for rate in (0, -1, 1e6, np.nan, None, "30", [1, 2], True):
            with pytest.raises(DataError, match="frames per second"):
                frame_rate(at, rate)
