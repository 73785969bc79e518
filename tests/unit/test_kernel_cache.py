"""Compiled code is cached by all that a kernel depends on: what is loaded is what would be compiled."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import pytest
from springbench.solvers.jit import kernel_cache, source_digest
from springbench.solvers.jit.kernel_compilation import cached_njit

YEAR_2001 = 1e9
"""Seconds since 1970."""

KERNEL = """
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.kernels.inner_of_test import FACTOR, times
@jit_kernel
def product(x):
    return times(x) * FACTOR
"""
INNER = """
from springbench.solvers.jit.kernel_compilation import jit_inner
FACTOR = 2.0
@jit_inner
def times(x):
    return 3.0 * x
"""
CALL_PROGRAM = """
from springbench.solvers.kernels.kernel_of_test import product
print(product(1.0), sum(product.stats.cache_hits.values()))
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with a copy of the solvers' sources, without compiled code, and with a kernel more."""
    project = Path(__file__).resolve().parents[2]
    for package in ("solvers", "harness"):
        shutil.copytree(project / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(project / ".src", tmp_path / ".src", symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "solvers" / "kernels" / "kernel_of_test.py").write_text(KERNEL)
    (tmp_path / "solvers" / "kernels" / "inner_of_test.py").write_text(INNER)
    return tmp_path


def run_code(checkout: Path, code: str, **environment: str) -> str:
    """What a new process prints."""
    saved = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    completed = subprocess.run(
        [sys.executable, "-c", code],
        cwd=checkout,
        # What is edited here may have one length, and one second: bytecode would be taken for today's.
        env=saved
        | {
            "PYTHONPATH": str(checkout / ".src"),
            "PYTHONDONTWRITEBYTECODE": "1",
            "XDG_CACHE_HOME": str(checkout / "cache"),
        }
        | environment,
        capture_output=True,
        text=True,
    )
    assert completed.returncode == 0, completed.stderr
    return completed.stdout.strip()


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_changed_kernel_never_runs_stale_in_any_order_of_imports(checkout: Path):
    inner, outer = (checkout / "solvers" / "kernels" / f"{name}_of_test.py" for name in ("inner", "kernel"))
    assert run_code(checkout, CALL_PROGRAM) == "6.0 0"
    assert run_code(checkout, "import numba\n" + CALL_PROGRAM) == "6.0 1"
    edit(inner, "3.0 * x", "6.0 * x")  # a function in another file
    assert run_code(checkout, CALL_PROGRAM) == "12.0 0"
    assert run_code(checkout, "import numba, springbench.harness\n" + CALL_PROGRAM) == "12.0 1"
    edit(inner, "FACTOR = 2.0", "FACTOR = 4.0")  # a constant from another file
    assert run_code(checkout, "import springbench, numba\n" + CALL_PROGRAM) == "24.0 0"
    edit(outer, "* FACTOR", "/ FACTOR")
    assert run_code(checkout, "import numba\n" + CALL_PROGRAM) == "1.5 0"
    edit(outer, "/ FACTOR", "* FACTOR")  # as it was: what was compiled then serves again
    assert run_code(checkout, CALL_PROGRAM) == "24.0 1"


def test_options_of_the_compiler_have_code_of_their_own(checkout: Path):
    assert run_code(checkout, CALL_PROGRAM) == "6.0 0"
    assert run_code(checkout, CALL_PROGRAM, NUMBA_BOUNDSCHECK="1") == "6.0 0"
    edit(checkout / "solvers" / "jit" / "kernel_compilation.py", '"nogil": True', '"nogil": True, "fastmath": True')
    assert run_code(checkout, CALL_PROGRAM) == "6.0 0"


@pytest.mark.parametrize("variable", ["NUMBA_CACHE_DIR", "XDG_CACHE_HOME"])
def test_one_folder_serves_many_checkouts(checkout: Path, tmp_path_factory: pytest.TempPathFactory, variable: str):
    shared, other = tmp_path_factory.mktemp("kernels"), tmp_path_factory.mktemp("other") / "checkout"
    shutil.copytree(checkout, other, symlinks=True)
    assert run_code(checkout, CALL_PROGRAM, **{variable: str(shared)}) == "6.0 0"
    assert run_code(other, CALL_PROGRAM, **{variable: str(shared)}) == "6.0 1"
    assert not [*checkout.rglob("*.nbc")]


COMPILE_SLOWLY = """
from pathlib import Path
from threading import Event
from springbench.solvers.kernels import kernel_of_test
compile_code = kernel_of_test.times._compiler.compile
def compile_slowly(args, return_type):
    Path("compiling").touch()
    while not Path("goes on").exists():
        Event().wait(0.01)
    return compile_code(args, return_type)
kernel_of_test.times._compiler.compile = compile_slowly
"""
SHOW_WAITING = """
from pathlib import Path
from threading import Event
from numba.core import compiler
from springbench.solvers.jit import kernel_cache
class ShownEvent(Event):
    def wait(self, timeout):
        Path("waiting").touch()
        return super().wait(timeout)
def refuse(*args, **options):
    raise AssertionError("compiled twice")
kernel_cache.Event, compiler.compile_extra = ShownEvent, refuse
"""


def test_processes_that_need_the_same_code_at_the_same_time_compile_it_once(checkout: Path):
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(run_code, checkout, COMPILE_SLOWLY + CALL_PROGRAM)
        while not (checkout / "compiling").exists():
            assert not first.done()
            Event().wait(0.01)
        second = pool.submit(run_code, checkout, SHOW_WAITING + CALL_PROGRAM)
        while not (checkout / "waiting").exists():
            assert not second.done()
            Event().wait(0.01)
        (checkout / "goes on").touch()
        assert first.result() == "6.0 0"
        assert second.result() == "6.0 0"
    assert not [*checkout.rglob("*.lock")]


DIGESTS_OF_MODULES = """
from pathlib import Path
from springbench.solvers.jit import source_digest
for path in sorted(Path("solvers").rglob("*.py")):
    print(path.as_posix(), source_digest.digest_sources([path]))
"""


def test_editing_one_solver_recompiles_its_own_kernels_only(checkout: Path):
    def digests() -> dict[str, str]:
        return dict(line.split() for line in run_code(checkout, DIGESTS_OF_MODULES).splitlines())

    before = digests()
    own = [*(checkout / "solvers").rglob("*xpbd*.py")]  # the method, its kernels, a device's
    names = {path.relative_to(checkout).as_posix() for path in own}
    for path in own:
        path.write_text(path.read_text() + "\n# another line\n")
    after = digests()
    assert {name for name, digest in after.items() if before[name] != digest} == names


def test_what_was_edited_since_its_import_is_stored_for_no_other_process(checkout: Path):
    editing = "from pathlib import Path\nimport springbench.solvers.kernels.inner_of_test\n"
    editing += "path = Path('solvers/kernels/inner_of_test.py')\n"
    editing += "path.write_text(path.read_text().replace('3.0', '9.0'))\n"
    assert run_code(checkout, editing + CALL_PROGRAM) == "6.0 0"  # its own module is as it was
    assert run_code(checkout, CALL_PROGRAM) == "18.0 0"
    assert run_code(checkout, CALL_PROGRAM) == "18.0 1"


def test_a_source_that_is_removed_while_a_process_runs_stops_nothing(checkout: Path):
    removing = "from pathlib import Path\nimport springbench.solvers.kernels.kernel_of_test\n"
    removing += "Path('solvers/kernels/inner_of_test.py').unlink()\n"
    assert run_code(checkout, removing + CALL_PROGRAM) == "6.0 0"


TYPES = "TYPE_CHECKING"


def list_imports(path: Path) -> set[str]:
    """The project's modules that a source imports when it runs, by Python's own grammar."""
    found, tree = set(), ast.parse(path.read_text())
    tree.body = [node for node in tree.body if not (isinstance(node, ast.If) and ast.unparse(node.test) == TYPES)]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)}
    names = {name.removeprefix("springbench.") for name in found if name.startswith("springbench.")}
    return {name for name in names if name.split(".")[0] in source_digest.PACKAGE_NAMES}


