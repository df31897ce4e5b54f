"""Arrows go one way: which module of the package may import which."""

import ast
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import kornia_pnpnet

ROOT = Path(kornia_pnpnet.__file__).parent

#: The only table to edit. From the bottom up, by folder or module: a module imports from its own layer and those below.
LAYERS = (
    "core",
    "result",
    "problem",
    "refine judge",
    "cameras arguments frame data losses likelihood metrics covariance measurements propose pretrained",
    "solver",
    "registry peers __init__",
    "training evaluation export arrow diagnosis",
    "cli",
)

#: Optional packages and the only modules that may import them.
OWNERS = {
    "matplotlib": {"evaluation.plots"},
    "hydra": {"training.sweep"},
    **{name: {"peers"} for name in ("cv2", "kornia_rs", "poselib")},
    "pycolmap": {"data.colmap", "peers"},
    "pyarrow": {"arrow", "cli.shards"},
    "pydantic": {"core.schema", "evaluation.forms"},
    **{name: {"export"} for name in ("onnx_ir", "onnxscript")},
    **{name: set() for name in ("pandas", "ray")},
}
#: What importing the package must not import: the extras, which a user of the layer need not have.
EXTRAS = [*OWNERS, "lightning_fabric", "omegaconf", "seaborn"]

FILES = sorted(ROOT.rglob("*.py"))
MODULES = {".".join(x.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): x for x in FILES}

#: Methods for users may call a function of a higher layer: ``result.covariance(…)`` calls ``pose_covariance``.
SHORTCUTS = {(MODULES["result"], "covariance")}


@cache
def imports(path):
    """Full names of all that a file imports, at its top or inside functions."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [(alias.name, None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: a relative import"
            found += [(node.module, alias.name) for alias in node.names]
    return found


def own_imports(path):
    """Names, below the package, of the modules that a file imports."""
    for module, name in imports(path):
        package, _, below = module.partition(".")
        if package == "kornia_pnpnet" and (path, below) not in SHORTCUTS:
            inner = f"{below}.{name}".removeprefix(".")
            yield inner if name is not None and inner in MODULES else below or "__init__"


def layer(name):
    """The place in LAYERS of a module, or of the folder that it is in."""
    found = [level for level, members in enumerate(LAYERS) if name.split(".")[0] in members.split()]
    assert found, f"{name} is in no layer: say in LAYERS where it belongs."
    return found[0]


@pytest.mark.parametrize("name", MODULES)
def test_imports_come_from_the_same_layer_or_below(name):
    wrong = {other for other in own_imports(MODULES[name]) if layer(other) > layer(name)}
    assert not wrong, f"{name} (layer {layer(name)}) imports {sorted(wrong)} from above."


def test_no_circles():
    graph = {name: set(own_imports(path)) - {name} for name, path in MODULES.items()}
    assert {*TopologicalSorter(graph).static_order()} >= graph.keys()  # an error names the modules of a circle


@pytest.mark.parametrize(("package", "owners"), OWNERS.items())
def test_optional_packages_have_one_door(package, owners):
    users = {name for name, path in MODULES.items() for module, _ in imports(path) if module.split(".")[0] == package}
    assert not {user for user in users if not any(f"{user}.".startswith(f"{owner}.") for owner in owners)}


def test_importing_the_package_imports_no_extras_and_loading_a_solver_leaves_no_trace():
    code = (
        "import sys, torch; torch.manual_seed(5); old = (torch.get_rng_state(), torch.get_num_threads());"
        f"import kornia_pnpnet; print([name for name in {EXTRAS!r} if name in sys.modules]);"
        "kornia_pnpnet.create_solver('pnpnet-set');"
        "new = (torch.get_rng_state(), torch.get_num_threads());"
        "assert torch.equal(old[0], new[0]) and (old[1], torch.get_default_dtype()) == (new[1], torch.float32)"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert output.stdout.strip() == "[]"
