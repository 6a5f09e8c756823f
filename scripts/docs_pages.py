"""What mkdocs is told while it builds: pages made of files outside of docs/ and of the code, and where links lead on the site.

README.md is the home page, CONTRIBUTING.md and its neighbours have pages too, and each room has one made of its docstrings. All
of them exist once, in the repository; links between them are written for readers there and turned here. See mkdocs.yml.
"""

from __future__ import annotations

import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "scripts"))
from draw_architecture import HOUSE, PACKAGE, below  # noqa: E402

PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
}
"""Files of the repository by the names of their pages."""
LINK = re.compile(r"(!?)\[([^\[\]]*)\]\(([^)#\s]+)(#[^)]*)?\)")
NAME = re.compile(rf"(?<!\[)`((?:{'|'.join((*HOUSE, *below()))})(?:\.(?!py`)\w+)+)`(?!\])")
"""Names of the code as pages write them: paths from the package."""


def packages() -> list[str]:
    """Rooms and the packages within them, in the order of the house."""
    found = [file.parent for room in HOUSE for file in sorted((PACKAGE / room).rglob("__init__.py"))]
    return [".".join(folder.relative_to(PACKAGE).parts) for folder in found]


def reference(package: str) -> str:
    """The page of a package: its own docstring, then its modules."""
    folder = PACKAGE.joinpath(*package.split("."))
    name = f"{PACKAGE.name}.{package}"
    modules = sorted(file.stem for file in folder.glob("*.py") if file.stem != "__init__")
    blocks = [f"::: {name}\n    options:\n      members: false\n      heading_level: 1\n      show_root_full_path: true\n"]
    blocks += [f"::: {name}.{module}\n    options:\n      heading_level: 2\n" for module in modules]
    return "\n".join(blocks)


def examples() -> str:
    """The page of the examples: what each says of itself, and its program."""
    parts = ["# Examples\n\nThe programs of the folder `examples/`, as they are run by the tests.\n"]
    for file in sorted((ROOT / "examples").glob("*.py")):
        text = file.read_text("utf-8")
        parts.append(f"## {file.name}\n\n```python\n{text}```\n")
    return "\n".join(parts)


def place_of(target: str) -> str | None:
    """Page of the site, with its anchor, for a file of the repository; None where there is none.

    Args:
        target: path from the root of the repository.
    """
    if target in PAGES:
        return PAGES[target]
    if target.split("/")[0] == "examples":
        return "examples.md"
    if target.startswith("docs/"):
        return target.removeprefix("docs/")
    path = Path(target.removesuffix("/"))
    if path.parts[:1] != (PACKAGE.name,):
        return None
    if path.suffix != ".py":
        return f"reference/{'.'.join(path.parts[1:])}.md"
    module = path.parent if path.name == "__init__.py" else path.with_suffix("")
    if path.name == "__init__.py":
        return f"reference/{'.'.join(module.parts[1:])}.md#{'.'.join(module.parts)}"
    return f"reference/{'.'.join(module.parent.parts[1:])}.md#{'.'.join(module.parts)}"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The pages of the rooms join the navigation, in the order of the house."""
    assert config.nav is not None
    config.nav.insert(5, {"Rooms": [{name: f"reference/{name}.md"} for name in [*packages(), *below()]]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that do not lie in docs/."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text("utf-8")))
    files.append(File.generated(config, "examples.md", content=examples()))
    for module in below():
        content = f"::: {PACKAGE.name}.{module}\n    options:\n      heading_level: 1\n      show_root_full_path: true\n"
        files.append(File.generated(config, f"reference/{module}.md", content=content))
    for package in packages():
        files.append(File.generated(config, f"reference/{package}.md", content=reference(package)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files, **_: Any) -> str:
    """Links to files of the repository lead to their pages, names of the code to what they name."""
    here = page.file.src_uri
    written = next((source for source, name in PAGES.items() if name == here), f"docs/{here}")

    def turned(match: re.Match[str]) -> str:
        picture, words, target, anchor = match[1], match[2], match[3], match[4] or ""
        if "://" in target:
            return match[0]
        found = place_of(posixpath.normpath(posixpath.join(posixpath.dirname(written), target)))
        if found is None:
            return words  # a file that has no page
        path, _, own = found.partition("#")
        relative = posixpath.relpath(path, posixpath.dirname(here) or ".")
        return f"{picture}[{words}]({relative}{f'#{own}' if own else anchor})"

    return NAME.sub(rf"[`\1`][{PACKAGE.name}.\1]", LINK.sub(turned, markdown))
