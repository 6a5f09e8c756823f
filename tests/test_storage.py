"""Stored tensors come back to the bit or not at all."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from pgsd_nerfstudio.storage import load_tensors, save_tensors

TENSORS = {
    "positions": torch.randn(50, 3, generator=torch.Generator().manual_seed(0)),
    "births": torch.arange(50, dtype=torch.int32),
    "kinds": torch.zeros(50, dtype=torch.uint8),
    "half": torch.ones(4, 4, dtype=torch.bfloat16),
    "seen": torch.tensor([True, False]),
    "one": torch.tensor(3.0, dtype=torch.float64),
    "none": torch.zeros(0, 3),
}
ABOUT = {"fps": 25.0, "name": "Schnee fällt", "domain": [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]}


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    path = tmp_path / "stored.safetensors"
    save_tensors(path, TENSORS, ABOUT)
    return path


def is_whole(found: tuple[dict[str, torch.Tensor], dict] | None) -> bool:
    if found is None:
        return False
    tensors, about = found
    same = all(torch.equal(tensors[n], t) and tensors[n].dtype == t.dtype for n, t in TENSORS.items())
    return same and tensors.keys() == TENSORS.keys() and about == ABOUT


def test_what_was_stored_comes_back(stored):
    assert is_whole(load_tensors(stored))


def test_a_missing_file_is_none_without_a_word(tmp_path, caplog):
    assert load_tensors(tmp_path / "nothing.safetensors") is None
    assert not caplog.records


def test_one_flipped_bit_is_always_noticed(stored, caplog):
    """Anywhere: in the length of the header, in the header, in the description, in the values."""
    whole = stored.read_bytes()
    draw = random.Random(0)
    places = [*range(8), *(draw.randrange(len(whole)) for _ in range(600))]
    taken = 0
    for place in places:
        flipped = bytearray(whole)
        flipped[place] ^= 1 << draw.randrange(8)
        stored.write_bytes(flipped)
        found = load_tensors(stored)
        assert found is None or is_whole(found), place
        taken += found is not None
    assert taken < 5  # spaces that pad the header may be anything
    assert len(caplog.records) == len(places) - taken
    assert all(str(stored) in record.getMessage() for record in caplog.records)
    assert any("not what was written" in record.getMessage() for record in caplog.records)


@pytest.mark.parametrize("part", [0, 7, 100, 0.5, 0.999])
def test_a_truncated_file_is_noticed(stored, part):
    whole = stored.read_bytes()
    stored.write_bytes(whole[: part if isinstance(part, int) else int(part * len(whole))])
    assert load_tensors(stored) is None


def test_a_damaged_file_stays_where_it_is(stored):
    """It may be somebody's only copy; what is made again replaces it."""
    stored.write_bytes(b"no")
    assert load_tensors(stored) is None
    assert stored.read_bytes() == b"no"
    save_tensors(stored, TENSORS, ABOUT)
    assert is_whole(load_tensors(stored))


def test_a_file_without_a_digest_is_of_an_older_version(tmp_path, caplog):
    save_file({"a": torch.ones(3)}, tmp_path / "old.safetensors", metadata={"about": json.dumps({})})
    assert load_tensors(tmp_path / "old.safetensors") is None
    assert "older version" in caplog.text
