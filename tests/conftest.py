"""Inputs that tests share: the real capture beside the repository, and a splatfacto run made of it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


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
