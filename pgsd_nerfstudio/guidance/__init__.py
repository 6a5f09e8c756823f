"""TAUGHT: video diffusion. Sees only clips, knows nothing of Gaussians."""

from pgsd_nerfstudio.guidance.distillation import DistillationConfig, Distilled, DistilledClip, distill, distill_clip
from pgsd_nerfstudio.guidance.folder import PriorError
from pgsd_nerfstudio.guidance.prior import VideoPrior
from pgsd_nerfstudio.guidance.schedules import TimestepSchedule, Weighting, regularization_scale

__all__ = [
    "DistillationConfig",
    "Distilled",
    "DistilledClip",
    "PriorError",
    "TimestepSchedule",
    "VideoPrior",
    "Weighting",
    "distill",
    "distill_clip",
    "regularization_scale",
]
