"""Write docs/measurements/mobile.json: instruction counts of the specular terms on Adreno and Mali.

    python -m benchmarks.prices.mobile FOLDER

Compiles with Mesa of Debian 13 for arm64 on Mesa's null drivers; nothing is rendered. Needs root on
Debian, qemu-user-static, glslang-tools and the dependency group compilers. On first use, apt
downloads the packages to FOLDER: 64 MB, 310 MB unpacked.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from benchmarks.prices import amd
from facerender.pricing import cost

OUTPUT = Path(__file__).parents[2] / "docs" / "measurements" / "mobile.json"
QEMU = "qemu-aarch64-static"
PACKAGES = "mesa-vulkan-drivers mesa-drm-shim libvulkan1 python3-minimal python3-cffi"
LIBRARIES = "/usr/lib/aarch64-linux-gnu"
# Null driver, with the same name as its Vulkan driver, and settings of the simulated GPU.
GPUS = {
    "adreno-630": ("freedreno", {"FD_GPU_ID": "630"}),
    "adreno-740": ("freedreno", {"FD_GPU_ID": "740"}),
    "mali-g610": ("panfrost", {"PAN_GPU_ID": "a867", "BIFROST_MESA_DEBUG": "shaderdb"}),
}


def make_root(folder: Path) -> None:
    """Unpack Debian 13's packages for arm64 into a folder, with QEMU and the package vulkan."""
    apt = folder / "apt"
    for name in ("lists/partial", "cache/archives/partial"):
        (apt / name).mkdir(parents=True)
    (apt / "status").touch()
    listed = ["apt-get", "indextargets", "--format", "$(REPO_URI)", "Component: main"]
    hosts = subprocess.run(listed, capture_output=True, text=True, check=True).stdout.split()
    host = next(each for each in hosts if "security" not in each)
    (apt / "sources").write_text(f"deb {host} trixie main\n")
    settings = {
        "APT::Architecture": "arm64",
        "APT::Architectures": "arm64",
        "APT::Sandbox::User": "root",
        "Dir::State::Lists": apt / "lists",
        "Dir::State::status": apt / "status",
        "Dir::Etc::SourceList": apt / "sources",
        "Dir::Etc::SourceParts": "/dev/null",
        "Dir::Cache": apt / "cache",
    }
    options = [f"-o{name}={value}" for name, value in settings.items()]
    subprocess.run(["apt-get", *options, "-q", "update"], check=True)
    install = ["install", "-yq", "--download-only", "--no-install-recommends", *PACKAGES.split()]
    subprocess.run(["apt-get", *options, *install], check=True)
    root = folder / "root"
    for package in sorted((apt / "cache/archives").glob("*.deb")):
        subprocess.run(["dpkg", "-x", package, root], check=True)
    for name in ("bin", "lib"):
        if not (root / name).exists():
            (root / name).symlink_to(f"usr/{name}")
    (root / "dev").mkdir(exist_ok=True)
    os.mknod(root / "dev/null", 0o20666, os.makedev(1, 3))
    shutil.copy(shutil.which(QEMU) or QEMU, root)
    vulkan = Path(find_spec("vulkan").origin).parent  # type: ignore
    shutil.copytree(vulkan, root / "facerender/vulkan")


def compiled(root: Path, gpu: str, programs: str) -> tuple[str, list[tuple[int, int]]]:
    """Return the driver and two instruction counts per program.

    The counts are all instructions except waits, and the instructions of the unit for roots,
    reciprocals and transcendentals.
    """
    shutil.copy(Path(amd.__file__).with_name("radv.py"), root / "facerender")
    shim, feigned = GPUS[gpu]
    environment = {
        "LD_PRELOAD": f"{LIBRARIES}/lib{shim}_noop_drm_shim.so",
        "VK_ICD_FILENAMES": f"/usr/share/vulkan/icd.d/{shim}_icd.json",
        "MESA_SHADER_CACHE_DISABLE": "true",
        **feigned,
    }
    settings = [word for pair in environment.items() for word in ("-E", "=".join(pair))]
    command: list[str | Path] = [
        "chroot",
        root,
        f"/{QEMU}",
        *settings,
        "/usr/bin/python3",
        "/facerender/radv.py",
    ]
    run = subprocess.run(command, input=programs, capture_output=True, text=True, check=True)
    driver, rows = json.loads(run.stdout)
    if shim == "panfrost":  # only its log has the cycles of the special unit: 16 instructions each
        found = re.findall(r"shader: (\d+) inst, .* ([\d.]+) sfu", run.stderr)
        return driver, [(int(every), round(16 * float(cycles))) for every, cycles in found]
    return driver, [
        (row["Instruction Count"] - row["NOPs Count"], row["cat4 instructions"]) for row in rows
    ]


def main(folder: Path) -> None:
    if not (folder / "root/facerender").exists():
        make_root(folder)
    terms = {
        (model, name): term for model in cost.PRINTED for name, term in cost.terms(model).items()
    }
    kernels = [amd.kernel(*term, ballast="") for term in (("", cost.INPUTS), *terms.values())]
    programs = json.dumps(
        {"attributes": [], "programs": [[m.hex() for m in each] for each in kernels]}
    )
    drivers: dict[str, None] = {}
    found: dict[str, dict[str, dict[str, dict[str, int]]]] = {}
    for gpu in GPUS:
        driver, (empty, *gross) = compiled(folder / "root", gpu, programs)
        drivers[driver] = None
        found[gpu] = {model: {} for model in cost.PRINTED}
        for (model, name), row in zip(terms, gross, strict=True):
            net = (each - of_empty for each, of_empty in zip(row, empty, strict=True))
            found[gpu][model][name] = dict(zip(("all", "special"), net, strict=True))
    text = json.dumps({"compilers": list(drivers), "instructions": found}, indent=2)
    OUTPUT.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