def test_every_import_of_the_project_is_followed():
    for package in source_digest.PACKAGE_NAMES:
        for path in (source_digest.PROJECT_ROOT / package).rglob("*.py"):
            reached = source_digest.find_dependencies(str(path))
            for name in list_imports(path):
                place = source_digest.PROJECT_ROOT.joinpath(*name.split("."))
                module = {str(place.with_suffix(".py")), str(place / "__init__.py")}
                exists = any(os.path.exists(file) for file in module)
                assert not exists or module & reached, f"{path} imports {name}"


OUTSIDE = {
    "own.py": "import numpy\nfrom helper import (\n    A,  # one, with a comma\n    B,\n)\nfrom pack import part\n",
    "helper.py": "import json\nimport springbench.solvers.linalg.memory as memory, unused\n",
    "unused.py": "",
    "json.py": "",
    "pack/__init__.py": "from .part import C\n",
    "pack/part.py": "from ..pack import other\nfrom . import another\nfrom .third import D\n",
    "pack/other.py": "",
    "pack/another.py": "",
    "pack/third.py": "",
    "alien.py": "",
}


def test_a_source_from_outside_depends_on_its_folder_and_on_the_solvers_that_it_imports(tmp_path: Path):
    for name, text in OUTSIDE.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    found = {Path(path) for path in source_digest.find_dependencies(str(tmp_path / "own.py"))}
    assert {path.relative_to(tmp_path).as_posix() for path in found if tmp_path in path.parents} == (
        OUTSIDE.keys() - {"alien.py"}
    )
    assert source_digest.PROJECT_ROOT / "solvers" / "linalg" / "memory.py" in found


