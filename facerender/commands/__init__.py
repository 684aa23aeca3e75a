"""The command line: arguments to calls, results to standard output. An error is one line on
standard error and exit status 2; warnings go to standard error as well."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
import signal
import sys
import textwrap
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, TextIO

from facerender._version import __version__
from facerender.drawing.context import BACKENDS, probe
from facerender.drawing.frame import ONLY
from facerender.drawing.prepare import start_maps
from facerender.drawing.renderer import Renderer
from facerender.errors import FacerenderError, FacerenderWarning, InputError, reason
from facerender.glsl.library import TARGETS, shader_dir, shader_source
from facerender.image import read_image, write_bytes
from facerender.loading import load_mesh
from facerender.lobes import NAMES as LOBES
from facerender.scenes.camera import Camera, turntable
from facerender.scenes.file import load_scene
from facerender.scenes.light import LIGHTS, parse_light
from facerender.scenes.scene import Scene
from facerender.shading import FRESNEL_TERMS, MASKING_TERMS, MODELS, OUTSIDE, Shading

CAMERAS = {"front": 0.0, "three-quarter": -35.0, "profile": 90.0}


class _Parser(argparse.ArgumentParser):
    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        # Values such as -35,10 are no options either.
        self._negative_number_matcher = re.compile(r"-[\d.]")

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")


def console() -> NoReturn:
    """Entry point of the command. Ctrl-C ends the process at once, since trimesh would catch and
    forget a KeyboardInterrupt; while a file is written, it is cleaned up first. So does a reader of
    standard output that has read enough."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    sys.exit(main())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status: 0 done, 1 images differ, 2 bad input, no OpenGL."""
    caught: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("always", FacerenderWarning)
        warnings.showwarning = _warning_printer(caught)
        try:
            options = _parser().parse_args(arguments)
            command: Callable[[argparse.Namespace, list[str]], int] = options.command
            return command(options, caught)
        except FacerenderError as error:
            print(f"facerender: error: {' '.join(str(error).split())}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            return 130


def _warning_printer(caught: list[str]) -> Callable[..., None]:
    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        line_number: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, FacerenderWarning):
            caught.append(str(message))
            print(f"facerender: warning: {message}", file=sys.stderr)

    return show


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="facerender", description="Render face meshes with skin highlights.")
    parser.add_argument("--version", action="version", version=f"facerender {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_render(commands.add_parser("render", help="render a mesh file, or the built-in head"))
    _add_plan(
        commands.add_parser("plan", help="the cheapest shading within a budget, with its proof")
    )
    _add_measure(
        commands.add_parser("measure", help="what each approximation costs and loses, here")
    )
    reproduce = commands.add_parser(
        "reproduce", help="the paper's figures and claims, measured here"
    )
    reproduce.add_argument(
        "-o", "--output", default="out/reproduction", metavar="DIR", help="(out/reproduction)"
    )
    reproduce.set_defaults(command=_reproduce)
    _add_compare(commands.add_parser("compare", help="whether two renders are the same"))
    _add_shaders(commands.add_parser("shaders", help="the GLSL library, for programs of your own"))
    doctor = commands.add_parser("doctor", help="what OpenGL is found here, what is missing")
    doctor.add_argument("--json", action="store_true", help="print the findings as JSON")
    doctor.set_defaults(command=_doctor)
    return parser


def _add_render(render: argparse.ArgumentParser) -> None:
    render.set_defaults(command=_render)
    render.add_argument("-o", "--output", required=True, metavar="OUT", help=".png or .exr")
    terms, scene = _add_scene(render)
    terms.add_argument("--lobe", choices=LOBES, help="(exact)")
    terms.add_argument(
        "--outside",
        choices=OUTSIDE,
        help="what a material gets whose m leaves the domain of the lobe (error)",
    )
    terms.add_argument(
        "--budget",
        metavar="ERROR",
        help="plan the cheapest terms within 1/255, 0.5%% or '0.02 flip', and use them",
    )
    scene.add_argument("--scene", metavar="FILE.toml", help="camera, lights, material, reflectance")
    scene.add_argument("--camera", metavar="WHERE", help=_WHERE)

    image = render.add_argument_group("image")
    image.add_argument("--size", default="1024", help="N or WxH in pixels (1024)")
    image.add_argument("--samples", type=int, default=4, help="per pixel; 1 for none (4)")
    image.add_argument("--exposure", type=float, default=0.0, help="of the PNG, in stops (0)")
    image.add_argument("--only", choices=ONLY, help="one term in place of the whole image")
    image.add_argument("--backend", choices=BACKENDS, default="auto", help="(auto)")
    image.add_argument("--json", action="store_true", help="describe the image as JSON")


def _add_plan(plan: argparse.ArgumentParser) -> None:
    plan.set_defaults(command=_plan)
    plan.description = (
        "The cheapest shading of a scene whose error at every pixel stays within a budget, against "
        "the exact lobe with all terms and maps."
    )
    plan.add_argument(
        "--budget", required=True, metavar="ERROR", help="1/255, 0.5%% or '0.02 flip'"
    )
    plan.add_argument(
        "--guarantee", action="store_true", help="bound the error for every camera; looser"
    )
    plan.add_argument(
        "--cost",
        default="auto",
        metavar="OF",
        help="llvmpipe, navi21 (RDNA2) or vega10 (GCN5) from a table; here, to measure; "
        "radv:navi21 or radv:vega10, to compile (auto: the table of llvmpipe where the CPU draws, "
        "of RDNA2 elsewhere)",
    )
    _, scene = _add_scene(plan)
    scene.add_argument(
        "--from", dest="scene", metavar="FILE.toml", help="camera, lights, material, reflectance"
    )
    scene.add_argument(
        "--camera",
        action="append",
        metavar="WHERE",
        help=f"{_WHERE}; turntable, for 8 around; a TOML file with a path of [[cameras]]; repeat "
        "for several",
    )
    images = plan.add_argument_group("where the error is measured")
    images.add_argument("--size", default="1024", help="N or WxH in pixels (1024)")
    images.add_argument("--samples", type=int, default=4, help="per pixel; 1 for none (4)")
    images.add_argument("--exposure", type=float, default=0.0, help="of the display, in stops (0)")
    images.add_argument("--backend", choices=BACKENDS, default="auto", help="(auto)")

    output = plan.add_argument_group("results")
    output.add_argument("--json", action="store_true", help="every figure")
    output.add_argument("--emit", metavar="OUT.glsl", help="the shader, with these choices made")
    output.add_argument("--target", choices=TARGETS, help="of the shader: begin with its #version")
    output.add_argument(
        "--scene",
        dest="pinned",
        metavar="OUT.toml",
        help="the scene with this shading, for facerender render --scene",
    )
    output.add_argument("--error-map", metavar="OUT.png", help="of the camera with the largest")


_WHERE = f"{', '.join(CAMERAS)}, or AZIMUTH[,ELEVATION[,ZOOM]] in degrees"


def _add_scene(
    command: argparse.ArgumentParser,
) -> tuple[argparse._ArgumentGroup, argparse._ArgumentGroup]:
    """Add what a scene is made of, and return the groups on reflectance and on the scene."""
    command.add_argument(
        "mesh", nargs="?", help=".glb .gltf .obj .ply .stl; without it the built-in head"
    )
    terms = command.add_argument_group("reflectance")
    terms.add_argument("--model", choices=MODELS, help="(cook-torrance)")
    terms.add_argument("--fresnel", choices=FRESNEL_TERMS, help="(schlick)")
    terms.add_argument("--masking", choices=MASKING_TERMS, help="(v-cavity)")
    terms.add_argument(
        "--m", type=float, help="rms slope of the microfacets, in place of the file's map (0.3)"
    )
    terms.add_argument("--f0", type=float, help="reflectance at normal incidence (0.028)")
    terms.add_argument("--ks", type=float, help="specular weight (1)")
    terms.add_argument("--kd", type=float, help="diffuse weight (1)")

    maps = command.add_argument_group("maps, in place of those of the mesh file")
    for name in ("albedo", "normal-map", "specular-map", "roughness-map"):
        maps.add_argument(f"--{name}", metavar="FILE")
    maps.add_argument("--flip-v", action="store_true", help="turn texture coordinates upside down")
    maps.add_argument("--anisotropy", type=float, default=1.0, help="of texture filtering (1)")
    maps.add_argument("--float-albedo", action="store_true", help="albedo as linear float16")

    scene = command.add_argument_group("scene")
    scene.add_argument("--fov", type=float, help="vertical angle of view in degrees (25)")
    scene.add_argument(
        "--light",
        action="append",
        metavar="LIGHT",
        help=f"{', '.join(LIGHTS)}, AZIMUTH,ELEVATION[,IRRADIANCE] or "
        "point:X,Y,Z[,IRRADIANCE]; repeat for several (key, rim, fill)",
    )
    scene.add_argument("--ambient", metavar="E", help="irradiance from everywhere, E or R,G,B")
    scene.add_argument("--background", metavar="RGB", help="linear R,G,B, or none: transparent")
    return terms, scene


def _add_measure(measure: argparse.ArgumentParser) -> None:
    measure.set_defaults(command=_measure)
    measure.add_argument("mesh", nargs="?", help="rendered; without it the built-in head")
    measure.add_argument(
        "-o",
        "--output",
        default="out/measure",
        metavar="DIR",
        help="for measure.json, plots and index.html (out/measure)",
    )
    measure.add_argument("--m", type=float, default=0.3, help="rms slope of the mesh (0.3)")
    measure.add_argument("--quick", action="store_true", help="smaller images, fewer repeats")
    measure.add_argument("--backend", choices=BACKENDS, default="auto", help="(auto)")
    measure.add_argument("--json", action="store_true", help="print measure.json, no table")


def _add_compare(compare: argparse.ArgumentParser) -> None:
    compare.set_defaults(command=_compare)
    compare.description = "Exit status: 0 the same, 1 they differ, 2 they cannot be compared."
    kinds = ".exr, .npz, .npy, .png or .jpg, or a folder of them"
    compare.add_argument("a", metavar="A", help=f"reference: {kinds}")
    compare.add_argument("b", metavar="B", help="image, or folder with files of the same names")
    compare.add_argument(
        "--point", type=float, help="limit: excess of a pixel (0.05; 8-bit: 8 steps)"
    )
    compare.add_argument(
        "--block", type=float, help="limit: mean difference of a block (0.005; 8-bit: 1 step)"
    )
    compare.add_argument("--coverage", type=float, help="limit: share of changed pixels (0.005)")
    compare.add_argument("--mask", metavar="FILE", help="image, not 0 where pixels count")
    compare.add_argument("--heatmap", metavar="OUT.png", help="map of FLIP, for two images")
    compare.add_argument("--report", metavar="OUT.html", help="a page to look at the images")
    compare.add_argument("--json", action="store_true", help="every figure")


def _add_shaders(shaders: argparse.ArgumentParser) -> None:
    actions = shaders.add_subparsers(required=True, metavar="ACTION")
    listing = actions.add_parser("list", help="every function: signature, unit, error")
    listing.add_argument("--json", action="store_true", help="all that the headers say, as JSON")
    listing.set_defaults(command=_list_shaders)
    path = actions.add_parser("path", help="the include root")
    path.set_defaults(command=_print_shader_dir)
    flatten = actions.add_parser("flatten", help="one file, with all that it includes")
    flatten.add_argument(
        "name",
        metavar="NAME",
        help="cook_torrance, lobe/exact, ...; a function; or a GLSL file of your own",
    )
    flatten.add_argument(
        "--target",
        choices=TARGETS,
        help="begin with this #version; without it: text to include, for all targets",
    )
    flatten.add_argument("--lobe", choices=LOBES, help="leave the others out")
    flatten.add_argument("--m", type=float, help="rms slope, as a constant")
    flatten.set_defaults(command=_flatten)


def _render(options: argparse.Namespace, caught: list[str]) -> int:
    size = _parse_size(options.size)
    if options.budget is not None and options.only is not None:
        raise InputError(f"--budget plans the whole image: leave --only {options.only} out")
    scene, shading = _load(options, [options.camera] if options.camera else [])[:2]
    found: dict[str, Any] = {}
    with _renderer(options, size, options.samples) as renderer:
        if options.budget is not None:
            from facerender.planning.cache import planned

            found = planned(scene, options.budget, shading, options.exposure, renderer)
            shading = Shading.from_dict(found["shading"])
        frame = renderer.render(scene, shading, options.only)
        backend = renderer.context.backend
    _clean_up_on_interrupt()
    frame.save(options.output, options.exposure)
    if options.json:
        facts = {
            "output": options.output,
            "size": size,
            "backend": backend,
            "only": frame.only,
            **frame.metadata,
            "warnings": caught,
        }
        if found:
            facts["plan"] = found
        print(json.dumps(facts, indent=2))
    else:
        print(options.output)
        if found:
            print(*found["text"].splitlines()[-2:], sep="\n", file=sys.stderr)
    return 0


def _plan(options: argparse.Namespace, caught: list[str]) -> int:
    from facerender.planning.budget import Budget
    from facerender.planning.plan import plan
    from facerender.pricing.table import COMPILED, HERE

    size = _parse_size(options.size)
    Budget.parse(options.budget, options.exposure)
    if options.target and not options.emit:
        raise InputError(f"--target {options.target} is of a shader: say --emit OUT.glsl")
    if options.guarantee and (options.camera or options.error_map):
        raise InputError("--guarantee is not measured: leave --camera and --error-map out")
    _check_outputs(options)
    _check_pinned(options.pinned)
    scene, full, cameras = _load(options, options.camera or [])
    if options.cost == HERE or options.cost in COMPILED:
        print("facerender: measuring costs takes a minute or two", file=sys.stderr)
    choices: dict[str, Any] = {"cost": options.cost, "exposure": options.exposure, "full": full}
    if options.guarantee:
        found = plan(scene, options.budget, guarantee=True, **choices)
    else:
        with _renderer(options, size, options.samples) as renderer:
            found = plan(scene, options.budget, cameras=cameras, renderer=renderer, **choices)
    _clean_up_on_interrupt()
    if options.emit:
        write_bytes(options.emit, found.shader(options.target).encode())
    if options.pinned:
        write_bytes(options.pinned, (_PINNED + found.scene_toml()).encode())
    if options.error_map:
        found.save_error_map(options.error_map)
    print(json.dumps(found.as_dict(), indent=2) if options.json else found.explain())
    return 0


def _check_outputs(options: argparse.Namespace) -> None:
    """Nothing is planned for results that cannot be written, or that would replace one another or
    what is read."""
    read = ("mesh", "scene", "albedo", "normal_map", "specular_map", "roughness_map")
    taken = {Path(name).resolve() for key in read if (name := getattr(options, key))}
    for name in filter(None, (options.emit, options.pinned, options.error_map)):
        path = Path(name).resolve()
        if path in taken:
            raise InputError(f"{name} is read, or written twice: give another name")
        if path.is_dir() or not os.access(path.parent, os.W_OK):
            raise InputError(f"cannot write {name}: give a file in a writable folder")
        taken.add(path)
    if options.error_map and not options.error_map.lower().endswith(".png"):
        raise InputError(f"--error-map {options.error_map}: give a .png")


_PINNED = "# Written by facerender plan.\n"


def _check_pinned(name: str | None) -> None:
    """A scene that somebody wrote is not replaced: --scene names one to read elsewhere."""
    if name is None or not Path(name).is_file():
        return
    try:
        start = Path(name).read_bytes()[: len(_PINNED)]
    except OSError as error:
        raise InputError(f"cannot read {name}: {reason(error)}") from None
    if start != _PINNED.encode():
        raise InputError(
            f"{name} exists, and is not of facerender plan: --from {name} reads a scene; give "
            "--scene another name"
        )


def _renderer(options: argparse.Namespace, size: tuple[int, int], samples: int) -> Renderer:
    return Renderer(
        size,
        samples=samples,
        backend=options.backend,
        anisotropy=options.anisotropy,
        float_albedo=options.float_albedo,
    )


def _load(
    options: argparse.Namespace, places: Sequence[str]
) -> tuple[Scene, Shading, tuple[Camera, ...]]:
    """Return what options, scene file and mesh say: scene, shading, and the cameras of the places,
    or else of the file, or else the scene's own."""
    if options.m is not None and options.roughness_map is not None:
        raise InputError("--m and --roughness-map exclude each other: leave one of them out")
    settings = load_scene(options.scene) if options.scene else {}
    names = ("model", "lobe", "fresnel", "masking", "outside")
    terms = {name: value for name in names if (value := getattr(options, name, None)) is not None}
    pinned = settings.pop("shading", {})
    _check_unpinned(options, pinned)
    shading = Shading.from_dict(pinned | terms)
    material = settings.pop("material", {})
    if options.roughness_map is not None:
        material.pop("m", None)
    path = settings.pop("cameras", ())
    camera = settings.get("camera", path[0] if path else Camera())
    if options.fov is not None:
        camera = dataclasses.replace(camera, fov=options.fov)
    cameras = tuple(each for place in places for each in _cameras(place, camera)) or path
    settings["camera"] = cameras[0] if places else camera
    settings.update(_scene_settings(options))
    material.update(
        (name, value)
        for name in ("m", "f0", "ks", "kd")
        if (value := getattr(options, name)) is not None
    )
    _import_trimesh()
    mesh = load_mesh(
        options.mesh,
        albedo=options.albedo,
        normal_map=options.normal_map,
        specular_map=options.specular_map,
        roughness_map=options.roughness_map,
        flip_v=options.flip_v,
    ).with_material(**material)
    start_maps(mesh, "linear-color" if options.float_albedo else "color")
    scene = Scene(mesh, **settings)
    return scene, shading, cameras or (scene.camera,)


def _measure(options: argparse.Namespace, caught: list[str]) -> int:
    from facerender.measure import plots, report
    from facerender.measure.run import measure

    plots.check()
    folder = _folder(options.output)
    _import_trimesh()
    mesh = load_mesh(options.mesh)
    with _Progress() as progress:
        measurement, triptychs = measure(mesh, options.m, options.quick, options.backend, progress)
        progress("report", 0.0)
        _clean_up_on_interrupt()
        paths = report.write(measurement, triptychs, folder)
    content = measurement.as_dict()
    print(json.dumps(content, indent=2) if options.json else report.table(measurement))
    for line in measurement.not_measured:
        print(f"facerender: not measured: {line}", file=sys.stderr)
    print(*paths, sep="\n", file=sys.stderr)
    return 0


def _clean_up_on_interrupt() -> None:
    """From here on files are written, which Ctrl-C must not leave half-written."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _folder(text: str) -> Path:
    """Make the folder of the results, so that nothing is measured for one that cannot be."""
    try:
        Path(text).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make {text}: {reason(error)}; give a writable folder") from None
    return Path(text)


class _Progress:
    """A line on standard error that says what is done, and vanishes; on a terminal only."""

    def __enter__(self) -> _Progress:
        return self

    def __call__(self, what: str, done: float) -> None:
        if sys.stderr.isatty():
            bar = "#" * round(24 * done)
            print(f"\r\033[K{bar:24}  {what}", end="", file=sys.stderr, flush=True)

    def __exit__(self, *exception: object) -> None:
        if sys.stderr.isatty():
            print("\r\033[K", end="", file=sys.stderr, flush=True)


def _import_trimesh() -> None:
    """Import trimesh without scipy and networkx, which it imports where it finds them, for things
    that reading a file does not need, and which take two thirds of a cold start. The process is
    this command's own, so nobody else misses them in trimesh."""
    absent = [name for name in ("scipy", "networkx") if name not in sys.modules]
    sys.modules.update(dict.fromkeys(absent))  # type: ignore[arg-type]
    try:
        import trimesh  # noqa: F401
    finally:
        for name in absent:
            del sys.modules[name]


def _parse_size(text: str) -> tuple[int, int]:
    try:
        numbers = [int(word) for word in text.lower().split("x")]
        width, height = numbers * 2 if len(numbers) == 1 else numbers
    except ValueError:
        raise InputError(f"size {text!r}: give N or WxH, such as 1024 or 640x480") from None
    return width, height


def _numbers(option: str, text: str, counts: Sequence[int]) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts:
        wanted = " or ".join(map(str, counts))
        raise InputError(f"--{option} {text!r}: give {wanted} numbers with commas between")
    return numbers


def _check_unpinned(options: argparse.Namespace, pinned: Mapping[str, Any]) -> None:
    """An option of which the scene's shading would take no account is refused."""
    for key, names in (
        ("m", ("m", "roughness_map")),
        ("ks", ("ks", "specular_map")),
        ("normal_map", ("normal_map",)),
        ("ambient", ("ambient",)),
        ("specular_lights", ("light",)),
        ("frontal_lights", ("light",)),
    ):
        for name in names:
            if key in pinned and getattr(options, name) is not None:
                raise InputError(
                    f"{options.scene} pins {key} = {pinned[key]} of the shading: leave "
                    f"--{name.replace('_', '-')} out, or that line"
                )


def _cameras(place: str, camera: Camera) -> tuple[Camera, ...]:
    """Return the cameras that a word means, others of their kind as the given one."""
    if place == "turntable":
        return turntable(camera)
    if place.lower().endswith(".toml"):
        if not (path := load_scene(place).get("cameras")):
            raise InputError(f"{place} has no [[cameras]]")
        return tuple(path)
    orbit: dict[str, Any] = {}
    if place in CAMERAS:
        orbit = {"azimuth": CAMERAS[place], "elevation": 0.0}
    else:
        try:
            numbers = _numbers("camera", place, (1, 2, 3))
        except InputError as error:
            raise InputError(f"{error}, or {', '.join(CAMERAS)}") from None
        orbit = dict(zip(("azimuth", "elevation", "zoom"), numbers, strict=False))
    return (dataclasses.replace(camera, position=None, **orbit),)


def _scene_settings(options: argparse.Namespace) -> dict[str, Any]:
    """The fields of Scene that options set, over those of the scene file; but for the camera."""
    settings: dict[str, Any] = {}
    if options.light:
        settings["lights"] = tuple(parse_light(text) for text in options.light)
    if options.ambient is not None:
        numbers = _numbers("ambient", options.ambient, (1, 3))
        settings["ambient"] = tuple(numbers) if len(numbers) == 3 else numbers[0]
    if options.background is not None:
        transparent = options.background == "none"
        settings["background"] = (
            None if transparent else tuple(_numbers("background", options.background, (3,)))
        )
    return settings


def _reproduce(options: argparse.Namespace, caught: list[str]) -> int:
    from facerender.measure import plots
    from facerender.measure.reproduce import reproduce

    plots.check()
    folder = _folder(options.output)
    result = reproduce(progress=lambda step: print(f"facerender: {step}", file=sys.stderr))
    _clean_up_on_interrupt()
    for path in result.write(folder):
        print(path)
    return 0


def _compare(options: argparse.Namespace, caught: list[str]) -> int:
    from facerender.comparison.gates import Pair, pairs_of
    from facerender.comparison.pictures import save_heat_map
    from facerender.comparison.report import entry, write_report

    limits = {name: getattr(options, name) for name in ("point", "block", "coverage")}
    mask = read_image(options.mask).color.max(axis=-1) if options.mask else None
    names = pairs_of(options.a, options.b)
    if options.heatmap and len(names) > 1:
        raise InputError(f"--heatmap takes two images, not the {len(names)} of two folders")
    results, entries, status = [], [], 0
    for name in names:
        pair = Pair.of(*name, mask=mask, **limits)
        status = max(status, pair.status)
        results.append(pair.as_dict())
        if options.report:
            entries.append(entry(pair))
        if pair.error:
            print(f"facerender: error: {pair.error}", file=sys.stderr)
        elif not options.json:
            print(f"{pair.name}: {pair.comparison}")
    _clean_up_on_interrupt()
    if options.report:
        write_report(options.report, entries)
    if options.json:
        print(json.dumps({"same": status == 0, "pairs": results}, indent=2))
    if options.heatmap:
        save_heat_map(options.heatmap, pair)
    return status


def _list_shaders(options: argparse.Namespace, caught: list[str]) -> int:
    from facerender.glsl.catalogue import functions

    if options.json:
        print(json.dumps([dataclasses.asdict(function) for function in functions()], indent=2))
        return 0
    for function in functions():
        print(f"{function.signature}    {function.file}")
        print(f"    {function.summary}")
        for name, text in (("unit", function.unit), ("error", function.error)):
            lines = textwrap.wrap(text, 86, break_on_hyphens=False)
            print(f"    {name:6}" + f"\n{'':10}".join(lines))
    return 0


def _print_shader_dir(options: argparse.Namespace, caught: list[str]) -> int:
    print(shader_dir())
    return 0


def _flatten(options: argparse.Namespace, caught: list[str]) -> int:
    print(shader_source(options.name, options.target, lobe=options.lobe, m=options.m), end="")
    return 0


def _doctor(options: argparse.Namespace, caught: list[str]) -> int:
    findings = probe()
    if options.json:
        print(json.dumps([dataclasses.asdict(finding) for finding in findings], indent=2))
    else:
        print(f"facerender {__version__}, Python {sys.version.split()[0]}")
        for finding in findings:
            if finding.error:
                print(f"{finding.backend:7} {finding.error}")
            else:
                print(
                    f"{finding.backend:7} {finding.renderer}, OpenGL {finding.version}, "
                    f"up to {finding.samples} samples and {finding.size} pixels a side"
                )
    return 0 if any(not finding.error for finding in findings) else 2
