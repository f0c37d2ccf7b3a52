import pytest
import torch

from motionlab.errors import DataError, MissingData, ShapeError, check_shape


@pytest.mark.parametrize(
    ("shape", "pattern", "sizes"),
    [
        ((7, 22, 3), "... J 3", {"J": 22}),
        ((22, 3), "... J 3", {"J": 22}),
        ((2, 3, 4, 4), "... N N", {"N": 4}),
        ((0, 3), "T 3", {"T": 0}),
        ((), "...", {}),
    ],
)
def test_fitting_shapes_return_their_sizes(shape, pattern, sizes):
    assert check_shape(torch.zeros(shape), pattern, "x") == sizes


@pytest.mark.parametrize(
    ("shape", "pattern"),
    [((3,), "... J 3"), ((7, 4), "... J 3"), ((1, 7, 3), "T 3"), ((3, 4), "... N N"), ((), "... 3"), ((2,), "")],
)
def test_other_shapes_are_refused_with_name_expected_and_actual(shape, pattern):
    with pytest.raises(ShapeError, match=r"joints: expected shape .* got \("):
        check_shape(torch.zeros(shape), pattern, "joints")


def test_data_error_names_file_place_and_remedy():
    error = DataError("odd count", path="walk.bvh", place="line 7", remedy="export again")
    assert str(error) == "walk.bvh, line 7: odd count (remedy: export again)"
    assert (error.path, error.place, error.remedy) == ("walk.bvh", "line 7", "export again")
    assert str(DataError("odd count")) == "odd count" and isinstance(error, ValueError)


def test_other_errors_carry_what_helps():
    missing = MissingData("the body", "Run make setup.")
    assert str(missing) == "the body is missing. Run make setup."
