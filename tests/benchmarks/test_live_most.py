"""How many characters a machine carries: twice as many until frames are late, then between."""

import pytest

from controllers.benchmarks.live import find_most


@pytest.mark.parametrize("carried", [0, 1, 2, 3, 5, 8, 11, 64])
def test_the_largest_number_without_a_late_frame_is_found_in_few_runs(carried):
    tried = []

    def measure(count):
        tried.append(count)
        return {"characters": count, "late_frames": max(0, count - carried)}

    rows = find_most(measure, 64)
    assert [row["characters"] for row in rows if row["most"] == "yes"] == ([carried] if carried else [])
    assert len(tried) == len(set(tried)) <= 12
    assert [row["characters"] for row in rows] == sorted(tried)
