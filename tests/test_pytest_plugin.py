"""Tests the pytest plugin on generated suites, which run in this process or in another."""

from __future__ import annotations

import errno
import re
import shutil
import signal
from pathlib import Path
from typing import get_args

import numpy as np
import OpenEXR
import pytest

import facerender as fr
from facerender import pytest_plugin
from facerender.comparison import report  # noqa: F401  (imported once, not in every suite)
from facerender.comparison.calibration import NAMES, read_limits, text_of
from facerender.comparison.compare import Driver, compare
from facerender.comparison.goldens import write
from facerender.images.files import read_image, save_exr
from facerender.images.image import image_from_array
from tests.awkward_files import MINI_HEAD

PLUGIN = ("-p", "facerender.pytest_plugin", "-p", "xdist")

# image(value) has one value everywhere; RENDERER is the renderer in its metadata.
SUITE = """
import os
import numpy as np
import pytest

def image(value=0.5): return np.full((32, 32, 3), value, dtype=np.float32)

@pytest.fixture
def snapshot(facerender_snapshot):
    renderer = os.environ.get("RENDERER", "llvmpipe (LLVM 15.0.6, 256 bits)")
    def check(pixels, *args, **options):
        options.setdefault("metadata", {"GL_RENDERER": renderer})
        facerender_snapshot.check(pixels, *args, **options)
    return check
"""
ONE = "def test_head(snapshot): snapshot(image({value}))\n"


class Suites:
    """Writes test suites and runs them."""

    def __init__(self, pytester: pytest.Pytester) -> None:
        self.pytester = pytester
        self.path = pytester.path

    def write(self, tests: str, module: str = "test_suite") -> None:
        self.pytester.makepyfile(**{module: SUITE + tests})

    def run(self, *options: str, **outcomes: int) -> pytest.RunResult:
        result = self.pytester.runpytest_inprocess(*PLUGIN, *options)
        if outcomes:
            result.assert_outcomes(**outcomes)
        return result

    def passes(self, *options: str) -> list[bool]:
        """Run one module, and return for each test whether it passed."""
        output = self.run(*options).stdout.str()
        (letters,) = re.findall(r"^(?:test_suite\.py )?([.F]+) +\[100%\]$", output, re.M)
        return [letter == "." for letter in letters]

    def run_apart(self, *options: str) -> pytest.RunResult:
        return self.pytester.runpytest_subprocess(*PLUGIN, *options)

    def golden(self, name: str = "test_head", module: str = "test_suite") -> Path:
        return self.path / "goldens" / module / f"{name}.exr"

    def share(self, count: int) -> None:
        """Copy the golden of test_head to the tests test_0, test_1, ..."""
        for number in range(count):
            shutil.copy(self.golden(), self.golden(f"test_{number}"))

    def goldens(self) -> list[str]:
        return sorted(path.name for path in self.path.glob("goldens/*/*"))

    def value(self, name: str = "test_head") -> float:
        value = float(read_image(self.golden(name)).pixels[0, 0, 0])
        return round(value, 4)  # goldens have 24-bit floats


@pytest.fixture
def suites(pytester, monkeypatch) -> Suites:
    monkeypatch.setenv("PYTHONPATH", str(Path(fr.__file__).parents[1]))
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    return Suites(pytester)


@pytest.fixture
def recorded(suites) -> Suites:
    """A suite with one test and its golden of value 0.5, recorded on llvmpipe."""
    suites.write(ONE.format(value=0.5))
    suites.run("--facerender-update-missing", passed=1)
    return suites


# --- comparing -----------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [(), ("--facerender-unused=list",)])
def test_missing_golden_fails_and_names_the_option(suites, options):
    suites.write(ONE.format(value=0.5))
    result = suites.run(*options, "--facerender-report=page", failed=1)
    assert "<li>no golden yet</li>" in (suites.path / "page/index.html").read_text()
    result.stdout.fnmatch_lines(["*test_head has no golden: --facerender-update-missing writes it"])
    result.stdout.no_fnmatch_line("*if intended*")
    assert suites.goldens() == []


