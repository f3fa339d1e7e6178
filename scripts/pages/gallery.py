"""Draw docs/images/ and write the list of pictures at the end of docs/gallery.md, with the command `star render`.

    python scripts/pages/gallery.py [TASK ...]    all tasks, or some

The list always names every task.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import envs
from envs.tasks import TASKS
from star import cli

DOCS = Path(__file__).parents[2] / "docs"
HEADING = "## Tasks\n"
SETTINGS = "--steps 0 --env.options.goals test"
HEIGHT, SMALL = 340, 200  # pixels; small are the mazes of other projects, of which many are alike


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="TASK")
    for name in parser.parse_args().tasks or envs.names():
        height = SMALL if TASKS[name].pairs else HEIGHT
        settings = [*SETTINGS.split(), "--height", str(height), "--force"]
        code = cli.main(["render", name, "--out", str(DOCS / "images" / f"{name}.jpg"), *settings])
        if code:
            return code
    page = DOCS / "gallery.md"
    before, _, _ = page.read_text(encoding="utf-8").partition(HEADING)
    pictures = [f"### `{name}`\n\n![{name}](images/{name}.jpg)\n" for name in envs.names()]
    page.write_text(before + HEADING + "\n" + "\n".join(pictures), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
