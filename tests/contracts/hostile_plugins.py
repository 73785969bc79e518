"""Code of others that misbehaves while it is imported, bound, run or used for a report: what it does, what is said."""

from __future__ import annotations

from math import ceil
from pathlib import Path
from typing import NamedTuple

from tests.machine_load import shares_per_core

SOUND = """
import ctypes, os, signal, subprocess, sys, threading, time
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np

from springbench.harness.schema.base_model import ConfigModel
from springbench.harness.scenes.effects.effect_interface import EffectContribution, PinGroup, build_constant_force
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.solvers.model.integrators import IMPLICIT_EULER
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import Solution

{importing}


@dataclass(frozen=True)
class Mine:
    {fields}

    def prepare(self, system):
        {preparing}
        return Prepared(SparseLocalGlobal().prepare(system))


class Prepared:
    description, stats = "", {{}}

    def __init__(self, sound):
        self.sound = sound

    def iterates(self, problem):
        {iterating}
        return self.sound.iterates(problem)

    def residual_at(self, problem, p):
        {measuring}
        return self.sound.residual_at(problem, p)

    def iteration_phases(self, problem):
        return {{}}

    def solve(self, problem, stop):
        found = self.sound.solve(problem, stop)
        {solving}
        return found


class Hum(ConfigModel):
    kind: Literal["hum"] = "hum"

    def build_contribution(self, mesh, mass, time_step):
        def force(p, v, t):
            {forcing}
            return np.zeros_like(p)

        def filtered(v):
            {filtering}
            return v

        made = EffectContribution(forces=(force,), velocity_filters=(filtered,))
        {binding}
        return made


class Cord(ChainMesh):
    kind: Literal["cord"] = "cord"
    {counting}

    def generate_mesh(self, size):
        made = super().generate_mesh(size)
        {generating}
        return made


def predict_target(now, before, dt):
    {predicting}
    return now.positions + dt * now.velocity, now.positions


EULER = replace(IMPLICIT_EULER, predict_target=predict_target)
{integrator}


def tell(rows, folder):
    path = folder / "told.txt"
    {reporting}
    path.write_text("told")
    return [path]
"""
PLACES = (
    "importing", "fields", "preparing", "iterating", "measuring", "solving", "forcing", "filtering", "binding",
    "counting", "generating", "predicting", "integrator", "reporting",
)  # fmt: skip
PARTS = {"solver": "Mine", "effect": "Hum", "mesh": "Cord", "integrator": "EULER", "report": "tell"}

MISTAKE, FAILED, FINE = 2, 1, 0
"""Exit codes: the code cannot be imported or bound; a run or a report failed; all went well."""


class Hostile(NamedTuple):
    """What a plug-in does at one of PLACES, which part of a config it is, the exit code, and what is said."""

    place: str
    does: str
    part: str
    code: int
    said: str


HANG, LIMIT = "while True: pass", "did not end within"
SWELL = "taken = [bytes(2**20) for _ in range(6 * 2**10)]"
SWELL_AT_ONCE = "taken = np.ones((6, 2**27))"
CRASH = "ctypes.string_at(0)"
STRAY = "subprocess.Popen(['sleep', '600'], start_new_session=True)"
PRINT = "print('x' * 20 * 2**20)"

