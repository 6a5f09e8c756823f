"""Laws of the project's shell: README, scripts and what may lie in the repository."""

import ast
import re
import shlex
import stat
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text("utf-8")
HOUSE = ["scene", "rendering", "surface", "weather", "physics", "response", "dynamics", "guidance", "evaluation", "export"]
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
            for flag in (word for word in words if word.startswith("--")):
                assert flag in known, f"{flag} of: {' '.join(words)}"


def test_every_training_flag_of_the_readme_is_a_field_of_the_options():
    declared = ("plugin/options.py", "weather/knobs.py")
    text = "".join((ROOT / "pgsd_nerfstudio" / path).read_text("utf-8") for path in declared)
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


@pytest.mark.parametrize("name", ["scripts/demo", "scripts/test", "scripts/environment", ".ci/run"])
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
    for path in tracked():
        assert path.suffix not in {".pkl", ".pickle", ".pt", ".pth", ".ckpt", ".bin", ".npy", ".npz"}, path
        assert path.stat().st_size < 21e6, path


def test_no_text_names_places_of_one_machine():
    # Built from parts, so that this file does not contain what it looks for.
    places = re.compile("|".join(["/" + "root/", "/" + "home/", "/" + "work/", "/opt" + "/", "/" + "tmp/plan", "file:" + "//"]))
    for path in tracked():
        data = path.read_bytes()
        if b"\0" not in data[:8000]:
            found = places.search(data.decode("utf-8", "replace"))
            assert found is None, f"{path.relative_to(ROOT)}: {found}"


def test_rooms_import_only_rooms_above_them():
    package = ROOT / "pgsd_nerfstudio"
    for path in package.rglob("*.py"):
        room = path.relative_to(package).parts[0]
        if room not in HOUSE:
            continue
        above = HOUSE[: HOUSE.index(room) + 1]
        for name in imported(path):
            if name.startswith("pgsd_nerfstudio."):
                other = name.split(".")[1]
                assert other in [*above, "storage"], f"{path.relative_to(ROOT)} imports {name}"
            assert name.split(".")[0] != "nerfstudio", f"{path.relative_to(ROOT)} imports {name}; only plugin/ may"


def imported(path: Path) -> set[str]:
    """Modules that a file imports when it runs; what only a type checker imports does not count."""
    names: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(path.read_text("utf-8")))
    return names


def test_help_is_quick():
    """Heavy libraries are imported by the commands, not by the command line."""
    program = "import sys, pgsd_nerfstudio.cli.main; print({'torch', 'numba', 'open3d', 'nerfstudio'} & {*sys.modules})"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "set()"
