"""Laws of the documents: what they name exists, what they draw is so, and each fact stands in one place."""

from __future__ import annotations

import ast
import re
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

import pgsd_nerfstudio

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "pgsd_nerfstudio"
sys.path.insert(0, str(ROOT / "scripts"))
try:
    from draw_architecture import HOUSE, Room, below, drawn, rooms
finally:
    sys.path.pop(0)

ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text("utf-8")
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text("utf-8")
ENTRY = re.compile(r"\| ([^|]+) \| ([^|]+) \| \[([\w.]+)\]\(\.\./([\w/.]+)\) \|")


def names_in(text: str) -> list[str]:
    """Names of the code as pages write them: paths from the package."""
    return re.findall(rf"`((?:{'|'.join((*HOUSE, *below()))})(?:\.(?!py`)\w+)+)`", text)


def defined(path: str) -> bool:
    """Whether a dotted path from the package names a module, or something that is defined in one; nothing is imported."""
    parts = path.split(".")
    for count in range(len(parts), 0, -1):
        place = PACKAGE.joinpath(*parts[:count])
        file = place.with_suffix(".py") if place.with_suffix(".py").is_file() else place / "__init__.py"
        if file.is_file():
            body: list[ast.stmt] = ast.parse(file.read_text("utf-8")).body
            for name in parts[count:]:
                found = next((node for node in body if name in _names(node)), None)
                if found is None:
                    return False
                body = found.body if isinstance(found, ast.ClassDef) else []
            return True
    return False


def _names(node: ast.stmt) -> set[str]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    if isinstance(node, ast.Assign):
        return {target.id for target in node.targets if isinstance(target, ast.Name)}
    return {node.target.id} if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) else set()


def test_the_picture_shows_the_rooms_and_imports_of_the_code():
    def shown(house: list[Room]) -> list[tuple[str, str, tuple[str, ...]]]:
        return [(room.name, room.does, room.uses) for room in house]

    assert shown(drawn()) == shown(rooms()), "run: python scripts/draw_architecture.py"


def test_a_room_of_which_the_house_does_not_know_is_refused(tmp_path: Path):
    for name in (*HOUSE, "attic"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text('"""A room."""\n')
    with pytest.raises(ValueError, match="attic"):
        rooms(tmp_path)
    (tmp_path / "attic" / "__init__.py").unlink()
    (tmp_path / "scene" / "__init__.py").write_text("")
    with pytest.raises(ValueError, match="scene must say"):
        rooms(tmp_path)


@pytest.mark.parametrize("name", sorted(set(names_in(ARCHITECTURE))))
def test_what_the_architecture_names_exists(name: str):
    assert defined(name)


def test_names_are_judged_to_the_last_part():
    assert defined("scene.frame.Frame.to_metric") and defined("scene.frame.Frame.metres_per_unit") and defined("scene.frame")
    assert not defined("scene.frame.Frame.to_imperial") and not defined("scene.picture_frame")


def test_both_routes_are_told():
    """One through training, one from birth to picture; each passes all rooms that it must."""
    training, particle = (
        set(name.split(".")[0] for name in names_in(text))
        for text in ARCHITECTURE.split("## A clip through training")[1].split("## Caching")[0].split("## A particle")
    )
    assert {"plugin", "dynamics", "guidance", "rendering", "scene"} <= training
    assert {"effects", "physics", "response", "dynamics", "rendering", "scene"} <= particle


def test_each_word_of_the_glossary_stands_once_in_order_and_leads_to_its_module():
    rows = [line for line in GLOSSARY.splitlines() if line.startswith("| ") and not line.startswith("| word")]
    entries = [match.groups() for row in rows if (match := ENTRY.fullmatch(row))]
    assert len(entries) == len(rows), "a row is not of the form | word | meaning | [module](../path) |"
    words = [word for word, *_ in entries]
    assert words == sorted(set(words), key=str.lower)
    for word, _, module, path in entries:
        assert path == f"pgsd_nerfstudio/{module.replace('.', '/')}.py" or path.endswith("__init__.py"), word
        assert (ROOT / path).is_file(), word


def test_the_version_stands_in_one_place():
    """The package says it; the metadata, the changelog and the citation follow."""
    said = pgsd_nerfstudio.__version__
    assert version("pgsd-nerfstudio") == said, "install again: pip install --no-deps -e ."
    assert re.findall(r"^## \[([\d.]+)\]", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)[0] == said
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))["version"] == said
    assert not re.search(r"^version", (ROOT / "pyproject.toml").read_text("utf-8"), re.MULTILINE)


def test_the_paper_is_cited_alike_everywhere():
    paper = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))["preferred-citation"]
    entry = re.search(r"```bibtex\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)
    assert entry is not None
    written = re.sub(r"[{}]", "", entry[1])
    assert paper["title"] in written and str(paper["year"]) in written and paper["url"] in written
    assert " and ".join(f"{one['family-names']}, {one['given-names']}" for one in paper["authors"]) in written


def test_the_paper_is_cited_as_it_calls_itself(shared: Path):
    source = (shared / "paper.tex").read_text("utf-8")
    paper = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))["preferred-citation"]
    title = re.search(r"\\title\{(.*)\}", source)
    assert title is not None and " ".join(title[1].replace("\\\\", " ").split()) == paper["title"]
    authors = re.search(r"\\author\{(.*?)\\\\", source, re.DOTALL)
    assert authors is not None
    assert re.findall(r"(\w[\w\s-]+\w)\$", authors[1]) == [f"{a['given-names']} {a['family-names']}" for a in paper["authors"]]


@pytest.mark.parametrize("form", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=lambda path: path.name)
def test_forms_for_issues_ask_something(form: Path):
    asked = yaml.safe_load(form.read_text("utf-8"))
    if form.name != "config.yml":
        assert asked["name"] and asked["description"]
        assert any(part.get("validations", {}).get("required") for part in asked["body"])
        ids = [part["id"] for part in asked["body"]]
        assert len(ids) == len(set(ids))


def test_the_page_of_the_public_names_has_all_of_them():
    page = (ROOT / "docs" / "reference" / "api.md").read_text("utf-8")
    assert {*re.findall(r"^        - (\w+)$", page, re.MULTILINE)} == {*pgsd_nerfstudio.__all__} - {"__version__"}
