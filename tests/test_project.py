"""Laws of the project's shell: README, scripts and what may lie in the repository."""

import ast
import re
import shlex
import stat
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib.metadata import entry_points
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text("utf-8")
PACKAGE = ROOT / "pgsd_nerfstudio"
BELOW_ALL = ["version", "storage", "refusal", "vectors", "kernels"]
ROOMS = [
    *("scene", "rendering", "surface", "effects", "physics", "response", "dynamics", "guidance", "weather"),
    *("plugin", "laboratory", "cli"),
]
PHYSICS = [
    "clock",
    "curve",
    "bodies",
    "flock",
    "laws",
    "mpm",
    "ground",
    "air",
    "record",
    "paper",
    "frames",
    "metric",
    "motion_prior",
]
NERFSTUDIO = {"ns-train", "ns-viewer", "ns-render", "ns-eval", "ns-export"}


def tracked() -> list[Path]:
    """Files that are or would be in the repository."""
    found = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True
    )
    if found.returncode:
        pytest.skip("needs git and a checkout")
    return [path for name in found.stdout.split("\0") if name and (path := ROOT / name).is_file()]


def blocks(language: str = "bash") -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def commands() -> list[list[str]]:
    return [shlex.split(line, comments=True) for block in blocks() for line in block.splitlines() if line.strip()]


def test_every_command_of_the_readme_exists():
    offered = {script.name for script in entry_points(group="console_scripts")}
    for words in commands():
        assert words[0] in offered | NERFSTUDIO | {"pip"} or (ROOT / words[0]).stat().st_mode & stat.S_IXUSR, words


def test_every_pgsd_flag_of_the_readme_is_known(capsys):
    from pgsd_nerfstudio.cli.main import run

    for words in commands():
        if words[0] == "pgsd":
            with pytest.raises(SystemExit):
                run([words[1], "--help"])
            known = capsys.readouterr().out
            for flag in (word.split("=")[0] for word in words if word.startswith("--")):
                assert flag in known, f"{flag} of: {' '.join(words)}"


def test_every_training_flag_of_the_readme_is_a_field_of_the_options():
    text = "".join(path.read_text("utf-8") for path in PACKAGE.rglob("*options.py"))
    fields = {f"--{name.replace('_', '-')}" for name in re.findall(r"^    (\w+): ", text, re.MULTILINE)}
    used = {word for words in commands() if words[0] == "ns-train" for word in words if word.startswith("--")}
    assert used and used <= fields


def test_local_links_and_pictures_of_the_documents_lead_somewhere():
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text("utf-8")):
            assert target.startswith("https://") or (page.parent / target).exists(), f"{page.name}: {target}"


def test_ci_finds_its_command_in_the_readme():
    marks = re.findall(r"readme (\w+)", (ROOT / ".ci" / "run").read_text("utf-8"))
    assert marks == ["test"]
    assert "<!-- ci: test -->\n```bash\nscripts/test\n```" in README


@pytest.mark.parametrize("name", ["scripts/demo", "scripts/test", "scripts/environment", "scripts/prove_setup", ".ci/run"])
def test_shell_scripts_parse(name):
    assert subprocess.run(["bash", "-n", str(ROOT / name)], capture_output=True).stderr == b""


def test_the_page_of_figures_is_what_the_json_files_say():
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        from make_benchmarks_page import page
    finally:
        sys.path.pop(0)
    files = sorted((ROOT / "docs" / "figures").glob("*.json"))
    assert (ROOT / "docs" / "benchmarks.md").read_text("utf-8") == page(files)


def test_no_pickles_and_nothing_large_is_tracked():
    colmap = ROOT / "tests" / "colmap"  # its tables are called so
    for path in tracked():
        forbidden = {".pkl", ".pickle", ".pt", ".pth", ".ckpt", ".npy", ".npz"} | (
            set() if colmap in path.parents else {".bin"}
        )
        assert path.suffix not in forbidden, path
        assert path.stat().st_size < 21e6, path


def test_no_text_names_places_of_one_machine():
    # Built from parts, so that this file does not contain what it looks for.
    places = re.compile("|".join(["/" + "root/", "/" + "home/", "/" + "work/", "/opt" + "/", "/" + "tmp/plan", "file:" + "//"]))
    for path in tracked():
        data = path.read_bytes()
        if b"\0" not in data[:8000]:
            found = places.search(data.decode("utf-8", "replace"))
            assert found is None, f"{path.relative_to(ROOT)}: {found}"


def texts() -> list[tuple[Path, str]]:
    """Every file of the repository that can be read, but the licence."""
    found = ((path, path.read_bytes()) for path in tracked() if path.name != "LICENSE")
    return [(path, data.decode("utf-8", "replace")) for path, data in found if b"\0" not in data[:8000]]


def test_every_document_that_a_text_names_is_in_the_repository():
    names = {path.relative_to(ROOT).as_posix() for path in tracked()}
    # These two name pages of the site, made from documents of other names; mkdocs looks after them.
    site = {ROOT / "mkdocs.yml", ROOT / "scripts" / "docs_pages.py"}
    for path, text in texts():
        if path in site:
            continue
        for named in re.findall(r"(?<![\w./*{}<>-])[\w./-]*\w\.md\b", text):
            beside = (path.parent / named).resolve()
            assert named in names or beside.is_file() or any(name.endswith(f"/{named}") for name in names), (
                f"{path.relative_to(ROOT)} names {named}"
            )


