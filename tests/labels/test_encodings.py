"""The encodings of SemanticKITTI's classes, and their detection."""

import numpy as np
import pytest

from segslam.core.types import Label, SegslamError
from segslam.labels.encodings import RAW, RAW_OF_LABEL, Encoding, detect_encoding, to_labels

STREET = {  # points of each class in a street of 1000 points
    Label.UNLABELLED: 20,
    Label.CAR: 60,
    Label.BICYCLIST: 2,
    Label.ROAD: 300,
    Label.PARKING: 30,
    Label.SIDEWALK: 200,
    Label.BUILDING: 150,
    Label.FENCE: 8,
    Label.VEGETATION: 230,
}


def _histogram(points_of_id: dict[int, int]) -> np.ndarray:
    histogram = np.zeros(2**16, dtype=np.int64)
    for value, num_points in points_of_id.items():
        histogram[value] = num_points
    return histogram


def _of_classes(points_of_label: dict[Label, int], encoding: Encoding) -> np.ndarray:
    shift = 1 if encoding == "learning-0" else 0
    labels = {label: n for label, n in points_of_label.items() if label >= shift}
    return _histogram({int(RAW_OF_LABEL[x]) if encoding == "raw" else x - shift: n for x, n in labels.items()})


def test_raw_ids_become_the_classes_of_the_benchmark() -> None:
    ids = np.array([0, 1, 10, 13, 18, 20, 40, 60, 72, 81, 99, 252, 259, 258], dtype=np.uint32)
    expected = [0, 0, 1, 5, 4, 5, 9, 9, 17, 19, 0, 20, 24, 25]
    np.testing.assert_array_equal(to_labels(ids, "raw"), expected)


def test_every_class_has_its_raw_ids_and_none_is_in_two_classes() -> None:
    assert set(RAW) == set(Label)
    ids = [value for values in RAW.values() for value in values]
    assert len(ids) == len(set(ids)) == 34  # SemanticKITTI's annotation has 34 ids
    np.testing.assert_array_equal(to_labels(RAW_OF_LABEL, "raw"), list(Label))


def test_learning_ids_stay_and_predictions_move_up_by_one() -> None:
    np.testing.assert_array_equal(to_labels(np.arange(26), "learning"), np.arange(26))
    np.testing.assert_array_equal(to_labels(np.arange(19), "learning-0"), np.arange(1, 20))


@pytest.mark.parametrize(("value", "encoding"), [(7, "raw"), (26, "learning"), (19, "learning-0"), (65535, "raw")])
def test_id_of_no_class_is_named(value: int, encoding: Encoding) -> None:
    with pytest.raises(SegslamError, match=f"id {value} is not in the encoding {encoding}"):
        to_labels(np.array([0, value]), encoding)


@pytest.mark.parametrize("encoding", ["raw", "learning", "learning-0"])
def test_a_street_determines_its_encoding(encoding: Encoding) -> None:
    assert detect_encoding(_of_classes(STREET, encoding)) == encoding


@pytest.mark.parametrize(
    ("ids", "encoding"),
    [([0, 40], "raw"), ([0, 252], "raw"), ([9, 19], "learning"), ([9, 20, 22], "learning"), ([0, 80], "raw")],
)
def test_one_id_can_determine_the_encoding(ids: list[int], encoding: Encoding) -> None:
    assert detect_encoding(_histogram(dict.fromkeys(ids, 100))) == encoding


@pytest.mark.parametrize(
    "points_of_id",
    [
        {0: 1000},  # no label at all, or nothing but cars
        {0: 100, 10: 500, 11: 20},  # cars by the raw ids, parking by the learning ids
        dict.fromkeys(range(19), 100),  # no street has as many motorcyclists as road
        {0: 60, 12: 500, 14: 400},  # no road in either reading
        {4: 20, 7: 90, 8: 40, 9: 300, 15: 200, 21: 5, 22: 300},  # SemanticPOSS: its ground would move
    ],
)
def test_ambiguous_ids_are_reported_with_the_reason(points_of_id: dict[int, int]) -> None:
    with pytest.raises(SegslamError, match=r"they fit .* and .*--encoding raw\|learning\|learning-0"):
        detect_encoding(_histogram(points_of_id))


def test_ids_of_no_encoding_are_refused() -> None:
    with pytest.raises(SegslamError, match=r"ids: 7, 40\): no encoding contains all of them"):
        detect_encoding(_histogram({7: 5, 40: 5}))