def test_golden_is_stored_next_to_the_test_with_metadata(suites):
    suites.pytester.mkpydir("inner")
    suites.pytester.path.joinpath("inner/test_deep.py").write_text(SUITE + ONE.format(value=2.5))
    result = suites.run("--facerender-update-missing", passed=1)
    golden = suites.path / "inner/goldens/test_deep/test_head.exr"
    result.stdout.fnmatch_lines(["written: inner/goldens/test_deep/test_head.exr"])
    file = OpenEXR.File(str(golden))
    np.testing.assert_array_equal(file.channels()["RGB"].pixels, np.full((32, 32, 3), 2.5))
    assert file.header()["GL_RENDERER"] == "llvmpipe (LLVM 15.0.6, 256 bits)"
    assert file.header()["facerender"] == fr.__version__


def test_golden_of_an_array_names_no_driver(suites):
    suites.write("def test_head(facerender_snapshot): facerender_snapshot.check(image())")
    suites.run("--facerender-update-missing", passed=1)
    assert not read_image(suites.golden()).metadata.keys() & {"GL_RENDERER", "GL_VERSION"}


def test_golden_of_a_frame_has_its_metadata(suites, egl):
    suites.write(
        "import facerender as fr\n"
        "def test_frame(facerender_snapshot):\n"
        f"    mesh = fr.load_mesh({str(MINI_HEAD)!r})\n"
        f"    frame = fr.render(mesh, size=(48, 32), samples=1, backend={egl!r})\n"
        "    facerender_snapshot.check(frame)\n"
    )
    suites.run("--facerender-update-missing", passed=1)
    metadata = read_image(suites.golden("test_frame")).metadata
    assert set(metadata) >= {"facerender", "GL_RENDERER", "GL_VERSION", "samples", "camera"}
    suites.run(passed=1)


def test_path_of_an_image(recorded):
    save_exr(recorded.path / "own.exr", np.full((32, 32, 3), 0.5, np.float32), {})
    recorded.write("def test_head(snapshot): snapshot('own.exr')")
    recorded.run(passed=1)


def test_difference_fails_with_reasons_and_both_images(recorded):
    recorded.write(ONE.format(value=0.6))
    result = recorded.run("--basetemp=out", failed=1)
    result.stdout.fnmatch_lines(
        [
            "*AssertionError: test_head differs from its golden: point: 1024 pixels differ * by up "
            "to 0.09*, limit 0.005: perhaps *",
            f"*golden {recorded.golden()}",
            "*actual *out/facerender0/goldens/test_suite/test_head.exr",
            "*if intended: pytest test_suite.py::test_head --facerender-update, or a wider limit: "
            "check(image, point=..., block=...)",
            "test_suite.py:*: AssertionError",  # a line of the suite, not of the plugin
        ]
    )
    actual = read_image(recorded.path / "out/facerender0/goldens/test_suite/test_head.exr")
    assert actual.pixels[0, 0] == pytest.approx(0.6)
    assert recorded.value() == 0.5


LIMITS = [
    ("0.51", "", False),
    ("0.51", "block=0.03", True),
    ("0.6", "block=0.3, point=0.2", True),
    ("0.6", "block=0.3", False),
    ("0.50001", "", True),
    ("0.501", "block=1e-3", False),
    ("0.6", "mask=np.zeros((32, 32))", False),
]


def test_limits_are_options_of_check(recorded):
    recorded.write(
        "".join(
            f"def test_{i}(snapshot): snapshot(image({value}), {options})\n"
            for i, (value, options, _) in enumerate(LIMITS)
        )
    )
    recorded.share(len(LIMITS))
    assert recorded.passes() == [passes for *_, passes in LIMITS]


NONE = {
    "image(np.nan)": "*the image holds 3072 NaN and 0 infinite values*",
    "image()[..., 0]": "*the image is grey: give RGB",
    "image().astype(np.uint8)": "*8-bit, which is too coarse for a golden*facerender compare",
    "image(), block=-1.0": "*limit block = -1.0 is outside*",
    "image(), mask=np.ones((3, 3))": "*the mask is 3 x 3*",
}


def test_invalid_images_are_not_stored_as_goldens(suites):
    def write(*images: str) -> None:
        tests = enumerate(images)
        suites.write("".join(f"def test_{i}(snapshot): snapshot({each})\n" for i, each in tests))

    def refuse() -> None:
        write(*NONE)
        result = suites.run("--facerender-update", failed=len(NONE))
        result.stdout.fnmatch_lines([*NONE.values()])

    refuse()
    assert suites.goldens() == []
    write(*["image()"] * len(NONE))
    suites.run("--facerender-update-missing", passed=len(NONE))
    refuse()
    assert [suites.value(f"test_{i}") for i in range(len(NONE))] == [0.5] * len(NONE)


