"""The subjects of the fuzzer: a file of a seed, the function that reads it, and the checks of the
result."""

from __future__ import annotations

import re
import shutil
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from functools import cache, partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

import facerender as fr
from facerender.batch.jobs import JobTable
from facerender.commands import main
from facerender.drawing import maps
from facerender.errors import FacerenderError, InputError
from facerender.images.files import read_image
from facerender.mesh import face
from facerender.scene.environment import EnvironmentFile, load_environment
from facerender.scene.job import load_scene
from facerender.scene.pose import posed
from tests.verification.fuzz import seeds

SLOW = 10.0  # seconds of processor time per input; waiting is limited by HANGS
LARGE = 1 << 30  # bytes of resident memory that one input may add
LONGEST = 600  # characters in a message, which has one line
# Smaller values of constants (module, name, value): points for the face and texels of shadow maps
# take most of the time.
REDUCED = (
    (face, "_POINTS", face._POINTS // 16),
    (face, "_LOCAL", face._LOCAL // 16),
    (maps, "_FEWEST_TEXELS", maps._FEWEST_TEXELS // 8),
    (maps, "_BLOCKS", maps._BLOCKS // 8),
)
_HEAD = Path(__file__).parents[3] / "tests" / "data" / "mini_head.glb"
_CLEAR, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")
OUTCOMES = ("clean", "warned", "refused", "crash", "unsound", "slow", "large")
FAULTS = OUTCOMES[3:]


class Unsound(Exception):
    """A result, an image or a message fails a check."""


@dataclass(frozen=True)
class Subject:
    """A file to mutate, with the files that it needs.

    Attributes
    ----------
    name : names the seed, and the changed file if there are several
    files : content of all files, by name; only one of them is changed
    changed : name of the changed file
    examine : reads the files in a folder; raises FacerenderError for input that it refuses, and
        Unsound if a check fails
    """

    name: str
    files: Mapping[str, bytes]
    changed: str
    examine: Callable[[Path], None]

    @property
    def seed(self) -> bytes:
        return self.files[self.changed]

    @property
    def suffix(self) -> str:
        return Path(self.changed).suffix


@dataclass(frozen=True)
class Result:
    """The outcome of an input, one of OUTCOMES, and for FAULTS a line that identifies the fault."""

    outcome: str
    signature: str = ""


@cache
def subjects() -> tuple[Subject, ...]:
    """Return every subject, in the order of the corpus."""
    return tuple(_subjects())


def _subjects() -> Iterator[Subject]:
    for number, (name, files) in enumerate(seeds.meshes()):
        for changed in files:
            label = f"{name}-{number}" if changed == name else f"{name}-{number}-{changed}"
            yield Subject(label, files, changed, partial(_examine_mesh, name))
    for name, content in seeds.vertices(len(_head().parts[0].positions)):
        yield Subject(f"vertices-{name}", {name: content}, name, partial(_examine_vertices, name))
    for number, (name, content) in enumerate(seeds.images()):
        yield Subject(f"{name}-{number}", {name: content}, name, partial(_examine_image, name))
    for number, content in enumerate(seeds.scenes(fr.Scene(_head()))):
        yield Subject(f"scene-{number}.toml", {"a.toml": content}, "a.toml", _examine_scene)
    for name, content in seeds.tables():
        yield Subject(f"jobs-{name}", {name: content}, name, partial(_examine_jobs, name))
    for name, content in seeds.cameras(_head()):
        yield Subject(f"cameras-{name}", {name: content}, name, partial(_examine_cameras, name))
    for number, words in enumerate(seeds.options()):
        content = "\n".join(words).encode()
        yield Subject(f"render-{number}.txt", {"a.txt": content}, "a.txt", _examine_render)


def examine(subject: Subject, content: bytes, folder: Path) -> Result:
    """Empty a folder, read a subject with changed content there, and return the outcome."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, data in {**subject.files, subject.changed: content}.items():
        (folder / name).write_bytes(data)
    _CLEAR.write_text("5")  # resets the peak of the resident memory
    before, start = _peak(), time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = _judged(subject, folder)
    if result.outcome == "clean" and caught:
        result = Result("warned")
        for each in caught:
            if "/PIL/" in each.filename:
                continue  # Pillow's warnings about tags and sizes
            if not issubclass(each.category, fr.FacerenderWarning):
                result = Result("unsound", _plain(f"{each.category.__name__}: {each.message}"))
            if why := _bad_message(str(each.message)):
                result = Result("unsound", f"{subject.name}: a warning {why}")
    if result.outcome not in FAULTS and time.process_time() - start > SLOW:
        return Result("slow", subject.name)
    if result.outcome not in FAULTS and _peak() - before > LARGE:
        return Result("large", subject.name)
    return result


def _judged(subject: Subject, folder: Path) -> Result:
    try:
        subject.examine(folder)
    except FacerenderError as error:
        if why := _bad_message(str(error)):
            return Result("unsound", f"{subject.name}: an error {why}")
        return Result("refused")
    except Unsound as error:
        return Result("unsound", f"{subject.name}: {error}")
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [each for each in frames if "/facerender/" in each.filename] or frames
        where = f"{Path(own[-1].filename).name}:{own[-1].lineno} {own[-1].name}"
        return Result("crash", _plain(f"{type(error).__name__} in {where}: {error}"))
    return Result("clean")


def _plain(text: str) -> str:
    """Return the beginning of a text with all numbers replaced by 0."""
    return re.sub(r"\d+", "0", text)[:160]


def _bad_message(message: str) -> str:
    if not message.strip() or re.search(r"(?<!\w)\(\s*\)", message):
        return "says nothing"
    if "\n" in message.strip():
        return "has lines"
    return f"has over {LONGEST} characters" if len(message) > LONGEST else ""


def _peak() -> int:
    """Return the peak of the resident memory in bytes."""
    (line,) = (line for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM"))
    return 1024 * int(line.split()[1])


# --- checks --------------------------------------------------------------------------------------


@cache
def _renderer() -> fr.Renderer:
    return fr.Renderer((24, 24), samples=1)


@cache
def _head() -> fr.Mesh:
    return fr.load_mesh(_HEAD)


def _demand(holds: object, what: str) -> None:
    if not holds:
        raise Unsound(what)


def _examine_mesh(name: str, folder: Path) -> None:
    mesh = fr.load_mesh(folder / name)
    for part in mesh.parts:
        count = len(part.positions)
        _demand(part.faces.size and part.faces.max() < count, "face indices")
        used = np.unique(part.faces)
        _demand(np.isfinite(part.positions[used]).all(), "positions")
        lengths = np.linalg.norm(part.normals[used], axis=1)
        _demand(np.allclose(lengths, 1.0, atol=1e-3), "normals")
        for values in (part.uv, part.colors):
            _demand(values is None or np.isfinite(values[used]).all(), "uv or colours")
    _demand(np.isfinite(mesh.bounds).all() and 0.0 < mesh.radius < np.inf, "bounds")
    _draw(fr.Scene(mesh))
    _draw(fr.Scene(mesh, fr.Camera(frame="face")))
    _examine_poses(mesh)


def _examine_poses(mesh: fr.Mesh) -> None:
    """Draw the middle of each clip, and the mesh with all shapes. Clips and shapes may be damaged
    in a file that is drawn without a warning: only the pose is then refused."""
    poses: list[Mapping[str, Any]] = [{"weights": dict.fromkeys(mesh.shapes, 0.5)}]
    poses += [{"clip": name, "time": 0.5 * seconds} for name, seconds in mesh.clips.items()]
    for pose in poses if mesh.shapes or mesh.clips else ():
        try:
            moved = mesh.with_pose(**pose)
        except InputError as error:
            _demand(not _bad_message(str(error)), f"an error {_bad_message(str(error))}")
            continue
        for part in moved.parts:
            used = np.unique(part.faces)
            _demand(np.isfinite(part.positions[used]).all(), "positions of a pose")
            lengths = np.linalg.norm(part.normals[used], axis=1)
            _demand(np.allclose(lengths, 1.0, atol=1e-3), "normals of a pose")
        _draw(fr.Scene(fr.tracked(moved)))


def _examine_vertices(name: str, folder: Path) -> None:
    for frame in (0, 1):
        _draw(fr.Scene(posed(_head(), fr.Pose(vertices=str(folder / name), frame=frame))))


def _draw(scene: fr.Scene, shading: fr.Shading = fr.Shading()) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        frame = _renderer().render(scene, shading)
    for each in caught:
        warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    _demand(np.isfinite(frame.linear).all(), "a pixel is not finite")
    _demand((frame.linear >= 0.0).all(), "a pixel is negative")
    _demand(frame.linear[..., 3].any() or caught, "an empty picture, and no word of it")
    frame.srgb8()


def _examine_image(name: str, folder: Path) -> None:
    path, refused = folder / name, []
    for read in (_as_map, _as_picture, _as_environment):
        try:
            read(path)
        except InputError as error:
            refused.append(error)
    if len(refused) == 3:
        raise min(refused, key=lambda error: -len(str(error)))


def _as_map(path: Path) -> None:
    _draw(fr.Scene(_head().with_material(albedo_map=fr.Texture.open(path))))


def _as_picture(path: Path) -> None:
    picture = read_image(path)
    result = fr.compare(picture, picture)
    _demand(result.same, f"an image differs from itself: {result}")


def _as_environment(path: Path) -> None:
    if path.suffix in (".hdr", ".exr", ".npy", ".npz"):
        environment = load_environment(EnvironmentFile(str(path)))
        _draw(fr.Scene(_head(), lights=(), environment=environment))


def _examine_scene(folder: Path) -> None:
    settings = load_scene(folder / "a.toml")
    mesh = _head()
    if "material" in settings:
        mesh = mesh.with_material(**settings.pop("material"))
    shading = fr.Shading.from_dict(settings.pop("shading", {}))
    if (environment := settings.pop("environment", None)) is not None:
        settings["environment"] = load_environment(environment)
    cameras = settings.pop("cameras", ())
    settings.pop("planned", None)
    for name in ("before", "pose"):
        with suppress(InputError):  # the mesh has no shapes
            mesh = posed(mesh, settings.pop(name, fr.Pose()))
    for camera in {settings.pop("camera", fr.Camera()), *cameras}:
        _draw(fr.Scene(mesh, camera, **settings), shading)


def _examine_cameras(name: str, folder: Path) -> None:
    cameras = fr.load_cameras(folder / name, (24, 24))
    for camera in dict.fromkeys([*cameras.values()][:4]):
        _draw(fr.Scene(_head(), camera))


def _examine_render(folder: Path) -> None:
    """Run ``facerender render`` with the lines of a file as arguments."""
    words = (folder / "a.txt").read_text("latin-1").split("\n")
    image = folder / "a.exr"
    own = ["--size", "24", "--no-cache", "-o", str(image)]
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as stderr:
        try:
            status: object = main(["render", str(_HEAD), *words, *own])
        except SystemExit as error:  # --help
            status = error.code or 0
    lines = stderr.getvalue().splitlines()
    for line in lines:
        _demand(line.startswith("facerender: "), f"standard error has {line[:80]!r}")
        _demand(not _bad_message(line), f"a message {_bad_message(line)}")
    _demand(status in (0, 2), f"exit status {status}")
    if status == 2:
        _demand(not image.exists() and lines, "exit status 2 with an image or without a word")
        raise InputError(lines[-1])
    if image.exists():
        linear = read_image(image).pixels
        _demand(np.isfinite(linear).all(), "a pixel is not finite")
        _demand(linear[..., 3].any() or lines, "an empty picture, and no word of it")


def _examine_jobs(name: str, folder: Path) -> None:
    for _ in (table := JobTable(folder / name)):
        pass
    for fault in table.faults:
        if why := _bad_message(fault):
            raise Unsound(f"fault {why}: {fault[:200]!r}")
