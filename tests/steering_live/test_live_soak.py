"""A minute of a browser that does anything at random; half an hour of it: `python tests/live_soak.py`."""

import pytest
from live_browser import CHROMIUM
from live_soak import list_failures, soak


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium; .ci/setup browser says how to get it")
def test_a_minute_of_anything_breaks_nothing(prior, monkeypatch, tmp_path):
    """How many frames are late is not looked at: a browser that draws without a graphics card leaves no processor."""
    monkeypatch.chdir(tmp_path)
    report = soak(1.0, "--prior", prior)
    print(report.table())
    assert list_failures(report, 1.0) == []
    assert report.frames > 100
    assert sum(report.actions.values()) > 20
