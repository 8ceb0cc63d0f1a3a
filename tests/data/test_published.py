"""The reader of the SCB result files, on hand-made files of the real format."""

from pathlib import Path

import pytest
from references.published import result_text, write

from torchqm.data.published import load_published, natural_key, published_names, read_published


def test_reads_every_field(tmp_path: Path) -> None:
    result = read_published(write(tmp_path))
    assert (result.method, result.source, result.target, result.seconds) == ("BlendedMap", "cat0", "cat6", 474.0)
    assert list(result.blocks) == ["Stats", "Stats1", "StatsWithFlip"]
    assert result.plain.errors.tolist() == [0.01, 0.03, 0.08]
    assert result.plain.flipped is None
    assert result.landmarks is not None
    assert result.landmarks.errors.tolist() == [0.03, 1.24143e-11]
    assert result.landmarks.flipped is True


def test_zero_time_means_not_stated(tmp_path: Path) -> None:
    assert read_published(write(tmp_path, text=result_text(time="0"))).seconds is None


def test_folder_of_result_files_is_accepted_and_order_is_natural(tmp_path: Path) -> None:
    for pair in ("cat10_to_cat3", "cat2_to_cat6", "cat2_to_cat1"):
        write(tmp_path, f"BenchResult_BlendedMap_{pair}.txt")
    pairs = [("cat2", "cat1"), ("cat2", "cat6"), ("cat10", "cat3")]
    assert [(result.source, result.target) for result in load_published(tmp_path)] == pairs
    assert published_names(tmp_path, "BlendedMap") == pairs


def test_missing_folder_and_method_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="Results_Corr_TOSCA is not a folder"):
        load_published(tmp_path)
    write(tmp_path)
    with pytest.raises(FileNotFoundError, match="methods with results there: BlendedMap"):
        load_published(tmp_path, "LipmanGMDS")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_published(tmp_path / "BenchResult_BlendedMap_cat1_to_cat6.txt")
    with pytest.raises(ValueError, match="expected a name like"):
        read_published(tmp_path / "cat1_to_cat6.txt")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no block 'Stats'"),
        ("\tAverage\t[0.1]\n", ":1: expected a block name"),
        ("Stats:\n\tAverage\t[0.1]\n", "'Stats' has no PerSampleErrors"),
        (result_text().split(", 0.08")[0], ":7: expected 'Key .value, ....', got .* cut short"),
        (result_text("[0.01, x, 0.08]"), ":7: expected a number, got ' x'"),
        (result_text("[0.01, -0.03, 0.08]"), ":7: expected a finite number"),
        (result_text("[0.01, nan, 0.08]"), ":7: expected a finite number"),
        (
            result_text("[0.01, 0.03]"),
            ":7: the 2 errors of block 'Stats' have mean 0.02, but the file states Average 0.04",
        ),
        (result_text("[]"), ":7: expected a number"),
        (result_text(flipped="maybe"), ":18: Flipped must be true or false"),
        (result_text(time="soon"), ":8: expected a number"),
        (result_text() + "Stats:\n", ":23: block 'Stats' occurs twice"),
    ],
)
def test_malformed_files_name_file_and_line(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text=text)
    with pytest.raises(ValueError, match=message) as caught:
        read_published(path)
    assert str(path) in str(caught.value)


def test_natural_key_orders_mixed_names() -> None:
    names = ["dog10", "dog", "dog0", "cat12", "cat2", "2x"]
    assert sorted(names, key=natural_key) == ["2x", "cat2", "cat12", "dog", "dog0", "dog10"]
