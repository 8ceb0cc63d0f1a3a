"""What the tests of commands share."""

from pathlib import Path

import pytest


@pytest.fixture
def plain_curves(monkeypatch):
    """Trainings whose curves are not looked at: to draw them takes longer than to train (``tests/viz`` draws them)."""

    def written(metrics, path, title=None):
        Path(path).touch()
        return Path(path)

    monkeypatch.setattr("torchqm.viz.callbacks.training_curves", written)
