"""The floors hold: a room imports only from lower floors, JAX is imported in one place, and nothing heavy at start."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import helmstar

ROOT = Path(helmstar.__file__).parent
FLOORS = {
    "errors": -2, "files": -2, "units": -2, "backend": -2, "versions": -2, "progress": -2,
    "native": -3, "configuration": -1, "geometry": 0, "distortion": 0,
    "core": 1, "attitude": 1, "astro": 1, "imaging": 1,
    "stars": 2, "filters": 2, "models": 2, "evaluate": 2,
    "sensors": 3, "io": 3,
    "scenarios": 4, "telemetry": 4, "startracker": 4, "opnav": 4,
    "campaign": 5, "report": 5,
    "parser": 5, "cli": 6, "__main__": 7, "__init__": -3,
}  # fmt: skip
# Rooms of one floor that may look at each other, in the direction given; report.claims is the one thing that scenarios
# and telemetry build for the floor above them, inside the functions that make or write a report.
BESIDE = {
    ("filters", "models"),
    ("models", "filters"),
    ("report", "campaign"),
    ("sensors", "io"),
    ("imaging", "attitude"),
    ("telemetry", "startracker"),
}
UPWARD = {("scenarios", "report"), ("telemetry", "report")}


def room_of(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imported_rooms(path: Path) -> set[str]:
    """Rooms that a module imports, relative or absolute, wherever in the file."""
    rooms = set()
    package = ("helmstar", *path.relative_to(ROOT).parent.parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = []
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            full = (*base, *(node.module or "").split(".")) if node.module else base
            names = [full] if len(full) > 1 else [(*full, a.name) for a in node.names]
        elif isinstance(node, ast.Import):
            names = [tuple(a.name.split(".")) for a in node.names]
        rooms |= {n[1] for n in names if n[0] == "helmstar" and len(n) > 1}
    return rooms - {"__version__"}


def test_imports_go_down():
    wrong = []
    for path in sorted(ROOT.rglob("*.py")):
        mine = room_of(path)
        assert mine in FLOORS, f"{mine} has no floor"
        for other in imported_rooms(path) - {mine}:
            if FLOORS[other] < FLOORS[mine] or (mine, other) in BESIDE | UPWARD:
                continue
            wrong.append(f"{path.relative_to(ROOT)} (floor {FLOORS[mine]}) imports {other} (floor {FLOORS[other]})")
    assert not wrong, "\n".join(wrong)


def test_the_check_sees_an_upward_import(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    bad = tmp_path / "geometry" / "so3.py"
    bad.parent.mkdir()
    bad.write_text("from ..filters import run\nfrom helmstar.campaign import x\n")
    assert imported_rooms(bad) == {"filters", "campaign"}


def test_upward_looks_happen_inside_functions_only():
    for path in sorted(ROOT.rglob("*.py")):
        if (room_of(path), "report") not in UPWARD:
            continue
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                assert not node.module.startswith("report"), path


def test_jax_is_imported_in_one_module():
    users = []
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            if any(m == "jax" or m.startswith("jax.") for m in modules):
                users.append(path.relative_to(ROOT).as_posix())
    # attitude/wahba.py looks at jax only when somebody else has imported it already.
    assert sorted(set(users)) == ["attitude/wahba.py", "backend.py"]


def loaded_by(code: str) -> set[str]:
    out = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys; print('\\n'.join(sys.modules))"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return {m.split(".")[0] for m in out.stdout.split()}


HEAVY = {"jax", "pydantic", "xarray", "plotly", "rich", "scipy", "pandas", "numpy"}


def test_help_loads_nothing_heavy():
    code = "from helmstar.cli import main\ntry: main(['run', '--help'])\nexcept SystemExit: pass"
    assert not loaded_by(code) & HEAVY
    assert not loaded_by("import helmstar") & HEAVY


def test_attitude_of_numpy_arrays_needs_no_jax():
    code = "import numpy as np\nfrom helmstar.attitude import svd\nsvd(np.eye(3)[:2], np.eye(3)[:2])"
    assert not loaded_by(code) & {"jax", "pydantic", "xarray"}


def test_the_backend_switches_float64_on():
    code = "from helmstar.backend import jnp; print(jnp.ones(1).dtype)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "float64"
