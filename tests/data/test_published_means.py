"""Means over published results, of hand-made files and, where at hand, of the real ones."""

import os
from pathlib import Path

import pytest
import torch
from references.published import result_text, write

from torchqm.data.published import RESULT_FOLDER, PublishedResult, load_published, read_published
from torchqm.data.published_means import published_summary, summarize_published

REAL = os.environ.get("TORCHQM_SCB")


def test_summary_is_the_mean_of_per_pair_means(tmp_path: Path) -> None:
    """Candidates (Stats1) stay out; a pair counts once however many samples it has; blocks are not mixed."""
    write(tmp_path / RESULT_FOLDER)
    write(
        tmp_path / RESULT_FOLDER,
        "BenchResult_BlendedMap_cat2_to_cat10.txt",
        result_text("[0.1]", "[0.1]", flipped="false", time="500"),
    )
    summary = summarize_published(load_published(tmp_path, "BlendedMap"))
    assert summary.n_pairs == summary.n_landmark_pairs == 2
    assert summary.plain == pytest.approx((0.04 + 0.1) / 2)
    assert summary.landmarks == pytest.approx(0.015)
    assert summary.flipped == 0.5
    assert summary.median_seconds == 487.0


def test_the_plain_mean_of_a_tiny_file_is_exactly_bims(tmp_path: Path) -> None:
    """Three samples around 0.0342, whatever the candidates and the flip-forgiven landmarks of the same file say."""
    errors = [0.0042, 0.0342, 0.0642]
    write(tmp_path, text=result_text(str(errors), "[0.0342]"))
    summary = published_summary(tmp_path, thresholds=torch.tensor([0.0, 0.0042, 0.05, 0.1], dtype=torch.float64))
    assert (summary.method, summary.n_pairs, summary.plain) == ("BlendedMap", 1, sum(errors) / 3)
    assert round(summary.plain, 12) == 0.0342
    assert summary.curve.tolist() == pytest.approx([0.0, 1 / 3, 2 / 3, 1.0])
    assert summary.landmark_curve is not None
    assert summary.landmark_curve.tolist() == [0.0, 0.5, 1.0, 1.0]  # 1.24e-11 and 0.03
    assert (summary.n_timed, summary.median_seconds) == (1, 474.0)


def test_curves_are_means_over_pairs_and_time_over_those_that_state_one(tmp_path: Path) -> None:
    write(tmp_path, text=result_text(time="100"))
    write(tmp_path, "BenchResult_BlendedMap_cat1_to_cat6.txt", result_text("[0.2]", "[0.2]", time="0"))
    write(tmp_path, "BenchResult_BlendedMap_cat2_to_cat6.txt", "Stats:\n\tAverage\t[0]\n\tPerSampleErrors\t[0, 0]\n")
    summary = published_summary(tmp_path)
    assert len(summary.curve) == len(summary.thresholds) == 201
    assert float(summary.curve[-1]) == 1.0
    assert float(summary.curve[80]) == pytest.approx((1 + 0 + 1) / 3)  # at 0.1
    assert float(summary.curve[24]) == pytest.approx((2 / 3 + 0 + 1) / 3)  # at 0.03, one of the errors
    assert (summary.n_pairs, summary.n_landmark_pairs, summary.n_timed, summary.median_seconds) == (3, 2, 1, 100.0)


def test_a_summary_of_chosen_pairs(tmp_path: Path) -> None:
    write(tmp_path)
    write(tmp_path, "BenchResult_BlendedMap_cat1_to_cat6.txt", result_text("[0.2]", "[0.2]"))
    assert published_summary(tmp_path, pairs=[("cat1", "cat6")]).plain == 0.2
    with pytest.raises(ValueError, match=r"pairs: 1 of 2 have no result of BlendedMap in .*: cat1 -> cat7"):
        published_summary(tmp_path, pairs=[("cat1", "cat6"), ("cat1", "cat7")])
    with pytest.raises(ValueError, match="got 0 results"):
        published_summary(tmp_path, pairs=[])