IMPORTING = {
    "hangs": Hostile("importing", HANG, "effect", MISTAKE, "importing ./mine.py:Hum " + LIMIT),
    "sleeps": Hostile("importing", "time.sleep(1e6)", "mesh", MISTAKE, LIMIT),
    "exits well": Hostile("importing", "sys.exit(0)", "solver", MISTAKE, "raised SystemExit: 0 (mine.py:"),
    "exits ill": Hostile("importing", "sys.exit('no')", "effect", MISTAKE, "raised SystemExit: no"),
    "leaves": Hostile("importing", "os._exit(0)", "mesh", MISTAKE, "ended its process with exit code 0"),
    "aborts": Hostile("importing", "os.abort()", "integrator", MISTAKE, "crashed by SIGABRT at mine.py:"),
    "crashes": Hostile("importing", CRASH, "solver", MISTAKE, "crashed by SIGSEGV"),
    "kills itself": Hostile("importing", "os.kill(os.getpid(), 9)", "effect", MISTAKE, "killed by SIGKILL"),
    "kills its parent": Hostile("importing", "os.kill(os.getppid(), 9); time.sleep(5)", "effect", MISTAKE, "SIGKILL"),
    "kills its group": Hostile("importing", "os.killpg(0, 9); time.sleep(5)", "effect", MISTAKE, "killed by SIGKILL"),
    "swells": Hostile("importing", SWELL, "effect", MISTAKE, "MemoryError"),
    "swells at once": Hostile("importing", SWELL_AT_ONCE, "mesh", MISTAKE, "MemoryError"),
    "raises": Hostile("importing", "raise ValueError('no luck')", "effect", MISTAKE, "ValueError: no luck (mine.py:"),
    "interrupts": Hostile("importing", "raise KeyboardInterrupt", "mesh", MISTAKE, "raised KeyboardInterrupt"),
    "raises a base exception": Hostile(
        "importing", "class E(BaseException): pass\nraise E('odd')", "solver", MISTAKE, "raised E: odd"
    ),
    "raises what cannot be told": Hostile(
        "importing",
        "class E(Exception):\n    def __str__(self): raise ValueError\nraise E",
        "effect",
        MISTAKE,
        "E: its message cannot be had",
    ),
    "raises much": Hostile("importing", "raise ValueError('x' * 10**7)", "effect", MISTAKE, "ValueError: xxx"),
    "is no Python": Hostile("importing", "def", "effect", MISTAKE, "SyntaxError"),
    "is binary": Hostile("importing", "\0", "mesh", MISTAKE, "null bytes"),
    "imports what is missing": Hostile("importing", "import nobodys", "solver", MISTAKE, "No module named 'nobodys'"),
    "recurses": Hostile("importing", "def f(): f()\nf()", "effect", MISTAKE, "RecursionError"),
    "recurses without a limit": Hostile(
        "importing", "sys.setrecursionlimit(10**9)\ndef f(x): return eval('f(x)')\nf(1)", "effect", MISTAKE, "./mine.py"
    ),
    "closes all files": Hostile("importing", "os.closerange(0, 4096)", "effect", MISTAKE, "ended its process"),
    "closes its output": Hostile(
        "importing", "os.close(1); os.close(2); print('x' * 9999)", "effect", MISTAKE, "mine.py"
    ),
    "loses its streams": Hostile("importing", "sys.stdout = sys.stderr = None", "effect", FINE, ""),
    "empties the modules": Hostile("importing", "sys.modules.clear()", "effect", MISTAKE, "mine.py"),
    "asks for a password": Hostile("importing", "input()", "effect", MISTAKE, "EOFError"),
    "forbids files": Hostile(
        "importing", "import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))", "effect", MISTAKE, ""
    ),
    "ignores the end": Hostile(
        "importing", "signal.signal(signal.SIGTERM, signal.SIG_IGN); " + "time.sleep(1e6)", "effect", MISTAKE, LIMIT
    ),
    "stops itself": Hostile("importing", "os.kill(os.getpid(), signal.SIGSTOP)", "effect", MISTAKE, LIMIT),
    "stops its parent": Hostile("importing", "os.kill(os.getppid(), signal.SIGSTOP)", "effect", FINE, ""),
    "prints much": Hostile("importing", PRINT, "effect", FINE, "of output the first 8192 are shown"),
    "prints for ever": Hostile("importing", "while True: print('x' * 9999)", "effect", MISTAKE, LIMIT),
    "leaves a process": Hostile("importing", STRAY, "effect", FINE, ""),
    "forks": Hostile("importing", "os.fork() or time.sleep(600)", "effect", FINE, ""),
    "starts a thread": Hostile(
        "importing", "threading.Thread(target=time.sleep, args=(600,)).start()", "mesh", FINE, ""
    ),
    "changes the folder": Hostile("importing", "os.chdir('/')", "effect", FINE, ""),
    "patches NumPy": Hostile("importing", "np.zeros_like = None", "effect", MISTAKE, "mine.py"),
    "changes the environment": Hostile("importing", "os.environ.clear()", "effect", FINE, ""),
    "answers every name": Hostile("importing", "__getattr__ = print\ndel ConfigModel", "effect", MISTAKE, "NameError"),
}
PREPARING = {
    "a field without a type": Hostile("fields", "x = 1", "solver", FINE, ""),
    "a field of an unknown type": Hostile("fields", "x: Unknown = 1", "solver", MISTAKE, "NameError"),
    "a field of an array": Hostile(
        "fields", "x: np.ndarray = field(default_factory=lambda: np.ones(3))", "solver", FINE, ""
    ),
    "a field without a default": Hostile("fields", "x: int", "solver", MISTAKE, "solvers[0].x: is missing"),
    "a refusal": Hostile(
        "fields", "def __post_init__(self): raise KeyError('no')", "solver", MISTAKE, "KeyError: 'no' (mine.py:"
    ),
    "statements that are none": Hostile(
        "fields", "solver_info: ClassVar = 7; is_minimiser: ClassVar = 'yes'", "solver", MISTAKE, ""
    ),
    "nothing prepared": Hostile("preparing", "return None", "solver", FAILED, "mine.py"),
    "a wrong thing prepared": Hostile("preparing", "return 7", "solver", FAILED, "mine.py"),
    "a crash while preparing": Hostile("preparing", CRASH, "solver", FAILED, "crashed by SIGSEGV"),
    "a written system": Hostile("preparing", "system.mass[:] = 1", "solver", FAILED, ""),
}
SOLVING = {
    "nothing": Hostile("solving", "return None", "solver", FAILED, "gave a NoneType"),
    "a wrong shape": Hostile(
        "solving", "return replace(found, positions=found.positions[:, :2])", "solver", FAILED, "shape"
    ),
    "single precision": Hostile(
        "solving", "return replace(found, positions=found.positions.astype(np.float32))", "solver", FAILED, "float32"
    ),
    "NaN": Hostile("solving", "found.positions[:] = np.nan", "solver", FAILED, "diverged"),
    "an exit": Hostile("solving", "sys.exit(0)", "solver", FAILED, "raised SystemExit: 0"),
    "an end": Hostile("solving", "os._exit(0)", "solver", FAILED, "ended its process with exit code 0"),
    "a hang": Hostile("solving", HANG, "solver", FAILED, LIMIT),
    "a crash": Hostile("solving", CRASH, "solver", FAILED, "crashed by SIGSEGV at mine.py:"),
    "too much memory": Hostile("solving", SWELL, "solver", FAILED, "MemoryError"),
    "too much memory in children": Hostile(
        "solving",
        "[subprocess.Popen([sys.executable, '-c', 'x = bytearray(400 * 2**20); input(); import time; time.sleep(99)'],"
        " stdin=subprocess.PIPE) for _ in range(4)]; time.sleep(99)",
        "solver",
        FAILED,
        "took more than 1 GiB with the processes it started",
    ),
    "processes": Hostile("solving", STRAY, "solver", FINE, ""),
    "much output": Hostile("solving", PRINT, "solver", FINE, "of output the first 8192 are shown"),
    "a written problem": Hostile(
        "solving", "problem.inertial_target[:] = 0", "solver", FAILED, "wrote to problem.inertial_target"
    ),
    "closed files": Hostile("solving", "os.closerange(0, 4096)", "solver", FAILED, ""),
    "another folder": Hostile("solving", "os.chdir('/')", "solver", FINE, ""),
    "a fault in its residual": Hostile("measuring", "return 'small'", "solver", FAILED, ""),
}
BINDING = {
    "binds nothing": Hostile(
        "binding", "return None", "effect", MISTAKE, "`build_contribution` returned None; expected"
    ),
    "binds a text": Hostile("binding", "return 'x'", "effect", MISTAKE, "`build_contribution` returned a str"),
    "writes to the mesh": Hostile("binding", "mesh.rest_positions[0] = 1", "effect", MISTAKE, "read-only"),
    "writes to the mesh by force": Hostile(
        "binding",
        "mesh.rest_positions.flags.writeable = True; mesh.rest_positions[0] = 1",
        "effect",
        MISTAKE,
        "wrote to the mesh",
    ),
    "writes to the masses": Hostile("binding", "mass *= 2", "effect", MISTAKE, "wrote to the mesh or the masses"),
    "raises": Hostile(
        "binding", "raise KeyError(3)", "effect", MISTAKE, "`build_contribution` raised KeyError: 3 (mine.py:"
    ),
    "exits": Hostile("binding", "sys.exit(0)", "effect", MISTAKE, "raised SystemExit: 0"),
    "hangs": Hostile("binding", HANG, "effect", MISTAKE, LIMIT),
    "crashes": Hostile("binding", CRASH, "effect", MISTAKE, "crashed by SIGSEGV"),
    "swells": Hostile("binding", SWELL, "effect", MISTAKE, "MemoryError"),
    "binds no tuple": Hostile(
        "binding", "return EffectContribution(forces=[force])", "effect", MISTAKE, "should be a tuple"
    ),
    "binds no energy": Hostile(
        "binding", "return EffectContribution(energies=(7,))", "effect", MISTAKE, "has no method"
    ),
    "binds no force": Hostile(
        "binding", "return EffectContribution(forces=(7,))", "effect", MISTAKE, "should be functions"
    ),
    "binds a force that is NaN": Hostile(
        "binding",
        "return EffectContribution(forces=build_constant_force(mesh.rest_positions * np.nan))",
        "effect",
        MISTAKE,
        "not finite",
    ),
    "binds a short force": Hostile(
        "binding",
        "return EffectContribution(forces=build_constant_force(np.ones((2, 3))))",
        "effect",
        MISTAKE,
        "shape (2, 3)",
    ),
    "pins what is not there": Hostile(
        "binding",
        "return EffectContribution(pins=(PinGroup(np.array([99]), np.ones((1, 3)), 1.0),))",
        "effect",
        MISTAKE,
        "names 99",
    ),
    "pins to nowhere": Hostile(
        "binding",
        "return EffectContribution(pins=(PinGroup(np.array([0]), np.full((1, 3), np.nan), 1.0),))",
        "effect",
        MISTAKE,
        "not finite",
    ),
    "pins with less than nothing": Hostile(
        "binding",
        "return EffectContribution(pins=(PinGroup(np.array([0]), np.ones((1, 3)), -1.0),))",
        "effect",
        MISTAKE,
        "above 0",
    ),
    "forces nothing": Hostile(
        "forcing", "return None", "effect", FAILED, "gave None; expected a force [N] of shape (4, 3)"
    ),
    "forces too little": Hostile("forcing", "return p[:, :2]", "effect", FAILED, "float64 of shape (4, 2)"),
    "forces NaN": Hostile("forcing", "return p * np.nan", "effect", FAILED, ""),
    "raises a force": Hostile("forcing", "raise KeyError(3)", "effect", FAILED, "KeyError: 3 (mine.py:"),
    "exits by force": Hostile("forcing", "sys.exit(0)", "effect", FAILED, "raised SystemExit: 0"),
    "hangs by force": Hostile("forcing", HANG, "effect", FAILED, LIMIT),
    "writes by force": Hostile("forcing", "p[:] = 7", "effect", FINE, ""),
    "filters to nothing": Hostile("filtering", "return None", "effect", FAILED, "gave None; expected a velocity [m/s]"),
}
MESHES = {
    "is none": Hostile(
        "generating", "return None", "mesh", MISTAKE, "returned None; expected a springbench.harness.scenes.mesh"
    ),
    "has NaN": Hostile(
        "generating",
        "return replace(made, rest_positions=made.rest_positions * np.nan)",
        "mesh",
        MISTAKE,
        "`rest_positions` has values",
    ),
    "is flat": Hostile(
        "generating",
        "return replace(made, rest_positions=made.rest_positions[:, :2].copy())",
        "mesh",
        MISTAKE,
        "shape (4, 2)",
    ),
    "is single": Hostile(
        "generating",
        "return replace(made, rest_positions=made.rest_positions.astype('f4'))",
        "mesh",
        MISTAKE,
        "float32",
    ),
    "is empty": Hostile(
        "generating", "return replace(made, rest_positions=np.empty((0, 3)))", "mesh", MISTAKE, "no vertices"
    ),
    "is a list": Hostile(
        "generating", "return replace(made, rest_positions=[[0.0, 0.0, 0.0]])", "mesh", MISTAKE, "mine.py"
    ),
    "springs away": Hostile(
        "generating", "return replace(made, springs=made.springs + 9)", "mesh", MISTAKE, "there are 4"
    ),
    "springs back": Hostile(
        "generating", "return replace(made, springs=made.springs - 1)", "mesh", MISTAKE, "names -1"
    ),
    "springs to itself": Hostile(
        "generating", "return replace(made, springs=made.springs * 0)", "mesh", MISTAKE, "to itself"
    ),
    "springs by halves": Hostile(
        "generating", "return replace(made, springs=made.springs * 0.5)", "mesh", MISTAKE, "integers"
    ),
    "has families of others": Hostile(
        "generating",
        "return replace(made, spring_families={'kin': np.arange(3)})",
        "mesh",
        MISTAKE,
        "`spring_families` has 'kin'",
    ),
    "forgets springs": Hostile(
        "generating", "return replace(made, spring_families={})", "mesh", MISTAKE, "each spring once"
    ),
    "shares too much": Hostile(
        "generating", "return replace(made, mass_fractions=made.mass_fractions * 2)", "mesh", MISTAKE, "sum to 1"
    ),
    "shares negatively": Hostile(
        "generating", "return replace(made, mass_fractions=-made.mass_fractions)", "mesh", MISTAKE, "below 0"
    ),
    "has a face away": Hostile(
        "generating", "return replace(made, triangles=np.array([[0, 1, 99]]))", "mesh", MISTAKE, "`triangles` names 99"
    ),
    "has seven dimensions": Hostile(
        "generating", "return replace(made, dimension=7)", "mesh", MISTAKE, "expected 1, 2 or 3"
    ),
    "raises": Hostile(
        "generating", "raise KeyError(3)", "mesh", MISTAKE, "`generate_mesh` raised KeyError: 3 (mine.py:"
    ),
    "hangs": Hostile("generating", HANG, "mesh", MISTAKE, LIMIT),
    "exits": Hostile("generating", "os._exit(0)", "mesh", MISTAKE, "exit code 0"),
    "swells": Hostile("generating", SWELL, "mesh", MISTAKE, "MemoryError"),
    "cannot count": Hostile(
        "counting", "def count_vertices(self, size): raise KeyError(3)", "mesh", MISTAKE, "KeyError: 3"
    ),
    "counts in words": Hostile("counting", "def count_vertices(self, size): return 'many'", "mesh", MISTAKE, "mine.py"),
    "begins in words": Hostile("counting", "MIN_SIZE: ClassVar = 'two'", "mesh", MISTAKE, "mine.py"),
}
OTHERS = {
    "an integrator that is a number": Hostile(
        "integrator", "EULER = 7", "integrator", MISTAKE, "is no integrator; expected"
    ),
    "an integrator that predicts nothing": Hostile("predicting", "return None", "integrator", FAILED, ""),
    "an integrator that raises": Hostile(
        "predicting", "raise KeyError(3)", "integrator", FAILED, "KeyError: 3 (mine.py:"
    ),
    "an integrator that hangs": Hostile("predicting", HANG, "integrator", FAILED, LIMIT),
    "an integrator that exits": Hostile("predicting", "os._exit(0)", "integrator", FAILED, "exit code 0"),
    "an integrator of NaN": Hostile(
        "integrator", "EULER = replace(EULER, inertia_factor=float('nan'))", "integrator", MISTAKE, ""
    ),
    "an integrator of words": Hostile(
        "integrator", "EULER = replace(EULER, inertia_factor='one')", "integrator", MISTAKE, ""
    ),
    "a report of nothing": Hostile(
        "reporting", "return None", "report", FAILED, "it returned a NoneType; expected a list"
    ),
    "a report that raises": Hostile("reporting", "raise KeyError(3)", "report", FAILED, "raised KeyError: 3 (mine.py:"),
    "a report that exits": Hostile("reporting", "sys.exit(0)", "report", FAILED, "raised SystemExit: 0"),
    "a report that hangs": Hostile("reporting", HANG, "report", FAILED, LIMIT),
    "a report that crashes": Hostile("reporting", CRASH, "report", FAILED, "crashed by SIGSEGV"),
    "a report that swells": Hostile("reporting", SWELL, "report", FAILED, "MemoryError"),
    "a report that prints much": Hostile("reporting", PRINT, "report", FINE, "of output the first 8192 are shown"),
    "a report elsewhere": Hostile("reporting", "os.chdir('/')", "report", FINE, ""),
}
GROUPS = {
    "importing": IMPORTING, "preparing": PREPARING, "solving": SOLVING,
    "an effect": BINDING, "a mesh": MESHES, "": OTHERS,
}  # fmt: skip
HOSTILE = {f"{group} {name}".strip(): case for group, cases in GROUPS.items() for name, case in cases.items()}


