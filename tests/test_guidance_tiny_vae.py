"""The tiny encoder against a plain twin that walks frame by frame, and what it says to files that are none."""

import pickle

import pytest
import torch
from safetensors.torch import save_file
from torch.nn.functional import conv2d

from pgsd_nerfstudio.guidance import CogVideoXPrior, PriorError
from pgsd_nerfstudio.guidance.tiny_vae import TinyEncoder, gradient_cosine
from pgsd_nerfstudio.laboratory.tiny_cogvideox import write_tiny

STAGES = ((2, 2), (7, 2), (12, 1))
"""Position of each stage's merging layer in the published file, and how many frames it merges."""


def published() -> dict[str, torch.Tensor]:
    """Random tensors with the names and shapes of taecvx, and one of its decoder."""
    shapes = {"encoder.0.weight": (64, 3, 3, 3), "encoder.0.bias": (64,)}
    for at, frames in STAGES:
        shapes[f"encoder.{at}.conv.weight"] = (64, 64 * frames, 1, 1)
        shapes[f"encoder.{at + 1}.weight"] = (64, 64, 3, 3)
        for block in range(at + 2, at + 5):
            for layer, channels in ((0, 128), (2, 64), (4, 64)):
                shapes[f"encoder.{block}.conv.{layer}.weight"] = (64, channels, 3, 3)
                shapes[f"encoder.{block}.conv.{layer}.bias"] = (64,)
    shapes |= {"encoder.17.weight": (16, 64, 3, 3), "encoder.17.bias": (16,), "decoder.1.weight": (256, 16, 3, 3)}
    generator = torch.Generator().manual_seed(0)
    return {
        name: torch.randn(shape, generator=generator) / max(1, torch.Size(shape[1:]).numel()) ** 0.5
        for name, shape in shapes.items()
    }


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    return published()


