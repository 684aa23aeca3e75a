"""Runs the commands of the README and the guide, page by page, in the order of the page.

A page's blocks without a language are shell commands, except after ``<!-- not run: reason -->``. A
block after a line such as `heads.toml`, or with a first line such as # heads.toml, is a file.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import facerender as fr
from tests import stand_ins
from tests.awkward_files import MINI_HEAD
from tests.markdown import blocks
from tests.test_guide import GUIDE, ROOT, name
from tests.test_standard_views import advanced, write_obj
from tools.docs.blocks import by_hand

NAMED = re.compile(r"(?:`|# |// )([a-z_]+\.(?:toml|json|jsonl|csv|py|glsl))`?")
SMOKE = "README"  # the page of `make test`; the other pages take seconds each

# Draws images of a tenth of the width and height; the tests check only that commands run. head.glb
# has no eyes here.
FACERENDER = """
import sys
from facerender.commands import main
if sys.argv[1] in ("render", "plan", "explore", "views"):
    from facerender.drawing.renderer import Renderer
    init = Renderer.__init__
    def tenth(self, size=(1024, 1024), *arguments, **options):
        init(self, tuple(max(side // 10, 8) for side in size), *arguments, **options)
    Renderer.__init__ = tenth
sys.exit(main([word.partition(",eye")[0] for word in sys.argv[1:]]))
"""
# Status 1 of compare is a difference of the images.
PRELUDE = """
facerender() {
    "$PYTHON" facerender_command.py "$@" && return
    local status=$?
    [ "$1 $status" = "compare 1" ] || { echo "status $status: facerender $*" >&2; exit 1; }
}
pytest() { "$PYTHON" -m pytest -p facerender.pytest_plugin "$@"; }
pip() { :; }
apt() { :; }
make() { :; }
command -v glslangValidator > /dev/null || glslangValidator() { :; }
set -e -o pipefail
"""
SHADER = """#version 450
#extension GL_GOOGLE_include_directive : require
#define FR_LOBE FR_LOBE_EXACT
#include "facerender/cook_torrance.glsl"
layout(location = 0) out vec4 color;
void main() { color = vec4(fr_cook_torrance(vec3(0.0), vec3(0.0), vec3(0.0), 0.3, 0.03)); }
"""


def script(text: str) -> str:
    """Return the shell commands of a page."""
    found = blocks(by_hand(text))
    return "".join(
        code for before, language, code in found if not language and "not run:" not in before
    )


def files(text: str) -> dict[str, str]:
    """Return the files of a page by name."""
    found = {}
    for before, language, code in blocks(text):
        named = NAMED.fullmatch(before) or NAMED.fullmatch(code.partition("\n")[0])
        if language and named:
            found[named[1]] = code
    return found


def write_inputs(folder: Path) -> None:
    """Write the files that the commands read and that no page contains."""
    shutil.copy(MINI_HEAD, folder / "head.glb")
    shutil.copy(ROOT / "assets" / "head.glb", folder / "talk.glb")
    egg = stand_ins.head(50, 100, 5_023, 9_976, 5_118, 0.28)
    stand_ins.write_obj(folder / "head.obj", egg, egg["v_template"])
    np.save(folder / "frames.npy", np.repeat(egg["v_template"][None], 13, axis=0))
    texels = np.full((32, 32, 3), (128, 128, 255), dtype=np.uint8)
    for file in ("colour.jpg", "pores.png", "sweat.png"):
        Image.fromarray(texels).save(folder / file)
    shutil.copy(folder / "head.obj", folder / "scan.obj")
    mini = fr.load_mesh(MINI_HEAD)
    for file, change in (("before.obj", lambda points: points), ("after.obj", advanced(mini))):
        write_obj(folder / file, mini, change)
    (folder / "skin.frag").write_text(SHADER)


def run(folder: Path, commands: str) -> None:
    (folder / "facerender_command.py").write_text(FACERENDER)
    environment = os.environ | {
        **{"PYTHON": sys.executable, "PYTHONPATH": str(ROOT), "LP_NUM_THREADS": "1"},
        "FACERENDER_CACHE_MIB": "0",
    }
    result = subprocess.run(
        ["bash", "-c", PRELUDE + commands],
        cwd=folder, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr


def pages() -> list[object]:
    return [
        pytest.param(page, marks=() if page.stem == SMOKE else pytest.mark.slow, id=name(page))
        for page in GUIDE
        if re.search(r"^facerender ", script(page.read_text(encoding="utf-8")), re.MULTILINE)
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("egl")
@pytest.mark.parametrize("page", pages())
def test_commands_run_in_the_order_of_the_page(page, tmp_path):
    text = page.read_text(encoding="utf-8")
    write_inputs(tmp_path)
    for file, content in files(text).items():
        # A tenth of the jobs of batch.md.
        (tmp_path / file).write_text(content.replace("count = 40", "count = 4"))
    run(tmp_path, script(text))


@pytest.mark.slow
@pytest.mark.usefixtures("egl")
def test_commands_of_the_examples_run(tmp_path):
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    fewer = ("sweep", "count = 50", "count = 1"), ("turntable", "step = 30", "step = 180")
    for file, many, few in fewer:
        path = tmp_path / "examples" / f"{file}.toml"
        path.write_text(path.read_text().replace(many, few))
    page = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    commands = re.findall(r"`(facerender (?:render|batch) .+?)`", page)
    assert len(commands) == 3
    run(tmp_path, "\n".join(commands))
    assert len(list((tmp_path / "turntable").rglob("*.png"))) == 2 * 4
    with Image.open(tmp_path / "scene.png") as image:
        assert image.size == (102, 102)


@pytest.mark.slow
def test_a_command_that_fails_is_seen(tmp_path):
    run(tmp_path, "facerender shaders path | cat > path\n")
    with pytest.raises(AssertionError, match="status 2: facerender render"):
        run(tmp_path, "facerender render nofile.glb -o a.png\nfacerender shaders path\n")
