"""Imports point downwards only (absolute imports, so that this test sees them all)."""

import ast
from pathlib import Path

LAYER = {
    "kernels": 0, "core": 1, "io": 2, "slam": 2, "simulator": 3, "sensor": 3, "texture": 3, "compensate": 3, "nn": 3, "data": 3, "board": 3,
    "rig": 3, "score": 3, "folder": 3, "picture": 3, "mapfile": 3, "mapimage": 3, "quality": 3, "chart": 3, "protocols": 3,
    "velocity": 3, "path": 3, "panoimage": 4, "config": 4, "track": 4, "resultfiles": 4, "alignment": 4, "evaluate": 5, "judge": 5,
    "tracktable": 5, "resultplots": 5, "job": 5, "page": 6, "workers": 6, "cluster": 6, "batch": 6, "report": 7, "trackreport": 7,
    "batchpage": 7, "panoreport": 8, "commands": 9, "cli": 10,
}  # fmt: skip
ABOVE = {("simulator", "texture"), ("simulator", "sensor"), ("simulator", "path")}  # four files of one thing
ORDER = [
    "so3", "pose", "plane", "camera", "window", "warp", "state", "vote", "draw", "contrast", "minimize", "model", "objective", "estimate",
    "match", "joint",
]  # fmt: skip
ROOT = Path(__file__).parents[1] / "torchcmax"


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: write absolute imports"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        yield from (name.split(".") for name in names)


def own(path):
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def test_every_module_has_its_layer():
    assert {own(path) for path in ROOT.rglob("*.py")} - {"__init__"} <= set(LAYER)


def test_imports_point_downwards():
    for path in ROOT.rglob("*.py"):
        here = own(path)
        others = {name[1] for name in imported(path) if name[0] == "torchcmax" and len(name) > 1} - {"__version__"}
        for other in others if here != "__init__" else ():
            below = other == here or LAYER[other] < LAYER[here] or (here, other) in ABOVE
            assert below, f"{path.name} ({here}) must not import {other}"


def test_core_is_a_chain_and_knows_torch_and_kornia_only():
    allowed = {"__future__", "torch", "kornia", "torchcmax", "dataclasses", "typing", "collections", "functools", "math", "abc"}
    for path in (ROOT / "core").glob("*.py"):
        for name in imported(path):
            assert name[0] in allowed, f"core/{path.name} must not import {name[0]}"
            if name[:2] == ["torchcmax", "core"] and path.stem in ORDER:
                other = name[2]
                assert ORDER.index(other) < ORDER.index(path.stem), f"core/{path.name} must not import {other}"


def test_the_rig_knows_nothing_of_the_rest():
    for path in (ROOT / "rig").glob("*.py"):
        for name in imported(path):
            assert name[0] != "torchcmax" or name[1] == "rig", f"rig/{path.name} must not import {'.'.join(name)}"


def test_every_file_of_the_core_is_in_the_chain():
    assert {path.stem for path in (ROOT / "core").glob("*.py")} - {"__init__"} == set(ORDER)


def test_importing_the_package_loads_nothing_heavy():
    heavy = {"kornia", "tensorboard", "jsonargparse", "matplotlib"}
    for path in [ROOT / "__init__.py", *(ROOT / "core").glob("*.py"), *(ROOT / "io").glob("*.py")]:
        top = ast.parse(path.read_text()).body
        for node in top:
            names = (
                [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module] if isinstance(node, ast.ImportFrom) else []
            )
            assert not heavy & {name.split(".")[0] for name in names if name}, f"{path} imports {names} before it is needed"