@pytest.mark.parametrize(
    ("scale", "limits", "bits"),
    [(1.0, {}, 24), (50.0, {}, 24), (1e6, {}, 32), (1.0, {"point": 0.0}, 32)],
)
def test_golden_is_rounded_by_a_part_of_the_limits(tmp_path, scale, limits, bits):
    values = np.random.default_rng(1).random((48, 64, 3), np.float32) * np.float32(scale)
    write(tmp_path / "a.exr", image_from_array(values, "a"), limits)
    error = (np.abs(read_image(tmp_path / "a.exr").pixels - values) / values).max()
    assert error <= {24: 2.0**-16, 32: 0.0}[bits] < 1000.0 * error + (bits == 32)
    assert compare(tmp_path / "a.exr", values, **limits).same


# --- names ---------------------------------------------------------------------------------------


def test_names_of_goldens(suites):
    suites.write(
        "@pytest.mark.parametrize('p', ['a/b', 'a-b', 'a[b]', 'x@y', 'ü', 0.5, '..'])\n"
        "def test_p(snapshot, p): snapshot(image())\n"
        "class TestA:\n"
        "    def test_same(self, snapshot): snapshot(image(0.1))\n"
        "class TestB:\n"
        "    def test_same(self, snapshot): snapshot(image(0.2))\n"
        "def test_named(snapshot):\n"
        "    snapshot(image(0.3), 'one')\n"
        "    snapshot(image(0.4), '../two')\n"
    )
    suites.run("--facerender-update-missing", passed=10)
    suites.run(passed=10)
    assert suites.goldens() == [
        *("TestA.test_same.exr", "TestB.test_same.exr"),
        *("test_named-..%2Ftwo.exr", "test_named-one.exr"),
        *("test_p-%5Cxfc.exr", "test_p-...exr", "test_p-0.5.exr", "test_p-a%2Fb.exr"),
        *("test_p-a%5Bb%5D.exr", "test_p-a-b.exr", "test_p-x%40y.exr"),
    ]


def test_long_names_are_shortened_and_stay_distinct(suites):
    suites.write(
        "@pytest.mark.parametrize('p', ['ж' * 300 + end for end in 'ab'], ids=str)\n"
        "def test_p(snapshot, p): snapshot(image(), 'ж' * 300 + p[-1])\n"
    )
    suites.run("--facerender-update-missing", passed=2)
    names = suites.goldens()
    assert len(names) == 2
    assert max(map(len, names)) < 200


def test_names_must_be_unique(suites):
    suites.write("def test_head(snapshot):\n    snapshot(image(0.1))\n    snapshot(image(0.2))\n")
    result = suites.run("--facerender-update", failed=1)
    result.stdout.fnmatch_lines(["*test_head was checked before in this test: give each image*"])
    assert suites.value() == pytest.approx(0.1)


SHARED = """
@pytest.mark.parametrize("p", ["front", "side"])
def test_view(snapshot, p): snapshot(image(0.1 if p == "front" else 0.2), "again")
def test_other(snapshot): snapshot(image(0.3), "again")
"""


@pytest.mark.parametrize("extra", [(), pytest.param(("-n", "2"), marks=pytest.mark.slow)])
def test_equal_names_in_two_tests_are_two_goldens(suites, extra):
    suites.write(SHARED)
    run = suites.run_apart if extra else suites.run
    run(*extra, "--facerender-update-missing").assert_outcomes(passed=3)
    names = ["test_other-again", "test_view-front-again", "test_view-side-again"]
    assert suites.goldens() == [f"{name}.exr" for name in names]
    assert [suites.value(name) for name in names] == pytest.approx([0.3, 0.1, 0.2])
    run(*extra).assert_outcomes(passed=3)


TWICE = {  # tests, and a test whose golden is also the golden of a later test
    "case": (
        "@pytest.mark.parametrize('p', ['A', 'a'])\ndef test_p(snapshot, p): snapshot(image())\n",
        "test_p[[]A]",
    ),
    "name": (
        "@pytest.mark.parametrize('p', ['x-y', 'x'])\n"
        "def test_p(snapshot, p): snapshot(image(), None if '-' in p else 'y')\n",
        "test_p[[]x-y]",
    ),
}