FLAT_IMPORTS = """
import springbench
from springbench import Citation
class Own(springbench.FixedPointSolver):
    ...
springbench.Simulation(scene, Own())
"""


def test_a_source_from_outside_depends_on_the_modules_of_the_public_names_that_it_uses(tmp_path: Path):
    (tmp_path / "own.py").write_text(FLAT_IMPORTS)
    found = source_digest.find_dependencies(str(tmp_path / "own.py"))
    names = {"/".join(Path(path).parts[-2:]) for path in found}
    assert {"iteration/solver_info.py", "local_global/fixed_point.py", "local_global/prefactored.py"} <= names
    assert "harness/api.py" not in {path.removeprefix(f"{source_digest.PROJECT_ROOT}{os.sep}") for path in found}


def twice(x: float) -> float:
    return 2.0 * x


Damage = Callable[[Path], object]
DAMAGES: dict[str, Damage] = {
    "empty": lambda path: path.write_bytes(b""),
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "of another key": lambda path: path.write_bytes(kernel_cache.dumps((("another",), None))),
    "gone": lambda path: path.unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_what_cannot_be_read_is_compiled_and_stored_again(home: Path, damage: Damage):
    assert cached_njit()(twice)(1.0) == 2.0
    (path,) = home.glob("*/*.nbc")
    damage(path)
    for hits in (0, 1):
        again = cached_njit()(twice)
        assert again(1.0) == 2.0
        assert sum(again.stats.cache_hits.values()) == hits


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder in which kernels are cached."""
    monkeypatch.setattr(kernel_cache, "_writable_root", lambda source: tmp_path)
    return tmp_path


def test_a_full_disk_costs_the_stored_code_alone(home: Path, monkeypatch: pytest.MonkeyPatch):
    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kernel_cache, "_write_atomically", full)
    assert cached_njit()(twice)(1.0) == 2.0
    assert not [*home.glob("*/*")]


def test_unused_code_of_other_sources_is_removed_when_new_code_is_stored(home: Path):
    for name in ("used", "unused"):
        (home / f"{__name__}-{name}").mkdir()
    (home / "another-unused").mkdir()
    for name in (f"{__name__}-unused", "another-unused"):
        os.utime(home / name, (YEAR_2001, YEAR_2001))
    cached_njit()(twice)(1.0)
    assert {path.name for path in home.iterdir()} >= {f"{__name__}-used", "another-unused"}
    assert not (home / f"{__name__}-unused").exists()


def test_a_cache_folder_without_write_access_is_no_obstacle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "users").write_text("a file, where a folder would have to be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "users"))
    monkeypatch.setattr(kernel_cache._NUMBA_CONFIG, "CACHE_DIR", "")
    assert kernel_cache._writable_root(str(tmp_path)) == tmp_path / "__pycache__"


DIGESTS = """
import hashlib
from itertools import islice
import springbench
from springbench.solvers.registry import SOLVERS, load_target
from tests.scene_builders import build_cloth, build_first_problem
problem = build_first_problem(build_cloth(12))
for name in ("numba", "lbfgs", "vbd"):
    iterates = load_target(SOLVERS[name])().prepare(problem.system).iterates(problem)
    print(name, hashlib.sha256(b"".join(p.tobytes() for p in islice(iterates, 20))).hexdigest())
"""


@pytest.mark.long
def test_the_process_that_compiles_a_kernel_finds_the_bits_of_those_that_load_it(tmp_path: Path):
    root = Path(__file__).resolve().parents[2]
    compiling, loading = (
        subprocess.run(
            [sys.executable, "-c", DIGESTS],
            cwd=root,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for _ in range(2)
    )
    assert compiling == loading
