# SPDX-License-Identifier: MIT
"""The house rules that no other tool checks, over every file that is or would be in git."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGES = ("bench", "scapo", "sim_assets")
MAX_FILE_LINES = 500
MAX_FUNCTION_LINES = 40  # docstring not counted
MAX_BYTES = 100 * 1024
MAX_CHECKPOINT_BYTES = 4 * 1024 * 1024
WITH_LICENCE_LINE = {".py", ".sh", ".toml", ".yaml", ".cff"}
PICKLES = {".pkl", ".pickle", ".pt", ".pth", ".ckpt", ".joblib"}
# Written in pieces, so that this file passes its own test.
MACHINE_PATH = re.compile(r"(?<![\w.<>*$}\])-])/" + r"(?:work|root|home|tmp|Users|mnt|opt)/\w")
REGISTRY_HOST = re.compile(
    r"py"
    + r"pi\.org|python"
    + r"hosted|npm"
    + r"js\.(?:org|com)|deb\."
    + r"debian\.org|download\.py"
    r"torch|ana" + r"conda\.(?:org|com)|archive\.ub" + r"untu"
)


def repository_files(root: Path) -> list[Path]:
    """Tracked files, and new ones that git does not ignore."""
    if shutil.which("git") is None or not (root / ".git").exists():
        pytest.skip("not a git checkout")
    command = ["git", "ls-files", "-co", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    files = [root / name for name in listed.stdout.split("\0") if name]
    return [path for path in files if path.is_file()]


@pytest.fixture(scope="module")
def files(repository: Path) -> list[Path]:
    return repository_files(repository)


@pytest.fixture(scope="module")
def texts(files: list[Path]) -> dict[Path, str]:
    """Contents of the files that are text, without the lock files."""
    found = {}
    for path in files:
        data = path.read_bytes()
        if b"\0" not in data and path.suffix != ".lock":
            found[path] = data.decode()
    return found


@pytest.fixture(scope="module")
def modules(texts: dict[Path, str], repository: Path) -> dict[str, str]:
    """Python files by their path in the repository."""
    named = {path.relative_to(repository).as_posix(): text for path, text in texts.items()}
    return {name: text for name, text in named.items() if name.endswith(".py")}


def long_functions(source: str) -> list[tuple[str, int]]:
    """Functions over the limit, with their lengths."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno:
            body = node.body
            documented = ast.get_docstring(node) is not None
            skipped = (body[0].end_lineno or 0) - body[0].lineno + 1 if documented else 0
            length = node.end_lineno - node.lineno + 1 - skipped
            if length > MAX_FUNCTION_LINES:
                found.append((node.name, length))
    return found


def names_of_tests(module: str) -> set[str]:
    """The names that the test of a module may have: its own, or its folder's."""
    *folders, stem = Path(module).with_suffix("").parts
    if stem == "__main__":
        return {f"test_{folders[-1]}", f"test_{folders[-1]}_main", f"test_{folders[-1]}_cli"}
    names = {f"test_{stem}", f"test_{folders[-1]}_{stem}"}
    return names | {f"test_{folder}" for folder in folders[1:]}


def test_files_are_short(modules: dict[str, str]):
    lengths = {name: text.count("\n") for name, text in modules.items()}
    assert {name: n for name, n in lengths.items() if n > MAX_FILE_LINES} == {}


def test_functions_are_short(modules: dict[str, str]):
    programs = {name: text for name, text in modules.items() if name.split("/")[0] in PACKAGES}
    found = {name: long_functions(text) for name, text in programs.items()}
    assert {name: functions for name, functions in found.items() if functions} == {}


def test_function_length_leaves_out_the_docstring():
    body = "    x = 1\n" * (MAX_FUNCTION_LINES - 1)
    docstring = '    """One\n    two\n    three.\n    """\n'
    assert long_functions(f"def f():\n{docstring}{body}") == []
    assert long_functions(f"def f():\n{body}    x = 2\n") == [("f", MAX_FUNCTION_LINES + 1)]


def imported_modules(source: str) -> set[str]:
    """Dotted names of what a test imports, `from a import b` as `a` and `a.b`."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def test_every_module_has_a_test(modules: dict[str, str]):
    tests = {name: text for name, text in modules.items() if name.startswith("tests/")}
    named = {Path(name).stem for name in tests}
    imported = set[str]().union(*(imported_modules(text) for text in tests.values()))
    programs = [
        name
        for name in modules
        if name.split("/")[0] in PACKAGES and not name.endswith("__init__.py")
    ]
    assert len(programs) > 10
    untested = [
        name
        for name in programs
        if not names_of_tests(name) & named
        and name.removesuffix(".py").replace("/", ".") not in imported
    ]
    assert untested == []


def test_names_of_tests():
    assert "test_icp" in names_of_tests("bench/baselines/icp.py")
    assert "test_baselines" in names_of_tests("bench/baselines/icp.py")
    assert "test_bench" not in names_of_tests("bench/metrics.py")
    assert "test_bench_main" in names_of_tests("bench/__main__.py")


def test_every_file_names_its_licence(texts: dict[Path, str], repository: Path):
    def first_lines(text: str) -> list[str]:
        return text.split("\n", 2)[: 2 if text.startswith("#!") else 1]

    line = "# SPDX-License-Identifier: MIT"
    named = {p for p in texts if p.suffix in WITH_LICENCE_LINE or p.name in ("Makefile", "run")}
    without = [p for p in named if line not in first_lines(texts[p])]
    assert [path.relative_to(repository).as_posix() for path in without] == []


@pytest.mark.parametrize("pattern", [MACHINE_PATH, REGISTRY_HOST], ids=["path", "registry"])
def test_no_machine_in_any_file(texts: dict[Path, str], repository: Path, pattern: re.Pattern[str]):
    found = [
        f"{path.relative_to(repository)}:{number}: {line.strip()}"
        for path, text in texts.items()
        for number, line in enumerate(text.splitlines(), start=1)
        if pattern.search(line)
    ]
    assert found == []


@pytest.mark.parametrize("slash", ["/"])
def test_machine_paths_are_recognised(slash: str):
    for folder in ("work", "tmp", "home"):
        assert MACHINE_PATH.search(f"see {slash}{folder}{slash}x")
    assert not MACHINE_PATH.search("results/tmp/x")
    assert not MACHINE_PATH.search("$DIR/home/x")


def test_no_pickles(files: list[Path], repository: Path):
    found = [path.relative_to(repository).as_posix() for path in files if path.suffix in PICKLES]
    assert found == []


def test_files_are_small(files: list[Path], repository: Path):
    def limit(path: Path) -> int:
        return MAX_CHECKPOINT_BYTES if "results" in path.parts else MAX_BYTES

    names = [path.relative_to(repository) for path in files if path.suffix != ".lock"]
    sizes = {name.as_posix(): (repository / name).stat().st_size for name in names}
    assert {name: n for name, n in sizes.items() if n > limit(Path(name))} == {}


def test_import_contracts(repository: Path):
    pytest.importorskip("importlinter")
    command = [Path(sys.executable).parent / "lint-imports", "--no-logo", "--no-cache"]
    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