@pytest.mark.parametrize("extra", [(), pytest.param(("-n", "2"), marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", TWICE)
def test_goldens_of_two_tests_in_one_file_are_refused(suites, case, extra):
    tests, owner = TWICE[case]
    suites.write(tests)
    run = suites.run_apart if extra else suites.run
    result = run(*extra, "--facerender-update-missing")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines([f"*.exr is also the golden of test_suite.py::{owner}, at least*"])


def test_golden_folder_that_cannot_be_created(suites):
    suites.write(ONE.format(value=0.5))
    (suites.path / "goldens").touch()
    result = suites.run("--facerender-update-missing", failed=1)
    result.stdout.fnmatch_lines(["*cannot make */goldens/test_suite: *"])


# --- updates -------------------------------------------------------------------------------------


def test_update_writes_different_and_missing_goldens(recorded):
    before = recorded.golden().read_bytes()
    stat = recorded.golden().stat()
    recorded.write(
        ONE.format(value=0.50001)  # within the limits
        + "def test_other(snapshot): snapshot(image(0.7))\n"
    )
    result = recorded.run("--facerender-update", passed=2)
    result.stdout.no_fnmatch_line("written: *test_head.exr")
    result.stdout.fnmatch_lines(["written: goldens/test_suite/test_other.exr"])
    assert recorded.golden().read_bytes() == before
    assert recorded.golden().stat().st_mtime_ns == stat.st_mtime_ns

    recorded.write(ONE.format(value=0.6) + "def test_other(snapshot): snapshot(image(0.7))\n")
    recorded.run(passed=1, failed=1)
    recorded.run("--facerender-update", passed=2)
    assert recorded.value() == pytest.approx(0.6)
    recorded.run(passed=2)


def test_update_accepts_another_size(recorded):
    recorded.write("def test_head(snapshot): snapshot(image()[:16])")
    result = recorded.run(failed=1)
    result.stdout.fnmatch_lines(["*test_head.exr is 32 x 32, the image is 32 x 16 pixels*"])
    recorded.run("--facerender-update", passed=1)
    recorded.run(passed=1)


def test_update_missing_keeps_different_goldens(recorded):
    before = recorded.golden().read_bytes()
    recorded.write(ONE.format(value=0.6) + "def test_other(snapshot): snapshot(image(0.7))\n")
    recorded.run("--facerender-update-missing", passed=1, failed=1)
    assert recorded.golden().read_bytes() == before
    assert recorded.goldens() == ["test_head.exr", "test_other.exr"]
    recorded.run("-o", "facerender_update=true", passed=2)  # option of an ini file
    assert recorded.value() == pytest.approx(0.6)


@pytest.mark.first_case
def test_update_refuses_the_golden_of_another_renderer(recorded, monkeypatch):
    recorded_on, this = "llvmpipe (LLVM 15.0.6, 256 bits)", "softpipe"
    monkeypatch.setenv("RENDERER", this)
    before = recorded.golden().read_bytes()
    recorded.write(ONE.format(value=0.6))
    result = recorded.run("--facerender-update", failed=1)
    result.stdout.fnmatch_lines(
        [
            f"*test_head.exr was recorded on {recorded_on}, this is {this}: "
            "--facerender-force overwrites it"
        ]
    )
    assert recorded.golden().read_bytes() == before
    recorded.run("--facerender-update", "--facerender-force", passed=1)
    assert recorded.value() == pytest.approx(0.6)
    assert recorded.goldens() == ["test_head.exr"]


def test_update_refuses_an_unreadable_golden(recorded):
    recorded.golden().write_text("version https://git-lfs.github.com/spec/v1\n")
    before = recorded.golden().read_bytes()
    for options in ((), ("--facerender-update",)):
        result = recorded.run(*options, failed=1)
        result.stdout.fnmatch_lines(["*test_head.exr is a Git LFS pointer; fetch it with git lfs*"])
    assert recorded.golden().read_bytes() == before
    assert recorded.goldens() == ["test_head.exr"]
    recorded.run("--facerender-update", "--facerender-force", passed=1)
    assert recorded.value() == 0.5


KILLED = """
import os, signal
from pathlib import Path

def half(path, content):
    with path.open("wb") as file:
        file.write(content[:200])
    os.kill(os.getpid(), signal.SIGKILL)

Path.write_bytes = half
"""


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGKILL, KeyboardInterrupt(), OSError(28)], ids=repr)
def test_interrupted_update_leaves_the_old_golden(recorded, monkeypatch, end):
    before = recorded.golden().read_bytes()
    recorded.write(ONE.format(value=0.6))
    if killed := end is signal.SIGKILL:
        recorded.pytester.makeconftest(KILLED)
        assert recorded.run_apart("--facerender-update").ret == -end
        recorded.pytester.makeconftest("")
    else:

        def half(path: Path, content: bytes) -> None:
            with path.open("wb") as file:
                file.write(content[:200])
            raise end

        with monkeypatch.context() as patched:
            patched.setattr(Path, "write_bytes", half)
            result = recorded.pytester.runpytest_inprocess(
                *PLUGIN, "--facerender-update", no_reraise_ctrlc=True
            )
        assert result.ret == (1 if isinstance(end, OSError) else pytest.ExitCode.INTERRUPTED)
    assert recorded.golden().read_bytes() == before
    left = [name for name in recorded.goldens() if name != "test_head.exr"]
    assert all(name.startswith(".") for name in left)
    assert len(left) == int(killed)

    recorded.write(ONE.format(value=0.5))  # partial files of a killed process are ignored
    assert recorded.run("--facerender-unused=fail").ret == pytest.ExitCode.OK


@pytest.mark.parametrize(
    ("ini", "options", "message"),
    [
        ("", ["--facerender-force"], "--facerender-force needs --facerender-up*"),
        ("", ["--facerender-report=file/page"], "cannot write */file/page: Not a directory"),
        ("facerender_unused = never", [], "facerender_unused: give one of ignore, list, fail"),
        ("facerender_shift = far", [], "facerender_shift = far: give a number"),
    ],
)
def test_invalid_settings_are_refused(suites, ini, options, message):
    (suites.path / "file").touch()
    suites.pytester.makeini(f"[pytest]\n{ini}\n")
    suites.write(ONE.format(value=0.5))
    result = suites.run(*options)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([f"ERROR: {message}"])


# --- ini -----------------------------------------------------------------------------------------


def test_ini(suites):
    suites.pytester.makeini(
        "[pytest]\nfacerender_update_missing = true\nfacerender_unused = fail\n"
        "facerender_report = page\n"
    )
    suites.write(ONE.format(value=0.5))
    inner = suites.pytester.mkdir("inner")
    result = suites.pytester.runpytest_inprocess(*PLUGIN, f"--rootdir={suites.path}")
    result.assert_outcomes(passed=1)
    assert suites.goldens() == ["test_head.exr"]
    assert (suites.path / "page").is_dir()
    suites.golden("old").write_bytes(b"")
    assert suites.run().ret == pytest.ExitCode.TESTS_FAILED
    assert suites.run("--facerender-unused=ignore").ret == pytest.ExitCode.OK
    suites.golden().unlink()
    suites.run("-o", "facerender_update_missing=false", failed=1)
    assert list(inner.iterdir()) == []


def test_plugin_has_every_limit():
    assert pytest_plugin.LIMITS == NAMES
    assert get_args(Driver) == pytest_plugin.DRIVERS


@pytest.mark.first_case
@pytest.mark.parametrize(
    ("name", "before"),
    [
        ("pytest.ini", "[pytest]\n"),
        ("tox.ini", "[tox]\nenvlist = py  ; one\n[pytest]\n"),
        ("setup.cfg", "[metadata]\nname = x\n[tool:pytest]\n"),
        ("pyproject.toml", '[project]\nname = "x"\n[tool.pytest.ini_options]\n'),
        ("pyproject.toml", '[tool.pytest]\naddopts = ["-q"]\n'),
    ],
)
def test_pytest_and_compare_read_the_same_limits(recorded, name, before):
    path = recorded.path / name
    limits = {**dict.fromkeys(NAMES, (1e6, "sees nothing")), "block": (0.03, "")}
    _, *rows = text_of(path, {"linear": limits}).splitlines()
    path.write_text(before + "\n".join(rows))
    assert read_limits(path)["linear"]["block"] == 0.03
    values = enumerate((0.5, 0.51, 0.52))  # 0.51 differs from 0.5 by 2 %
    recorded.write("".join(f"def test_{i}(snapshot): snapshot(image({v}))\n" for i, v in values))
    recorded.share(3)
    assert recorded.passes(f"-c{path}") == [True, True, False]


@pytest.mark.slow
def test_driver_of_images_that_name_none(recorded):
    """Only images of another driver may have this noise."""
    noisy = "image() * (1.0 + 2e-3 * np.random.default_rng(1).normal(size=(32, 32, 1)))"
    for value, options in ((noisy, ""), (noisy, "driver='same'"), ("image()", "driver='same'")):
        recorded.write(
            "def test_head(snapshot):\n"
            f"    snapshot({value}, metadata={{}}, point=1, texture=1, {options})\n"
        )
        for driver in ("auto", "same", "other"):
            recorded.pytester.makeini(f"[pytest]\nfacerender_driver = {driver}\n")
            strict = "same" in options or driver == "same"
            passes = value == "image()" or not strict
            recorded.run(passed=int(passes), failed=int(not passes))
    recorded.pytester.makeini("[pytest]\nfacerender_driver = x\n")
    result = recorded.run()
    result.stderr.fnmatch_lines(["*facerender_driver: give one of auto, same, other"])


def test_arguments_of_check_override_the_ini_file(recorded):
    recorded.pytester.makeini("[pytest]\nfacerender_block = 1e-4\nfacerender_trend = 1e6\n")
    for options, passes in (("", False), ("block=0.01", True)):
        recorded.write(f"def test_head(snapshot): snapshot(image(0.5004), {options})")
        recorded.run(passed=int(passes), failed=int(not passes))


# --- goldens that no test uses -------------------------------------------------------------------

TWO = """
def test_a(snapshot): snapshot(image())
class TestB:
    def test_b(self, snapshot): snapshot(image(), 'b')
    def test_c(self): pass
"""


@pytest.fixture
def unused(suites) -> Suites:
    """A suite with two modules and their goldens, and one unused golden for each module."""
    for module in ("test_one", "test_two"):
        suites.write(TWO, module)
    suites.run("--facerender-update-missing", passed=6)
    for module in ("test_one", "test_two"):
        suites.golden("old", module).write_bytes(b"")
    return suites


def found(result: pytest.RunResult) -> list[str]:
    return [line for line in result.outlines if line.startswith("unused: ")]


BOTH = [f"unused: goldens/{module}/old.exr" for module in ("test_one", "test_two")]


@pytest.mark.parametrize("extra", [(), pytest.param(("-n", "2"), marks=pytest.mark.slow)])
def test_unused_goldens_are_listed_or_fail(unused, extra):
    run = unused.run_apart if extra else unused.run
    result = run(*extra, "--facerender-unused=list")
    assert found(result) == BOTH
    assert result.ret == pytest.ExitCode.OK
    result = run(*extra, "--facerender-unused=fail")
    assert found(result) == BOTH
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.assert_outcomes(passed=6)
    result = run(*extra)
    assert found(result) == []
    result.stdout.no_fnmatch_line("*= facerender =*")


SELECTIONS = [
    (["-k", "test_a"], []),
    (["-k", "test_a or test_two"], ["test_two"]),
    (["--deselect=test_one.py::TestB::test_b"], ["test_two"]),
    (["test_one.py"], ["test_one"]),
    (["test_one.py::test_a", "test_two.py"], ["test_two"]),
    (["test_one.py::TestB", "test_two.py"], ["test_two"]),
    (["test_one.py::TestB", "test_one.py::test_a"], ["test_one"]),
    (["--ignore=test_one.py"], ["test_two"]),
    (["-n2", "-k", "test_a or test_two"], ["test_two"]),
    (["--lf"], []),
    (["--co"], []),
]


@pytest.mark.slow
def test_unused_goldens_need_a_complete_module(unused):
    for selection, judged in SELECTIONS:
        run = unused.run_apart if "-n2" in selection else unused.run
        result = run(*selection, "--facerender-unused=fail")
        assert found(result) == [f"unused: goldens/{name}/old.exr" for name in judged], selection
        status = pytest.ExitCode.TESTS_FAILED if judged else pytest.ExitCode.OK
        assert result.ret == status, selection


@pytest.mark.first_case
@pytest.mark.parametrize(
    "tests",
    [
        TWO + "def test_d(): pytest.skip()\n",
        TWO + "def test_d(): assert False\n",
        TWO + "@pytest.mark.xfail\ndef test_d(): assert False\n",
        TWO + "raise RuntimeError\n",
        TWO + "pytest.importorskip('no_such_module')\n",
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_unused_goldens_need_passed_tests(unused, tests):
    unused.write(tests, "test_one")
    result = unused.run("--facerender-unused=list", "--continue-on-collection-errors")
    assert found(result) == BOTH[1:]
    if "d(): assert False" in tests and "xfail" not in tests:  # --lf skips whole modules
        result = unused.run("--lf", "--facerender-unused=list")
        result.assert_outcomes(failed=1)
        assert found(result) == []


def test_goldens_of_a_removed_module_are_unused(unused):
    (unused.path / "test_one.py").unlink()
    result = unused.run("--facerender-unused=list")
    names = ("TestB.test_b-b", "old", "test_a")
    assert found(result) == [f"unused: goldens/test_one/{name}.exr" for name in names] + BOTH[1:]


# --- the report ----------------------------------------------------------------------------------


@pytest.mark.parametrize("extra", [(), pytest.param(("-n", "2"), marks=pytest.mark.slow)])
def test_report_has_every_image_and_failed_ones_as_exr(recorded, extra):
    recorded.write(
        ONE.format(value=0.6)
        + "@pytest.mark.parametrize('p', [1, 2, 3])\n"
        + "def test_many(snapshot, p): snapshot(image(0.5), 'head')\n"
    )
    for p in (1, 2, 3):
        shutil.copy(recorded.golden(), recorded.golden(f"test_many-{p}-head"))
    run = recorded.run_apart if extra else recorded.run
    result = run(*extra, "--facerender-report", "new/page")
    result.assert_outcomes(passed=3, failed=1)
    folder = recorded.path / "new/page"
    page = (folder / "index.html").read_text()
    names = ("test_head", *(f"test_many[{p}] head" for p in (1, 2, 3)))
    assert [f"test_suite.py::{name}" in page for name in names] == [True] * 4
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
    actual = "actual/goldens/test_suite/test_head.exr"
    assert files == [actual, "index.html"]
    result.stdout.fnmatch_lines([f"*actual {folder}/{actual}", f"report: {folder}/index.html"])


def test_actual_images_replace_goldens_by_a_copy(recorded):
    """The folder of failed images has the structure of pytest's root directory."""
    inner = recorded.pytester.mkpydir("inner")
    (inner / "test_deep.py").write_text(SUITE + ONE.format(value=0.7))
    recorded.write(ONE.format(value=0.6))
    recorded.run("--facerender-report=page", failed=2)
    shutil.copytree(recorded.path / "page/actual", recorded.path, dirs_exist_ok=True)
    recorded.run(passed=2)
    assert recorded.value() == pytest.approx(0.6)


def test_report_in_a_folder_without_write_permission(recorded, monkeypatch):
    """The error is one line before the first test, also if the folder has an old report."""
    recorded.write(ONE.format(value=0.6))
    recorded.run("--facerender-report=page", failed=1)

    def refuse(*arguments: object, **options: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    for part in ("pathlib.Path.unlink", "tempfile.TemporaryFile"):
        with monkeypatch.context() as patched:
            patched.setattr(part, refuse)
            result = recorded.run("--facerender-report=page")
        assert result.ret == pytest.ExitCode.USAGE_ERROR
        assert re.fullmatch(
            r"ERROR: cannot write .*page: Read-only file system\n*", result.stderr.str()
        )


def test_report_removes_images_of_earlier_sessions(recorded):
    recorded.write(ONE.format(value=0.6))
    recorded.run("--facerender-report=page", failed=1)
    recorded.write(ONE.format(value=0.5))
    recorded.run("--facerender-report=page", passed=1)
    assert list((recorded.path / "page").rglob("*.exr")) == []


# Repeats a failed test as pytest-rerunfailures does: it logs no report after the failed one.
RERUNS = """
from _pytest.runner import runtestprotocol

def pytest_runtest_protocol(item, nextitem):
    for last in (False, True):
        for report in runtestprotocol(item, nextitem=nextitem, log=False):
            failed = report.failed and not last
            report.outcome = "rerun" if failed else report.outcome
            item.ihook.pytest_runtest_logreport(report=report)
            if failed:
                break
        else:
            return True

def pytest_report_teststatus(report):
    return ("rerun", "R", "RERUN") if report.outcome == "rerun" else None
"""
FLAKY = """
from collections import Counter
attempts = Counter()

@pytest.fixture
def first(request):
    attempts[request.node.name] += 1
    return attempts[request.node.name] == 1

@pytest.fixture
def late(first): assert first

def wrong(is_wrong): return image(0.9 if is_wrong else 0.5)

def test_passes(snapshot, first): snapshot(wrong(first))
@pytest.mark.parametrize("p", ["a", "b"])
def test_many(snapshot, first, p): snapshot(wrong(first and p == "a"))
def test_other_image(snapshot, first):
    snapshot(wrong(first), "one")
    snapshot(wrong(not first), "two")
def test_fewer_images(snapshot, first):
    if first: snapshot(wrong(True), "one")
def test_setup(late, snapshot): snapshot(wrong(True))
def test_twice(snapshot): snapshot(wrong(True))
"""


@pytest.mark.parametrize("extra", [(), pytest.param(("-n", "2"), marks=pytest.mark.slow)])
def test_only_the_last_attempt_at_a_test_leaves_images(recorded, extra):
    names = ["test_passes", "test_many-a", "test_many-b", "test_setup", "test_twice"]
    names += ["test_other_image-one", "test_other_image-two", "test_fewer_images-one"]
    for name in names:
        shutil.copy(recorded.golden(), recorded.golden(name))
    recorded.write(FLAKY)
    recorded.pytester.makeconftest(RERUNS)
    result = recorded.run_apart(*extra, "--facerender-report=page")
    result.assert_outcomes(passed=4, failed=2, errors=1)
    actual = {path.name for path in (recorded.path / "page").rglob("*.exr")}
    assert actual == {"test_other_image-two.exr", "test_twice.exr"}
    page = (recorded.path / "page/index.html").read_text()
    assert "<h1>Comparison: 2 differ, 4 the same</h1>" in page
    assert "test_fewer_images" not in page


@pytest.mark.parametrize("tests", ["def test_other(): pass\n", ""])
def test_session_without_images_removes_the_report_of_an_earlier_one(recorded, tests):
    recorded.write(ONE.format(value=0.6))
    recorded.run("--facerender-report=page", failed=1)
    recorded.write(tests)
    recorded.run("--facerender-report=page")
    assert [path for path in (recorded.path / "page").rglob("*") if path.is_file()] == []


@pytest.mark.slow
@pytest.mark.parametrize("end", ["os.kill(os.getpid(), 9)", "os._exit(3)"])
def test_dead_worker_leaves_no_file(recorded, end):
    recorded.write(
        ONE.format(value=0.5)
        + f"def test_dies(snapshot):\n    snapshot(image(), 'one')\n    {end}\n"
        + "@pytest.fixture\n"
        + f"def ending():\n    yield\n    {end}\n"
        + "def test_dies_later(ending, snapshot): snapshot(image(0.9))\n"
    )
    for name in ("test_dies-one", "test_dies_later"):
        shutil.copy(recorded.golden(), recorded.golden(name))
    recorded.run_apart("-n", "2", "--facerender-report=page")
    folder = recorded.path / "page"
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert files == {"index.html", "actual/goldens/test_suite/test_dies_later.exr"}
    page = (folder / "index.html").read_text()
    assert "<h1>Comparison: 1 differs, 1 the same</h1>" in page


def test_failure_to_store_an_image_hides_no_reason(recorded):
    recorded.write(ONE.format(value=0.6))
    (recorded.path / "page").mkdir()
    (recorded.path / "page/actual").touch()
    result = recorded.run("--facerender-report=page")
    result.stdout.fnmatch_lines(["*test_head differs from its golden*", "*actual not written: *"])


# --- other sessions ------------------------------------------------------------------------------


def test_sessions_without_images_import_nothing(suites):
    suites.pytester.makepyfile(
        "import sys\n"
        "heavy = {'facerender.errors', 'numpy', 'moderngl'}\n"
        "def test_nothing(): assert not heavy & set(sys.modules)\n"
    )
    result = suites.run_apart("--facerender-unused=list", "--facerender-report=page")
    result.assert_outcomes(passed=1)
    assert list((suites.path / "page").iterdir()) == []
