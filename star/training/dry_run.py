"""A preview of a run: `star train --dry-run`. Nothing is written, and no epoch is compiled."""

from __future__ import annotations

from pathlib import Path

from star.config.run import RunConfig
from star.training import memory_budget, trainer


def told(config: RunConfig, run_dir: Path) -> str:
    """The resolved settings as YAML, and before them, as comments, what they lead to; raises `UserError` like a run."""
    program = trainer.ready(config, run_dir)
    needed = memory_budget.needed(program)
    total, unit = program.epochs * program.steps_per_epoch, program.kind.unit
    section = program.config.trainer
    seeds = f"{len(program.seeds)} seeds side by side" if len(program.seeds) > 1 else f"seed {program.seeds[0]}"
    parts = ", ".join(f"{name} {_mib(count)}" for name, count in sorted(needed.items(), key=lambda one: -one[1])[:3])
    lines = [
        "dry run: nothing was written",
        f"would write to  {run_dir}: config.yaml, metrics, checkpoints and figures",
        f"would train     {total:,} {unit}, {program.epochs:,} epochs of {program.steps_per_epoch:,}, {seeds}",
        f"would evaluate  every {section.eval_every} epochs, and save every {section.checkpoint_every}",
        f"needs           at least {_mib(sum(needed.values()))} of memory ({parts}); "
        f"there are {_mib(memory_budget.available(section.devices))}",
        *program.experiment.notes(),
    ]
    return "\n".join([*(f"# {line}" for line in lines), program.config.to_yaml().rstrip()])


def _mib(count: int) -> str:
    return f"{count / 2**20:,.0f} MiB"
