"""torchqm.benchmark.plan: learned methods by the name of their files, told apart by what is in them."""

import pytest
import torch
from references import shapes

from torchqm.benchmark import Settings, choose_methods, plan_tasks, run_task
from torchqm.benchmark.ledger import read_record
from torchqm.benchmark.plan import functions_of
from torchqm.data import open_shapes
from torchqm.geometry import save_mesh
from torchqm.learn import LearnedDescriptors, MatchNet, NetOptions, save_net
from torchqm.matching.baselines import Ours

ROOT = "synthetic:kinds=ellipsoid;poses=2;verts=500;triangulation=shared"
PAIR = ("ellipsoid-0-pose0", "ellipsoid-0-pose1")


def net_file(folder, name, seed=0, **more):
    torch.manual_seed(seed)
    return save_net(MatchNet(NetOptions(**{"k": 20, "channels": 8, **more})), folder / f"{name}.safetensors")


def planned(methods, out):
    matchers, _ = choose_methods(methods)
    tasks = plan_tasks(open_shapes(ROOT), matchers, [PAIR], Settings(ROOT, out, points=20))
    return [task for task in tasks if task.kind == "pair"]


def test_results_of_a_network_are_kept_under_its_content(tmp_path):
    path = net_file(tmp_path, "net")
    (first,) = planned([f"learned:{path}"], tmp_path)
    (same,) = planned([f"learned:{path}"], tmp_path)
    assert (first.key, first.path) == (same.key, same.path)
    net_file(tmp_path, "net", seed=1)
    (other,) = planned([f"learned:{path}"], tmp_path)
    assert other.key != first.key
    assert other.path.parent != first.path.parent


def test_results_of_the_classical_matcher_do_not_know_of_learning(tmp_path):
    """They are kept under the same key as before there was any: nothing of it is in what is hashed."""
    from torchqm.benchmark.plan import _config

    config = _config(Ours(), Settings(ROOT, tmp_path))
    assert set(config) == {"format", "version", "matcher", "parameters", "functions", "points", "solver"}
    assert "descriptors" not in config["matcher"]


def test_a_network_of_many_functions_gets_them(tmp_path):
    (many,), _ = choose_methods([f"learned:{net_file(tmp_path, 'many', k=220)}"])
    (few,), _ = choose_methods([f"learned:{net_file(tmp_path, 'few')}"])
    assert (functions_of(many), functions_of(few)) == (220, 200)


def test_a_learned_method_runs_as_a_task(tmp_path, monkeypatch):
    path, root = net_file(tmp_path, "net"), tmp_path / "set"
    root.mkdir()
    for number in range(2):
        save_mesh(shapes.blob(2, 2).mesh, root / f"a{number}.off")
    (matcher,), _ = choose_methods([f"learned:{path}"])
    asked, own = [], LearnedDescriptors.__call__
    monkeypatch.setattr(LearnedDescriptors, "__call__", lambda s, x: asked.append(x.mesh.name) or own(s, x))
    settings = Settings(str(root), tmp_path / "out", points=10)
    tasks = plan_tasks(open_shapes(root), [matcher], [("a0", "a1")], settings)
    assert [run_task(task) for task in tasks if task.kind == "pair"] == ["done"]
    assert asked == ["a0", "a1"]
    record = read_record(tasks[-1].path, tasks[-1].key)
    assert record["method"] == f"learned:{path}"
    assert record["row"]["plain_mean"] < 0.01


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("learned:", "expected after 'learned:'"),
        ("learned:none", "none: no such file"),
        ("learnd:x", "allowed are .*learned:RUN, pub"),
    ],
)
def test_names_that_lead_to_no_network(name, message):
    with pytest.raises(ValueError, match=message):
        choose_methods([name])
