"""Check that a killed command leaves no partial file, temporary file or process.

    python benchmarks/kills.py [--kills 200] [--seed 1] [render exr measure plan compare ...]

Runs each command once to its end, then repeatedly over existing files. Each of these runs gets
SIGKILL, SIGINT or SIGTERM, in turn, at a random moment; half of them near the end, when the command
writes. A run that ends before the signal is repeated. Afterwards:

- every output file is complete: the old file or the new one;
- after SIGINT and SIGTERM, the exit status is 130 or 143, standard error has one line about it, and
  no temporary file and no process remains;
- after SIGKILL, temporary files may remain; their names mark them as temporary.

The exit status is 1 if a check fails. batch_kills.py tests batches of many processes.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from random import Random

import numpy as np
import psutil
from batch_kills import small
from PIL import Image

_SIGNALS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
_MARK = "FACERENDER_KILLS"  # environment variable that marks the processes of a trial
_UNFINISHED = ".facerender-"
_TERM = 1 << (signal.SIGTERM - 1)

# Arguments of each command. IN and OUT are the folders of inputs and outputs.
COMMANDS = {
    "render": "render IN/small.obj --size 64 -o OUT/a.png",
    "exr": "render IN/small.obj --size 256 -o OUT/a.exr",
    "measure": "measure IN/small.obj --quick -o OUT",
    "plan": "plan IN/small.obj --budget 1/255 --size 32 --samples 1 --cost llvmpipe"
    " --emit OUT/a.glsl --save-scene OUT/a.toml --error-map OUT/a.png",
    "compare": "compare IN/a IN/b --report OUT/a.html",
    "heatmap": "compare IN/a/0.png IN/b/0.png --heatmap OUT/a.png",
    "explore": "explore IN/small.obj -o OUT/a.html",
    "batch": "batch IN/jobs.jsonl -o OUT --workers 1 --chunk 2",
}


@dataclass
class Trial:
    """A command with its own folders for inputs, outputs, temporary files and cache."""

    name: str
    folder: Path

    def __post_init__(self) -> None:
        self.given, self.out = self.folder / "in", self.folder / "out"
        self.places = [self.folder / name for name in ("tmp", "cache")]
        for path in (self.given, self.out, *self.places):
            path.mkdir(parents=True)
        inputs(self.given)
        text = COMMANDS[self.name].replace("IN/", f"{self.given}/").replace("OUT", str(self.out))
        self.command = [sys.executable, "-m", "facerender", *text.split()]
        self.environment = os.environ | {
            _MARK: str(self.folder),
            "TMPDIR": str(self.places[0]),
            "XDG_CACHE_HOME": str(self.places[1]),
        }
        self.environment.pop("FACERENDER_CACHE_MIB", None)

    def start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            self.command,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def files(self) -> dict[str, bytes]:
        """Return the contents of the output folder by file name."""
        found = {}
        for path in self.out.rglob("*"):
            with suppress(FileNotFoundError, IsADirectoryError):
                found[str(path.relative_to(self.out))] = path.read_bytes()
        return found

    def temporary(self) -> list[str]:
        """Return the temporary files in the output folder, the cache and the temporary folder."""
        left = [name for name in self.files() if Path(name).name.startswith(_UNFINISHED)]
        left += [name for name in self.files() if name.startswith(".unfinished")]
        left += [path.name for path in self.places[0].iterdir()]
        return left + [path.name for path in self.places[1].rglob(".*")]

    def processes(self) -> list[str]:
        """Return the command lines of the trial's running processes."""
        found = []
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                running = process.status() != psutil.STATUS_ZOMBIE
                if running and process.environ().get(_MARK) == str(self.folder):
                    found.append(" ".join(process.cmdline())[:80])
        return found

    def clear(self) -> None:
        """Remove the temporary files and folders that SIGKILL may leave."""
        for name in self.files():
            if Path(name).name.startswith(_UNFINISHED):
                (self.out / name).unlink()
        shutil.rmtree(self.out / ".unfinished", ignore_errors=True)
        for place in self.places:
            shutil.rmtree(place)
            place.mkdir()