def test_every_path_that_a_text_names_is_in_the_repository():
    folders = f"docs|scripts|{PACKAGE.name}"
    for path, text in texts():
        # Behind < or { stands a name that is filled in, behind a backslash more of a pattern: what is before it is a folder.
        for named, filled_in in re.findall(rf"(?<![\w/.-])((?:{folders})/[\w./*-]*)([<{{\\]?)", text):
            pattern = (named.rpartition("/")[0] if filled_in else named).rstrip("./")
            found = (ROOT / pattern).exists() or any(ROOT.glob(pattern))
            assert found, f"{path.relative_to(ROOT)} names {named}"


def test_every_module_that_a_text_names_is_there():
    known = modules()
    entry_groups = re.findall(r'entry-points\."([\w.]+)"', (ROOT / "pyproject.toml").read_text("utf-8"))
    for path, text in texts():
        for named in {*re.findall(rf"\b{PACKAGE.name}(?:\.\w+)+", text)} - {*entry_groups}:
            module = owner(named, known)
            rest = named.removeprefix(module).split(".")[1:2]
            assert not rest or re.search(rf"\b{rest[0]}\b", known[module].read_text("utf-8")) or rest[0].startswith("__"), (
                f"{path.relative_to(ROOT)} names {named}"
            )


def test_only_tests_know_of_inputs_beside_the_repository():
    for path, text in texts():
        if path.relative_to(ROOT).parts[0] not in {"tests", ".ci"}:
            assert "../" + "shared" not in text, path.relative_to(ROOT)


@cache
def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name."""
    named = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sorted(PACKAGE.rglob("*.py"))}
    return {name.removesuffix(".__init__"): path for name, path in named.items()}


def owner(name: str, known: dict[str, Path]) -> str:
    """The module in which a dotted name of the package stands: the longest of its beginnings that is a module."""
    while name not in known:
        name = name.rpartition(".")[0]
    return name


@cache
def imports(path: Path, *, inside_functions: bool = True) -> set[str]:
    """What a file imports, by full name, with what only a type checker imports."""
    names: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.relative_to(ROOT)}: imports name the module in full"
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.FunctionDef) and not inside_functions:
            return
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(path.read_text("utf-8")))
    return names


def room_of(name: str) -> str | None:
    """Room of a module of the package; None for the package itself and for what is not ours."""
    parts = owner(name, modules()).split(".") if name.split(".")[0] == PACKAGE.name else []
    return parts[1] if len(parts) > 1 else None


def test_the_law_of_imports_knows_every_room():
    assert {path.parent.name for path in PACKAGE.glob("*/__init__.py")} == {*ROOMS}
    assert {path.stem for path in PACKAGE.glob("*.py")} == {"__init__", *BELOW_ALL}
    inside = {path.stem for path in (PACKAGE / "physics").glob("*.py")}
    inside |= {path.parent.name for path in (PACKAGE / "physics").glob("*/__init__.py")}
    assert inside - {"__init__"} == {*PHYSICS}


def test_a_room_imports_only_rooms_before_it():
    for name, path in modules().items():
        room = room_of(name)
        if room is not None:
            before = BELOW_ALL if room in BELOW_ALL else [*BELOW_ALL, *ROOMS[: ROOMS.index(room)]]
            assert {room_of(other) for other in imports(path)} <= {None, room, *before}, name


def test_inside_physics_a_room_imports_only_rooms_before_it():
    for name, path in modules().items():
        if name.startswith(f"{PACKAGE.name}.physics."):
            here = name.split(".")[2]
            found = (owner(other, modules()).split(".") for other in imports(path) if room_of(other) == "physics")
            others = {other[2] if len(other) > 2 else "physics itself" for other in found}
            assert others <= {here, *PHYSICS[: PHYSICS.index(here)]}, name


def test_no_module_imports_itself_by_way_of_others():
    known = modules()
    graph = {name: {owner(other, known) for other in imports(path) if room_of(other)} for name, path in known.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_guidance_knows_nothing_of_gaussians():
    """It takes and gives tensors: no other room is needed for that."""
    for name, path in modules().items():
        if room_of(name) == "guidance":
            assert {room_of(other) for other in imports(path)} <= {None, "guidance", *BELOW_ALL}, name


def test_only_the_plugin_imports_nerfstudio():
    for name, path in modules().items():
        if room_of(name) != "plugin":
            assert "nerfstudio" not in {other.split(".")[0] for other in imports(path)}, name


def test_commands_import_the_laboratory_only_when_they_run():
    for name, path in modules().items():
        if room_of(name) == "cli":
            assert "laboratory" not in {room_of(other) for other in imports(path, inside_functions=False)}, name


def test_help_is_quick():
    """Heavy libraries are imported by the commands, not by the command line."""
    program = "import sys, pgsd_nerfstudio.cli.main; print({'torch', 'numba', 'open3d', 'nerfstudio'} & {*sys.modules})"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"


def test_the_package_itself_is_imported_at_once():
    program = f"import sys, time, {PACKAGE.name}; print(time.process_time(), 'torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT)
    seconds, with_torch = found.stdout.split()
    assert float(seconds) < 0.3 and with_torch == "False"
