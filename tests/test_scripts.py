import argparse
import importlib.util
from pathlib import Path

from envs.arena import Arena

SCRIPTS = Path(__file__).parents[1] / "scripts"


def load(name):
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_check_of_the_physics_passes_and_notices_another_model(monkeypatch):
    script = load("verify_physics")
    options = argparse.Namespace(
        engine="native",
        preset="fast",
        reference=None,
        envs=20,
        rollouts=20,
        steps=20,
        throws=20,
        random_steps=100,
    )
    row = script.verify("ant_fall", options)
    assert row["passed"] and (row["crossings"], row["non_finite"], row["overflow"]) == (0, 0, 0)
    assert row["one_step"] < 1e-5 and row["contacts"] >= 2
    batch = script.Batch("ant_fall", "native", 20, preset="fast", reference="fast")
    batch.model.opt.gravity[2] *= 0.9
    assert script.one_step(batch)["one_step"] > 1e-3
    monkeypatch.setattr(Arena, "walls", Arena.free)
    assert script.throws(batch, 20) == 20  # everywhere is now a wall


def test_the_benchmark_measures_both_loops():
    script = load("benchmark_physics")
    options = argparse.Namespace(preset="fast", steps=3, repeats=2)
    row = script.measure("ant_maze", "native", 4, options)
    assert row["bare"] > 0 and row["full"] > 0 and len(row["ratios"]) == 2
