"""One door for both families of priors: a folder says itself which class opens it."""

import pytest
import torch
from wan_tiny import tiny_wan

from pgsd_nerfstudio.guidance import CogVideoXPrior, PriorError, VideoPrior, WanPrior, load_prior
from pgsd_nerfstudio.laboratory.tiny_cogvideox import write_tiny


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A model of CogVideoX and one of Wan."""
    cogvideox, wan = (tmp_path_factory.mktemp(name) for name in ("cogvideox", "wan"))
    tiny_wan().save_pretrained(wan)
    return write_tiny(cogvideox), wan


def test_a_folder_is_opened_by_the_class_of_its_family(folders):
    for folder, kind in zip(folders, (CogVideoXPrior, WanPrior), strict=True):
        prior, own = load_prior(folder, "cpu", torch.float64, frames=13), kind.load(folder, frames=13)
        assert type(prior) is kind and isinstance(prior, VideoPrior)
        assert prior.dtype == torch.float64 and prior.clip_shape == own.clip_shape and prior.clip_shape[0] == 13
        assert torch.equal(prior.alphas_cumprod, own.alphas_cumprod)


def test_a_class_refuses_the_folder_of_the_other_family(folders):
    cogvideox, wan = folders
    expected = "must hold a WanTransformer3DModel, found CogVideoXTransformer3DModel; use a Wan model"
    with pytest.raises(PriorError, match=expected):
        WanPrior.load(cogvideox)
    expected = "must hold a CogVideoXTransformer3DModel, found WanTransformer3DModel; use a CogVideoX model"
    with pytest.raises(PriorError, match=expected):
        CogVideoXPrior.load(wan)


def test_a_folder_of_neither_family_is_told_what_a_cogvideox_folder_holds(tmp_path):
    with pytest.raises(PriorError, match="not a diffusers CogVideoX folder: it lacks transformer, vae"):
        load_prior(tmp_path)
    with pytest.raises(PriorError, match="there is no local folder /no/such/prior"):
        load_prior("/no/such/prior")
