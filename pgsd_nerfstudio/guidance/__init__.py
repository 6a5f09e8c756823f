"""Score distillation from a video diffusion model. This room sees only clips and knows nothing of Gaussians."""

from pgsd_nerfstudio.guidance.cogvideox import CogVideoXPrior
from pgsd_nerfstudio.guidance.distillation import DistillationConfig, Distilled, DistilledClip, distill, distill_clip
from pgsd_nerfstudio.guidance.folder import PriorError
from pgsd_nerfstudio.guidance.loading import load_prior
from pgsd_nerfstudio.guidance.prompts import Prompts, embed_texts, prompts_for
from pgsd_nerfstudio.guidance.schedules import TimestepSchedule, WeightDecay, Weighting, regularization_scale
from pgsd_nerfstudio.guidance.variants import Embeddings, Omega, Role, Variant, roles_of
from pgsd_nerfstudio.guidance.video_prior import VideoPrior
from pgsd_nerfstudio.guidance.wan import WanPrior

__all__ = [
    "CogVideoXPrior",
    "DistillationConfig",
    "Distilled",
    "DistilledClip",
    "Embeddings",
    "Omega",
    "PriorError",
    "Prompts",
    "Role",
    "TimestepSchedule",
    "Variant",
    "VideoPrior",
    "WanPrior",
    "WeightDecay",
    "Weighting",
    "distill",
    "distill_clip",
    "embed_texts",
    "load_prior",
    "prompts_for",
    "regularization_scale",
    "roles_of",
]
