"""Generated documents are what their generators write."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from facerender.comparison.compare import compare
from tools.docs.comparison import failed_checks

ROOT = Path(__file__).parents[1]


STALE = (  # a document, what it says, what it should not, what is told
    ("accuracy", "| 0.05 | 0.0683 |", "| 0.05 | 0.0684 |", "other tables of the lobes"),
    (
        "accuracy",
        "| 0.05 | 24 | 0.48 |",
        "| 0.05 | 24 | 0.49 |",
        "another table of one slope for all",
    ),
    ("comparison", "## What escapes", "## What passes", "no line '## What escapes'"),
    ("levels", "put into the normal map", "put there", "no line '- Relief that is lost"),
    ("plan", "| planned for |", "| plan for |", "no line '| planned for | budget | its cameras |"),
    ("reproduction", "reaches the", "reached the", 'no line "reaches the paper\'s number."'),
    ("scale", "What this leaves out", "Left out", "no line 'What this leaves out: the table"),
    ("shaders", "gamma is", "Gamma is", "not what the headers say"),
    ("targets", "of its bound the worst", "of its bound a", "no line 'The last two columns tell"),
    ("trade", "# The trade", "# Trade", "not what its measurement says"),
)


def check(folder: Path) -> list[str]:
    """Return what the check of a folder's documents tells."""
    done = subprocess.run(
        [sys.executable, "-m", "tools.docs", "--check"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == bool(done.stderr), done.stderr
    return done.stderr.splitlines()


def test_generated_documents_are_current():
    assert check(ROOT) == []


def test_check_names_what_is_stale(tmp_path):
    shutil.copytree(ROOT / "docs", tmp_path / "docs")
    shutil.copytree(ROOT / "tools", tmp_path / "tools")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (tmp_path / "README.md").write_text(readme.replace("| Cook-Torrance, ns |", "| ns |"))
    for name, old, new, _ in STALE:
        path = tmp_path / "docs" / f"{name}.md"
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new), encoding="utf-8")
    told = check(tmp_path)
    assert len(told) == len(STALE) + 1
    for name, _, _, fault in STALE:
        assert any(line.startswith(f"docs/{name}.md: {fault}") for line in told), told
        assert any(line.endswith(f": run python -m tools.docs.{name}") for line in told)
    assert any(line.startswith("docs/trade.md: README.md has not") for line in told)


def test_the_comparison_names_the_checks_that_failed():
    a = np.ones((64, 64, 4), dtype=np.float32)
    less = a.copy()
    less[:32, :, 3] = 0.2
    assert failed_checks(compare(a, less)) == ["coverage"]
    assert failed_checks(compare(a, 1.003 * a)) == ["trend"]
    assert failed_checks(compare(a, 1.01 * a)) == ["block"]
    assert failed_checks(compare(a, a)) == []