def test_summary_refuses_mixed_or_no_results(tmp_path: Path) -> None:
    one = read_published(write(tmp_path))
    other = read_published(write(tmp_path, "BenchResult_BestConf_cat0_to_cat6.txt"))
    with pytest.raises(ValueError, match="BestConf"):
        summarize_published([one, other])
    with pytest.raises(ValueError, match="none"):
        summarize_published([])


@pytest.mark.skipif(not REAL, reason="TORCHQM_SCB does not point to an SCB folder")
class TestRealFiles:
    """Pinned to the benchmark's own summary pages, clusterTop.html and clusterTop_AllowingFlips.html."""

    @pytest.mark.parametrize(
        ("method", "plain", "landmarks", "flipped"),
        [
            ("BlendedMap", 0.034162, 0.037002, 0.0),
            ("LipmanGMDS", 0.0984677, 0.0675925, 0.1125),
            ("BestConf", 0.0840756, 0.104804, 0.0125),
            ("BronsteinGMDS", 0.308529, 0.189602, 0.5375),
            ("Ovsjanikov1", 0.239495, 0.203086, 0.4125),
            ("Ovsjanikov2", 0.22871, 0.167001, 0.45),
        ],
    )
    def test_means_are_those_of_the_benchmark(
        self, method: str, plain: float, landmarks: float, flipped: float
    ) -> None:
        results = load_published(str(REAL), method)
        summary = summarize_published(results)
        assert summary.n_pairs == summary.n_landmark_pairs == 80
        assert summary.plain == pytest.approx(plain, rel=5e-6)
        assert summary.landmarks == pytest.approx(landmarks, rel=5e-6)
        assert summary.flipped == flipped
        assert {len(result.plain.errors) for result in results} == {1024}
        assert {len(result.landmarks.errors) for result in results if result.landmarks} == {21, 36, 46}

    @pytest.mark.parametrize(
        ("method", "shares", "seconds"),
        [
            ("BlendedMap", (0.8386, 0.9652, 0.9920), 490.5),
            ("LipmanGMDS", (0.6006, 0.7934, 0.9125), 49.0),
            ("BestConf", (0.5842, 0.7567, 0.9110), 294.0),
            ("BronsteinGMDS", (0.2250, 0.3816, 0.5853), None),
            ("Ovsjanikov1", (0.2395, 0.4481, 0.7009), None),
            ("Ovsjanikov2", (0.2597, 0.4760, 0.7108), None),
        ],
    )
    def test_curves_and_times(self, method: str, shares: tuple[float, ...], seconds: float | None) -> None:
        """At 0.05, 0.1 and 0.25: the share of all errors below, as every pair has 1024. Three methods state no time."""
        summary = published_summary(str(REAL), method)
        assert summary.curve[[40, 80, 200]].tolist() == pytest.approx(shares, abs=5e-5)
        pooled = torch.cat([result.plain.errors for result in load_published(str(REAL), method)])
        expected = [float((pooled <= t).double().mean()) for t in (0.05, 0.1, 0.25)]
        assert summary.curve[[40, 80, 200]].tolist() == pytest.approx(expected, abs=1e-12)
        assert (summary.n_timed, summary.median_seconds) == (0 if seconds is None else 80, seconds)

    def test_where_the_quoted_0311_comes_from(self) -> None:
        """The better *block* of each pair, 1024 samples or some 30 landmarks, with the points pooled: no protocol."""
        results = load_published(str(REAL), "BlendedMap")
        pooled = torch.cat([self._better_block(result) for result in results])
        assert float(pooled.mean()) == pytest.approx(0.0311, abs=5e-5)
        assert float((pooled < 0.05).double().mean()) == pytest.approx(0.86, abs=5e-3)
        assert summarize_published(results).median_seconds == 490.5

    @staticmethod
    def _better_block(result: PublishedResult) -> torch.Tensor:
        assert result.landmarks is not None
        return min(result.plain.errors, result.landmarks.errors, key=lambda errors: float(errors.mean()))
