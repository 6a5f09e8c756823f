"""Each example runs as a stranger runs it, and leaves what it says."""

from __future__ import annotations

import ast
import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

EXAMPLES = sorted((Path(__file__).resolve().parent.parent / "examples").glob("*.py"))
SECONDS = 60  # of all cores together


def run(example: Path, output: Path) -> list[Path]:
    """Run an example; returns the paths that it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, example, "--output", output], capture_output=True, text=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < SECONDS
    return [Path(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_leaves_what_it_prints_and_nothing_else(example: Path, tmp_path: Path):
    told = ast.get_docstring(ast.parse(example.read_text("utf-8"))) or ""
    usage = next(line.split() for line in told.splitlines() if line.startswith("    python examples/"))
    assert "Writes" in told and usage[1] == f"examples/{example.name}" and usage[2] == "--output"
    output = tmp_path / usage[3]
    made = run(example, output)
    left = [output] if output.is_file() else sorted(output.iterdir())
    assert sorted(made) == left
    for path in made:
        if path.suffix == ".png":
            assert np.asarray(Image.open(path)).std() > 0 or "accumulation" in path.name, f"{path.name} is of one colour"
        elif path.suffix == ".json":
            assert json.loads(path.read_text("utf-8"))
        else:
            assert path.stat().st_size > 1000


def test_examples_are_numbered_without_gaps():
    assert [int(path.name[:2]) for path in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))
