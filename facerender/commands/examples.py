"""What the help of each command ends with."""

from __future__ import annotations

EXAMPLES = {
    "render": (
        "facerender render -o head.png",
        "facerender render scan.obj --albedo skin.jpg --camera three-quarter -o scan.png",
        "facerender render head.glb --hide '*lash*,hair' --m 0.25 --light key -o head.exr",
        "facerender render head.glb --only parts -o parts.png",
        "facerender render head.glb --budget 1/255 --size 512 -o cheap.png",
    ),
    "info": ("facerender info head.glb", "facerender info scan.obj --json"),
    "batch": (
        "facerender batch jobs.csv -o out --size 256 --outputs image,mask,depth",
        "facerender batch jobs.toml --check",
        "facerender batch --status out",
    ),
    "plan": (
        "facerender plan head.glb --budget 1/255",
        "facerender plan --budget 0.5% --within 99% --camera turntable --size 256..1024",
        "facerender plan --budget 1/255 --scene planned.toml --emit cheap.glsl --target 330",
    ),
    "measure": ("facerender measure --quick", "facerender measure head.glb --m 0.25 -o out/head"),
    "compare": (
        "facerender compare golden.exr new.exr",
        "facerender compare goldens out --report report.html",
        "facerender compare --calibrate runs --limits pytest.ini",
    ),
    "explore": ("facerender explore head.glb -o head.html",),
    "shaders": (
        "facerender shaders list",
        "facerender shaders flatten cook_torrance --target 330 --lobe d16",
        "facerender shaders prepare-normal-map pores.png pores.ktx2",
    ),
    "doctor": ("facerender doctor",),
    "completion": (
        'eval "$(facerender completion bash)"',
        "facerender completion zsh > ~/.zfunc/_facerender",
    ),
}
