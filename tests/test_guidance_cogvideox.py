"""CogVideoX as a video prior against diffusers' own pipeline, and what it says to a folder that is none."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from guidance_prior import rewrite, there_and_back

from pgsd_nerfstudio.guidance import CogVideoXPrior, PriorError, folder
from pgsd_nerfstudio.guidance.text import token_ids
from pgsd_nerfstudio.laboratory.tiny_cogvideox import scheduler_2b, tiny_pipeline, write_tiny

PROMPT, NEGATIVE = "snow is falling in a garden", "no snow"


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("prior") / "tiny")


@pytest.fixture(scope="module")
def prior(tiny) -> CogVideoXPrior:
    return CogVideoXPrior.load(tiny)


@pytest.fixture
def broken(tiny, tmp_path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(tiny, tmp_path / "broken"))


def test_alpha_bar_is_that_of_cogvideox_2b(prior):
    assert prior.alphas_cumprod.dtype == torch.float64
    found = prior.alphas_cumprod[[20, 500, 740, 980, 999]].tolist()
    assert found == pytest.approx([0.944, 0.0953, 0.0122, 2.4e-5, 0.0], rel=0.02)
    assert torch.equal(prior.alphas_cumprod, scheduler_2b().alphas_cumprod)


@pytest.mark.parametrize(
    ("variant", "frames", "height", "width"), [("2b", 9, 32, 48), ("2b", 17, 48, 32), ("5b", 9, 32, 48), ("1.5", 13, 32, 48)]
)
def test_prediction_is_that_of_diffusers_pipeline(tmp_path, monkeypatch, variant, frames, height, width):
    pipeline = tiny_pipeline(variant)
    pipeline.save_pretrained(tmp_path / "prior")
    prior = CogVideoXPrior.load(tmp_path / "prior")
    noisy = torch.randn(1, (frames - 1) // 4 + 1, 4, height // 8, width // 8, generator=torch.Generator().manual_seed(1))
    seen = {}

    def step(v, t, latents, **_):
        seen[int(t)] = v
        return (latents,)

    monkeypatch.setattr(pipeline.scheduler, "step", step)
    pipeline(
        PROMPT,
        NEGATIVE,
        height,
        width,
        frames,
        2,
        guidance_scale=6.0,
        latents=noisy,  # type: ignore[arg-type]
        output_type="latent",
        max_sequence_length=12,
    )
    text, negative = prior.encode_prompt([PROMPT, NEGATIVE]).split(1)
    assert len(seen) == 2
    for t, truth in seen.items():
        v_negative, v_text = prior.predict_v(noisy, t, torch.cat([negative, text])).split(1)
        torch.testing.assert_close(v_negative + 6.0 * (v_text - v_negative), truth, rtol=1e-4, atol=1e-5)


def test_odd_latent_frames_of_the_larger_models_are_padded_in_front_and_dropped(tmp_path):
    prior = CogVideoXPrior.load(write_tiny(tmp_path / "prior", "1.5"))
    noisy, text = torch.randn(1, 3, 4, 4, 6), prior.encode_prompt([PROMPT])
    padded = prior.predict_v(torch.cat([noisy[:, :1], noisy], dim=1), 500, text)
    assert torch.equal(prior.predict_v(noisy, 500, text), padded[:, 1:])


def test_positions_are_made_once_per_clip_shape(prior, monkeypatch):
    text, noisy = prior.encode_prompt([PROMPT]), torch.randn(1, 5, 4, 8, 6)
    first = prior.predict_v(noisy, 300, text)
    monkeypatch.setattr(prior.transformer.patch_embed, "_get_positional_embeddings", lambda *_: pytest.fail("made again"))
    assert torch.equal(prior.predict_v(noisy, 300, text), first)


def test_positions_are_held_in_half_precision_and_are_those_that_diffusers_makes_in_every_call(tiny):
    held, made = (CogVideoXPrior.load(tiny, dtype=torch.float16) for _ in range(2))
    text, noisy = held.encode_prompt([PROMPT]), torch.randn(1, 5, 4, 8, 6, generator=torch.Generator().manual_seed(3)).half()
    truth = made.transformer(noisy, text, torch.tensor([300]), return_dict=False)[0]
    assert torch.equal(held.predict_v(noisy, 300, text), truth.float())
    assert held.transformer.patch_embed.pos_embedding.dtype == torch.float16


def test_clip_shape_is_the_models_own_or_as_many_frames_as_asked(tiny, prior):
    assert prior.clip_shape == (9, 32, 48)
    assert CogVideoXPrior.load(tiny, frames=17).clip_shape == (17, 32, 48)
    with pytest.raises(ValueError, match=r"4k \+ 1 frames, found 10; use 9 or 13"):
        CogVideoXPrior.load(tiny, frames=10)


def test_latents_are_the_scaled_mean_of_the_vae_and_differentiable(prior):
    clip = torch.rand(9, 3, 32, 48, requires_grad=True)
    latents = prior.encode(clip)
    assert latents.shape == (1, 3, 4, 4, 6) and latents.dtype == torch.float32
    posterior = prior.vae.encode((2 * clip.detach() - 1).permute(1, 0, 2, 3)[None]).latent_dist
    torch.testing.assert_close(latents, (posterior.mean * prior.vae.config.scaling_factor).permute(0, 2, 1, 3, 4))
    (gradient,) = torch.autograd.grad(latents.square().sum(), clip)
    assert torch.isfinite(gradient).all() and (gradient.flatten(1).norm(dim=1) > 0).all()
    assert prior.decode(latents.detach()).shape == clip.shape


def test_checkpointing_changes_memory_not_gradients(tiny, prior):
    clip = torch.rand(9, 3, 32, 48)
    thrifty = CogVideoXPrior.load(tiny, checkpointing=True)
    gradients, kept = zip(*(there_and_back(which, clip) for which in (prior, thrifty)), strict=True)
    assert torch.equal(gradients[0], gradients[1])
    assert kept[1] < 0.5 * kept[0]


@pytest.mark.parametrize(("checkpointing", "times"), [(False, 1), (True, 2)])
def test_checkpointing_computes_every_resnet_a_second_time_and_not_a_third(tiny, checkpointing, times):
    prior = CogVideoXPrior.load(tiny, checkpointing=checkpointing)
    calls = {}
    for name, module in prior.vae.encoder.named_modules():
        if type(module).__name__ == "CogVideoXResnetBlock3D":
            calls[name] = 0

            def count(*_, name=name):
                calls[name] += 1

            module.register_forward_pre_hook(count)
    pixels = torch.rand(9, 3, 32, 48).requires_grad_()
    torch.autograd.grad(prior.encode(pixels).sum(), pixels)
    assert calls and set(calls.values()) == {times}


def test_no_weight_ever_gets_a_gradient(prior):
    assert not any(p.requires_grad for model in (prior.transformer, prior.vae) for p in model.parameters())
    assert not prior.predict_v(torch.randn(1, 3, 4, 4, 6, requires_grad=True), 10, prior.encode_prompt([PROMPT])).requires_grad


@pytest.mark.mistyped
@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((8, 3, 32, 48), r"4k \+ 1 frames, found 8; use 5 or 9"),
        ((9, 3, 40, 48), "multiples of 16 .* found 40x48"),
        ((9, 4, 32, 48), r"\[frames, 3, height, width\], found \[9, 4, 32, 48\]"),
    ],
)
def test_a_clip_of_the_wrong_shape_is_refused(prior, shape, message):
    with pytest.raises(ValueError, match=message):
        prior.encode(torch.rand(*shape))


def test_texts_are_encoded_once_and_the_text_encoder_is_not_loaded_again(tiny, monkeypatch, tmp_path):
    monkeypatch.setenv("PGSD_CACHE", str(tmp_path))
    first = CogVideoXPrior.load(tiny).encode_prompt([PROMPT, NEGATIVE, PROMPT])
    assert first.shape == (3, 12, 16) and torch.equal(first[0], first[2]) and not torch.equal(first[0], first[1])
    monkeypatch.setattr("transformers.T5EncoderModel.from_pretrained", lambda *_, **__: pytest.fail("loaded again"))
    assert torch.equal(CogVideoXPrior.load(tiny).encode_prompt([NEGATIVE, PROMPT]), first[[1, 0]])


def test_another_text_encoder_does_not_get_the_cached_embeddings(tiny, tmp_path):
    other = write_tiny(tmp_path / "other", seed=7)
    found = [CogVideoXPrior.load(place).encode_prompt([PROMPT]) for place in (tiny, other)]
    assert not torch.equal(*found)


def test_bare_sentencepiece_model_as_cogvideox_ships_it(tmp_path, monkeypatch):
    """The truth is transformers' own conversion, given the protobuf module that works with nerfstudio's protobuf."""
    sentencepiece = pytest.importorskip("sentencepiece")
    (tmp_path / "corpus.txt").write_text(
        "\n".join(f"snow is falling in a garden number {i} on day {7 * i}" for i in range(300))
    )
    sentencepiece.SentencePieceTrainer.train(
        input=str(tmp_path / "corpus.txt"), model_prefix=str(tmp_path / "spiece"), vocab_size=60,
        pad_id=0, eos_id=1, unk_id=2, bos_id=-1, minloglevel=2,
    )  # fmt: skip
    (tmp_path / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "T5Tokenizer", "extra_ids": 100}))
    texts = ["snow is falling", "Snow  is falling, über 35!", "", "a garden " * 20]
    found = token_ids(tmp_path, texts, 12)
    from transformers import AutoTokenizer, convert_slow_tokenizer
    from transformers.utils import sentencepiece_model_pb2

    monkeypatch.setattr(convert_slow_tokenizer, "import_protobuf", lambda *_, **__: sentencepiece_model_pb2)
    tokenizer = AutoTokenizer.from_pretrained(tmp_path, local_files_only=True)
    truth = tokenizer(texts, padding="max_length", max_length=12, truncation=True, return_tensors="pt").input_ids
    assert torch.equal(found, truth)


def test_one_text_alone_is_refused(prior):
    with pytest.raises(TypeError, match="list of texts"):
        prior.encode_prompt(PROMPT)


def test_missing_folder_is_one_sentence():
    with pytest.raises(PriorError, match="there is no local folder /no/such/prior; give a diffusers CogVideoX folder"):
        CogVideoXPrior.load("/no/such/prior")


def test_hub_id_without_network_is_one_sentence(monkeypatch):
    def offline(*_, **__):
        raise ConnectionError("Name or service not known\nlong trace")

    monkeypatch.setattr("huggingface_hub.snapshot_download", offline)
    with pytest.raises(PriorError) as raised:
        CogVideoXPrior.load("nobody/no-such-model")
    assert str(raised.value) == (
        "there is no local folder nobody/no-such-model, and it could not be downloaded from the Hugging Face hub: "
        "Name or service not known"
    )


def test_bundled_prior_without_weights_says_how_to_make_them(monkeypatch, tmp_path):
    monkeypatch.setattr(folder, "BUNDLED", tmp_path)
    with pytest.raises(PriorError, match=r"python scripts/train_bundled_prior\.py"):
        CogVideoXPrior.load("bundled")


def test_a_file_is_no_folder(tiny):
    with pytest.raises(PriorError, match=r"model_index\.json is a file"):
        CogVideoXPrior.load(tiny / "model_index.json")


def test_missing_parts_are_named(broken):
    shutil.rmtree(broken / "vae")
    shutil.rmtree(broken / "tokenizer")
    with pytest.raises(PriorError, match="is not a diffusers CogVideoX folder: it lacks vae, tokenizer"):
        CogVideoXPrior.load(broken)


@pytest.mark.parametrize(
    ("file", "changes", "message"),
    [
        (
            "transformer/config.json",
            {"_class_name": "UNet2DConditionModel"},
            "must hold a CogVideoXTransformer3DModel, found UNet2D",
        ),
        ("transformer/config.json", {"in_channels": 8}, "takes 8 channels where its VAE makes 4: an image-to-video model"),
        ("scheduler/scheduler_config.json", {"prediction_type": "epsilon"}, "must have the prediction_type v_prediction"),
    ],
)
def test_another_kind_of_model_is_refused(broken, file, changes, message):
    rewrite(broken / file, **changes)
    with pytest.raises(PriorError, match=message):
        CogVideoXPrior.load(broken)


def test_missing_and_damaged_weights_are_named(broken):
    weights = broken / "transformer" / "diffusion_pytorch_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(PriorError, match="could not be loaded"):
        CogVideoXPrior.load(broken)
    weights.unlink()
    with pytest.raises(PriorError, match=r"transformer holds no \*\.safetensors weights; download"):
        CogVideoXPrior.load(broken)


@pytest.mark.skipif(torch.cuda.is_available(), reason="only where there is no CUDA device")
def test_cuda_is_refused_where_there_is_none(tiny):
    with pytest.raises(PriorError, match="no CUDA device was found; use the device cpu"):
        CogVideoXPrior.load(tiny, "cuda")
