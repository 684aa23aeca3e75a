"""README and guide: length, links, examples, and the site built from them."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from PIL import Image

import facerender as fr
from facerender.commands import parser_of
from facerender.drawing.context import create_context
from tests import stand_ins
from tests.awkward_files import MINI_HEAD
from tests.markdown import code, prose
from tools.docs.blocks import by_hand

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NOT_GUIDE = {"api", "changelog", "index", "shader-functions"}
GUIDE = [ROOT / "README.md", *(p for p in sorted(DOCS.glob("*.md")) if p.stem not in NOT_GUIDE)]
PAGES = sorted(
    page
    for pattern in ("*.md", "docs/**/*.md", "examples/*.md", "examples/*/README.md")
    for page in ROOT.glob(pattern)
)
COMMAND = re.compile(r"^facerender (.+?)(?: \| .*)?$", re.MULTILINE)
SLOW = {"moving", "speed"}


def words(page: Path) -> int:
    return len(by_hand(page.read_text(encoding="utf-8")).split())


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def commands(page: Path) -> list[str]:
    """Return the command lines of a page. Those of command-line.md are generated from parsers."""
    blocks = code(by_hand(page.read_text(encoding="utf-8")), "")
    return [line for block in blocks for line in COMMAND.findall(block.replace("\\\n", ""))]


def python(page: Path) -> list[str]:
    return code(page.read_text(encoding="utf-8"), "python")


@pytest.mark.slow
def test_type_checkers_accept_the_python_of_the_guide(tmp_path):
    """In strict mode, except for functions without annotations, and for other packages."""
    for page in (page for page in GUIDE if page.stem != "batch"):  # about OpenCV and webdataset
        blocks = [block for block in python(page) if "import moderngl" not in block]
        (tmp_path / f"{page.stem}.py").write_text("import facerender as fr\n" + "\n".join(blocks))
    options = ("--strict", "--allow-untyped-defs", "--disable-error-code", "import-untyped")
    command = [sys.executable, "-m", "mypy", *options, "--cache-dir", tmp_path / "cache", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout


def pages_with_python() -> list[object]:
    """The examples of batch.md have tests in test_batch_jobs and test_batch_outputs."""
    pages = (page for page in GUIDE if python(page))
    return [
        pytest.param(page, marks=pytest.mark.slow if page.stem in SLOW else ())
        for page in pages
        if page.stem != "batch"
    ]


def anchors(page: Path) -> set[str]:
    """Return what GitHub lets a link name: headings in lower case, spaces as hyphens, no signs."""
    seen: Counter[str] = Counter()
    found = set()
    for heading in re.findall(r"^#+ (.+)$", prose(page.read_text("utf-8")), re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        found.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return found


def broken_links(page: Path) -> list[str]:
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page.read_text("utf-8"))):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if link.startswith(("http://", "https://")):
            continue
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    return broken


def test_the_readme_and_the_guide_are_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 700
    assert sum(words(page) for page in GUIDE[1:]) <= 18_250


@pytest.fixture
def small_images(monkeypatch):
    """Draw images of a tenth of the width and height; the test checks only that examples run."""
    init = fr.Renderer.__init__

    def tenth(self, size=1024, *arguments, **options):
        sides = (size, size) if isinstance(size, int) else size
        init(self, tuple(max(side // 10, 8) for side in sides), *arguments, **options)

    monkeypatch.setattr(fr.Renderer, "__init__", tenth)


@pytest.mark.parametrize("page", pages_with_python(), ids=name)
@pytest.mark.filterwarnings("ignore:no face was found")  # files of the test
@pytest.mark.filterwarnings("ignore:.*presets by name")  # trimesh drops transmission
@pytest.mark.usefixtures("small_images")
def test_python_examples_run_in_the_order_of_the_page(page, egl, tmp_path, monkeypatch):
    shutil.copy(MINI_HEAD, tmp_path / "head.glb")
    monkeypatch.chdir(tmp_path)
    if page.stem == "moving":
        stand_ins.write_all(tmp_path)
        Path("landmarks.json").write_text(code(page.read_text("utf-8"), "json")[0])
    if page.stem == "compare":
        for m, file in ((0.3, "golden.exr"), (0.306, "new.exr")):
            fr.render(m=m, size=(640, 640)).save(file)
    if page.stem == "shaders":
        Image.new("RGB", (8, 4), (128, 128, 255)).save("normal.png")
    names: dict[str, object] = {}
    for block in python(page):
        exec(compile(block, name(page), "exec"), names)


VARIABLES = """#version 330 core
uniform vec3 n, l, v, u, albedo, irradiance, position, centre;
uniform vec2 uv;
uniform float m, f0, ks, s, k, material_m, radius, size;
uniform mat3 frame, axes;
uniform sampler2D normal_map, map;
vec3 radiance = vec3(0.0);
out vec4 color;
"""


@pytest.mark.parametrize(
    ("page", "number"),
    [
        pytest.param(page, number, id=f"{page.stem}-{number}")
        for page in GUIDE
        for number, _ in enumerate(code(page.read_text(encoding="utf-8"), "glsl"))
    ],
)
def test_glsl_examples_compile(page, number, egl):
    lines = code(page.read_text(encoding="utf-8"), "glsl")[number].splitlines()
    head = [line for line in lines if line.startswith("#")]
    body = [line for line in lines if line not in (*head, "...")]
    if not head:  # the example of skin.md
        files = ("cook_torrance", "cook_torrance_sample")
        head = [f'#include "facerender/{file}.glsl"' for file in files]
    source = "\n".join([VARIABLES, *head, "void main() {", *body, "color = vec4(radiance, 1.0); }"])
    vertex = "#version 330 core\nvoid main() { gl_Position = vec4(0.0); }"
    context = create_context(egl)
    try:
        with context.drawing() as gl:
            gl.program(vertex_shader=vertex, fragment_shader=fr.resolve_includes(source))
    finally:
        context.release()


@pytest.mark.parametrize("page", [page for page in GUIDE if commands(page)], ids=name)
def test_commands_of_the_page_have_valid_options(page):
    for line in commands(page):
        arguments = shlex.split(line, comments=True)
        if "COMMAND" not in arguments:
            parser_of(arguments).parse_args(arguments)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_somewhere(page):
    assert broken_links(page) == []


def test_a_broken_link_is_seen(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# A `b`, c\n\n# Twice\n\n# Twice\n\n```\n# none\n[x](code)\n```\n\n"
        "[a](#a-b-c) [b](page.md#twice-1) [c](gone.md) [d](#none) [e](https://example.org)\n"
    )
    assert broken_links(page) == ["gone.md", "#none"]


def test_the_api_reference_has_every_public_name():
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    documented = set(
        re.findall(r"^\.\. (?:auto(?:function|class|exception)|py:data):: (\w+)$", page, re.M)
    )
    modules = set(re.findall(r"^\.\. automodule:: facerender\.(\w+)$", page, re.MULTILINE))
    assert documented | modules == set(fr.__all__) - {"__version__"}


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--quiet", DOCS, tmp_path]
    result = subprocess.run(command, capture_output=True, text=True)
    assert (result.returncode, result.stdout + result.stderr) == (0, "")
    assert (tmp_path / "start.html").exists()
