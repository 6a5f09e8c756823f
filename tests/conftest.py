"""Types checked while tests run, and inputs that tests share: the real capture, and a splatfacto run made of it.

In each test, the first calls of every function of the package are compared with its annotations, shapes included: what has
other types raises a jaxtyping.TypeCheckError. This has to be set up before anything imports the package. Tests of how bad input
is refused hand over what annotations forbid; they are marked `mistyped` and run without the comparison.
"""

from __future__ import annotations

import ast
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxtyping
import pytest

ROOT = Path(__file__).resolve().parent.parent

KERNELS = ("numba.njit", "ti.kernel", "ti.func", "kernel", "inlined")
"""Decorators whose functions are compiled: their annotations are those of a compiler, not of a value."""


def holds_kernels(tree: ast.Module) -> bool:
    """Whether a module defines a function that numba or Taichi compiles."""
    functions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    names = (ast.unparse(decorator).partition("(")[0] for function in functions for decorator in function.decorator_list)
    return any(name in KERNELS for name in names)


def checked_modules() -> list[str]:
    """Modules whose types are checked: all with functions of their own, but those that hold kernels."""
    paths = (path for path in sorted((ROOT / "pgsd_nerfstudio").rglob("*.py")) if path.name != "__init__.py")
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in paths
        if not holds_kernels(ast.parse(path.read_text("utf-8")))
    ]


CALLS = 20
"""Calls of a function that are compared in each test. Later ones rarely have other types, and comparing all of them made tests
that step through hundreds of frames take 1.7 times as long."""

_number = 0  # of the present test
_compared = jaxtyping.jaxtyped


def _compared_at_first(**settings: Any) -> Callable[[Any], Any]:
    """jaxtyping's decorator, which the import hook puts on every function, for the first calls in each test."""

    def decorate(function: Any) -> Any:
        compared = _compared(**settings)(function)
        if isinstance(function, type):
            return compared
        calls, number = 0, -1

        @functools.wraps(compared)
        def sampled(*arguments: Any, **named: Any) -> Any:
            nonlocal calls, number
            if number != _number:
                calls, number = 0, _number
            calls += 1
            return (compared if calls <= CALLS else function)(*arguments, **named)

        return sampled

    return decorate


jaxtyping.jaxtyped = _compared_at_first
# The numeric tower lets a whole number stand for a float, as type checkers do.
jaxtyping.install_import_hook(checked_modules(), "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")


@pytest.fixture(autouse=True)
def _mistyped(request: pytest.FixtureRequest):
    """Counts tests, and leaves types unchecked in a test with the mark of that name."""
    global _number
    _number += 1
    jaxtyping.config.update("jaxtyping_disable", request.node.get_closest_marker("mistyped") is not None)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory):
    """Tests read nothing that an earlier version has cached; set PGSD_CACHE to share a cache between runs."""
    if "PGSD_CACHE" in os.environ:
        yield
        return
    os.environ["PGSD_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    yield
    del os.environ["PGSD_CACHE"]


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real inputs beside the repository."""
    path = ROOT.parent / "shared"
    if not path.is_dir():
        pytest.skip("needs the real capture in ../shared, which lies outside the repository")
    return path


@pytest.fixture(scope="session")
def garden_ply(shared: Path) -> Path:
    """120,000 Gaussians of a garden, SH degree 1, in the coordinates of the poses in `garden_data`."""
    return _existing(shared / "scenes" / "garden.ply")


@pytest.fixture(scope="session")
def garden_data(shared: Path) -> Path:
    """The capture of that garden: 185 photographs with poses in nerfstudio's format."""
    return _existing(shared / "garden")


@pytest.fixture(scope="session")
def splatfacto_run(tmp_path_factory: pytest.TempPathFactory, garden_ply: Path, garden_data: Path) -> Path:
    """Folder of a splatfacto run (config.yml, dataparser_transforms.json, nerfstudio_models) that holds the garden's splat."""
    from splatfacto_run import write_splatfacto_run

    return write_splatfacto_run(tmp_path_factory.mktemp("outputs"), garden_ply, garden_data)


@pytest.fixture(scope="session")
def yard(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A dark floor of 6 x 6 m as a splat, and eight views of it from a ring: (the .ply, the folder of transforms.json)."""
    from yard_scene import write_yard

    return write_yard(tmp_path_factory.mktemp("yard"))


def _existing(path: Path) -> Path:
    if not path.exists():
        pytest.skip(f"needs ../{path.relative_to(ROOT.parent)}")
    return path
