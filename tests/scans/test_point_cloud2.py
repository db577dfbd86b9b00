"""Messages whose numbers contradict each other: NumPy would read memory that is not theirs."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from segslam.scans.point_cloud2 import read_message

FIELDS = [SimpleNamespace(name=name, offset=4 * k, datatype=7, count=1) for k, name in enumerate("xyz")]


def _message(**changed: Any) -> SimpleNamespace:
    data = np.arange(30, dtype="<f4").tobytes()
    values = {"height": 2, "width": 5, "point_step": 12, "row_step": 60, "data": data, "fields": FIELDS} | changed
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0)), is_bigendian=False, **values
    )


def test_a_consistent_message_is_read() -> None:
    np.testing.assert_array_equal(read_message(_message()).points, np.arange(30.0).reshape(10, 3))


@pytest.mark.parametrize(
    "changed",
    [
        {"data": b""},
        {"data": b"", "width": 2_000_000},
        {"data": bytes(119)},
        {"height": 2**32 - 1, "row_step": 0},
        {"width": 2**32 - 1},
        {"row_step": 2**32 - 1},
        {"point_step": 0},
        {"point_step": 8},
        {"height": -1, "width": -1},
        {"fields": [*FIELDS[:2], SimpleNamespace(name="z", offset=2**31 - 1, datatype=7, count=1)]},
        {"fields": [*FIELDS[:2], SimpleNamespace(name="z", offset=-4, datatype=7, count=1)]},
    ],
)
def test_points_outside_of_the_data_are_refused(changed: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"not fit into|is not in a point"):
        read_message(_message(**changed))


def test_a_message_without_points_has_none() -> None:
    assert len(read_message(_message(height=0, width=0, data=b"")).points) == 0


def test_padding_may_have_a_name_twice_or_a_datatype_of_its_own() -> None:
    padding = [SimpleNamespace(name="_", offset=at, datatype=kind, count=1) for at, kind in ((8, 2), (9, 2), (0, 99))]
    np.testing.assert_array_equal(
        read_message(_message(fields=[*FIELDS, *padding])).points, np.arange(30.0).reshape(10, 3)
    )


def test_a_coordinate_given_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="has the field x twice"):
        read_message(_message(fields=[*FIELDS, FIELDS[0]]))
