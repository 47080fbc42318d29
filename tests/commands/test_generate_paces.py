"""When `mapctl generate` tells a prior paces: unless the style names one, or asks for none."""

import pytest
from helpers import run
from tiny_prior import save_tiny_prior

from mapctl.commands import generate as generate_run
from priors.lstm_gmm.density import PACE_LABELS


@pytest.fixture(scope="module")
def prior(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paces")
    return save_tiny_prior(folder / "prior.safetensors", labels=("style=elderly", *PACE_LABELS))


@pytest.mark.parametrize(
    ("style", "told", "like_start"),
    [
        (None, True, True),
        ("elderly", True, False),
        ("walk", False, False),
        ("elderly,pace=run", False, False),
        ("none", False, False),
    ],
)
def test_paces_are_told_unless_one_is_named(tmp_path, prior, monkeypatch, style, told, like_start):
    class Asked(Exception):
        """Generation has begun."""

    def stream(*_given, settings, **_more):
        raise Asked(settings.vary_paces, settings.condition_on_start)

    monkeypatch.setattr(generate_run, "stream", stream)
    words = () if style is None else ("--style", style)
    with pytest.raises(Asked) as asked:
        run("generate", "-o", tmp_path / "out", "--seconds", 1, "--prior", prior, *words)
    assert asked.value.args == (told, like_start)