@pytest.fixture(scope="module")
def folder(weights, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiny")
    torch.save(weights, folder / "taecvx.pth")
    return folder


@pytest.fixture(scope="module")
def tiny(folder) -> TinyEncoder:
    return TinyEncoder.load(folder)


def twin(weights, frames):
    """Latents of frames, one frame after the other, in float64; every block keeps what it saw last."""
    w = {name: tensor.double() for name, tensor in weights.items()}

    def conv(x, name, stride=1):
        return conv2d(x, w[f"encoder.{name}.weight"], w.get(f"encoder.{name}.bias"), stride, padding=1)

    stream = [conv(frame[None].double(), "0").relu() for frame in frames]
    for at, merged in STAGES:
        groups = [stream[i : i + merged] for i in range(0, len(stream), merged)]
        stream = [conv(conv2d(torch.cat(g, 1), w[f"encoder.{at}.conv.weight"]), str(at + 1), 2) for g in groups]
        for block in range(at + 2, at + 5):
            last, new = torch.zeros_like(stream[0]), []
            for x in stream:
                inner = conv(torch.cat([x, last], 1), f"{block}.conv.0").relu()
                inner = conv(conv(inner, f"{block}.conv.2").relu(), f"{block}.conv.4")
                last = x
                new.append((inner + x).relu())
            stream = new
    return torch.cat([conv(x, "17") for x in stream])


def test_latents_are_those_of_a_walk_frame_by_frame(weights, tiny):
    clip = torch.rand(8, 3, 16, 24)
    latents = tiny.encode(clip)
    assert latents.shape == (1, 2, 16, 2, 3) and latents.dtype == torch.float32
    torch.testing.assert_close(latents[0].double(), twin(weights, list(clip)), rtol=1e-4, atol=1e-5)


def test_a_clip_of_4k_plus_1_frames_is_filled_by_repeating_its_first_or_last_frame(weights, folder, tiny):
    clip = torch.rand(9, 3, 16, 16)
    late = TinyEncoder.load(folder, padding="end")
    for encoder, frames in ((tiny, [clip[0]] * 3 + list(clip)), (late, list(clip) + [clip[8]] * 3)):
        torch.testing.assert_close(encoder.encode(clip)[0].double(), twin(weights, frames), rtol=1e-4, atol=1e-5)


def test_a_latent_sees_the_frames_up_to_that_of_its_place_in_cogvideox_and_none_later(tiny):
    clip = torch.rand(9, 3, 16, 16, requires_grad=True)
    latents = tiny.encode(clip)
    for k in range(3):
        (gradient,) = torch.autograd.grad(latents[0, k].square().sum(), clip, retain_graph=True)
        seen = gradient.flatten(1).norm(dim=1) > 0
        assert seen[4 * k] and not seen[4 * k + 1 :].any()
        assert seen[max(0, 4 * k - 3) : 4 * k + 1].all()


def test_both_file_formats_hold_the_same_encoder(weights, tiny, tmp_path):
    save_file(weights, tmp_path / "taecvx.safetensors")
    other, clip = TinyEncoder.load(tmp_path / "taecvx.safetensors"), torch.rand(5, 3, 16, 16)
    assert torch.equal(other.encode(clip), tiny.encode(clip))
    assert not any(p.requires_grad for p in other.parameters())


def test_an_encoder_agrees_with_itself_and_not_with_another(weights, tiny, tmp_path):
    mirrored = {name: -tensor if name.startswith("encoder.17") else tensor for name, tensor in weights.items()}
    torch.save(mirrored, tmp_path / "taecvx.pth")
    clip = torch.rand(9, 3, 16, 16)
    assert gradient_cosine(tiny, tiny, clip) == pytest.approx(1.0, abs=1e-9)
    assert gradient_cosine(tiny, TinyEncoder.load(tmp_path), clip) == pytest.approx(-1.0, abs=1e-9)
    assert abs(gradient_cosine(tiny, TinyEncoder(), clip)) < 0.5


def test_cosine_is_of_the_gradient_that_is_carried_back(tiny):
    class Scaled:
        """Twice the first latent frame, minus the others: the direction agrees or opposes, by what is carried back."""

        def encode(self, clip):
            return tiny.encode(clip) * torch.tensor([2.0, -1.0, -1.0])[None, :, None, None, None]

    clip, first, last = torch.rand(9, 3, 16, 16), torch.zeros(1, 3, 16, 2, 2), torch.zeros(1, 3, 16, 2, 2)
    first[:, 0], last[:, 2] = 1.0, 1.0
    assert gradient_cosine(tiny, Scaled(), clip, first) == pytest.approx(1.0, abs=1e-6)
    assert gradient_cosine(tiny, Scaled(), clip, last) == pytest.approx(-1.0, abs=1e-6)


def test_a_gradient_of_zero_has_no_direction(tiny):
    with pytest.raises(PriorError, match="finite and not zero"):
        gradient_cosine(tiny, tiny, torch.rand(1, 3, 16, 16), torch.zeros(1, 1, 16, 2, 2))


@pytest.fixture(scope="module")
def prior(tmp_path_factory) -> CogVideoXPrior:
    """A random prior with 16 latent channels, which the tiny encoder fits."""
    return CogVideoXPrior.load(write_tiny(tmp_path_factory.mktemp("prior16"), latent_channels=16))


def test_a_prior_encodes_through_the_tiny_encoder_and_is_itself_unchanged(prior, tiny):
    clip = torch.rand(9, 3, 32, 48)
    own = prior.encode(clip)
    cheap = prior.through(tiny)
    assert torch.equal(cheap.encode(clip), tiny.encode(clip)) and cheap.encode(clip).shape == own.shape
    assert torch.equal(prior.encode(clip), own)
    text = torch.rand(1, 12, 16)
    assert torch.equal(cheap.predict_v(own, 500, text), prior.predict_v(own, 500, text))
    assert -1 <= gradient_cosine(prior, tiny, clip) <= 1 and gradient_cosine(prior, prior, clip) == pytest.approx(1.0)
    with pytest.raises(ValueError, match=r"4k \+ 1 frames, found 8"):
        cheap.encode(clip[:8])


def test_a_prior_with_other_latents_is_refused(tiny, tmp_path):
    small = CogVideoXPrior.load(write_tiny(tmp_path / "small"))
    with pytest.raises(PriorError, match=r"16 latent channels, 8 pixels and 4 frames per latent, .* has 4, 8 and 4"):
        small.through(tiny)
    with pytest.raises(PriorError, match=r"one shape, found \[1, 3, 16, 4, 6\] for \[1, 3, 4, 4, 6\]"):
        gradient_cosine(small, tiny, torch.rand(9, 3, 32, 48))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w: w.pop("encoder.4.conv.2.bias"), r"not hold the weights of taecvx: it lacks encoder\.4\.conv\.2\.bias$"),
        (lambda w: w.update({"scale": torch.ones(1)}), "it has an unknown scale$"),
        (lambda w: w.update({"encoder.17.bias": torch.ones(48)}), r"encoder\.17\.bias of shape \[48\] where \[16\] belongs$"),
        (lambda w: [w.pop(n) for n in list(w) if n.startswith("encoder.0")], r"lacks encoder\.0\.weight, and 1 more such"),
    ],
)
def test_a_file_with_missing_unknown_or_misshapen_tensors_is_refused(weights, tmp_path, change, message):
    changed = dict(weights)
    change(changed)
    torch.save(changed, tmp_path / "taecvx.pth")
    with pytest.raises(PriorError, match=message):
        TinyEncoder.load(tmp_path)


class Intruder:
    """Would run code when unpickled without care."""

    def __reduce__(self):
        return (print, ("code of a weights file ran",))


def test_a_pickle_that_wants_to_run_code_is_not_run(tmp_path, capsys):
    with (tmp_path / "taecvx.pth").open("wb") as stream:
        pickle.dump(Intruder(), stream, protocol=2)
    with pytest.raises(PriorError, match="could not be read: ") as raised:
        TinyEncoder.load(tmp_path)
    assert "\n" not in str(raised.value)
    torch.save(Intruder(), tmp_path / "taecvx.pth")
    with pytest.raises(PriorError, match="could not be read: "):
        TinyEncoder.load(tmp_path)
    assert "ran" not in capsys.readouterr().out


def test_what_is_no_weights_file_is_refused_in_one_sentence(tmp_path):
    with pytest.raises(PriorError, match=r"must hold taecvx\.safetensors or taecvx\.pth; download"):
        TinyEncoder.load(tmp_path)
    with pytest.raises(PriorError, match="is not there; download"):
        TinyEncoder.load(tmp_path / "none.pth")
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(PriorError, match="is another kind of file; download"):
        TinyEncoder.load(tmp_path / "notes.txt")
    torch.save([1, 2], tmp_path / "taecvx.pth")
    with pytest.raises(PriorError, match="must be a dictionary of tensors, found list"):
        TinyEncoder.load(tmp_path)


@pytest.mark.mistyped
def test_odd_sizes_and_paddings_are_refused(tiny):
    with pytest.raises(ValueError, match="multiples of 8, found 20x16"):
        tiny.encode(torch.rand(1, 3, 20, 16))
    with pytest.raises(ValueError, match="front or end, got 'middle'"):
        TinyEncoder("middle")  # type: ignore[arg-type]
