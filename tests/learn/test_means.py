import pytest

from torchqm.learn import means
from torchqm.learn.means import PairMeans


def test_pairs_count_alike_in_whatever_process_and_batch_they_are(monkeypatch):
    ranks = [PairMeans(), PairMeans(), PairMeans()]
    ranks[0].add("loss", 6.0, 2)
    ranks[0].add("loss", 5.0, 1)
    ranks[1].add("loss", 1.0, 1)
    ranks[1].add("error", 0.5, 1)  # the others have no pair with a truth
    ranks[2].add("error", 0.0, 0)
    monkeypatch.setattr(means, "everywhere", lambda own: [rank._sums for rank in ranks])
    for rank in ranks:
        assert rank.reduced() == {"loss": pytest.approx(3.0), "error": 0.5}


def test_of_no_pair_there_is_no_mean():
    empty = PairMeans()
    assert empty.reduced() == {}
    empty.add("error", 0.0, 0)
    assert empty.reduced() == {}
