"""`springbench regress --baseline REVISION`, in small repositories whose gates do arithmetic instead of physics."""

import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from springbench.harness.cli.main import app
from springbench.harness.experiments.regression import git_worktrees, revision_worker
from springbench.harness.experiments.regression.revision_comparison import WorkRequest, start_revisions
from springbench.harness.experiments.regression.revision_process import GitRevision, describe_changes, start_workers
from springbench.harness.results.regression_verdict import RegressionVerdict, combine_verdicts
from typer.testing import CliRunner

from tests.scene_builders import CLOTH_SCENE_YAML

GATES = """
from types import SimpleNamespace

def work(rounds, answer):
    def run():
        total = 0
        for k in range(rounds):
            total += k
        print("what the work prints is no answer")
        return [[0.0, 1.0], [answer, 2.0]]
    return run

ALL = (
    SimpleNamespace(name="adding", clock="cpu", candidate=lambda: work({rounds}, {answer})),
    SimpleNamespace(name="{other}", clock="cpu", candidate=lambda: work(10, 0.0)),
)
"""


def git(folder: Path, *arguments: str) -> str:
    who = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.org"]
    completed = subprocess.run(["git", *who, *arguments], cwd=folder, capture_output=True, text=True, check=True)
    return completed.stdout.strip()


def state(folder: Path, rounds: int = 100_000, answer: float = 0.0, other: str = "old") -> None:
    bench = folder / "tests" / "bench"
    bench.mkdir(parents=True, exist_ok=True)
    for package in (bench.parent, bench):
        (package / "__init__.py").touch()
    text = GATES.replace("{rounds}", str(rounds)).replace("{answer}", str(answer)).replace("{other}", other)
    (bench / "test_gates.py").write_text(text)


def commit(folder: Path) -> None:
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--message", "a state")


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout with one commit, and the current directory."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "mine"
    folder.mkdir()
    git(folder, "init", "--quiet")
    state(folder)
    commit(folder)
    monkeypatch.chdir(folder)
    return folder


def regress(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["regress", *arguments])
    return done.exit_code, " ".join(done.output.split())


def test_a_program_that_takes_twice_as_long_fails_and_an_equal_one_passes(repository: Path):
    # Nothing depends on the machine's speed: the limits lie far from the ratios 2 and 1, and there is time enough.
    state(repository, rounds=200_000)
    code, said = regress("--baseline", "HEAD", "-k", "adding", "--max-ratio", "1.2", "--budget", "500")
    assert code == 1, said
    assert re.search(r"adding: fail: (ratio|slower by) .* \(limit (1.2|20.0 %)\)", said), said
    state(repository)
    code, said = regress("--baseline", "HEAD", "-k", "adding", "--max-ratio", "5", "--budget", "500")
    assert code == 0, said
    assert re.search(r"adding: pass: ratio .* \(limit 5\)", said), said


def test_an_inconclusive_comparison_has_an_exit_code_of_its_own(repository: Path):
    code, said = regress("--baseline", "HEAD", "-k", "adding", "--budget", "0.001")
    assert code == 3, said
    assert re.search(r"adding: inconclusive: \d+ blocks only", said), said


def test_solutions_that_differ_fail_before_anything_is_timed(repository: Path):
    state(repository, answer=0.5)
    code, said = regress("--baseline", "HEAD", "-k", "adding")
    assert code == 2
    # The old answer's size is 1, which 0.5 is half of.
    assert "the answers differ by 5.0e-01 of their size, at most 1e-09 is allowed; nothing was timed" in said


def test_a_gate_that_lacks_its_input_is_skipped_with_its_reason(repository: Path):
    gates = repository / "tests" / "bench" / "test_gates.py"
    skip = 'candidate=lambda: pytest.skip("there is no folder shared")'
    missing = f'    SimpleNamespace(name="absent", clock="cpu", {skip}),\n)'
    gates.write_text("import pytest\n" + gates.read_text().rstrip().removesuffix(")") + missing)
    commit(repository)
    code, said = regress("--baseline", "HEAD", "--budget", "0.001")
    assert code == 3, said
    assert "absent: skipped: there is no folder shared" in said
    assert "adding: inconclusive" in said
    code, said = regress("--baseline", "HEAD", "-k", "absent")
    assert code == 2, said
    assert "no work can be compared" in said


