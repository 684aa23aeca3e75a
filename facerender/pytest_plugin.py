"""pytest plugin: the fixture ``facerender_snapshot`` compares images with the tests' goldens.

Pytest imports this module in every session if facerender is installed. This module therefore
imports other modules of facerender only when a test first checks an image.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from facerender.comparison.goldens import Snapshot

UNUSED = ("ignore", "list", "fail")
DRIVERS = ("auto", "same", "other")
LIMITS = ("point", "block", "trend", "grain", "texture", "coverage", "shift")

_CHECKS = pytest.StashKey[list[dict[str, str]]]()  # of a test, since its last report


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("facerender", "facerender: images compared with goldens")

    def add(name: str, text: str, default: str | bool = False, **options: Any) -> None:
        flag = {} if options else {"action": "store_true"}
        group.addoption(f"--facerender-{name}", default=None, help=text, **options, **flag)
        value_type: Any = "bool" if flag else None
        parser.addini(f"facerender_{name.replace('-', '_')}", text, value_type, default)

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
        from_ini = config.getoption("facerender_report") is None
        folder = (config.rootpath if from_ini else config.invocation_params.dir) / report
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


@pytest.fixture
def facerender_snapshot(request: pytest.FixtureRequest) -> Snapshot:
    """Compare an image with its golden by facerender_snapshot.check(frame)."""
    from facerender.comparison.goldens import Snapshot

    config, stash = request.config, request.node.stash
    names = ("update", "update_missing", "force", "report", "driver")
    settings = {name: _setting(config, name) for name in names}
    limits = {name: _limit(config, name) for name in LIMITS}
    return Snapshot(
        request, settings, limits, lambda check: stash.setdefault(_CHECKS, []).append(check)
    )


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
        from facerender.comparison.goldens import goldens_of

        used = self._of_checks("golden")
        folders = {goldens_of(Path(module)) for module in modules}
        for root in {folder.parent for folder in folders}:
            folders |= {f for f in root.glob("*/") if not (root.parent / f"{f.name}.py").exists()}
        goldens = (golden for folder in folders for golden in folder.glob("[!.]*.exr"))
        return sorted(golden for golden in goldens if str(golden) not in used)

    def _write_report(self, folder: Path) -> None:
        """Write the report, and remove images of attempts that were not a test's last one."""
        for path in {*folder.glob("actual/**/*.exr")} - {*map(Path, self._of_checks("actual"))}:
            path.unlink(missing_ok=True)
        if texts := self._of_checks("entry"):
            from facerender.comparison.report import write_report

            entries = map(json.loads, texts)
            write_report(folder / "index.html", sorted(entries, key=lambda entry: entry["name"]))

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
