import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.mark.parametrize(
    ("script", "bound"),
    [("quotient_by_hand.py", 0.03), ("match_two_creatures.py", 0.03)],
)
def test_examples_run_and_find_good_maps(script, bound, capsys):
    runpy.run_path(str(EXAMPLES / script), run_name="__main__")
    lines = [line for line in capsys.readouterr().out.splitlines() if "sqrt(area)" in line]
    assert lines
    for line in lines:
        assert float(line.split()[-2]) < bound, line


def test_every_example_is_run():
    assert {path.name for path in EXAMPLES.glob("*.py")} == {"quotient_by_hand.py", "match_two_creatures.py"}