def write(folder: Path, case: Hostile) -> Path:
    """The plug-in and a sweep that names it, with a run that it has no part in where its part is not of all runs."""
    does = dict.fromkeys(PLACES, "pass") | {"importing": "", "integrator": ""}
    indent = {"importing": 0, "integrator": 0, "forcing": 12, "filtering": 12}
    indent |= dict.fromkeys(("fields", "counting", "predicting", "reporting"), 4)
    does[case.place] = case.does.replace("\n", "\n" + " " * indent.get(case.place, 8))
    (folder / "mine.py").write_text(SOUND.format(**does))
    name = f"./mine.py:{PARTS[case.part]}"
    mesh = name if case.part == "mesh" else "chain"
    hum = f"{{kind: '{name}'}}, " if case.part == "effect" else ""
    shared = "mass: 1.0\ntime_step: 1/30\nframes: 2\ndefault_size: 4\n"
    effects = "{kind: springs, stretch: 200}, {kind: gravity}, {kind: pins, parts: [ends]}"
    (folder / "odd.yaml").write_text(f"mesh: {{kind: '{mesh}', length: 2.0}}\n{shared}effects: [{hum}{effects}]\n")
    (folder / "sound.yaml").write_text(f"mesh: {{kind: chain, length: 2.0}}\n{shared}effects: [{effects}]\n")
    scenes = "[odd.yaml, sound.yaml]" if case.part in ("mesh", "effect") else "[odd.yaml]"
    solvers = f"['{name}', sparse]" if case.part == "solver" else "[sparse]"
    integrators = f"[implicit-euler, '{name}']" if case.part == "integrator" else "implicit-euler"
    reports = f"reports: ['{name}']\n" if case.part == "report" else ""
    limit = (6 if LIMIT in case.said else 120) * ceil(shares_per_core())  # the sound run has it too
    (folder / "sweep.yaml").write_text(
        f"scenes: {scenes}\nsolvers: {solvers}\n{reports}options: {{integrator: {integrators}, rounds: 1, "
        "max_iterations: 3, record: false, pictures: false, time_limit: " + f"{limit}, memory_limit: 1}}\n"
    )
    return folder / "sweep.yaml"