def test_a_revision_that_cannot_be_run_gives_its_own_reason(repository: Path):
    (repository / "tests" / "bench" / "test_gates.py").write_text("ALL = (\n")
    commit(repository)
    state(repository)
    code, said = regress("--baseline", "HEAD", "-k", "adding")
    assert code == 2
    assert "revision HEAD" in said
    assert "cannot be run: SyntaxError: '(' was never closed" in said


@pytest.mark.long
def test_a_revision_whose_libraries_are_unavailable_does_not_build(repository: Path):
    project = '[project]\nname = "mine"\nversion = "{}"\ndependencies = [{}]\n'
    (repository / "pyproject.toml").write_text(project.format("0", '"no such thing !"'))
    commit(repository)
    (repository / "pyproject.toml").write_text(project.format("1", ""))
    code, said = regress("--baseline", "HEAD", "-k", "adding")
    assert code == 2
    assert "cannot be installed:" in said
    # One that was killed while it was built is not taken for whole.
    (tree,) = (path for path in git_worktrees.locate_worktree_cache().iterdir() if path.is_dir())
    (tree / ".venv" / "bin").mkdir(parents=True)
    (tree / ".venv" / "bin" / "python").touch()
    code, said = regress("--baseline", "HEAD", "-k", "adding")
    assert code == 2
    assert "cannot be installed:" in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--baseline", "nowhere", "-k", "adding"), "--baseline: unknown revision 'nowhere'; expected a commit"),
        (("--baseline", "--help", "-k", "adding"), "--baseline: unknown revision '--help'; expected a commit"),
        (("--baseline", "HEAD", "-k", "subtracting"), "-k subtracting: no such gate; expected a part of adding, new"),
        (("--baseline", "HEAD", "-k", "new"), "-k new: revision HEAD"),
        (("--baseline", "HEAD", "-k", "old"), "-k old: this checkout has no gate old"),
        (("--baseline", "HEAD", "scene.yaml", "-k", "old"), "-k: does not apply to a comparison of a scene or a sweep"),
        (("--baseline", "HEAD", "nowhere.yaml"), "cannot be read: No such file"),
        (("--baseline", "HEAD", "--clock", "sun"), "'sun' is not one of 'cpu', 'wall'"),
        (("--baseline", "HEAD", "--budget", "-1"), "--budget: got -1.0; expected a positive number of seconds"),
        (("--baseline", "HEAD", "--max-ratio", "-1"), "--max-ratio: got -1.0; expected a ratio of times"),
        (("--baseline", "HEAD", "--size", "4"), "--size: does not apply to a comparison of gates with a revision"),
        (("-k", "old"), "nothing to compare with; add --baseline REVISION"),
        (("a.json", "--baseline", "b.json", "--budget", "3"), "--budget: does not apply to a comparison of stored"),
        (("a.json", "b.json"), "got 2 subjects; expected one"),
        (("a.json",), "nothing to compare with; add --baseline REVISION"),
        ((), "nothing to compare with; add --baseline REVISION"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_a_mistake_is_one_message(repository: Path, arguments: tuple[str, ...], said: str):
    state(repository, other="new")
    code, printed = regress(*arguments)
    assert code == 2, printed
    assert said in printed


def test_a_folder_outside_git_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    code, said = regress("--baseline", "HEAD", "-k", "adding")
    assert code == 2
    assert "is in no git checkout" in said


def test_a_run_has_exact_counts_and_each_revision_its_own_file(repository: Path):
    (repository / "cloth.yaml").write_text(CLOTH_SCENE_YAML)
    other = repository / "elsewhere"
    other.mkdir()
    (other / "cloth.yaml").write_text(CLOTH_SCENE_YAML.replace("300", "600"))
    sides = GitRevision("this", repository), GitRevision("that", other, checkout=repository, injected_slowdown=0.1)
    run_options = {"solvers": ["sparse"], "sizes": [], "max_iterations": 20}
    with start_workers(*sides) as alive:
        fixed = []
        for worker in alive:
            config = str(worker.revision.resolve_file(repository / "cloth.yaml"))
            (title,) = worker.send_request("list_runs", config=config, run_options=run_options)["runs"]
            assert title == "cloth, size 4, sparse, 20 iterations, implicit-euler, dt 0.03333"
            given = {
                "config": config,
                "run_options": run_options,
                "index": 0,
                "num_frames": 9,
                "injected_slowdown": worker.revision.injected_slowdown,
            }
            fixed.append(worker.prepare_work("prepare_run", **given))
            assert worker.time_calls(2, "cpu") > 0
    assert [(h.num_frames, h.clock, h.answer.shape) for h in fixed] == [(2, "cpu", (16, 3))] * 2
    assert fixed[0].stats == fixed[1].stats  # what is planted is in addition to the run's own work
    assert fixed[0].stats["iterations"] == 40
    assert fixed[0].stats["nnz_factor"] > 16
    assert abs(fixed[0].answer - fixed[1].answer).max() > 1e-6


def test_rebuilt_work_is_prepared_again_before_it_is_timed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made, done = list[int](), list[int]()

    def candidate() -> Callable[[], float]:
        made.append(number := len(made))
        return lambda: done.append(number) or 0.0

    monkeypatch.setattr(
        revision_worker, "_load_gates", lambda: {"mine": SimpleNamespace(candidate=candidate, clock="cpu")}
    )
    fixed = revision_worker.RevisionWorker()
    monkeypatch.setattr(fixed, "_pin_threads", lambda threads: None)
    fixed.prepare_gate("mine", str(tmp_path / "answer.npy"))
    fixed.rebuild_work()
    fixed.time_calls(2, "cpu")
    assert (made, done) == ([0, 1], [0, 1, 1])


def test_a_worker_that_dies_is_reported_with_its_last_line(tmp_path: Path):
    (tmp_path / "json.py").write_text("raise SystemExit('there is no more json')")
    request = WorkRequest("a gate", "prepare_gate", {"name": "a gate"})
    from springbench.harness.errors import InputError
    from springbench.harness.experiments.regression.revision_comparison import ComparisonOptions

    with (
        pytest.raises(InputError, match="that: cannot be run: there is no more json"),
        start_revisions(
            (GitRevision("that", tmp_path), GitRevision("this", tmp_path)), request, ComparisonOptions(1.0), print
        ),
    ):
        pass


def test_changes_of_exact_counts_are_described():
    old = {"iterations": 200, "nnz_factor": 1000, "instructions": 1_000_000, "gone": 1}
    new = {"iterations": 210, "nnz_factor": 1000, "instructions": 1_000_900, "come": 2}
    assert describe_changes(new, old) == ["iterations 200 -> 210 (+5.0%)"]
    assert describe_changes(new | {"instructions": 990_000}, old)[1] == "instructions 1,000,000 -> 990,000 (-1.0%)"


@pytest.mark.parametrize(
    ("verdicts", "code"),
    [
        (["pass"], 0),
        (["pass", "inconclusive"], 3),
        (["inconclusive", "fail", "pass"], 1),
        ([], 3),
    ],
)
def test_a_failure_outweighs_an_inconclusive_test_and_that_a_pass(verdicts: list[str], code: int):
    assert combine_verdicts(map(RegressionVerdict, verdicts)).exit_code == code


@pytest.mark.parametrize(
    ("package", "message"),
    [
        ("", "lacks a name that a comparison needs (No module named 'springbench.harness.config"),
        ("def load_config(path): ...", "lacks a name that a comparison needs (load_config() got an unexpected keyword"),
        (
            "class Run:\n    def __getattr__(self, name): raise AttributeError(name)\n"
            "class Sweep:\n    def list_runs(self): return [Run()]\n"
            "def load_config(path, **options): return Sweep()\n",
            "lacks a name that a comparison needs (solver)",
        ),
    ],
    ids=["other modules", "other parameters", "other attributes"],
)
def test_a_revision_with_other_names_is_refused(repository: Path, package: str, message: str):
    (repository / "cloth.yaml").write_text(CLOTH_SCENE_YAML)
    config = repository / ".src" / "springbench" / "harness" / "config"
    config.mkdir(parents=True)
    for folder in (config.parents[1], config.parent, *([config] if package else [])):
        (folder / "__init__.py").touch()
    if package:
        (config / "config_loader.py").write_text(package)
    else:
        config.rmdir()
    commit(repository)
    code, output = regress("--baseline", "HEAD", "cloth.yaml", "--solver", "sparse")
    assert code == 2, output
    assert message in output


def test_a_revision_without_the_package_is_refused(repository: Path):
    (repository / ".src").mkdir()
    code, output = regress("--baseline", "HEAD", "-k", "adding")
    assert code == 2, output
    assert "has no folder .src, so its code cannot be run by this checkout; choose a later revision" in output
