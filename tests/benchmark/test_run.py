"""torchqm.benchmark.run: a task that is done is not done again, whoever asks for it."""

import pytest
from references import shapes
from references.matchers import Scripted

from torchqm.benchmark import Settings, plan_tasks, run_task
from torchqm.benchmark.ledger import read_record
from torchqm.data import open_shapes
from torchqm.geometry import save_mesh


@pytest.mark.parametrize(("fails", "status"), [("", "done"), ("a1", "failed")])
def test_a_result_that_is_there_is_told_and_not_made_again(tmp_path, fails, status):
    root, log = tmp_path / "set", tmp_path / "log.txt"
    root.mkdir()
    for number in range(2):
        save_mesh(shapes.blob(2, 2).mesh, root / f"a{number}.off")
    settings = Settings(str(root), tmp_path / "out", points=10)
    matcher = Scripted(log=str(log), fails=fails)
    (task,) = plan_tasks(open_shapes(root), [matcher], [("a0", "a1")], settings)
    assert (run_task(task), run_task(task)) == (status, status)
    assert len(log.read_text().splitlines()) == 1
    assert read_record(task.path, task.key)["status"] == status
    task.path.unlink()
    assert run_task(task) == status
    assert len(log.read_text().splitlines()) == 2
