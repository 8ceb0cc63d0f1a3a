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


def test_two_lines_make_a_pipeline_quotient_aware(capsys):
    runpy.run_path(str(EXAMPLES / "dropin_ulrssm.py"), run_name="__main__")
    full, even = (float(line.split()[-2]) for line in capsys.readouterr().out.splitlines())
    assert even < 0.02
    assert even < full / 2


def test_a_bare_loop_learns(capsys):
    runpy.run_path(str(EXAMPLES / "dropin_bare.py"), run_name="__main__")
    losses = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()]
    assert len(losses) == 10
    assert losses[-1] < 0.8 * losses[0]


def test_every_example_is_run():
    scripts = {"quotient_by_hand.py", "match_two_creatures.py", "dropin_ulrssm.py", "dropin_bare.py"}
    assert {path.name for path in EXAMPLES.glob("*.py")} == scripts