def inputs(folder: Path) -> None:
    """Write the inputs of all commands."""
    mesh = small(folder)
    rng = np.random.default_rng(1)
    for name in ("a", "b"):
        (folder / name).mkdir()
        for number in range(4):
            pixels = rng.integers(0, 256, (96, 96, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(folder / name / f"{number}.png")
    rows = [{"id": f"job{i}", "mesh": str(mesh), "image.size": 48} for i in range(8)]
    (folder / "jobs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def whole(name: str, content: bytes) -> bool:
    """Return whether a file whose content varies between runs is complete."""
    try:
        if name.endswith(".png"):
            Image.open(BytesIO(content)).load()
        elif name.endswith((".json", ".jsonl")):
            [json.loads(line) for line in content.splitlines()] if "jsonl" in name else json.loads(
                content
            )
        else:
            return name.endswith(".html") and content.rstrip().endswith(b"</html>")
    except (OSError, ValueError, SyntaxError):
        return False
    return True


def catches_sigterm(process: subprocess.Popen[bytes]) -> bool:
    """Return whether a process has installed its handler of SIGTERM."""
    with suppress(OSError, StopIteration, ValueError):
        lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
        caught = next(line for line in lines if line.startswith("SigCgt"))
        return bool(int(caught.split()[1], 16) & _TERM)
    return False


def run(trial: Trial, kills: int, random: Random) -> tuple[Counter[str], list[str]]:
    """Kill a command ``kills`` times; return the counts of exit statuses and the errors."""
    began = time.monotonic()
    process = trial.start()
    process.communicate()
    seconds, calm = time.monotonic() - began, process.returncode
    new = trial.files()
    if calm not in (0, 1) or not new or trial.temporary():
        raise SystemExit(f"{trial.name}: exit status {calm} without a kill, {trial.temporary()}")
    # The commands may read JSON files again, so these must stay valid.
    old = {
        name: content + (b"\n" if name.endswith(".json") else b"\nold")
        for name, content in new.items()
    }
    ends, faults = Counter[str](), []
    number = 0
    while number < kills:
        sent = _SIGNALS[number % len(_SIGNALS)]
        if trial.name == "batch":
            shutil.rmtree(trial.out)
            trial.out.mkdir()
        else:
            for name, content in old.items():
                (trial.out / name).write_bytes(content)
        began = time.monotonic()
        process = trial.start()
        while not catches_sigterm(process) and process.poll() is None:
            time.sleep(0.001)
        at = seconds * random.uniform(random.choice((0.0, 0.8)), 1.0)
        with suppress(subprocess.TimeoutExpired):
            process.wait(max(at - (time.monotonic() - began), 0.0))
        process.send_signal(sent)
        _, errors = process.communicate()
        code = process.returncode
        if code == calm:
            seconds = 0.8 * seconds + 0.2 * (time.monotonic() - began)
        else:
            number += 1
        ends[f"{sent.name}: {code}"] += 1
        about = f"{trial.name}, kill {number}, {sent.name}, exit status {code}"
        for name, content in trial.files().items():
            if Path(name).name.startswith((".facerender-", ".lock")) or ".unfinished" in name:
                continue
            known = (old.get(name), new.get(name))
            if content not in known and not whole(name, content):
                faults.append(f"{about}: {name} is incomplete, {len(content)} bytes")
        if sent is not signal.SIGKILL:
            if code not in (128 + sent, calm):
                faults.append(f"{about}: {errors.decode()[-300:]}")
            lines = [line for line in errors.decode().splitlines() if "interrupted" in line
                     or "terminated" in line or "Traceback" in line]  # fmt: skip
            if code == 128 + sent and (len(lines) != 1 or "Traceback" in lines[0]):
                faults.append(f"{about}: standard error is {errors.decode()[-300:]!r}")
            faults += [f"{about}: temporary file {left} remains" for left in trial.temporary()]
            faults += [f"{about}: process {left} still runs" for left in trial.processes()]
        trial.clear()
    return ends, faults


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200, help="kills per command")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("commands", nargs="*", metavar="COMMAND", help=", ".join(COMMANDS))
    options = parser.parse_args()
    wrong = 0
    for name in options.commands or COMMANDS:
        folder = Path(tempfile.mkdtemp(prefix="kills-"))
        began = time.monotonic()
        ends, faults = run(Trial(name, folder / "trial"), options.kills, Random(options.seed))
        counts = ", ".join(f"{count} {end}" for end, count in sorted(ends.items()))
        print(f"{name}: {options.kills} kills in {time.monotonic() - began:.0f} s; {counts}; "
              f"{len(faults)} errors", flush=True)  # fmt: skip
        for fault in faults[:10]:
            print(f"  {fault}")
        wrong += len(faults)
        shutil.rmtree(folder)
    return int(bool(wrong))


if __name__ == "__main__":
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path[1:]))
    raise SystemExit(main())
