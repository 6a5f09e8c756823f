"""pgsd cache: what is kept is listed, and nothing but that is removed."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

import pytest
import torch

from pgsd_nerfstudio.cli.cache import ABANDONED, DAY, KINDS, age_of, kept, size_of
from pgsd_nerfstudio.cli.main import run
from pgsd_nerfstudio.storage import save_tensors

PACKAGE = Path(__file__).resolve().parent.parent / "pgsd_nerfstudio"
KEY = "0123456789abcdef"
OURS = {
    f"demo-{KEY}.safetensors": "demo",
    f"surfaces/{KEY}.safetensors": "surfaces",
    f"motion/{KEY}.safetensors": "motion",
    f"motion/{KEY}/chunk-0000.safetensors": "motion",
    f"answers/{KEY}.safetensors": "answers",
    f"edits/{KEY}.safetensors": "edits",
    f"edits/{KEY}.unfinished.safetensors": "edits",
    f"prompts/{KEY}.safetensors": "prompts",
    f"requests/request-{KEY}.json": "requests",
    f"views/{KEY}/view_0003.png": "views",
}
FOREIGN = [
    "thesis.safetensors",
    "demo-of-mine.safetensors",
    f"motion/{KEY}.txt",
    f"motion/{KEY}/notes.md",
    "motion/mine.safetensors",
    f"other/{KEY}.safetensors",
    f"views/{KEY}/deeper/view_0003.png",
    f"deep/motion/{KEY}.safetensors",
]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache with a file of each kind, and among them files that are somebody else's."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("PGSD_CACHE", str(folder))
    for name in (*OURS, *FOREIGN):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x" * 1000)
    return folder


def names(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()}


def test_every_folder_that_the_code_stores_in_is_a_kind():
    text = "".join(path.read_text("utf-8") for path in PACKAGE.rglob("*.py") if path.parent.name != "cli")
    used = {*re.findall(r'cache(?:_dir)?\(\) / f?"(\w+)', text)}
    assert used == {*KINDS}


def test_each_file_is_of_its_kind_and_others_are_of_none(cache: Path):
    assert {each.path.relative_to(cache).as_posix(): each.kind for each in kept(cache)} == OURS


def test_all_that_is_kept_is_removed_and_nothing_else(cache: Path, capsys: pytest.CaptureFixture):
    assert run(["cache", "clear", "--yes"]) == 0
    assert names(cache) == {*FOREIGN}
    assert f"{len(OURS)} files, {len(OURS)} kB removed" in " ".join(capsys.readouterr().out.split())
    assert not (cache / "surfaces").exists() and (cache / "motion" / KEY).is_dir() and cache.is_dir()
    assert run(["cache", "clear", "--yes"]) == 0
    assert "nothing to remove" in capsys.readouterr().out


def test_what_links_point_to_is_left_alone(tmp_path: Path, cache: Path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for path in (elsewhere / f"{KEY}.safetensors", elsewhere / "ffmpeg"):
        path.write_text("precious")
    (cache / "bin").mkdir()
    (cache / "bin" / "ffmpeg").symlink_to(elsewhere / "ffmpeg")
    (cache / f"prompts/{KEY}.safetensors").unlink()
    (cache / "prompts").rmdir()
    (cache / "prompts").symlink_to(elsewhere)
    assert run(["cache", "clear", "--yes"]) == 0
    assert {path.read_text() for path in elsewhere.iterdir()} == {"precious"} and len([*elsewhere.iterdir()]) == 2
    assert not (cache / "bin").exists() and (cache / "prompts").is_symlink()


def test_a_cache_that_is_itself_a_link_is_cleared(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "link").symlink_to(cache)
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path / "link"))
    assert run(["cache", "clear", "--yes"]) == 0
    assert names(cache) == {*FOREIGN}


def test_only_the_kinds_and_ages_that_are_asked_for_are_removed(cache: Path):
    old = time.time() - 10 * DAY
    for name in (f"surfaces/{KEY}.safetensors", f"motion/{KEY}.safetensors"):
        os.utime(cache / name, (old, old))
    assert run(["cache", "clear", "--yes", "--kind", "motion", "answers", "--older-than", "9"]) == 0
    assert {*OURS} - names(cache) == {f"motion/{KEY}.safetensors"}
    assert run(["cache", "clear", "--yes", "--older-than", "11"]) == 0
    assert run(["cache", "clear", "--yes", "--kind", "views"]) == 0
    assert {*OURS} - names(cache) == {f"motion/{KEY}.safetensors", f"views/{KEY}/view_0003.png"}


def test_a_dry_run_names_each_file_and_removes_none(cache: Path, capsys: pytest.CaptureFixture):
    before = names(cache)
    assert run(["cache", "clear", "--dry-run", "--yes"]) == 0
    said = capsys.readouterr().out
    assert names(cache) == before and all(str(cache / name) in said for name in OURS) and "would be removed" in said


@pytest.mark.parametrize(("answer", "left"), [("y", 0), ("n", len(OURS)), ("", len(OURS))])
def test_it_asks_first(cache: Path, monkeypatch: pytest.MonkeyPatch, answer: str, left: int):
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda *_: answer)
    assert run(["cache", "clear"]) == 0
    assert len([*kept(cache)]) == left


def test_where_nobody_can_be_asked_nothing_is_removed(cache: Path, capsys: pytest.CaptureFixture):
    before = names(cache)
    assert run(["cache", "clear"]) == 1
    assert names(cache) == before and "add --yes" in capsys.readouterr().err


@pytest.mark.parametrize("days", ["-1", "nan"])
def test_ages_that_are_none_are_refused(cache: Path, capsys: pytest.CaptureFixture, days: str):
    assert run(["cache", "clear", "--yes", "--older-than", days]) == 1
    assert "--older-than must be a number of days, 0 or more" in capsys.readouterr().err
    assert {*OURS} <= names(cache)


def test_a_file_that_is_being_written_is_left_until_nobody_can_be_writing_it(cache: Path):
    path = cache / "motion" / f".0a1b2c3d.{KEY}.safetensors"
    path.write_text("half")
    assert path not in {each.path for each in kept(cache)}
    old = time.time() - 2 * ABANDONED
    os.utime(path, (old, old))
    assert "left unfinished" in next(each.what for each in kept(cache) if each.path == path)


def test_files_say_what_they_are(cache: Path, capsys: pytest.CaptureFixture):
    about = {"effect": "rainfall", "intensity": 20.0, "unit": "mm/h of water", "seed": 3}
    path = cache / f"motion/{KEY}.safetensors"
    save_tensors(path, {"x": torch.zeros(3)}, about)
    assert next(each.what for each in kept(cache) if each.path == path) == "rainfall, 20 mm/h of water, seed 3"
    assert run(["cache", "list"]) == 0
    said = capsys.readouterr().out
    assert "rainfall, 20" in said and f"{len(OURS)} files" in said and str(cache) in said
    assert run(["cache", "list", "--kind", "views"]) == 0
    assert "1 file, 1 kB" in capsys.readouterr().out


def test_a_cache_that_is_not_there_yet_is_empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path / "none"))
    assert run(["cache", "list"]) == 0 and "0 files, 0 bytes" in capsys.readouterr().out


def test_sizes_and_ages_have_units():
    assert [size_of(n) for n in (0, 999, 1000, 6_190_058, 12_300_000_000)] == [
        "0 bytes",
        "999 bytes",
        "1 kB",
        "6.19 MB",
        "12.3 GB",
    ]
    assert [age_of(s) for s in (5, 119, 120, 7200, 2 * DAY)] == ["5 s", "119 s", "2 min", "2 h", "2 days"]
