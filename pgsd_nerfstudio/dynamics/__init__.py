"""The neural dynamics field: what is learned of motion and look, rolled out over time from the simulated motion."""

from pgsd_nerfstudio.dynamics.deformation import Deformation, DeformationConfig, DeformedCloud, scattered
from pgsd_nerfstudio.dynamics.drift import Gap, drift, gaps
from pgsd_nerfstudio.dynamics.field import DeltaBounds, DynamicsField, FieldConfig
from pgsd_nerfstudio.dynamics.look import LearnedLook
from pgsd_nerfstudio.dynamics.regularizers import RegularizationWeights, regularization
from pgsd_nerfstudio.dynamics.rollout import Motion, Rollout
from pgsd_nerfstudio.dynamics.rollout_frame import RolloutFrame
from pgsd_nerfstudio.dynamics.sequence import Begin, GaussianSequence
from pgsd_nerfstudio.dynamics.velocity_field import VelocityField

__all__ = [
    "Begin",
    "Deformation",
    "DeformationConfig",
    "DeformedCloud",
    "DeltaBounds",
    "DynamicsField",
    "FieldConfig",
    "Gap",
    "GaussianSequence",
    "LearnedLook",
    "Motion",
    "RegularizationWeights",
    "Rollout",
    "RolloutFrame",
    "VelocityField",
    "drift",
    "gaps",
    "regularization",
    "scattered",
]
