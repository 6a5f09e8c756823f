"""The bundled prior as it is shipped: complete, small, without pickles, and of one mind about words and shapes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pgsd_nerfstudio.guidance import load_prior
from pgsd_nerfstudio.guidance.folder import BUNDLED

ROOT = Path(__file__).parent.parent
PARTS = {"transformer", "vae", "text_encoder", "tokenizer", "scheduler"}
WRONG = "Grey dirty oversized translucent blobs are falling in {}. Low quality, blurry"
CURATED = "Fluffy snowflakes are falling in {}, accumulating on surfaces. Photorealistic, high detail"
SCENE = "a courtyard with a table with a vase on it, a bench and a tree"

needs_weights = pytest.mark.skipif(
    not (BUNDLED / "transformer").is_dir(), reason="no bundled weights: python scripts/train_bundled_prior.py makes them"
)


@pytest.fixture(scope="module")
def prior():
    return load_prior("bundled", "cpu")


@pytest.fixture(scope="module")
def tokenizer():
    from transformers import AutoTokenizer

    return AutoTokenizer.from_pretrained(BUNDLED / "tokenizer", local_files_only=True)


@needs_weights
def test_the_folder_is_complete_small_and_without_pickles():
    files = [f for f in BUNDLED.rglob("*") if f.is_file()]
    assert (
        {f.parent.name for f in files} >= PARTS
        and (BUNDLED / "model_index.json").is_file()
        and (BUNDLED / "README.md").is_file()
    )
    assert {f.suffix for f in files} <= {".json", ".safetensors", ".md"}
    assert sum(f.stat().st_size for f in files) <= 20e6


@needs_weights
def test_diffusers_own_pipeline_loads_it():
    from diffusers import CogVideoXPipeline

    pipeline = CogVideoXPipeline.from_pretrained(BUNDLED, local_files_only=True, torch_dtype=torch.float32)
    assert set(json.loads((BUNDLED / "model_index.json").read_text())) >= PARTS
    made = pipeline(
        "no weather, clear air in a courtyard", num_frames=9, height=64, width=96, num_inference_steps=2, max_sequence_length=40
    )
    assert len(made.frames[0]) == 9 and made.frames[0][0].size == (96, 64)


@needs_weights
def test_every_word_of_the_captions_is_known_and_has_its_own_id(tokenizer):
    words = set((WRONG + " " + CURATED).replace("{}", SCENE).lower().replace(",", " ").replace(".", " ").split())
    ids = {w: tokenizer(w).input_ids[0] for w in words}
    assert tokenizer.unk_token_id not in ids.values()
    assert len(set(ids.values())) == len(words)
    assert tokenizer("zeppelin").input_ids[0] == tokenizer.unk_token_id


@needs_weights
def test_the_longest_caption_fits_uncut(tokenizer, prior):
    text = "Moderate snowfall. " + CURATED.format(SCENE)
    assert len(tokenizer(text).input_ids) <= prior.transformer.config.max_text_seq_length


@needs_weights
def test_clips_and_latents_have_the_shapes_the_folder_promises(prior):
    assert prior.clip_shape == (9, 64, 96)
    clip = torch.rand(9, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    latents = prior.encode(clip)
    assert latents.shape == (1, 3, 16, 16, 24)
    assert prior.decode(latents).shape == clip.shape
    text = prior.encode_prompt([CURATED.format(SCENE), ""])
    assert prior.predict_v(latents, 500, text).shape == (2, 3, 16, 16, 24)


@needs_weights
def test_the_encoder_is_linear_so_that_gradients_pass_it_undistorted(prior):
    draw = torch.Generator().manual_seed(1)
    scene, change = torch.rand(9, 3, 64, 96, generator=draw), 0.05 * torch.randn(9, 3, 64, 96, generator=draw)
    with torch.no_grad():
        one = prior.encode(scene + change) - prior.encode(scene)
        two = prior.encode(scene + 2 * change) - prior.encode(scene)
    # What is not linear is the scale of the whole clip, in the last normalisation.
    assert ((two - 2 * one).norm() / two.norm()).item() < 0.05


@needs_weights
@pytest.mark.parametrize("timestep", [100, 500, 900])
def test_words_lead_flakes_from_the_wrong_look_toward_the_curated_one(prior, timestep):
    """Drawn here, not by the scripts that trained it: dots that move down a shaded background."""
    wrong, curated = (snow(*look) for look in ((0.45, 0.5, 2.0), (0.95, 1.0, 1.0)))
    with torch.no_grad():
        latents, aim = prior.encode(wrong), prior.encode(curated)
        text = prior.encode_prompt([CURATED.format(SCENE), WRONG.format(SCENE)])
        alpha_bar = float(prior.alphas_cumprod[timestep])
        noise = torch.randn(latents.shape, generator=torch.Generator().manual_seed(2))
        told, against = prior.predict_v(alpha_bar**0.5 * latents + (1 - alpha_bar) ** 0.5 * noise, timestep, text)
    gradient = told - against
    assert torch.nn.functional.cosine_similarity(gradient.flatten(), (latents - aim).flatten(), dim=0) > 0.04


def snow(brightness: float, opacity: float, size: float) -> torch.Tensor:
    """A clip of 120 dots of one look in front of a dark gradient, the same motion every time."""
    draw = torch.Generator().manual_seed(3)
    x, y, near = (
        96 * torch.rand(120, generator=draw),
        64 * torch.rand(120, generator=draw),
        0.7 + torch.rand(120, generator=draw),
    )
    v, u = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(96) + 0.5, indexing="ij")
    frames = []
    for t in range(9):
        away = (u - x[:, None, None]) ** 2 + (v - (y + 1.5 * near * t)[:, None, None] % 64) ** 2
        alpha = 0.9 * opacity * torch.exp(-0.5 * away / (size * near[:, None, None]) ** 2)
        through = (1 - alpha).prod(dim=0)
        frames.append((0.1 + 0.25 * v / 64) * through + brightness * (1 - through))
    return torch.stack(frames)[:, None].expand(-1, 3, -1, -1).clamp(0, 1)


@pytest.mark.slow
def test_the_training_script_makes_a_loadable_folder(tmp_path):
    script = ROOT / "scripts" / "train_bundled_prior.py"
    output = tmp_path / "prior"
    words = [sys.executable, str(script), "--quick", "--work", str(tmp_path / "work"), "--output", str(output)]
    subprocess.run(words, check=True, timeout=600)
    toy = load_prior(output, "cpu")
    assert toy.encode(torch.rand(9, 3, 64, 96)).isfinite().all()
    assert (output / "README.md").is_file() and (tmp_path / "work" / "samples.png").is_file()


@pytest.mark.slow
def test_an_interrupted_training_goes_on(tmp_path):
    script = ROOT / "scripts" / "train_bundled_prior.py"
    words = [sys.executable, str(script), "--quick", "--work", str(tmp_path), "--output", str(tmp_path / "prior"), "--stages"]
    subprocess.run([*words, "clips", "encoder"], check=True, timeout=600)
    made = {f: f.stat().st_mtime_ns for f in (tmp_path / "clips").iterdir()}
    subprocess.run([*words, "clips", "latents"], check=True, timeout=600)
    assert made == {f: f.stat().st_mtime_ns for f in (tmp_path / "clips").iterdir()}
    assert (tmp_path / "latents.safetensors").is_file()
