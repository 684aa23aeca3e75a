"""pytest plugin: the fixture ``facerender_snapshot`` compares images with the tests' goldens.

Pytest imports this module in every session if facerender is installed. This module therefore
imports other modules of facerender only when a test first checks an image.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import tempfile
import zlib
from collections.abc import Generator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import pytest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from facerender.comparison.compare import Driver
    from facerender.comparison.goldens import GoldenResult
    from facerender.comparison.sources import Comparable

LONGEST = 180  # characters of a file name; most systems allow 255 bytes
UNUSED = ("ignore", "list", "fail")
DRIVERS = ("auto", "same", "other")
LIMITS = ("point", "block", "trend", "grain", "texture", "coverage", "shift")

_WRITTEN = pytest.StashKey[set[Path]]()  # goldens written in this session
_CHECKS = pytest.StashKey[list[dict[str, str]]]()  # of a test, since its last report
_OWNERS = pytest.StashKey[dict[str, str]]()  # ids of the tests that own goldens, keyed by path


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("facerender", "facerender: images compared with goldens")

    def add(name: str, text: str, default: str | bool = False, **options: Any) -> None:
        flag = {} if options else {"action": "store_true"}
        group.addoption(f"--facerender-{name}", default=None, help=text, **options, **flag)
        kind: Any = "bool" if flag else None
        parser.addini(f"facerender_{name.replace('-', '_')}", text, kind, default)

    add("update", "write missing goldens, and goldens that differ if this renderer recorded them")
    add("force", "with --facerender-update: also overwrite goldens of another renderer")
    add("update-missing", "write missing goldens")
    report = "write DIR/index.html with all images and goldens, and failed images as EXR"
    add("report", report, "", metavar="DIR")
    unused = "action for goldens that no test used, in modules whose tests all passed"
    add("unused", unused, "ignore", choices=UNUSED)
    driver = "same or other: whether one driver draws images and goldens; auto: see their metadata"
    parser.addini("facerender_driver", driver, default="auto")
    for name in LIMITS:
        text = f"default of limit {name}; facerender compare --calibrate finds a value"
        parser.addini(f"facerender_{name}", text, default="")


def pytest_configure(config: pytest.Config) -> None:
    for name, known in {"unused": UNUSED, "driver": DRIVERS}.items():
        if _setting(config, name) not in known:
            raise pytest.UsageError(f"facerender_{name}: give one of {', '.join(known)}")
    for name in LIMITS:
        _limit(config, name)
    if _setting(config, "force") and not _setting(config, "update"):
        raise pytest.UsageError("--facerender-force needs --facerender-update: add it")
    if report := _setting(config, "report"):
        given_here = config.getoption("facerender_report") is not None
        folder = (config.invocation_params.dir if given_here else config.rootpath) / report
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            if not hasattr(config, "workerinput"):
                for path in (folder / "index.html", *folder.glob("actual/**/*.exr")):
                    path.unlink(missing_ok=True)
        except OSError as error:
            raise pytest.UsageError(f"cannot write {folder}: {error.strerror}") from None
        config.option.facerender_report = str(folder)  # workers may have another current folder
    config.pluginmanager.register(_Session(config), "facerender-session")


def _setting(config: pytest.Config, name: str) -> Any:
    """Return the value of an option from the command line, or else from the ini file."""
    value = config.getoption(f"facerender_{name}", None)
    return config.getini(f"facerender_{name}") if value is None else value


def _limit(config: pytest.Config, name: str) -> float | None:
    """Return a limit from the ini file, or None if the file does not set this limit."""
    text = config.getini(f"facerender_{name}")
    try:
        return float(text) if text else None
    except ValueError:
        raise pytest.UsageError(f"facerender_{name} = {text}: give a number") from None


def _goldens(module: Path) -> Path:
    """Return the folder of the goldens of a test file."""
    return module.parent / "goldens" / module.stem


class Snapshot:
    """Value of the fixture :func:`facerender_snapshot`; it compares images with their goldens."""

    def __init__(self, request: pytest.FixtureRequest) -> None:
        self._request = request
        self._names: set[str] = set()

    def check(
        self,
        image: Comparable,
        name: str | None = None,
        *,
        mask: NDArray[Any] | None = None,
        metadata: Mapping[str, str] | None = None,
        driver: Driver | None = None,
        **limits: float | None,
    ) -> None:
        """Compare an image with its golden; fail if they differ or the golden is missing.

        The golden is goldens/MODULE/TEST-PARAMETERS-NAME.exr in the directory of the test file.

        Parameters
        ----------
        image : a Frame, an array (H, W, 3 or 4) of linear float, or the path of an EXR file
        name : name of this image; a test needs it for each image but one
        mask : see :func:`facerender.compare`
        limits : see :func:`facerender.compare`; default: the values in the ini file
        metadata : metadata for the golden in addition to the frame's, for example GL_RENDERER for
            an array
        driver : see :func:`facerender.compare`; default: the ini file's

        Raises
        ------
        AssertionError : the image fails; the message has the reasons and the files
        InputError : the image is not linear float, or another image has the same golden
        """
        __tracebackhide__ = True
        from facerender import InputError
        from facerender.comparison.goldens import Updates, check

        node, config = self._request.node, self._request.config
        if unknown := sorted(limits.keys() - {*LIMITS}):
            raise TypeError(f"{unknown[0]} is not a limit: give {', '.join(LIMITS)}")
        safe = _file_name(f"{_name_of(node)}-{name}" if name else _name_of(node))
        if safe in self._names:
            raise InputError(f"{safe} was checked before in this test: give each image a new name")
        self._names.add(safe)
        golden = _goldens(self._request.path) / f"{safe}.exr"
        owner = _owners(self._request.session).setdefault(str(golden).casefold(), node.nodeid)
        if owner != node.nodeid:
            raise InputError(
                f"{safe}.exr is also the golden of {owner}, at least on disks that ignore case: "
                "rename a parameter or an image"
            )
        written = config.stash.setdefault(_WRITTEN, set())
        result = check(
            f"{node.nodeid} {name}" if name else node.nodeid,
            image,
            golden,
            Updates(*(_setting(config, key) for key in ("update_missing", "update", "force"))),
            written,
            metadata=metadata,
            mask=mask,
            driver=driver or _setting(config, "driver"),
            **{limit_name: _limit(config, limit_name) for limit_name in LIMITS}
            | {limit_name: limit for limit_name, limit in limits.items() if limit is not None},
        )
        if result.written:
            written.add(golden)
        record = self._record(result, golden)
        if result.failure:
            record["actual"] = actual = self._save_actual(result, golden)
            remedy = "" if _setting(config, "update") else _remedy(node.nodeid, result)
            raise AssertionError(f"{result.failure}\n  golden {golden}\n  actual {actual}{remedy}")

    def _record(self, result: GoldenResult, golden: Path) -> dict[str, str]:
        """Record a check for the session, with its report entry as JSON, and return the record."""
        written = str(golden) if result.written else ""
        record = {"golden": str(golden), "written": written, "entry": ""}
        self._request.node.stash.setdefault(_CHECKS, []).append(record)
        if _setting(self._request.config, "report"):
            from facerender.comparison.report import entry

            record["entry"] = json.dumps(asdict(entry(result.pair)))
        return record

    def _save_actual(self, result: GoldenResult, golden: Path) -> str:
        """Write an image that failed; return its path, or the reason why it was not written. The
        path in the folder is the golden's path in pytest's root directory."""
        from facerender import InputError
        from facerender.images.files import save_exr

        root = self._request.config.rootpath
        if report := _setting(self._request.config, "report"):
            folder = Path(report) / "actual"
        else:
            folder = self._request.getfixturevalue("tmp_path_factory").mktemp("facerender")
        actual = folder / (golden.relative_to(root) if golden.is_relative_to(root) else golden.name)
        try:
            actual.parent.mkdir(parents=True, exist_ok=True)
            save_exr(actual, result.image.pixels, result.image.metadata)
        except (OSError, InputError) as error:
            return f"not written: {error}"
        return str(actual)


def _remedy(test: str, result: GoldenResult) -> str:
    """Return a line with the options that accept a changed image; "" if there is no golden."""
    if result.pair.reference is None:
        return ""
    comparison = result.pair.comparison
    failed = [] if comparison is None else comparison.failed
    names = dict.fromkeys("point" if name == "slivers" else name for name in failed)
    wider = ", ".join(f"{name}=..." for name in names if name in LIMITS)
    text = f"\n  if intended: pytest {shlex.quote(test)} --facerender-update"
    return f"{text}, or a wider limit: check(image, {wider})" if wider else text


def _name_of(node: pytest.Item) -> str:
    """Return the name of a test as CLASS.test-PARAMETERS."""
    names = [part.name for part in node.listchain() if isinstance(part, pytest.Class | pytest.Item)]
    return re.sub(r"\[(.*)\]$", r"-\1", ".".join(names))


def _owners(session: pytest.Session) -> dict[str, str]:
    """Return the ids of the tests that own goldens, keyed by the goldens' paths in lower case. Each
    xdist worker collects all tests, so all workers find the same owners of unnamed images."""
    if _OWNERS not in session.stash:
        owners = session.stash[_OWNERS] = {}
        for item in session.items:
            golden = _goldens(item.path) / f"{_file_name(_name_of(item))}.exr"
            owners.setdefault(str(golden).casefold(), item.nodeid)
    return session.stash[_OWNERS]


def _file_name(name: str) -> str:
    """Return a unique file name that is valid on every file system."""
    safe = quote(name, safe="=,+")
    if len(safe) <= LONGEST:
        return safe
    return f"{safe[:LONGEST]}~{zlib.crc32(name.encode(errors='surrogateescape')):08x}"


@pytest.fixture
def facerender_snapshot(request: pytest.FixtureRequest) -> Snapshot:
    """Compare an image with its golden by facerender_snapshot.check(frame)."""
    return Snapshot(request)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    if _CHECKS in item.stash:
        report.facerender_checks = item.stash[_CHECKS]  # type: ignore[attr-defined]
        del item.stash[_CHECKS]
    return report


class _Session:
    """State of a session: checks and goldens.

    With pytest-xdist, each worker sends its checks, as part of its test reports, to the reporting
    process. At its end, the worker also sends the ids of tests that did not pass. Plugins such as
    pytest-rerunfailures repeat failed tests. Only the checks of a test's last attempt count.
    """

    def __init__(self, config: pytest.Config) -> None:
        self.config = config
        self.unused: list[Path] = []
        self._checks: dict[str, list[dict[str, str]]] = {}  # of each test's last attempt
        self._passed: set[str] = set()
        self._collected: dict[str, set[str]] = {}  # test ids, keyed by module

    @pytest.hookimpl(wrapper=True)
    def pytest_make_collect_report(
        self, collector: pytest.Collector
    ) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
        report = yield
        module = collector.getparent(pytest.Module)
        if module is not None:
            collected = self._collected.setdefault(str(module.path), set())
            collected |= {collector.nodeid, *(child.nodeid for child in report.result)}
            if report.passed:
                self._passed.add(collector.nodeid)
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call" and report.passed:
            self._passed.add(report.nodeid)
        if not hasattr(self.config, "workeroutput"):
            earlier = [] if report.when == "setup" else self._checks.get(report.nodeid, [])
            self._checks[report.nodeid] = earlier + getattr(report, "facerender_checks", [])

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        output = getattr(node, "workeroutput", {})  # absent if the worker died
        for module, waiting in output.get("facerender", {}).items():
            self._collected.setdefault(module, set()).update(waiting)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        judged = _setting(self.config, "unused") != "ignore"
        waiting = {module: ids - self._passed for module, ids in self._collected.items()}
        if hasattr(self.config, "workeroutput"):
            if judged:
                lists = {module: sorted(ids) for module, ids in waiting.items()}
                self.config.workeroutput["facerender"] = lists
            return
        # With --lf, pytest collects skipped files as if they had no tests.
        if judged and not self.config.getoption("lf", False):
            self.unused = self._find_unused([module for module in waiting if not waiting[module]])
        fails = self.unused and _setting(self.config, "unused") == "fail"
        if fails and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
        if report := _setting(self.config, "report"):
            self._write_report(Path(report))

    def _find_unused(self, modules: list[str]) -> list[Path]:
        """Return unused goldens of these test files, and all goldens of deleted test files."""
        used = self._of_checks("golden")
        folders = {_goldens(Path(module)) for module in modules}
        for root in {folder.parent for folder in folders}:
            orphans = (f for f in root.glob("*/") if not (root.parent / f"{f.name}.py").exists())
            folders.update(orphans)
        goldens = (golden for folder in folders for golden in folder.glob("[!.]*.exr"))
        return sorted(golden for golden in goldens if str(golden) not in used)

    def _write_report(self, folder: Path) -> None:
        """Write the report, and remove images of attempts that were not a test's last one."""
        for path in {*folder.glob("actual/**/*.exr")} - {*map(Path, self._of_checks("actual"))}:
            path.unlink(missing_ok=True)
        if texts := self._of_checks("entry"):
            from facerender.comparison.report import Entry, write_report

            entries = [Entry(**json.loads(text)) for text in texts]
            write_report(folder / "index.html", sorted(entries, key=lambda entry: entry.name))

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        written = sorted(self._of_checks("written"))
        lines = [f"written: {self._relative(golden)}" for golden in written]
        lines += [f"unused: {self._relative(golden)}" for golden in self.unused]
        if self._of_checks("entry"):
            lines.append(f"report: {_setting(self.config, 'report')}/index.html")
        if lines:
            terminalreporter.write_sep("=", "facerender")
        for line in lines:
            terminalreporter.write_line(line)

    def _of_checks(self, key: str) -> set[str]:
        """Return all texts that the records of the checks have for a key."""
        records = (record for checks in self._checks.values() for record in checks)
        return {record[key] for record in records if record.get(key)}

    def _relative(self, path: str | Path) -> str:
        return os.path.relpath(path, self.config.invocation_params.dir)
