"""Ragged trajectories: who is where when, and files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pgsd_nerfstudio.physics.bodies import RunState
from pgsd_nerfstudio.physics.clock import Clock
from pgsd_nerfstudio.physics.record.chunks import Chunk, _trajectories, assemble
from pgsd_nerfstudio.physics.record.codec import quantised
from pgsd_nerfstudio.physics.record.history import ParticleHistory
from pgsd_nerfstudio.storage import load_tensors, save_tensors


@pytest.fixture
def history() -> ParticleHistory:
    """Three particles over 6 frames: one lands in frame 2, one flies on from frame 3, one is there in frame 1 only."""
    births, ends = torch.tensor([0, 3, 1]), torch.tensor([3, 6, 2])
    offsets = torch.tensor([0, 3, 6, 7])
    positions = torch.tensor([0.0, 1, 3, 10, 12, 16, 50])[:, None] * torch.tensor([1.0, 0, -1])
    return ParticleHistory(
        births=births.int(),
        ends=ends.int(),
        collided=torch.tensor([True, False, False]),
        offsets=offsets,
        positions=positions,
        rest_positions=torch.tensor([[3.0, 0, -3], [0, 0, 0], [0, 0, 0]]),
        rest_quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        rest_extents=torch.tensor([0.1, 0, 0]),
        rest_covers=torch.tensor([0.02, 0, 0]),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        diameters=torch.full((3,), 0.005),
        represents=torch.ones(3),
        reaches=torch.full((3,), 1e9),
        kinds=torch.tensor([0, 2, 5], dtype=torch.uint8),
        fps=25.0,
        frames=6,
        about={"effect": "test", "seed": 3},
    )


def test_a_particle_is_active_from_birth_through_its_hit(history):
    assert [history.active(f).tolist() for f in range(6)] == [[0], [0, 2], [0], [1], [1], [1]]


def test_it_rests_from_the_frame_after_the_hit(history):
    assert [history.resting(f).tolist() for f in range(6)] == [[], [], [], [0], [0], [0]]


def test_positions_belong_to_their_frames(history):
    assert history.positions_at(2, torch.tensor([0]))[0, 0] == 3
    assert history.positions_at(4, torch.tensor([1]))[0, 0] == 12
    assert history.positions_at(1, torch.tensor([0, 2]))[:, 0].tolist() == [1, 50]


def test_displacement_is_to_the_frame_before(history):
    assert history.displacement_at(1, torch.tensor([0]))[0].tolist() == [1, 0, -1]
    assert history.displacement_at(5, torch.tensor([1]))[0].tolist() == [4, 0, -4]


def test_displacement_in_the_first_frame_is_the_first_step(history):
    assert history.displacement_at(3, torch.tensor([1]))[0, 0] == 2
    assert history.displacement_at(0, torch.tensor([0]))[0, 0] == 1


def test_a_contact_cuts_a_step_short_and_not_the_displacement_of_a_shutter(history):
    """A drop of 8 m/s that arrives 1 cm after the beginning of its last frame still streaks by 32 cm a frame."""
    heights = torch.tensor([1.0, 0.68, 0.36, 0.35])
    drop = replace(
        history.select(torch.tensor([1])),
        births=torch.tensor([0]).int(),
        ends=torch.tensor([4]).int(),
        offsets=torch.tensor([0, 4]),
        positions=torch.stack([torch.zeros(4), torch.zeros(4), heights], 1),
        kinds=torch.zeros(1, dtype=torch.uint8),
    )
    fell = [drop.displacement_at(frame, torch.tensor([0]))[0, 2].item() for frame in range(4)]
    assert fell == pytest.approx([-0.32] * 4, abs=1e-6)
    slid = replace(drop, kinds=torch.tensor([2], dtype=torch.uint8))
    assert slid.displacement_at(3, torch.tensor([0]))[0, 2].item() == pytest.approx(-0.01, abs=1e-6)
    in_view = replace(drop, frames=4)  # the run ends before the drop does
    assert in_view.displacement_at(3, torch.tensor([0]))[0, 2].item() == pytest.approx(-0.01, abs=1e-6)


def test_displacement_is_zero_for_a_single_frame(history):
    assert history.displacement_at(1, torch.tensor([2]))[0].tolist() == [0, 0, 0]


def test_a_window_is_dense(history):
    window = history.window(2, 5)
    assert window.ids.tolist() == [0, 1]
    assert window.active.tolist() == [[True, False, False], [False, True, True]]
    assert window.positions[:, :, 0].tolist() == [[3, 3, 3], [10, 10, 12]]


def test_selected_particles_keep_what_is_theirs(history):
    ids = torch.tensor([len(history) - 1, 0])
    few = history.select(ids)
    assert (few.frames, few.fps, len(few)) == (history.frames, history.fps, 2)
    for new, old in enumerate(ids.tolist()):
        assert int(few.births[new]) == int(history.births[old]) and bool(few.collided[new]) == bool(history.collided[old])
        for frame in range(int(history.births[old]), int(history.ends[old])):
            there, here = few.positions_at(frame, torch.tensor([new])), history.positions_at(frame, torch.tensor([old]))
            assert torch.equal(there, here)
    assert len(history.select(ids[:0])) == 0


def test_saved_and_loaded_it_is_the_same(history, tmp_path):
    history.save(tmp_path / "h.safetensors")
    again = ParticleHistory.load(tmp_path / "h.safetensors")
    assert again is not None
    assert (again.fps, again.frames, dict(again.about)) == (25.0, 6, {"effect": "test", "seed": 3})
    for name, value in vars(history).items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, getattr(again, name)), name
            assert value.dtype == getattr(again, name).dtype


def test_a_damaged_file_is_no_history(history, tmp_path):
    path: Path = tmp_path / "h.safetensors"
    history.save(path)
    path.write_bytes(path.read_bytes()[:-20])
    assert ParticleHistory.load(path) is None
    assert ParticleHistory.load(tmp_path / "none.safetensors") is None


def test_saved_positions_are_rounded_by_half_a_quantum_at_most(history, tmp_path):
    off = replace(history, positions=history.positions + 1e-3 * torch.arange(7)[:, None])
    off.save(tmp_path / "h.safetensors")
    again = ParticleHistory.load(tmp_path / "h.safetensors")
    assert again is not None
    assert 0 < float((again.positions - off.positions).abs().max()) <= 2**-15


def test_a_file_whose_steps_do_not_fit_is_no_history(history, tmp_path):
    path = tmp_path / "h.safetensors"
    history.save(path)
    stored = load_tensors(path)
    assert stored is not None
    save_tensors(path, {**stored[0], "steps_two": stored[0]["steps_two"][:-1]}, stored[1])
    assert ParticleHistory.load(path) is None
    save_tensors(path, stored[0], {**stored[1], "format": 1})
    assert ParticleHistory.load(path) is None
    save_tensors(path, *stored)
    assert ParticleHistory.load(path) is not None


def test_a_run_put_together_from_chunks_is_the_same_bit_for_bit_when_loaded(tmp_path):
    rng = np.random.default_rng(4)
    count, frames = 5, 7
    none, one = np.zeros(0, np.float32), np.ones(count, np.float32)
    chunk = Chunk(
        start=0,
        frames=frames,
        row_ids=np.tile(np.arange(count, dtype=np.int32), frames),
        row_counts=np.full(frames, count, np.int32),
        row_positions=rng.normal(size=(count * frames, 3)).astype(np.float32),
        births=np.zeros(count, np.int32),
        diameters=one,
        represents=one,
        reaches=1e9 * one,
        quats=np.ones((count, 4), np.float32),
        kind_ids=np.array([1, 3], np.int32),
        kind_bits=np.array([2, 5], np.uint8),
        ended_ids=none.astype(np.int32),
        ended_frames=none.astype(np.int32),
        ended_how=none.astype(np.uint8),
        rest_ids=none.astype(np.int32),
        rest_positions=none.reshape(0, 3),
        rest_quats=none.reshape(0, 4),
        rest_extents=none,
        rest_covers=none,
        rest_represents=none,
        state=replace(RunState.empty(), born=count),
    )
    fresh = assemble([chunk], Clock(fps=25.0, frames=frames), {})
    fresh.save(tmp_path / "h.safetensors")
    again = ParticleHistory.load(tmp_path / "h.safetensors")
    assert again is not None
    assert again.kinds.tolist() == [0, 2, 0, 5, 0]
    for name, value in vars(fresh).items():
        if isinstance(value, torch.Tensor):
            assert value.numpy().tobytes() == getattr(again, name).numpy().tobytes(), name


def test_its_size_is_that_of_its_tensors(history):
    # Per particle 2 int32, 1 bool, 1 uint8, 3 + 4 + 4 + 5 float32 (place, two orientations, five lengths and counts).
    assert history.nbytes == 7 * 12 + 4 * 8 + 3 * (8 + 1 + 1 + 16 * 4)


def test_nan_is_not_saved(history, tmp_path):
    positions = history.positions.clone()
    positions[4, 1] = torch.nan
    with pytest.raises(ValueError, match="positions of particle 1 are not finite 1 frames after its birth"):
        replace(history, positions=positions).save(tmp_path / "h.safetensors")
    assert not list(tmp_path.iterdir())


def test_nan_is_reported_with_its_frame(history):
    positions = history.positions.clone()
    positions[4, 1] = torch.nan
    with pytest.raises(ValueError, match="positions of particle 1 are not finite in frame 4"):
        replace(history, positions=positions).check_finite()


def test_offsets_must_cover_the_positions(history):
    with pytest.raises(ValueError, match="offsets must have 4 entries and end at 6"):
        replace(history, positions=history.positions[:-1])


def test_rows_are_placed_by_particle_and_frame_and_wrong_ones_are_refused():
    """Two chunks of two frames each; particle 1 is born in frame 1, particle 0 ends before frame 3."""
    births, offsets = np.array([0, 1], np.int32), np.array([0, 3, 6])
    at = np.arange(18, dtype=np.float32).reshape(6, 3)
    ids = [np.array([0, 1, 0], np.int32), np.array([1, 0, 1], np.int32)]
    counts = [np.array([1, 2], np.int32), np.array([2, 1], np.int32)]

    def placed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        rows = zip((0, 2), ids, counts, (first, second), strict=True)
        chunks = [
            SimpleNamespace(start=s, births=births if s == 0 else births[:0], row_ids=i, row_counts=c, row_positions=p)
            for s, i, c, p in rows
        ]
        found = _trajectories(chunks, births, offsets)  # type: ignore[arg-type]
        assert not chunks  # they have been let go
        return found

    expected = at[[0, 2, 4, 1, 3, 5]]  # by particle, then frame
    np.testing.assert_array_equal(placed(at[:3], at[3:]), expected)
    far = at + np.float32(5000.0)  # the lattice is coarser there
    np.testing.assert_array_equal(placed(far[:3], far[3:]), quantised(far[[0, 2, 4, 1, 3, 5]], offsets))
    with pytest.raises(ValueError, match=r"particle 1 is not finite, or it is not active, in frame 2"):
        placed(at[:3], np.where(np.arange(3)[:, None] == 0, np.float32(np.nan), at[3:]))
    ids[1][2] = 0  # in frame 3
    with pytest.raises(ValueError, match=r"particle 0 is not finite, or it is not active, in frame 3"):
        placed(at[:3], at[3:])
